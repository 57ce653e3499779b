"""Figures that others published, from the file ``published.toml``: facts with their sources."""

from __future__ import annotations

import tomllib
from functools import cache
from pathlib import Path
from typing import Literal

import msgspec

from harness.benchmark.public.rules import RULES

PUBLISHED = Path(__file__).with_name("published.toml")


class Published(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What one method reached on one set, in the set's unit.

    ``rule`` is ``new`` where the figure was made under the window of the rule, ``old`` under another window or another
    start, ``unknown`` where nobody has looked; ``n`` is its window. ``read_by`` names a reading each: ``source`` of the
    source itself (the paper, or what its authors published of its results), ``list`` of somebody's list. ``note`` says
    what the source shows beside the figure.
    """

    method: str
    figures: dict[str, float]
    source: str
    year: int
    rule: Literal["new", "old", "unknown"]
    read_by: list[Literal["source", "list"]]
    n: int | None = None
    note: str = ""

    @property
    def read(self) -> str:
        """How often somebody compared its figures with their source.

        Examples
        --------
        >>> best_published("fine-steering-mirror", "100 mV")[1].read
        'source read twice'
        """
        times = self.read_by.count("source")
        return ("from a list", "source read once", "source read twice")[min(times, 2)]

    @property
    def mark(self) -> str:
        """What stands behind its figures: ``*`` for another window or start, ``?`` where that is not known.

        Examples
        --------
        >>> best_published("emps", "force pulses")[1].mark
        '*'
        """
        return {"new": "", "old": "*", "unknown": "?"}[self.rule]


@cache
def published() -> dict[str, tuple[Published, ...]]:
    """Return the published figures of each set."""
    found = msgspec.convert(tomllib.loads(PUBLISHED.read_text(encoding="utf-8")), dict[str, list[Published]])
    return {id: tuple(found.get(id, ())) for id in RULES}


def known_figures(id: str, test: str) -> list[tuple[float, Published]]:
    """Return the published figures of a test record, the least first, and whose they are.

    Examples
    --------
    >>> known_figures("silverbox", "arrow")[0][0]
    0.26
    """
    known = [(one.figures[test], one) for one in published()[id] if test in one.figures]
    return sorted(known, key=lambda pair: pair[0])


def best_published(id: str, test: str) -> tuple[float, Published] | None:
    """Return the least published figure of a test record, and whose it is; None where there is none.

    Examples
    --------
    >>> best_published("silverbox", "arrow")[0]
    0.26
    """
    known = known_figures(id, test)
    return known[0] if known else None
