"""Heads of tables: where one begins, what parts its cells, and headers of several rows.

The rows of readings tell where; several rows are groups above names, names above units, as merged cells have them.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Callable, Sequence

from harness.data.tables.cells import EMPTY, is_measured, is_number, is_unit_cell, units_below
from harness.data.tables.headers import TIME_UNITS, clock_of
from harness.data.times.stamps import is_date, is_time
from harness.errors import InputError

MOST_ROWS = 6  # Rows that a header may have.
MOST_ABOVE = 100  # Lines that a logger or a program may write above its titles.
SAMPLE = 5  # Rows before the last one that are asked how the rows of a table look: the last may be cut.
CERTAIN = 3  # Rows of readings on end with which a table begins; as many above others are a table of their own.
SIGNS = (",", ";", "\t", "|", None)  # What may part cells; None for blanks.

Row = Sequence[str]  # Cells of a row, without blanks about them.
UNEVEN = 0.2  # Part of a step by which two steps differ where numbers are no clock.

_LETTER = re.compile(r"[^\W\d_]|[\[(<{°%]")
_TITLE = re.compile(r"[^\s\[(/]+(?:\s*[\[(][^\])]*[\])]|\s/\s\S+)?")
_BRACKETED = re.compile(r"[\[({<](?P<unit>[^\[\](){}<>]+)[\])}>]")


_BEGINS = re.compile(r"[\s\"']*[+-]?[.,]?\d").match  # How a row begins whose first cell is a number or a time.


def cells_of(line: str, sign: str | None) -> list[str]:
    """Return the cells of a line; a quoted one may hold the sign.

    Examples
    --------
    >>> cells_of('0, "1,5" ,', ","), cells_of(' 0  "a b" ', None)
    (['0', '1,5', ''], ['0', 'a b'])
    """
    if sign is None:
        if '"' not in line:
            return line.split()
        spaced = csv.reader(io.StringIO(line.strip()), delimiter=" ", skipinitialspace=True)
        return [cell for cell in next(spaced) if cell]
    if '"' not in line:
        return [cell.strip() for cell in line.split(sign)]
    return [cell.strip() for cell in next(csv.reader(io.StringIO(line), delimiter=sign, skipinitialspace=sign != "\t"))]


def titles_of(line: str, sign: str | None, width: int) -> list[str]:
    """Return the titles in a line, as many as the table has columns if they can be parted so, else its cells.

    Of columns apart by blanks, a unit in brackets or behind a slash belongs to the title before it; titles of several
    words stand two blanks apart.

    Examples
    --------
    >>> titles_of("t [s] u [N m]", None, 2), titles_of("Input voltage / V   y", None, 2), titles_of("t u y", None, 2)
    (['t [s]', 'u [N m]'], ['Input voltage / V', 'y'], ['t', 'u', 'y'])
    """
    cells = cells_of(line, sign)
    if sign not in (None, "\t") or len(cells) == width:
        return cells
    parted = (re.split(r"\s{2,}|\t", line.strip()), _TITLE.findall(line))
    return next((titles for titles in parted if len(titles) == width), cells)


def sign_of(lines: Sequence[str]) -> str | None:
    """Return the sign that parts the cells of a table, None for blanks: by it most of its last rows are readings.

    Of several, the one that parts a line above into as many cells counts, then the one that makes more cells.

    Examples
    --------
    >>> sign_of(["Time, s;Voltage, V", "0,05;1,25", "0,10;1,5", "0,15;1,5"]), sign_of(["t u", "0,5 1", "0,6 1"])
    (';', None)
    >>> sign_of(["y", "0,5", "0,7"]), sign_of(["t,y", "0,5", "1,7"])
    (None, ',')
    """
    best: tuple[float, bool, int] = (0.0, False, 0)
    found = max((sign for sign in SIGNS if sign is not None), key=lines[0].count, default=None)
    found = found if found is not None and found in lines[0] else None
    for sign in SIGNS:
        rows = _sample([cells_of(line, sign) for line in lines[-SAMPLE - 1 :]])
        width = len(rows[-1])
        cells = [cell for row in rows for cell in row]
        # by letters: one long cell of words may hold several readings
        share = sum(len(cell) + 1 for cell in cells if _is_reading(cell)) / sum(len(cell) + 1 for cell in cells)
        above = (cells_of(line, sign) for line in lines[: min(MOST_ABOVE, len(lines) - len(rows))])
        titled = any(len(row) == width and any(row) and not any(_is_reading(c) for c in row if c) for row in above)
        if share and (width > 1 or sign is None) and (rank := (round(share, 6), titled, width)) > best:
            best, found = rank, sign
    return found


def begin_of(rows: Sequence[Row], below: Sequence[Row] | None = None) -> int:
    """Return the row of titles with which a table begins, or its first row; 0 also where nobody can say.

    Rows of readings are those in which numbers and times stand where the last rows have them. Titles stand right above
    the first of them, perhaps above units; of two rows that could be titles, that which names a clock counts.

    - ``rows``: the first rows of a file or sheet
    - ``below``: its last rows, where these are not among ``rows``

    Examples
    --------
    >>> begin_of([["Model", "X"], ["Rate", "20"], ["t", "u"], ["s", "V"], ["0", "1"], ["1", "2"], ["2", "2"]])
    2
    >>> begin_of([["t", "u"], ["0", "1"], ["1", "2"], ["2", "2"]])
    0
    """
    kinds = kinds_of(rows if below is None else below)
    top = first = first_reading(rows, kinds)
    while top > max(0, first - MOST_ROWS) and _heads(rows, top - 1, kinds):
        top -= 1
    if top == first:
        return 0  # no titles, or such as do not fit: they are refused as such
    whole = [row for row in range(top, first) if _names_all(rows, row, kinds)]
    if whole and (len(whole) == 1 or (_has_clock(rows[whole[-1]]) and not _has_clock(rows[whole[-2]]))):
        # what is said of units above the names is a part of the header
        top = next((row for row in range(top, whole[-1]) if _is_units(rows, row)), whole[-1])
    return 0 if top > MOST_ABOVE or is_table(rows[:top]) else top


def first_reading(rows: Sequence[Row], kinds: Sequence[Callable[[str], bool] | None]) -> int:
    """Return the first of rows of readings on end; 0 also where there are none.

    Examples
    --------
    >>> rows = [["Rig"], ["t", "u"], ["0", "1"], ["1", "2"], ["2", "2"]]
    >>> first_reading(rows, kinds_of(rows))
    2
    """
    fits = [_fits(row, kinds) for row in rows]
    return next((k for k in range(len(rows)) if all(fits[k : k + CERTAIN])), 0)


def lines_below(lines: Sequence[str]) -> int:
    """Return how many lines stand below the rows of a table and are none: words, where all rows begin with a number.

    Examples
    --------
    >>> rows = [f"{k};0.5" for k in range(12)]
    >>> lines_below([*rows, "Mean;0.5", "*** end ***"]), lines_below([*rows, "nan;0.5"]), lines_below(["u:1"] * 12)
    (2, 0, 0)
    """
    middle = lines[len(lines) // 2 :][:SAMPLE]
    if len(lines) < 2 * SAMPLE or not all(map(_BEGINS, middle)):
        return 0
    count = 0
    while count < len(lines) // 2 and not _BEGINS(line := lines[-1 - count]) and _first_cell(line) not in EMPTY:
        count += 1
    return count


def kinds_of(rows: Sequence[Row]) -> list[Callable[[str], bool] | None]:
    """Return what all cells of each column are in the last rows, numbers or times; None for words and for nothing.

    Examples
    --------
    >>> [kind and kind.__name__ for kind in kinds_of([["1", "12:00:00", "on", ""]])]
    ['_is_plain', '_is_stamp', None, None]
    """
    if not rows:
        return []
    rows = _sample(rows)
    width = len(rows[-1])
    columns = zip(*(row for row in rows if len(row) == width), strict=True)
    filled = [[cell for cell in column if cell.lower() not in EMPTY] for column in columns]
    return [
        next((kind for kind in (_is_plain, _is_stamp, is_measured) if column and all(map(kind, column))), None)
        for column in filled
    ]


def units_among(
    titles: Row, cells: Row, kinds: Sequence[Callable[[str], bool] | None] | None = None
) -> list[str] | None:
    """Return the titles with the units of the row below them; None if it is none. Columns of words need no unit.

    Examples
    --------
    >>> units_among(["t", "alarm"], ["s", "state"], kinds_of([["0.5", "LL"]]))
    ['t [s]', 'alarm']
    """
    if kinds is not None and len(kinds) == len(cells):
        cells = [
            cell if kind is not None or is_unit_cell(cell) else "" for cell, kind in zip(cells, kinds, strict=True)
        ]
    return units_below(titles, cells)


def is_table(rows: Sequence[Row]) -> bool:
    """Return True if three rows and more hold several numbers each, with no word before them.

    Examples
    --------
    >>> is_table([["0", "1"], ["1", "1"], ["2", "0"]]), is_table([["Rate", "1", "2"]] * 3)
    (True, False)
    """
    return sum(sum(map(is_number, row)) > 1 and not row[0][:1].isalpha() for row in rows) >= CERTAIN


def stacked_titles(rows: Sequence[Sequence[str]]) -> tuple[list[str], int] | None:
    """Return the titles that several rows give together, and how many rows these are; None where one row does.

    The row that names every column once, right above the units where there are any, gives the names. Where there is
    none, a column's lowest text is its name, with those above it in front (``left.X``) as far as names would be shared;
    an empty cell of an upper row belongs to the text on its left, as cells are merged. What stands below a row of units
    is a remark (OriginLab, *Origin Help*: long name, units, comments).

    - ``rows``: the first rows of a table, numbers included, all cells without blanks about them
    - returns (titles, count); None also where two rows name every column once: nobody can say which are the
      names

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
    parted = _without_units([list(row) for row in rows[:count]], kinds_of(rows[count:]))
    if parted is None:
        return None
    head, units = parted
    used = [k for k, cell in enumerate(rows[count]) if cell]
    names = _names(head, used)
    if names is None:
        return None
    units = units if any(units) else _unit_of_clock(head, names)
    titles = units_below(names, units) if any(units) else names
    return None if titles is None else (titles, count + named)


def _without_units(
    head: list[list[str]], kinds: Sequence[Callable[[str], bool] | None]
) -> tuple[list[list[str]], list[str]] | None:
    """Return the rows of names of a header, and the units that it states; None for one row of names above units."""
    count, units = len(head), [""] * len(head[0])
    if above := _units_above(head):
        head.append(head.pop(0))
    if below := next((k for k in range(count, 1, -1) if _are_units(head[:k], kinds)), 0):
        units = [cell if is_unit_cell(cell) else "" for cell in head[below - 1]]
        head = head[: below - 1]
        if len(head) > 1 and all(head[-1]) and len(set(head[-1])) == len(units):
            head, above = head[-1:], True
        above = above or below < count
    if len(head) < 2 and not above and not any(_BRACKETED.fullmatch(cell) for row in head for cell in row):
        return None
    for row in head:
        for k, cell in enumerate(row):
            found = _BRACKETED.fullmatch(cell)
            if found is not None and is_unit_cell(found["unit"]):
                row[k], units[k] = "", units[k] or cell
    return head, units


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
    if len(below) < 3 or any(len(row) != len(titles) for row in below) or not any(map(_is_plain, titles)):
        return False
    for k, cell in enumerate(titles):
        column = [row[k] for row in below]
        kind = next((kind for kind in (_is_plain, is_time) if kind(cell)), None)
        if not (all(map(kind, column)) if kind is not None else {*column} == {cell} or _is_made_alike(cell, column)):
            return False
    return True


def _is_made_alike(cell: str, column: Sequence[str]) -> bool:
    """Return True if all cells of a column hold digits and other signs, and are like the first but for these digits."""
    made = {re.sub(r"\w+", "w", one.lstrip("+-")) for one in (cell, *column)}
    return len(made) == 1 and all(re.search(r"\d", one) for one in (cell, *column)) and "w" not in made


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
            and not _is_remark(rows, row)
            and all(_is_head(one[1:]) for one in rows[:row])
            and len(rows[0]) > 2
        ):
            head = [["", *one[1:]] for one in rows[: row - 1]] + [[rows[row][0], *rows[row - 1][1:]]]
            return [*head, *rows[row + 1 :]], 1
    return rows, 0


def _head_rows(rows: Sequence[Sequence[str]]) -> int:
    """Return how many rows of words stand above a row of numbers, all of one width; 0 where they do not."""
    width, count = len(rows[0]) if rows else 0, 0
    while count < min(len(rows) - 1, MOST_ROWS) and len(rows[count]) == width:
        if not _is_head(rows[count]) and not _is_remark(rows, count):
            break
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


def _unit_of_clock(head: Sequence[Sequence[str]], names: Sequence[str]) -> list[str]:
    """Return the unit of time that another row of a header states at the clock, its column's; the others say words."""
    units = [""] * len(names)
    try:
        clock = clock_of(names)
    except InputError:
        return units
    if clock is not None:
        at = names.index(clock)
        units[at] = next((row[at] for row in head if _bare_unit(row[at]) in TIME_UNITS), "")
    return units


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


def _is_remark(rows: Sequence[Row], place: int) -> bool:
    """Return True for a row below one of units, or below such a remark, that holds no number."""
    if place < 2 or any(map(_is_plain, rows[place])):
        return False
    return _is_units(rows, place - 1) or _is_remark(rows, place - 1)


def _commas(row: Sequence[str]) -> int:
    """Return how many cells of a row are numbers with a decimal comma."""
    return sum("," in cell and is_number(cell.replace(",", ".")) for cell in row)


def _sample(rows: Sequence[Row]) -> Sequence[Row]:
    """Return the rows that are asked how the rows of a table look, none of its titles among them."""
    rows = rows[-SAMPLE - 1 : -1] if len(rows) > CERTAIN else rows[-1:]
    other = (k for k in range(len(rows) - 1, -1, -1) if len(rows[k]) != len(rows[-1]) or not any(map(_counts, rows[k])))
    return rows[min(next(other, -1) + 1, len(rows) - 1) :]


def _is_plain(cell: str) -> bool:
    """Return True for a number, perhaps with a decimal comma."""
    return is_number(cell) or is_number(cell.replace(",", ".", 1))


def _is_stamp(cell: str) -> bool:
    """Return True for a time or a date."""
    return is_time(cell) or is_date(cell)


def _counts(cell: str) -> bool:
    """Return True for a number, with or without its unit, or a time."""
    return _is_plain(cell) or _is_stamp(cell) or is_measured(cell)


def _is_reading(cell: str) -> bool:
    """Return True for a number, a time, or what stands where nothing was recorded."""
    return cell.lower() in EMPTY or _counts(cell)


def _fits(row: Row, kinds: Sequence[Callable[[str], bool] | None]) -> bool:
    """Return True for a row that holds numbers and times where the columns do, one at least."""
    if len(row) != len(kinds):
        return False
    cells = [(cell, kind) for cell, kind in zip(row, kinds, strict=True) if kind and cell.lower() not in EMPTY]
    return bool(cells) and all(kind(cell) for cell, kind in cells)


def _heads(rows: Sequence[Row], place: int, kinds: Sequence[Callable[[str], bool] | None]) -> bool:
    """Return True for a row of words as wide as the table; one alone in the first column is a remark."""
    row = rows[place]
    filled = [cell for cell in row if cell]
    if filled and len(row) == len(kinds) and _is_remark(rows, place):
        return True
    if len(row) != len(kinds) or not filled or (len(filled) < 2 < len(row) + 1 and row[0]):
        return False
    if not any(map(_is_reading, filled)):
        return True
    named = _is_units(rows, place + 1) and len(filled) == len(row) and not _is_reading(row[0])
    return named or _is_units(rows, place)


def _units_above(head: Sequence[Row]) -> bool:
    """Return True if the first of two rows gives each column its unit, and the clock one of time."""
    if len(head) != 2 or not all(head[0]) or not _is_units(head, 0):
        return False
    try:
        clock = clock_of(head[1])
    except InputError:
        return False
    return clock is not None and _bare_unit(head[0][head[1].index(clock)]) in TIME_UNITS


def _bare_unit(cell: str) -> str:
    """Return what stands in a cell without brackets, in small letters."""
    return cell.strip("[](){}<> ").lower()


def _are_units(head: Sequence[Row], kinds: Sequence[Callable[[str], bool] | None]) -> bool:
    """Return True if the last row of a header is one of units, alone or where the columns hold numbers."""
    if all(is_unit_cell(cell) for cell in head[-1] if cell):
        return True
    return len(set(head[-2])) == len(head[-2]) and units_among(head[-2], head[-1], kinds) is not None


def _is_units(rows: Sequence[Row], place: int) -> bool:
    """Return True for a row of units alone."""
    filled = [cell for cell in rows[place] if cell] if place < len(rows) else []
    return bool(filled) and all(cell == "1" or (is_unit_cell(cell) and not is_number(cell)) for cell in filled)


def _names_all(rows: Sequence[Row], place: int, kinds: Sequence[Callable[[str], bool] | None]) -> bool:
    """Return True if a row names each column of numbers by a word of its own, and does not state units below names."""
    names = [cell for cell, kind in zip(rows[place], kinds, strict=True) if kind]
    told = not any(_is_reading(name) or _BRACKETED.fullmatch(name) for name in names) and not _is_units(rows, place)
    if not all(names) or len(set(names)) < len(names) or not told:
        return False
    try:
        return place == 0 or units_among(rows[place - 1], rows[place], kinds) is None
    except InputError:
        return False  # two units of one column: said where the titles are read


def _has_clock(titles: Row) -> bool:
    """Return True if a title names a clock, or several do."""
    try:
        return clock_of(titles) is not None
    except InputError:
        return True


def _first_cell(line: str) -> str:
    """Return the first cell of a line, whatever parts its cells, in small letters."""
    return re.split(r"[,;\t|\s]", line.strip(" \"'"), maxsplit=1)[0].strip("\"'").lower()
