"""The figures that a study is run for: right with no rival tied first, and how large the tie sets are."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

from sysid_lab.outcome import has_double
from sysid_lab.pages.statistics import clopper_pearson

Row = dict[str, str]
GOOD = ("right", "tied")
DISTURBANCE = ((False, "without"), (True, "with"))
SURE = 0.95
"""Power from which on an experiment is said to tell two models apart: as much as is asked of the answers there."""


def alone(row: Row) -> bool:
    """Return whether an answer is the truth, and no rival is tied with it.

    Examples
    --------
    >>> alone({"outcome": "right", "tie_size": "3"})
    False
    """
    return row["outcome"] == "right" and int(row["tie_size"] or 0) <= 1


def figures(rows: Sequence[Row]) -> str:
    """Return the figures as a table."""
    foreign = [row for row in rows if row["engine"] in ("bullet", "pymunk", "hardware")]
    lines = [
        "| figure | reached |",
        "|---|---|",
        *_lines_alone(rows),
        *_lines_by_size(rows),
        *_lines_by_structure(rows),
    ]
    if foreign:
        lines.append(f"| right or tied, truth by Bullet, pymunk or other laws | {_of(_good, foreign)} |")
    lines.append(f"| named with confidence, and wrong | {_of(lambda row: row['outcome'] == 'wrong', rows)} |")
    return "\n".join([*lines, *_lines_doubted(rows), *_lines_beside_oracle(rows)])


def _lines_alone(rows: Sequence[Row]) -> Iterator[str]:
    """Yield how often an answer was right with no rival tied, and what limits it; without and with disturbance."""
    for shaken, words in DISTURBANCE:
        here = [row for row in rows if _shaken(row) == shaken]
        if not here:
            continue
        yield f"| **right, no rival tied**, {words} disturbance | {_of(alone, here)} |"
        able = [row for row in here if not has_double(row["truth"].split(" + "), row["plant"], row["engine"])]
        if able and len(able) < len(here):
            yield f"| the same where nothing is exactly like the truth, {words} | {_of(alone, able)} |"
        told = [row for row in able if row["told"] and float(row["told"]) >= SURE]
        if told:
            yield f"| the same where the experiment can tell it apart, {words} | {_of(alone, told)} |"
        yield f"| sizes of the tie sets of right or tied answers, {words} disturbance | {_sizes(here)} |"


def _lines_by_size(rows: Sequence[Row]) -> Iterator[str]:
    """Yield how often an answer was right or tied, by the size of what is hidden and by disturbance."""
    for level in ("nominal", "quarter"):
        for shaken, word in DISTURBANCE:
            here = [row for row in rows if row["level"] == level and _shaken(row) == shaken]
            if not here:
                continue
            words = f"{level} size, {word} disturbance"
            yield f"| right or tied, {words} | {_of(_good, here)} |"
            shown = [row for row in here if row["shown"] and float(row["shown"]) >= SURE]
            if shown and len(shown) < len(here):
                yield f"| the same where the experiment can show it, {words} | {_of(_good, shown)} |"


def _lines_by_structure(rows: Sequence[Row]) -> Iterator[str]:
    """Yield how often an answer was right or tied, where some nominal structures are a little wrong."""
    for words, wrong in (("right", False), ("a little wrong", True)):
        here = [row for row in rows if bool(row["structure"]) == wrong]
        if here and len(here) < len(rows):
            yield f"| right or tied, nominal structure {words} | {_of(_good, here)} |"


def _lines_doubted(rows: Sequence[Row]) -> Iterator[str]:
    """Yield how often a report doubts an answer that is right or tied."""
    doubted = [row for row in rows if _good(row) and row["stand_in"]]
    if doubted:
        yield f"| right or tied, but called a stand-in | {share(len(doubted), len(rows))} |"
        beside = [row for row in doubted if row["parts"]]
        yield f"| right or tied, beside effects said to be parts of what is left | {share(len(beside), len(rows))} |"


def _lines_beside_oracle(rows: Sequence[Row]) -> Iterator[str]:
    """Yield how near errors come to those of a fit that knows the truth."""
    compared = [row for row in rows if row["ratio"]]
    if compared:
        near = [row for row in compared if _good(row) and float(row["ratio"]) <= 1.1]
        words = "right or tied, and its validation error within 1.1 of the oracle's"
        yield f"| {words} | {share(len(near), len(compared))} |"
    for noise, factor in (("high", 10), ("low", 100)):
        known = [row for row in rows if row["noise"] == noise and row["oracle_improvement"] and row["improvement"]]
        able = [row for row in known if float(row["oracle_improvement"]) >= factor]
        reached = "the oracle's never"
        if able:
            reached = share(sum(float(row["improvement"]) >= factor / 1.1 for row in able), len(able))
        if known:
            yield f"| error falls {factor}x (less 10 %) if the oracle's does, {noise} noise | {reached} |"


def share(found: int, of: int) -> str:
    """Return a share with its 95 % interval.

    Examples
    --------
    >>> share(9, 10)
    '9 of 10 (90.0 %, 95 % interval 55 to 100 %)'
    """
    low, high = clopper_pearson(found, of)
    return f"{found} of {of} ({100 * found / of:.1f} %, 95 % interval {100 * low:.0f} to {100 * high:.0f} %)"


def _shaken(row: Row) -> bool:
    """Return whether an unknown torque disturbed the records."""
    return float(row["disturbance"]) > 0


def _good(row: Row) -> bool:
    return row["outcome"] in GOOD


def _of(test: Callable[[Row], bool], rows: Sequence[Row]) -> str:
    """Return the share of rows that a test holds for."""
    return share(sum(test(row) for row in rows), len(rows))


def _sizes(rows: Sequence[Row]) -> str:
    """Return how many tie sets hold one, two, three, and more."""
    sizes = [max(1, int(row["tie_size"] or 0)) for row in rows if _good(row)]
    parts = [f"{k}: {sum(size == k for size in sizes)}" for k in (1, 2, 3)]
    return ", ".join([*parts, f"4 or more: {sum(size > 3 for size in sizes)}"])
