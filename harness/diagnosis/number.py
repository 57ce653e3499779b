"""A number with its reason, as a field of the options that hold it."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, fields
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from _typeshed import DataclassInstance


@dataclass(frozen=True)
class Number:
    """Why a number is what it is."""

    reason: str
    source: str
    tuned_on: str = "nothing"


def number(value: Any, reason: str, source: str, tuned_on: str = "nothing") -> Any:
    """Return a field of a dataclass: its value, the reason, where that is from, and what it was tuned on."""
    return field(default=value, metadata={"number": Number(reason, source, tuned_on)})


def described(numbers: DataclassInstance) -> dict[str, dict[str, Any]]:
    """Return every number with its reason, for ``report.json``.

    Examples
    --------
    >>> from harness.diagnosis.policy import POLICY
    >>> described(POLICY)["evidence"]["value"]
    5.0
    """
    values = asdict(numbers)
    found = {}
    for entry in fields(numbers):
        why: Number = entry.metadata["number"]
        found[entry.name] = {"value": values[entry.name], **asdict(why)}
    return found
