"""Tables in long form: each row holds the time, the name of a signal, and one reading of it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from harness.data.tables.cells import EMPTY, is_number, numbers_of, with_unit
from harness.data.tables.headers import clock_of, says_time, split_header, words_of
from harness.data.tables.named import NamedColumns
from harness.data.times.stamps import is_date, is_time, is_time_of_day
from harness.errors import InputError
from harness.signals import FloatArray

NAMES = frozenset(
    "name signal signalname variable varname tag tagname channel channelname field key parameter sensor kanal "
    "displayname pointname parametername itemname nodeid browsename tagpath "
    "messstelle entityid".split()
)
"""Titles of the column that names the signal, in small letters without what parts their words."""
NODE = "nodeid"  # Of OPC UA.
VALUES = frozenset("value val varvalue reading wert messwert valeur valor state".split())
"""Titles of the column of readings, in small letters."""
UNITS = frozenset("unit units einheit unité unidad".split())  # Titles of the column of units, in small letters.
AFTER = frozenset(
    "server received receive arrival arrived ingest ingested inserted insert stored created updated processed".split()
)
"""Words of a stamp that was taken when a reading came in, not when it was measured."""
MOST = 200  # Signals of a table in long form: more names are texts of another kind.
FEWEST = 20
"""Readings of a signal below which it makes no record (:data:`harness.data.conditioning.timebase.SHORTEST`)."""


class LongTable:
    """The signals of a table in long form as columns beside one clock.

    Where all have the same stamps they share the rows; else each row holds what was written in it, in the order of the
    stamps, and the other signals are empty there.

    Names that stand in less than 20 rows are left out with their rows, such as what an archive writes at its end.

    Raises InputError if a cell cannot be read, or a signal has two units.

    - ``source``: with texts
    - ``columns``: titles of the clock, the names, the readings, and the units (empty for none)
    - ``tags``: the names, by row
    """

    def __init__(self, source: Any, columns: tuple[str, str, str, str], tags: Sequence[str]) -> None:
        clock, name, value, unit = columns
        self._source, self._title = source, clock
        self._clock = clock if clock_of([clock]) else "time"
        counts = Counter(tags)
        names = [one for one in counts if counts[one] >= FEWEST]
        self.titles = [self._clock, *names]
        written = np.array(tags)
        own = {one: np.flatnonzero(written == one) for one in names}
        few = [f"{one} ({count})" for one, count in counts.items() if count < FEWEST]
        stamps, units = np.full(len(tags), np.nan), dict[str, str]()
        rows = np.sort(np.concatenate(list(own.values())))
        kept = _Kept(source, rows)
        beside = NamedColumns(Path(), kept)
        together = beside.of_several(clock, turns=True)
        stamps[rows] = kept.values(clock) if together is None else together
        if together is not None or kept.units.get(clock):
            units[self._clock] = "s" if together is not None else kept.units[clock]
        readings, cells = np.full(len(tags), np.nan), source.texts(value)
        for one, rows in own.items():
            readings[rows] = _read(source, value, cells, rows, one, units)
        first = stamps[own[names[0]]]
        if all(len(rows) == len(first) and np.array_equal(stamps[rows], first) for rows in own.values()):
            self._rows = own[names[0]]
            self._columns: dict[str, FloatArray] = {one: readings[rows] for one, rows in own.items()}
        else:
            self._rows = np.argsort(stamps, kind="stable")
            filled = {one: np.full(len(stamps), np.nan) for one in names}
            for one, rows in own.items():
                filled[one][rows] = readings[rows]
            self._columns = {one: column[self._rows] for one, column in filled.items()}
        self._columns[self._clock] = stamps[self._rows]
        self._units = units | (_units_of(source.texts(unit), own, source.where) if unit else {})
        shown = ", ".join(names[:6]) + (" ..." if len(names) > 6 else "")
        self.notes = [
            *source.notes,
            *beside.notes,
            f"{name!r} names the signal of each row, {value!r} its reading: {shown} are columns",
            *([f"names in less than {FEWEST} rows are left out: {', '.join(few[:6])}"] if few else []),
        ]

    def values(self, title: str) -> FloatArray:
        """Return one column (N,)."""
        return self._columns[title].copy()

    def unit(self, title: str) -> str | None:
        """Return the unit that the rows or cells of a signal state, and s for dates."""
        return self._units.get(title)

    def where(self, row: int) -> str:
        """Return the place of a row (from 0) as the table's owner counts it."""
        return str(self._source.where(int(self._rows[row])))


class _Kept:
    """Some rows of a source, all columns as its cells are written."""

    def __init__(self, source: Any, rows: Any) -> None:
        self._source, self._rows = source, rows
        self.titles, self.units = list(source.titles), dict[str, str]()

    def texts(self, title: str, most: int | None = None) -> list[str]:
        """Return the cells of a column, at most so many."""
        rows = self._rows[:most]
        cells = self._source.texts(title, int(rows[-1]) + 1)
        return [cells[row] for row in rows]

    def values(self, title: str) -> FloatArray:
        """Return one column (n,)."""
        return _read(self._source, title, self._source.texts(title), self._rows, title, self.units)

    def unit(self, title: str) -> str | None:
        """Return the unit that the cells of a column carry, s for dates."""
        return self.units.get(title)


def _read(source: Any, title: str, cells: Sequence[str], rows: Any, name: str, units: dict[str, str]) -> FloatArray:
    """Return the numbers (n,) in some rows of a column, and keep by name the unit that they carry, s for dates."""

    def where(row: int) -> str:
        return f"{source.where(int(rows[row]))}, column {title!r}"

    texts = [cells[row] for row in rows]
    if (plain := _certain(texts)) is not None:
        return plain
    numbers = all(is_number(cell) or cell.strip().lower() in EMPTY for cell in texts)
    found = None if numbers else with_unit(texts, name, where, source.notes, units)
    return numbers_of(texts, where, source.notes) if found is None else found


def _certain(texts: Sequence[str]) -> FloatArray | None:
    """Return numbers whose points stand before decimals for certain, and no sign between thousands; None for others."""
    try:
        found = np.array([text or "nan" for text in texts]).astype(np.float64)
    except ValueError:
        return None
    size = np.abs(found[np.isfinite(found)])
    fractions = size[size != np.round(size)]
    certain = not fractions.size or fractions.min() < 1.0 or size.max() >= 1000.0
    return found if certain and not any("_" in text for text in texts) else None


def _units_of(units: Sequence[str], own: dict[str, Any], where: Callable[[int], str]) -> dict[str, str]:
    """Return the unit of each signal that states one."""
    found: dict[str, str] = {}
    for name, rows in own.items():
        for row in rows:
            unit = units[row].strip()
            if unit and found.setdefault(name, unit) != unit:
                raise InputError(
                    f"two units of the signal {name!r}",
                    expected="one",
                    got=f"{found[name]!r} and {unit!r}",
                    remedy="convert its rows to one of them",
                    place=where(int(row)),
                )
    return found


def _is_dated(cell: str) -> bool:
    """Return True for a time with its date."""
    return is_time(cell) and not is_time_of_day(cell)


def _clock_of(source: Any, titles: Sequence[str], taken: Sequence[str]) -> str | None:
    """Return the column of times; of several that of dates, which is said; None where nobody can say which counts."""
    free = [title for title in titles if title not in taken]
    spoken = [title for title in free if says_time(title)]
    found = [title for title in spoken or free if all(map(_is_dated, source.texts(title, 1 if spoken else FEWEST)))]
    if (time := _beside_dates(source, spoken)) is not None:
        return time
    dated = [title for title in found if not set(words_of(title)) & AFTER] if len(found) > 1 else found
    others = [title for title in spoken or found if title not in dated]
    if others and len(dated) == 1:
        source.notes.append(f"the dates in {dated[0]!r} count, not {', '.join(others)}")
    return dated[0] if len(spoken) != 1 and len(dated) == 1 else _only_clock_of(titles, taken, spoken)


def _beside_dates(source: Any, spoken: Sequence[str]) -> str | None:
    """Return the column of times of day of two, the other one of which has their dates."""
    times = [title for title in spoken if is_time_of_day(source.texts(title, 1)[0])]
    dates = [title for title in spoken if title not in times]
    apart = len(spoken) == 2 and len(times) == 1 and is_date(source.texts(dates[0], 1)[0])
    return times[0] if apart else None


def _only_clock_of(titles: Sequence[str], taken: Sequence[str], spoken: Sequence[str]) -> str | None:
    """Return the column of times by its title alone, None where several say so or none is clear."""
    try:
        return clock_of(titles, taken) if len(spoken) < 2 else None
    except InputError:
        return None


def _take_turns(tags: Sequence[str], names: Sequence[str]) -> bool:
    """Return True if all names stand among the first rows, as those of channels do and not the levels of a test."""
    return set(names) <= set(tags[: 2 * len(names)])


def in_long_form(source: Any) -> LongTable | None:
    """Return the signals of a table in long form as columns; None for any other table.

    Its titles must say it (``name`` and ``value``, or words like these, beside one clock), and two names and more must
    stand in at least 20 rows.
    """
    titles = [title for title in source.titles if title]
    found = [
        [title for title in titles if split_header(title)[0].lower().replace(" ", "").replace("_", "") in words]
        for words in (NAMES, VALUES, UNITS)
    ]
    found[0] = [title for title in found[0] if title.lower() != NODE] or found[0]  # beside a name that people read
    if len(found[0]) != 1 or len(found[1]) != 1 or len(found[2]) > 1 or not hasattr(source, "texts"):
        return None
    taken = [title for some in found for title in some]
    if split_header(found[1][0])[1] is not None:
        return None  # one unit for all: readings of one kind, of which nobody says that they are signals apart
    clock = _clock_of(source, titles, taken)
    if clock is None:
        return None
    tags = [tag.strip() for tag in source.texts(found[0][0])]
    if not _are_channels(tags, [name for name, count in Counter(tags).items() if count >= FEWEST]):
        return None
    return LongTable(source, (clock, found[0][0], found[1][0], found[2][0] if found[2] else ""), tags)


def _are_channels(tags: Sequence[str], names: Sequence[str]) -> bool:
    """Return True for names that signals may have, of at least two; numbers must take turns."""
    if not 1 < len(names) <= MOST or any(not name or (is_number(name) and not name.isdecimal()) for name in names):
        return False
    return not any(map(str.isdecimal, names)) or _take_turns(tags, names)
