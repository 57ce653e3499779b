"""One judge of records for all identifiers: whether anything beside the controller moves the inputs.

``feedback`` tests whether outputs foretell an input, ``law`` finds the law that it then follows, ``refusals`` says so.
"""

from __future__ import annotations

from harness.judgement.feedback import ALONE, NEW, Feedback, feedback_of, moves, reached_at_once, taken_up_at_once
from harness.judgement.law import Law, dependence_text, law_of
from harness.judgement.refusals import refuse_law, refuse_undetermined

__all__ = [
    "ALONE",
    "NEW",
    "Feedback",
    "Law",
    "dependence_text",
    "feedback_of",
    "law_of",
    "moves",
    "reached_at_once",
    "refuse_law",
    "refuse_undetermined",
    "taken_up_at_once",
]
