"""What of ours, and of others, is entered for each public set: the file ``choices.toml``, read and checked."""

from __future__ import annotations

import itertools
import tomllib
from pathlib import Path
from typing import Any

import msgspec

from harness.benchmark.public.rules import RULES
from harness.errors import UNREADABLE, InputError

CHOICES = Path(__file__).with_name("choices.toml")


class Candidate(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Identifiers that differ in their options: every combination of the values in ``grid``, with ``options``."""

    id: str
    options: dict[str, Any] = {}
    grid: dict[str, list[Any]] = {}
    rows: int | None = None
    """Samples at the start of each record that it learns from, where all would take too long."""

    def variants(self) -> list[dict[str, Any]]:
        """Return the options of each.

        Examples
        --------
        >>> Candidate(id="arx", grid={"order": [2, 3]}, options={"offset": True}).variants()
        [{'offset': True, 'order': 2}, {'offset': True, 'order': 3}]
        """
        combinations = itertools.product(*self.grid.values())
        return [{**self.options, **dict(zip(self.grid, values, strict=True))} for values in combinations]


class BlackChoices(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The identifiers among which the validation part chooses, and how large this part is."""

    validation: float
    """Share of the records to learn from: the end of each, or whole ones at the end where there are four and more."""
    candidates: list[Candidate]


class GreyChoice(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What the loop starts from: a registered recording, or a model by its name."""

    recording: str = ""
    """Recipe whose nominal model, signals and estimation and validation runs are used; its test runs are not shown."""
    model: str = ""
    """Nominal model, for a set without a recipe; the end of each record then validates."""
    options: dict[str, Any] = {}
    validation: float = 0.25
    grow: int = 0
    """So many effects more are added at most, to the nominal model and to what the loop ended with, where they bring
    the set's own figure over halves of the records down (:mod:`harness.benchmark.public.structures`)."""


class SetChoices(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What is entered for one set."""

    black: BlackChoices | None = None
    grey: GreyChoice | None = None
    peers: list[Candidate] = []
    """Plug-ins of other packages, a row each, chosen on the same validation part; a missing one is a row that says
    so."""


Choices = dict[str, SetChoices]


def read_choices(path: str | Path | None = None) -> Choices:
    """Return what is entered for each set.

    Raises InputError if the file is missing or no TOML, or names an unknown set or key.

    - ``path``: by default the declared choices of this program

    Examples
    --------
    >>> "black" in str(read_choices()["silverbox"])
    True
    """
    file = CHOICES if path is None else Path(path)
    try:
        found = msgspec.convert(tomllib.loads(file.read_text(encoding="utf-8")), Choices)
    except (*UNREADABLE, msgspec.ValidationError) as error:
        raise InputError(
            "choices of the public table",
            expected="a TOML file of sets with black, grey and peers",
            got=" ".join(str(error).split())[:200],
            remedy="repair it (docs/public.md shows the keys)",
            file=file,
        ) from error
    unknown = sorted(set(found) - set(RULES))
    wrong = [name for name, one in found.items() if one.black is not None and not 0.0 < one.black.validation < 1.0]
    if unknown or wrong:
        raise InputError(
            "choices of the public table", expected=f"sets among {', '.join(RULES)}, shares between 0 and 1",
            got=", ".join(unknown + wrong), remedy="correct them", file=file,
        )  # fmt: skip
    return found
