"""Cells of tables as people write them: numbers, nothing, and a row of units below the header."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from harness.data.tables.headers import TIME_UNITS, split_header, unit_of_time
from harness.data.times.stamps import clock
from harness.errors import InputError
from harness.signals import FloatArray
from harness.units import convert, fits, is_unit

EMPTY = {
    "",
    *"na n/a nan null none missing -nan nan(ind) -nan(ind) #n/a #num! #div/0! #value! #nv #n/d #nd".split(),
    *"#wert! #zahl! #valeur! #nombre!".split(),
    *("-" * k for k in range(1, 7)),
    *("1.#qnan", "-1.#qnan", "1.#snan", "1.#ind", "-1.#ind", "1.#qnan0", "-1.#ind0", "1.#ind00", "-1.#ind00"),
}
"""What stands where nothing was recorded, in small letters: by hand, of spreadsheets, of Microsoft's C library."""

_THOUSANDS = (re.compile(r"[+-]?[1-9]\d{0,2}(?:,\d{3})+"), re.compile(r"[+-]?[1-9]\d{0,2}(?:\.\d{3})+"))
_COMMA = re.compile(r"(?<!\d)[+-]?\d*,\d+(?:[eE][+-]?\d+)?(?!\d)")
_FORTRAN = re.compile(r"([+-]?\d+\.?\d*|[+-]?\.\d+)[dD]([+-]?\d+)")
_HEX = re.compile(r"0[xX](?![89a-fA-F](?:[\da-fA-F]|[\da-fA-F]{3}|[\da-fA-F]{7})$)([\da-fA-F]{1,13})")
"""Hexadecimal digits but for those whose first bit may be a sign."""
_ANY_HEX = re.compile(r"0[xX][\da-fA-F]+")
_SPAN = re.compile(
    r"(?:(?P<d>\d+)\s*d(?:ays?)?)?\s*(?:(?P<h>\d+)\s*(?:h|hr|hours?))?\s*(?:(?P<min>\d+)\s*(?:m|min|minutes?|'))?\s*"
    r"(?:(?P<s>\d+(?:[.,]\d*)?)\s*(?:s|sec|seconds?|\"|''))?\s*(?:(?P<ms>\d+(?:\.\d*)?)\s*ms)?"
)
_SECONDS = {"d": 86400.0, "h": 3600.0, "min": 60.0, "s": 1.0, "ms": 1e-3}  # Of the parts of such a span.
_WHOLE = re.compile(r"[+-]?\d{1,3}")
_GROUPS = "[ \u00a0\u2009\u202f'\u2019]"
"""Signs between thousands that are no decimal signs: spaces of any width, and apostrophes."""
_APART = re.compile(r"([+-])\s+(?=[\d.,])")  # A blank behind a sign, as columns of one width have it.
_DASH = re.compile(r"(?<![\d.,)])[\u2212\u2013\uff0d](?=[\d.,])")
"""Minus signs of a typesetter, also the dash that word processors make of a minus."""
POINTED = 3  # Cells with a point before which nobody asks whether it separates thousands.


def is_number(text: str) -> bool:
    """Return True if a cell holds a number (the word nan in a header is a title, not a number).

    Examples
    --------
    >>> is_number("1e3"), is_number("nan"), is_number("theta")
    (True, False, False)
    """
    try:
        _number(text)
    except ValueError:
        return False
    return not text.strip().lower().lstrip("+-").startswith(("nan", "inf"))


_SAID = re.compile(r"^units?\s*[:=]\s*|\s+vs\.?\s.+$", re.IGNORECASE)
"""What stands beside a unit: ``Unit: N``, and the reference of a potential, ``V vs. Ref.``."""


def _bare(cell: str) -> str:
    """Return the unit in a cell."""
    return _SAID.sub("", cell.strip().strip("[](){}<>").strip())


def is_unit_cell(cell: str) -> bool:
    """Return True if a cell is a unit, in brackets or not; of time in any language that titles may have.

    Examples
    --------
    >>> is_unit_cell("[Nm]"), is_unit_cell("sek."), is_unit_cell("V vs. Ref."), is_unit_cell("theta")
    (True, True, True, False)
    """
    text = _bare(cell)
    return is_unit(text) or text.rstrip(".").lower() in TIME_UNITS


def units_below(titles: Sequence[str], cells: Sequence[str]) -> list[str] | None:
    """Return the titles with the units of the row below them; None if that row is no row of units.

    Raises InputError if a title and the row below it state two units.

    Examples
    --------
    >>> units_below(["t", "u", "theta"], ["s", "[Nm]", "°"]), units_below(["t", "u"], ["0.0", "1.0"])
    (['t [s]', 'u [Nm]', 'theta [°]'], None)
    """
    bare = list(map(_bare, cells))
    if len(bare) == len(titles):  # NO. below Number, time below Date&Time say nothing
        words = " ".join(titles).lower().replace("&", " ").split()
        idle = {"no", "no.", "nr", "nr.", "#", *words}
        bare = ["" if cell.lower() in idle and not is_unit(cell) else cell for cell in bare]
    if len(bare) != len(titles) or not any(bare) or any(is_number(cell) and cell != "1" for cell in bare):
        return None
    if not any(cell and cell != "1" for cell in bare) or not all(is_unit_cell(cell) for cell in bare if cell):
        return None
    for title, cell in zip(titles, bare, strict=True):
        stated = split_header(title)[1]
        if cell and stated is not None and _spaced(stated) != _spaced(cell):
            raise InputError(
                f"two units of column {title!r}",
                expected="one",
                got=f"{stated!r} in the title, {cell!r} in the row below",
                remedy="remove the one that is wrong",
            )
    return [
        f"{title} [{cell}]" if cell and split_header(title)[1] is None else title
        for title, cell in zip(titles, bare, strict=True)
    ]


def arrow_values(array: Any) -> FloatArray:
    """Return an Arrow array of floats with NaN for what is missing, by its buffers: ``to_numpy`` imports pandas."""
    valid, data = array.buffers()
    found = np.frombuffer(data, np.float64, len(array), 8 * array.offset).copy()
    if valid is not None:
        bits = np.unpackbits(np.frombuffer(valid, np.uint8), bitorder="little")
        found[bits[array.offset : array.offset + len(array)] == 0] = np.nan
    return found


def _spaced(unit: str) -> str:
    """Return a unit without what may stand between its names."""
    return re.sub(r"[\s*\u00b7.]", "", unit)


def numbers_of(
    cells: Sequence[str], where: Callable[[int], str], notes: list[str] | None = None, *, commas: bool = False
) -> FloatArray:
    """Return the numbers in cells, NaN where one is empty.

    A comma is the decimal sign where no cell holds a point. Signs between thousands are read where a cell shows what
    they are, by both signs (``1.234,5``), by two groups (``1,234,567``) or by a sign that is none of decimals
    (``1'234``), and all cells fit. Else they are refused: ``1,234`` is a thousand as likely as a fraction, and so is
    ``1.234`` beside ``12`` and ``999``.

    Parameters
    ----------
    cells : sequence of str
    where : callable
        Gives the place of a cell for messages.
    notes : list of str, optional
        Gets a sentence where signs between thousands were read.
    commas : bool
        True where other columns of the table have decimal commas: so has this one, and its points may stand between
        thousands.

    Raises
    ------
    InputError
        At the first cell that is no number.

    Examples
    --------
    >>> numbers_of(["1,5", "", "-2,25e1", "\u22123"], str).tolist()
    [1.5, nan, -22.5, -3.0]
    >>> numbers_of(["1.234,5", "999", "-12.000"], str).tolist()
    [1234.5, 999.0, -12000.0]
    """
    cells = [_DASH.sub("-", cell.strip()) if not cell.isascii() else cell.strip() for cell in cells]
    cells, grouped = _without_groups(cells, notes)
    signs = [cell for cell in cells if "," in cell]
    thousands = bool(signs) and not commas and all(map(_THOUSANDS[0].fullmatch, signs))
    commas = not thousands and not any("." in cell for cell in cells)
    refuse_thousands(cells, where, commas=commas and not grouped)
    filled = [(row, cell) for row, cell in enumerate(cells) if cell.lower() not in EMPTY]
    hexadecimal = all(_ANY_HEX.fullmatch(cell) for _, cell in filled)
    numbers = np.full(len(cells), np.nan)
    for row, cell in filled:
        try:
            numbers[row] = _number(cell) if hexadecimal else _decimal(cell, commas=commas)
        except ValueError:
            more = " with one kind of decimal sign, and none for thousands" if "," in cell else ""
            raise _no_number(cell, where(row), f"a number{more}", "comma" if more else "") from None
    return numbers


def _without_groups(cells: list[str], notes: list[str] | None) -> tuple[list[str], bool]:
    """Return cells without the signs between their thousands, and whether there were any; that is noted."""
    if (style := _grouped(cells)) is None:
        return cells, False
    text = f"{'spaces or apostrophes' if style[0] == ' ' else repr(style[0])} between thousands are left out"
    if notes is not None and text not in notes:
        notes.append(text)
    return [cell if cell.lower() in EMPTY else _ungrouped(cell, *style) for cell in cells], True


_MEASURED = re.compile(
    r"(?P<number>[+-]?(?:\d[\d.,' \u00a0\u2009\u202f\u2019]*|[.,]\d+)(?:[eE][+-]?\d+)?)\s*(?P<unit>[^\W\d_].*|[°%].*)"
)


def is_measured(cell: str) -> bool:
    """Return True for a number with its unit behind it.

    Examples
    --------
    >>> is_measured("980 mV"), is_measured("12 %"), is_measured("1.5"), is_measured("3rd run")
    (True, True, False, False)
    """
    found = _MEASURED.fullmatch(cell)
    return found is not None and is_unit(unit_of_time(found["unit"]))


def measured(
    cells: Sequence[str],
    title: str,
    where: Callable[[int], str],
    notes: list[str] | None = None,
    *,
    commas: bool = False,
) -> tuple[FloatArray, str] | None:
    """Return the numbers in cells that all carry a unit behind them, and that unit; None where they do not.

    A meter that changes its range writes ``980 mV`` and ``1.02 V``: all are brought to the first unit; spans of time to
    seconds.

    Raises InputError if title and cells state two units, or a number cannot be read.

    - ``cells, where, notes, commas``: as for :func:`numbers_of`
    - ``title``: of the column, whose unit must be the same if it has one

    Examples
    --------
    >>> numbers, unit = measured(["980 mV", "", "1.02 V"], "u", str)
    >>> numbers.round(6).tolist(), unit
    ([980.0, nan, 1020.0], 'mV')
    >>> measured(["10 ms", "1 sec"], "time", str)[0].tolist(), measured(["1.5"], "u", str)
    ([0.01, 1.0], None)
    """
    found = [
        None if cell.lower() in EMPTY else _MEASURED.fullmatch(_DASH.sub("-", cell)) for cell in map(str.strip, cells)
    ]
    filled = [row for row, cell in enumerate(cells) if cell.strip().lower() not in EMPTY]
    if any(found[row] is None for row in filled):
        return None
    units = {text: unit_of_time(text) for one in found if one is not None and (text := one["unit"].strip())}
    unit = _one_unit(list(units.values()))
    if unit is None:
        return None
    stated = split_header(title)[1]
    if stated is not None and any(_spaced(stated) != _spaced(text) for text in units):
        raise InputError(
            f"two units of column {title!r}",
            expected="one",
            got=f"{stated!r} in the title, {next(iter(units))!r} in its cells",
            remedy="remove the one that is wrong",
            place=where(filled[0]),
        )
    numbers = numbers_of([one["number"].strip() if one else "" for one in found], where, notes, commas=commas)
    for text, other in units.items():
        if other != unit:
            rows = [row for row in filled if (one := found[row]) is not None and one["unit"].strip() == text]
            numbers[rows] = convert(numbers[rows], other, unit)
    said = f"{title}: units stand in the cells ({', '.join(units)})" + (
        f": they are read in {unit}" if len(units) > 1 else ""
    )
    if notes is not None and said not in notes:
        notes.append(said)
    return numbers, unit


def with_unit(
    cells: Sequence[str],
    title: str,
    where: Callable[[int], str],
    notes: list[str],
    stated: dict[str, str],
    *,
    commas: bool = False,
) -> FloatArray | None:
    """Return cells that are times, truths, or carry a unit, which is put in ``stated``; None if they are plain.

    Parameters are those of :func:`measured`.
    """
    if (stamps := clock(cells, notes, where)) is not None:
        stated[title] = "s"
        return stamps
    if (spans := _spans(cells)) is not None:
        stated[title] = "s"
        return spans
    if (truths := _truths(cells)) is not None:
        say_truths(notes, title, next(cell.strip() for cell in cells if cell.strip().lower() not in EMPTY))
        return truths
    found = measured(cells, title, where, notes, commas=commas)
    if found is None:
        return None
    stated[title] = found[1]
    return found[0]


def _spans(cells: Sequence[str]) -> FloatArray | None:
    """Return the seconds of spans of time in parts, as in ``1m 5s``; None where no cell has several parts.

    Examples
    --------
    >>> _spans(["58s", "1m 3.5s", "1h 0m 2s", ""]).tolist(), _spans(["1m", "2m"])
    ([58.0, 63.5, 3602.0, nan], None)
    """
    found = [_SPAN.fullmatch(cell.strip()) if cell.strip().lower() not in EMPTY else None for cell in cells]
    parts = [{name: part for name, part in one.groupdict().items() if part} if one else {} for one in found]
    if any(not one and cell.strip().lower() not in EMPTY for one, cell in zip(parts, cells, strict=True)):
        return None
    if not any(len(one) > 1 for one in parts):
        return None
    spans = [
        sum(_SECONDS[name] * float(part.replace(",", ".")) for name, part in one.items()) if one else np.nan
        for one in parts
    ]
    return np.array(spans)


TRUTHS = tuple(pair.split() for pair in ("false true", "off on", "aus ein", "arrêt marche", "выкл вкл"))
"""Words for 0 and 1 of what is switched, in small letters."""


def _truths(cells: Sequence[str]) -> FloatArray | None:
    """Return 1 and 0 for cells that are all true or false, on or off, or empty; None for any others."""
    words = {word for cell in cells if (word := cell.strip().lower()) not in EMPTY}
    pair = next((pair for pair in TRUTHS if words and words.issubset(pair)), None)
    if pair is None:
        return None
    known = {word: float(value) for value, word in enumerate(pair)}
    return np.array([known.get(cell.strip().lower(), np.nan) for cell in cells])


def _one_unit(units: Sequence[str]) -> str | None:
    """Return the unit to which others of its kind are brought, the second for times; None if they are of several."""
    if not units or not all(map(is_unit, units)):
        return None
    unit = "s" if fits(units[0], "s") else units[0]
    return unit if all(fits(other, unit) for other in units) else None


def refuse_thousands(cells: Sequence[str], where: Callable[[int], str], *, commas: bool = False) -> None:
    """Refuse numbers with points that may stand between thousands: ``1.234`` beside ``12``, or beside decimal commas.

    Raises InputError with the first of them.

    - ``cells``: without blanks about them
    - ``commas``: True where other columns of the table have decimal commas
    """
    points = [row for row, cell in enumerate(cells) if "." in cell and cell.lower() not in EMPTY]
    if len(points) < POINTED or not all(_THOUSANDS[1].fullmatch(cells[row]) for row in points):
        return
    others = [cell for cell in cells if "." not in cell and cell.lower() not in EMPTY]
    if (others or commas) and all(map(_WHOLE.fullmatch, others)):
        raise _no_number(cells[points[0]], where(points[0]), "a number without signs between thousands", "thousands")


def _grouped(cells: Sequence[str]) -> tuple[str, str] | None:
    """Return the signs between thousands and before decimals, where a cell shows which is which and all cells fit."""
    filled = [cell for cell in cells if cell.lower() not in EMPTY]
    if filled and all(re.fullmatch(r"[+-]?\d+ \d{3}", cell) for cell in filled):
        return None  # two numbers in each cell, as likely
    for group, pattern, point in ((".", r"\.", ","), (",", ",", r"\."), (" ", _GROUPS, "[.,]")):
        grouped = rf"[+-]?[1-9]\d{{0,2}}(?:{pattern}\d{{3}})"
        shown = rf"{grouped}+" if group == " " else rf"{grouped}+{point}\d+|{grouped}{{2,}}"
        if not any(re.fullmatch(rf"(?:{shown})(?:{point}\d*)?", cell) for cell in filled):
            continue
        if all(re.fullmatch(rf"(?:{grouped}+|[+-]?\d*)(?:{point}\d*)?", cell) for cell in filled):
            decimals = {sign for cell in filled for sign in ".," if sign in cell and sign != group}
            return (group, decimals.pop() if decimals else ".") if len(decimals) < 2 else None
    return None


def _ungrouped(cell: str, group: str, point: str) -> str:
    """Return a number without signs between thousands, with a decimal point."""
    plain = re.sub(_GROUPS, "", cell) if group == " " else cell.replace(group, "")
    return plain.replace(point, ".")


def _number(text: str) -> float:
    """Return a number as tables hold it; Python's own underscores are none."""
    if "_" in text:
        raise ValueError(text)
    if (digits := _HEX.fullmatch(text.strip())) is not None:
        return float(int(digits[1], 16))
    return float(_APART.sub(r"\1", text.strip() if text.isascii() else _DASH.sub("-", text.strip()), count=1))


def _decimal(cell: str, *, commas: bool) -> float:
    """Return a number that is no hexadecimal one: beside decimal numbers that is a slip."""
    if _HEX.fullmatch(cell):
        raise ValueError(cell)
    plain = _FORTRAN.sub(r"\1e\2", cell)
    return _number(plain.replace(",", ".") if commas and _COMMA.fullmatch(plain) else plain)


def _no_number(cell: str, place: str, expected: str, why: str) -> InputError:
    """Return the refusal of a cell."""
    remedies = {
        "hexadecimal": "export decimal numbers, as the first bit may be a sign; what a count measures, scale and "
        "offset in a dataset.toml say",
        "comma": "export with decimal points, and without signs between thousands",
        "thousands": "export without signs between thousands, or every number with as many decimals",
    }
    why = why or ("hexadecimal" if re.fullmatch(r"(?=.*\d)(?=.*[a-f])[\da-f]+h?|0x[\da-f]+", cell.lower()) else "")
    return InputError(
        "a cell that is no number" if why != "thousands" else "a number with two readings",
        expected=expected,
        got=repr(cell),
        remedy=remedies.get(why, f"correct or empty the cell{_MIXED if _is_mixed(cell) else _WORD}"),
        place=place,
    )


_WORD = ", or remove the row; what is switched is read as 1 and 0, true and false, or ON and OFF"
_MIXED = "; a unit belongs into the title, a time is read as in 2024-12-31T23:59:59.5 or in seconds"


def _is_mixed(cell: str) -> bool:
    """Return True if a cell holds digits and signs of a unit or of a time."""
    return re.search(r"\d", cell) is not None and re.search(r"[^\W\d_]|[:%°]", cell) is not None


def say_truths(notes: list[str], title: str, word: str = "true") -> None:
    """Say that two words of a column are read as 1 and 0, once: nobody has measured them in its unit.

    Examples
    --------
    >>> notes = []
    >>> say_truths(notes, "valve")
    >>> notes
    ['valve holds true and false: they are read as 1 and 0']
    """
    off, on = next(pair for pair in TRUTHS if word.lower() in pair)
    text = f"{title} holds {on} and {off}: they are read as 1 and 0"
    notes += [] if text in notes else [text]


def seconds_of(stamps: np.ndarray) -> FloatArray:
    """Return time stamps or spans of numpy as seconds: stamps from the first, spans as they are; missing ones are NaN.

    Examples
    --------
    >>> seconds_of(np.array(["2024-01-01T00:00:00", "2024-01-01T00:00:00.5"], dtype="datetime64[ns]")).tolist()
    [0.0, 0.5]
    """
    if stamps.dtype.kind == "M" and len(stamps):
        stamps = stamps - stamps[0]
    return np.where(np.isnat(stamps), np.nan, stamps / np.timedelta64(1, "ns") * 1e-9)
