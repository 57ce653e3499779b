"""Headers of several rows: groups above names, names above units, as merged cells and motion capture have them."""

from __future__ import annotations

import re
from collections.abc import Sequence

from harness.data.tables.cells import is_number, is_unit_cell, units_below
from harness.data.times.stamps import is_time

MOST_ROWS = 6
"""Rows that a header may have."""
UNEVEN = 0.2
"""Part of a step by which two steps differ where numbers are no clock."""

_LETTER = re.compile(r"[^\W\d_]|[\[(<{°%]")
_BRACKETED = re.compile(r"[\[({<](?P<unit>[^\[\](){}<>]+)[\])}>]")


def stacked_titles(rows: Sequence[Sequence[str]]) -> tuple[list[str], int] | None:
    """Return the titles that several rows give together, and how many rows these are; None where one row does.

    The lowest row that names every column once gives the names. Where there is none, a column's lowest text is its
    name, with those above it in front (``left.X``) as far as names would be shared; an empty cell of an upper row
    belongs to the text on its left, as cells are merged. A row of units stands below them all.

    Parameters
    ----------
    rows : sequence of sequence of str
        The first rows of a table, numbers included, all cells without blanks about them.

    Returns
    -------
    (titles, count), or None
        None also where two rows name every column once: nobody can say which are the names.

    Examples
    --------
    >>> stacked_titles([["Zeit", "Motor", ""], ["", "u", "y"], ["s", "V", "rad"], ["0", "1", "2"]])
    (['Zeit [s]', 'u [V]', 'y [rad]'], 3)
    >>> stacked_titles([["", "left", "", "right"], ["t", "X", "Y", "X"], ["0", "1", "2", "3"]])
    (['t', 'left.X', 'Y', 'right.X'], 2)
    >>> stacked_titles([["t", "u"], ["0", "1"]]) is None
    True
    """
    rows, named = _with_index_name(rows)
    count = _head_rows(rows)
    if count < 2:
        return None
    width = len(rows[0])
    head = [list(row) for row in rows[:count]]
    units = head.pop() if all(is_unit_cell(cell) for cell in head[-1] if cell) else [""] * width
    if len(head) < 2 and not any(_BRACKETED.fullmatch(cell) for row in head for cell in row):
        return None  # one row of names: with units below it or without
    for row in head:
        for k, cell in enumerate(row):
            found = _BRACKETED.fullmatch(cell)
            if found is not None and is_unit_cell(found["unit"]):
                row[k], units[k] = "", units[k] or cell
    used = [k for k, cell in enumerate(rows[count]) if cell]
    names = _names(head, used)
    if names is None:
        return None
    titles = units_below(names, units) if any(units) else names
    return None if titles is None else (titles, count + named)


def are_counted(rows: Sequence[Sequence[str]]) -> bool:
    """Return True if the first row numbers the columns, as pandas titles them, and is no reading.

    It counts from 0 or 1, while every column below holds decimals, and the first column goes on otherwise: from 0, 1 to
    0.01, 0.98 a time and a reading begin.

    Examples
    --------
    >>> are_counted([["0", "1"], ["0.25", "-1.5"], ["0.75", "2.5"]])
    True
    >>> are_counted([["0", "1"], ["0.01", "0.98"], ["0.02", "0.95"]]), are_counted([["0", "1"], ["1", "0"]])
    (False, False)
    """
    titles = list(rows[0])
    names = titles[1:] if not titles[0] else titles
    if len(rows) < 3 or not any(names == [str(first + k) for k in range(len(names))] for first in (0, 1)):
        return False
    columns = list(zip(*(row for row in rows[1:] if len(row) == len(titles)), strict=True))
    if not all(re.search("[.eE]", cell) for column in columns[-len(names) :] for cell in column if cell):
        return False
    if not titles[0]:
        return True
    first = [float(row[0]) for row in rows[:3] if is_number(row[0])]
    return len(first) < 3 or abs(first[2] - 2 * first[1] + first[0]) > UNEVEN * abs(first[2] - first[1])


def is_reading(rows: Sequence[Sequence[str]]) -> bool:
    """Return True for a first row that is one of readings: numbers and times where others have them, the same words.

    Examples
    --------
    >>> is_reading([["7", "base", "1.5"], ["8", "base", "1.6"], ["9", "base", "1.7"], ["10", "base", "1.8"]])
    True
    >>> is_reading([["1", "a", "b"], ["1", "2", "3"], ["2", "3", "4"], ["3", "4", "5"]])
    False
    """
    titles, *below = rows
    if len(below) < 3 or any(len(row) != len(titles) for row in below) or not any(map(_is_reading_cell, titles)):
        return False
    for k, cell in enumerate(titles):
        column = [row[k] for row in below]
        kind = next((kind for kind in (_is_reading_cell, is_time) if kind(cell)), None)
        if not (all(map(kind, column)) if kind is not None else set(column) == {cell}):
            return False
    return True


def _is_reading_cell(cell: str) -> bool:
    """Return True for a number, perhaps with a decimal comma."""
    return is_number(cell) or is_number(cell.replace(",", ".", 1))


def are_titles(cells: Sequence[str], width: int) -> bool:
    """Return True for cells that name as many columns, each by another word that is neither a number nor a unit."""
    named = all(cells) and not any(map(is_number, cells))
    return named and len(set(cells)) >= width and not all(map(is_unit_cell, cells))


def are_stamps(rows: Sequence[Sequence[str]]) -> bool:
    """Return True if the first two cells of all rows are whole seconds from 1970 and the nanoseconds between them.

    Examples
    --------
    >>> are_stamps([["1732874400", "990000000"], ["1732874401", "10000000"]]), are_stamps([["0", "1"], ["1", "2"]])
    (True, False)
    """
    if not all(len(row) == 2 and row[0].isdecimal() and row[1].isdecimal() for row in rows):
        return False
    whole = [(int(seconds), int(rest)) for seconds, rest in rows]
    return whole == sorted(whole) and all(10**9 <= seconds < 5 * 10**9 and rest < 10**9 for seconds, rest in whole)


def logger_titles(rows: Sequence[Sequence[str]]) -> tuple[list[str], int] | None:
    """Return the titles of a logger's own header, and its rows; None for any other.

    Reference: Campbell Scientific, *LoggerNet Instruction Manual*, "TOA5": station, names, units, kinds of value.

    Examples
    --------
    >>> toa5 = [["TOA5", "CR1000", "1"], ["TIMESTAMP", "RECORD", "u"], ["TS", "RN", "Volts"], ["", "", "Smp"]]
    >>> logger_titles([*toa5, ["2024-01-01 00:00:00", "0", "1.5"]])
    (['TIMESTAMP', 'RECORD', 'u [Volts]'], 4)
    """
    if len(rows) < 5 or rows[0][0] != "TOA5" or len(rows[1]) != len(rows[2]):
        return None
    return [
        f"{name} [{unit}]" if unit and unit not in ("TS", "RN") else name
        for name, unit in zip(rows[1], rows[2], strict=True)
    ], 4


def _with_index_name(rows: Sequence[Sequence[str]]) -> tuple[Sequence[Sequence[str]], int]:
    """Return rows with the name of the index among the names, and 1 where pandas gave it a row of its own (else 0)."""
    for row in range(1, min(len(rows) - 1, MOST_ROWS)):
        if (
            rows[row][0]
            and not any(rows[row][1:])
            and all(_is_head(one[1:]) for one in rows[:row])
            and len(rows[0]) > 2
        ):
            head = [["", *one[1:]] for one in rows[: row - 1]] + [[rows[row][0], *rows[row - 1][1:]]]
            return [*head, *rows[row + 1 :]], 1
    return rows, 0


def _head_rows(rows: Sequence[Sequence[str]]) -> int:
    """Return how many rows of words stand above a row of numbers, all of one width; 0 where they do not."""
    width, count = len(rows[0]) if rows else 0, 0
    while count < min(len(rows) - 1, MOST_ROWS) and len(rows[count]) == width and _is_head(rows[count]):
        count += 1
    if width < 2 or len(rows[count]) != width:
        return 0
    return count if sum(map(is_number, rows[count])) + _commas(rows[count]) > 1 else 0


def _names(head: Sequence[Sequence[str]], used: Sequence[int]) -> list[str] | None:
    """Return the names that rows without units give; None where they do not name all used columns, or twice."""
    whole = [row for row in head if all(row[k] for k in used) and len({row[k] for k in used}) == len(used)]
    if len(whole) > 1:
        return None
    if whole:
        return list(whole[0])
    filled = [list(row) for row in head]
    for row in filled[:-1]:
        for k in range(1, len(row)):
            row[k] = row[k] or row[k - 1]
    names = [next((row[k] for row in reversed(head) if row[k]), "") for k in range(len(head[0]))]
    above = [[row[k] for row in reversed(filled) if row[k]] for k in range(len(head[0]))]
    for step in range(1, len(head)):
        names = _told_apart(names, above, used, step)
    chosen = [names[k] for k in used]
    return names if all(chosen) and len(set(chosen)) == len(chosen) else None


def _told_apart(names: Sequence[str], above: Sequence[Sequence[str]], used: Sequence[int], step: int) -> list[str]:
    """Return names with a text from above in front of each that another used column has too."""
    apart = list(names)
    for k in used:
        more = [text for text in above[k] if text != names[k].rpartition(".")[2]]
        if [names[j] for j in used].count(names[k]) > 1 and len(more) >= step:
            apart[k] = f"{more[step - 1]}.{names[k]}"
    return apart


def _is_head(row: Sequence[str]) -> bool:
    """Return True if all cells of a row are words or units, two of them at least."""
    cells = [cell for cell in row if cell]
    return len(cells) > 1 and all(_LETTER.match(cell) or (not is_number(cell) and is_unit_cell(cell)) for cell in cells)


def _commas(row: Sequence[str]) -> int:
    """Return how many cells of a row are numbers with a decimal comma."""
    return sum("," in cell and is_number(cell.replace(",", ".")) for cell in row)
