"""Vetting: what somebody wants to know of an FMU before it is handed on, and whether a run agrees with a reference.

``described`` reads the description, ``runs`` runs the FMU in processes of their own, ``inside`` is what those processes
do, ``tubes`` and ``reference`` compare with a record, ``findings`` and ``page`` say what was tried and what came. A
newcomer adds a check to the list of the file that it belongs to. May import the rooms below ``harness.conformance``,
and that one.
"""

from harness.vetting.findings import Finding, Vetting
from harness.vetting.reference import Agreement, agreement
from harness.vetting.tubes import Tube
from harness.vetting.vet import vet

__all__ = ["Agreement", "Finding", "Tube", "Vetting", "agreement", "vet"]
