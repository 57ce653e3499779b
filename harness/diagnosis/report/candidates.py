"""What a diagnosis stands for, and one row for every candidate: how it was judged, and why it is not in the answer."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.diagnosis.report.estimates import estimate, known
from harness.diagnosis.report.refusals import refusals_text
from harness.diagnosis.runs.fitted import Fitted
from harness.diagnosis.search.compare import Judged
from harness.diagnosis.search.fit import Fit
from harness.diagnosis.search.refusal import Kind, Refusal
from harness.diagnosis.search.table import Accepted

if TYPE_CHECKING:
    from harness.diagnosis.diagnosis import Diagnosis

NO_FINDING = "the model does not fit these data: nothing is accepted"


@dataclass(frozen=True, eq=False)
class Conclusion:
    """What a diagnosis stands for: where the model does not fit, the nominal one and nothing beside it."""

    accepted: tuple[Accepted, ...]
    fit: Fit
    runs: Fitted | None


def answer_of(found: Diagnosis) -> Conclusion:
    """Return what a diagnosis stands for."""
    if found.misfit:
        return Conclusion((), found.nominal, found.runs.before)
    return Conclusion(tuple(found.outcome.accepted), found.final, found.runs.after)


def candidate_rows(found: Diagnosis, together: Sequence[str]) -> list[dict[str, Any]]:
    """Return one row for each refit of each round, then what the score test set aside."""
    accepted = {str(effect.placed) for effect in answer_of(found).accepted}
    tied = {str(p) for effect in answer_of(found).accepted for member in effect.tie for p in member} - accepted
    rows = []
    for number, step in enumerate(found.outcome.rounds, start=1):
        ranked = sorted(
            step.candidates, key=lambda judged: -np.inf if judged.comparison is None else -judged.comparison.total
        )
        rows += [_row(judged, number, accepted, tied, together, fits=not found.misfit) for judged in ranked]
        refitted = {judged.name for judged in step.candidates}
        dear = frozenset(found.untried if number == len(found.outcome.rounds) else ())  # where the search ended
        for lead in [*step.test.leads, *step.test.hidden]:
            if str(lead.placed) in refitted:
                continue
            if lead.share < found.policy.seen:
                reason = "cannot be told from the nominal parameters"
            elif str(lead.placed) in step.left:
                reason = _behind(str(lead.placed), dear)
            else:
                reason = "the score test promises less"
            rows.append(_aside(str(lead.placed), number, reason, lead.gain))
        tested = {str(lead.placed) for lead in (*step.test.leads, *step.test.hidden)}
        rows += [  # what no first-order test sees, as play and hidden resonances, promises nothing
            _aside(name, number, _behind(name, dear)) for name in sorted(step.left - refitted - tested)
        ]
    return rows


def _aside(name: str, number: int, reason: str, promise: float | None = None) -> dict[str, Any]:
    """Return the row of a candidate that was not refitted to its end."""
    effect, _, at = name.partition("@")
    return {
        "name": effect,
        "at": at,
        "round": number,
        "refitted": False,
        "accepted": False,
        "reason": reason,
        "promise": known(promise),
        "evidence": None,
    }


def _row(
    judged: Judged, number: int, accepted: set[str], tied: set[str], together: Sequence[str] = (), *, fits: bool = True
) -> dict[str, Any]:
    """Return the row of one refitted candidate."""
    reason = refusals_text(judged.refusals)
    if judged.passed and not fits:
        reason = NO_FINDING
    elif judged.passed and judged.name not in accepted:
        reason = "tied with the answer" if judged.name in tied else "another candidate explains more"
    compared = judged.comparison
    return {
        "name": " + ".join(p.effect.name for p in judged.added),
        "at": ", ".join(p.at for p in judged.added),
        "round": number,
        "refitted": True,
        "converged": bool(judged.fit is not None and judged.fit.converged),
        "accepted": judged.name in accepted and judged.passed,
        "passed": judged.passed,
        "reason": reason,
        "evidence": known(None if compared is None else compared.evidence),
        "validation_gain": known(None if compared is None else compared.validation),
        "validation_error": known(None if compared is None else compared.error),
        "total_error": known(None if compared is None else compared.total_error),
        "main": {}
        if judged.fit is None
        else {
            name: [estimate(judged.fit, name, together)[key] for key in ("value", "low", "high")]
            for name in (p.main() for p in judged.added)
            if name is not None and name in judged.fit.free
        },
    }


def _behind(name: str, dear: Collection[str]) -> str:
    """Return why a refit that was begun was not finished."""
    if name in dear:
        return refusals_text([Refusal(Kind.COST)])
    return "the first steps of its refit gained too little"
