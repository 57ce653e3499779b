"""Tables as programs print them: each title ends where the numbers below it end, the index stands before them."""

from __future__ import annotations

import re
from collections.abc import Sequence

from harness.data.tables.cells import EMPTY, is_number
from harness.data.tables.keyed import Line
from harness.errors import InputError

FEWEST = 3  # Rows of a table.
_OUT = re.compile(r"\.{2,3}(?:\s+\.{3})*")  # The row that stands for those that pandas leaves out.
_SHAPE = re.compile(r"\[\d+ rows x \d+ columns\]")


def printed(lines: Sequence[Line]) -> tuple[list[Line], str] | None:
    r"""Return the table that pandas prints, with tabs between its cells, and what to say; None for any other lines.

    Titles may hold blanks, so that only the places of their ends tell them apart. An index without a name that counts
    the rows is left out.

    Raises InputError if rows are left out, as in what ``print`` shows of a long table.

    Examples
    --------
    >>> rows = ["   time  motor torque", "0  0.00         1.500", "1  0.01        -0.500", "2  0.02         0.250"]
    >>> printed(list(enumerate(rows, start=1)))[0][:2]
    [(1, 'time\tmotor torque'), (2, '0.00\t1.500')]
    """
    if len(lines) <= FEWEST or not (head := lines[0][1].rstrip()).startswith(" ") or "\t" in head:
        return None
    width = len(head)
    named = lines[1][1].strip() if not any(map(is_number, lines[1][1].split())) else ""
    rows = [(number, line.rstrip()) for number, line in lines[2 if named else 1 :]]
    if _SHAPE.fullmatch(rows[-1][1]):
        rows.pop()
    left_out = [number for number, row in rows if _OUT.fullmatch(row)]
    kept = [(number, row) for number, row in rows if number not in left_out]
    if len(kept) < FEWEST or any(len(row) != width for _, row in kept):
        return None
    ends = sorted(set.intersection(*({one.end() for one in re.finditer(r"\S+", row)} for _, row in kept)))
    titles = [head[begin:end].strip() for begin, end in zip([0, *ends], ends, strict=False)]
    while titles and not titles[0]:  # what ends together before the first title is the index
        titles, ends = titles[1:], ends[1:]
    if not titles or not all(titles):
        return None
    table = [(number, _cells(row, ends)) for number, row in kept]
    if not all(is_number(cell) or cell.lower() in EMPTY for _, (_, cells) in table for cell in cells[:1]):
        return None
    indexed = [bool(index) for _, (index, _) in table]
    if any(indexed) and not all(indexed):
        return None
    if left_out:
        raise InputError(
            "a printed table without all its rows",
            expected="every row",
            got=f"'...' in line {left_out[0]}",
            remedy='write the frame by df.to_csv("log.csv"), or print df.to_string()',
            place=f"line {left_out[0]}",
        )
    counts = not named and all(index == str(k) for k, (_, (index, _)) in enumerate(table))
    if not any(indexed) or counts:
        body = [(number, "\t".join(cells)) for number, (_, cells) in table]
    else:
        titles = [named, *titles]
        body = [(number, "\t".join((index, *cells))) for number, (index, cells) in table]
    return [(lines[0][0], "\t".join(titles)), *body], "each title is that of the numbers which end where it does"


def _cells(row: str, ends: Sequence[int]) -> tuple[str, list[str]]:
    """Return the index of a row, empty for none, and the cells that end at these places."""
    first, *others = (row[begin:end].strip() for begin, end in zip([0, *ends], ends, strict=False))
    *index, cell = first.split() or [""]
    return " ".join(index), [cell, *others]
