"""Columns by their names: one of them as numbers with its unit, and the clock that the rows were taken by."""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np

from harness.data.tables.headers import (
    COUNTS,
    TIME_UNITS,
    TRUTH,
    behind_slashes,
    clock_of,
    clock_unit,
    fraction_of,
    part_unit,
    parts_of,
    says_time,
    split_header,
    stated_unit,
    unit_of_time,
    unlike_remark,
    words_of,
)
from harness.data.times.counts import DIGITS, HALF_DAY, dated, unwrapped
from harness.data.times.parts import of_parts
from harness.data.times.stamps import clock, is_date, is_time, is_time_of_day, with_dates, with_part
from harness.errors import InputError
from harness.signals import FloatArray
from harness.units import convert

EPOCH = (6e17, 4.2e18)  # Nanoseconds from 1970 to 1989 and 2103: so large a stamp counts nothing else.


class Source(Protocol):
    """What a reader of one format offers."""

    @property
    def titles(self) -> Sequence[str]:
        """Titles of the columns or names of the variables, in the file's order."""
        ...

    def values(self, title: str) -> FloatArray:
        """Return one column (N,) as float64; NaN where the file holds none, dates and times as seconds."""
        ...

    def unit(self, title: str) -> str | None:
        """Return the unit that the file itself states, after :meth:`values`: s for what was a date or time."""
        ...


class NamedColumns:
    """The columns of a source.

    - ``path``: what messages call it
    """

    def __init__(self, path: Path, source: Source) -> None:
        self.path = path
        self._source = source
        self._said: list[str] = []
        self._rising: dict[str, bool] = {}
        self._slashes: dict[str, tuple[str, str]] | None = None

    @property
    def titles(self) -> tuple[str, ...]:
        """Titles of the measured columns (those of true states are left out)."""
        return tuple(title for title in self._source.titles if not title.startswith(TRUTH))

    @property
    def notes(self) -> tuple[str, ...]:
        """What was noticed while reading."""
        return (*getattr(self._source, "notes", ()), *self._said)

    def where(self, row: int) -> str:
        """Return the place of a row (from 0) as an editor of the file counts it, or as the file itself does."""
        find = getattr(self._source, "where", None)
        return f"row {row}" if find is None else str(find(row))

    @property
    def all_titles(self) -> tuple[str, ...]:
        """Titles of all columns, those of true states included."""
        return tuple(self._source.titles)

    def clocks(self, columns: Sequence[str | int]) -> tuple[list[FloatArray], str] | None:
        """Return the stamps [s] of columns that have clocks of their own, and which they are; None for one clock."""
        find = getattr(self._source, "clocks", None)
        titles = [self.find(column) for column in columns]
        if find is None or None in titles:
            return None
        found: tuple[list[FloatArray], str] = find(titles)
        return found

    @property
    def called(self) -> dict[str, tuple[str, str]]:
        """Selector and unit by name of signals inside variables that say how they are called."""
        found: dict[str, tuple[str, str]] = getattr(self._source, "called", {})
        return found

    def inside(self, title: str) -> list[str] | None:
        """Return the selectors of what a variable holds; None where it is one column."""
        find = getattr(self._source, "inside", None)
        found: list[str] | None = None if find is None else find(title)
        return found

    def clock(self, taken: Collection[str | int] = ()) -> str | None:
        """Return the time column, or the one field of a structure or group that is called so; None if there is none.

        Raises InputError if two columns may be meant.

        - ``taken``: columns that are signals
        """
        found = clock_of(self.titles, taken) or self._clock_by_cells(taken)
        if hasattr(self._source, "clocks"):
            return found
        if found is not None:
            return self._one_that_runs_on(found, taken)
        paths = bool(getattr(self._source, "paths", False))
        inside = [field for title in self.titles for field in self.inside(title) or [title] * paths]
        fields = {field: re.split("[./]", field)[-1] for field in inside} | {name: name for name in self.called}
        times = [field for field, last in fields.items() if field not in taken and clock_of([last])]
        if len(times) != 1 or (taken and len(self.read(times[0])[0]) not in {len(self.read(one)[0]) for one in taken}):
            return None
        return times[0]

    def _clock_by_cells(self, taken: Collection[str | int]) -> str | None:
        """Return the column of dates or times, or of a time, that rises; None for none, or several that differ."""
        free = [title for title in self.titles if title and title not in taken]
        texts = getattr(self._source, "texts", None)
        typed = getattr(self._source, "times", ())
        dates = [
            title for title in free if title in typed or (texts is not None and clock(texts(title, 3)) is not None)
        ]
        timed = [title for title in free if says_time(title) and (self.split(title)[1] or "") in TIME_UNITS]
        spoken = [title for title in free if says_time(title)]
        for some in (dates, timed, spoken if len(spoken) > 1 else ()):
            if some and self._rises(some[0]) and all(self._are_alike(some[0], other) for other in some[1:]):
                return some[0]  # perhaps repeated beside each channel
        return None if texts is None else self._clock_in_digits(free, texts)

    def _clock_in_digits(self, titles: Sequence[str], texts: Callable[..., list[str]]) -> str | None:
        """Return the one column of dates in digits alone that rises; None for none or several."""
        begun = [title for title in titles if dated(texts(title, 3)) is not None]
        written = [title for title in begun if self._rises(title) and dated(texts(title)) is not None]
        return written[0] if len(written) == 1 else None

    def _are_alike(self, title: str, other: str) -> bool:
        """Return True if two columns hold the same numbers."""
        try:
            return np.array_equal(self.read(title)[0], self.read(other)[0])
        except InputError:
            return False

    def _one_that_runs_on(self, found: str, taken: Collection[str | int]) -> str:
        """Return a clock; in the place of one that runs back the one clock beside it that does not, which is said."""
        try:
            if self.titles.count(found) > 1 or not (np.diff(self.read_time(found)[0]) < 0).any():
                return found
            others = [title for title in self.titles if title not in ("", found, *taken) and says_time(title)]
            rising = [title for title in others if self._rises(title)]
            running = [title for title in rising if self._source.unit(title) == "s" or clock_of([title]) is not None]
        except InputError:
            return found  # said where it is read
        if not running or not all(self._are_alike(running[0], other) for other in running[1:]):
            return found
        self._say(f"{found!r} runs back: {running[0]!r}, which runs on, is the time")
        return running[0]

    def _rises(self, title: str) -> bool:
        """Return True if every number of a column is above the one before."""
        if title not in self._rising:
            self._rising[title] = bool((np.diff(self.read(title)[0]) > 0).all())
        return self._rising[title]

    def read_any(self, title: str) -> FloatArray:
        """Return a column (N,) by its exact title, be it measured or true."""
        return self._source.values(title)

    def find(self, column: str | int, like: str | None = None) -> str | None:
        """Return the title that a column's name means: exact, or its name before the unit; None if there is none.

        Raises InputError if two columns carry this name.

        - ``like``: a unit of what the column measures: the unit may then stand without brackets (``theta_deg``)
        """
        titles = self.titles
        column = getattr(self._source, "links", {}).get(column, column)
        if isinstance(column, int):
            return titles[column] if 0 <= column < len(titles) else None
        exact = [title for title in titles if title == column]
        found = exact or [title for title in titles if self.split(title)[0] == column.strip()]
        if not found and getattr(self._source, "paths", False):  # a field of a struct, whatever its file parts them by
            found = [title for title in titles if title.replace("/", ".") == column]
        if not found and like is not None:
            stated = {title: self.stated(title, like) for title in titles if title.startswith(column.strip())}
            found = [title for title, parts in stated.items() if parts is not None and parts[0] == column.strip()]
        if len(found) > 1:
            last = len(titles) - 1 - titles[::-1].index(found[-1])
            raise InputError(
                f"column {column!r} is there {len(found)} times",
                expected="one column of this name",
                got=", ".join(found),
                remedy="rename one, "
                + ("name its title with the unit, " if len(set(found)) == len(found) else "")
                + f"or give its number (--column NAME={last}, column = {last} in a dataset.toml)",
                file=self.path,
            )
        return found[0] if found else None

    def split(self, title: str) -> tuple[str, str | None]:
        """Return name and unit of a title; the index or joint at the end of a path, or beside others, is no unit."""
        name, unit = split_header(title)
        if unit is None and "/" in title and not getattr(self._source, "paths", False):
            if self._slashes is None:
                self._slashes = behind_slashes(self.titles)
            return self._slashes.get(title, (name, unit))
        if unit == "1" and title.rstrip().endswith("[1]") and any(_is_element(other, name) for other in self.titles):
            return title.strip(), None
        inside = (
            getattr(self._source, "paths", False)
            and unit is not None
            and not title[len(name) : len(name) + 1].isspace()
        )
        return (title, None) if inside else (name, unit)

    def stated(self, title: str, like: str) -> tuple[str, str] | None:
        """Return name and unit of a title that states a fitting unit without brackets; steps of a path are no units."""
        parts = stated_unit(title, like)
        path = getattr(self._source, "paths", False) and parts is not None and title[len(parts[0])] in "/."
        return None if path else parts

    def read_time(self, column: str | int, declared: str | None = None) -> tuple[FloatArray, bool]:
        """Return a column (N,) of time stamps [s], and whether their unit was stated or declared.

        Raises InputError if the column is not there, or its title states something that is no unit of time.
        """
        title = self.find(column)
        if title is not None:
            title = column = self._dates_of(title) or title
            if (together := self.of_several(title)) is not None:
                return together, True
        values, unit = self.read(column if title is None else title)
        own = None if title is None else self._source.unit(title)  # of a date, whatever its title says
        spelt = title if title is not None else str(column)
        if own is None:
            beside = unit if column in self.called else None
            unit = self._clock_unit(title, spelt, declared) or (beside and unit_of_time(beside))
            if unit is None and title is not None and (dates := self._dated(title, values)) is not None:
                return dates, True
            if title is not None and (part := fraction_of(title, self.titles)) is not None:
                values, unit = self._with_fraction(title, values, part), "s"
            if unit is None and values.size and EPOCH[0] < values.min() <= values.max() < EPOCH[1]:
                unit = "ns"
            if unit is None:
                self._refuse_remark(spelt)
        values, period, times = unwrapped(values, of_day=own is not None)
        self._say_anew(spelt, period, times, of_day=own is not None)
        if own is not None:
            values = self._with_part(spelt, values)
        unit = own or unit
        return convert(values, unit or "s", "s"), unit is not None

    def _say_anew(self, spelt: str, period: float, times: int, *, of_day: bool) -> None:
        """Say that a clock begins anew, and how it is read."""
        if times:
            kind = "clock of twelve hours" if period == HALF_DAY and of_day else "counter"
            self._say(f"{spelt} is a {kind} that begins anew after {period:.10g} ({times}x): it is taken to go on")

    def of_several(self, title: str, *, turns: bool = False) -> FloatArray | None:
        """Return time stamps [s] that stand in more columns than one, None where they do not.

        - ``turns``: True where rows of several signals take turns, which may share a stamp
        """
        dates = self._with_dates(title)
        return self._of_parts(title) if dates is None else self._with_part(title, dates, turns=turns)

    def _clock_unit(self, title: str | None, spelt: str, declared: str | None) -> str | None:
        """Return the unit of a time column by its declaration or its title; None where neither states one."""
        field = spelt if title is not None else spelt.rpartition(".")[2].partition("[")[0]  # of log.time_ms
        try:
            stated = clock_unit(field, path=title is None or bool(getattr(self._source, "paths", False)))
        except InputError as error:
            if declared is None and not self._is_of_channel(spelt, error.got.strip("'")):
                raise error.located(file=self.path) from error
            stated = None
        declared = declared if declared is None else unit_of_time(declared)
        scales = [convert(np.ones(1), one, "s") for one in (stated, declared) if one is not None]
        if scales and not np.isclose(scales[0], scales[-1]).all():
            self._say(f"the title {spelt!r} says {stated}; {declared}, as declared, counts")
        return declared or stated

    def _is_of_channel(self, clock: str, word: str) -> bool:
        """Return True if a word of a clock's title names its channel, as in ``Time - Plot 0`` beside ``Plot 0``."""
        others = {one for title in self.titles if title != clock and not says_time(title) for one in words_of(title)}
        return word in others and word not in COUNTS and word.isalpha()

    def second_clock(self, title: str, rows: int, most: int, *, seconds: bool) -> FloatArray | None:
        """Return the first stamps [s] of another column that tells the time of the same rows; None if it does not.

        - ``rows``: rows that the column must have: in some files those of other groups have more or fewer
        - ``most``: rows that are read
        - ``seconds``: True if a column without a unit counts seconds, as the clock itself
        """
        texts = getattr(self._source, "texts", None)
        try:
            stamps = None if texts is None else clock(texts(title, most))
            if stamps is not None:
                return stamps
            own = clock_of([title])
            unit = None if own is None else clock_unit(title, path=bool(getattr(self._source, "paths", False)))
            values = self._source.values(title)
            unit = self._source.unit(title) or unit or ("s" if own is not None and seconds else None)
            return None if unit is None or len(values) != rows else convert(values[:most], unit, "s")
        except InputError:
            return None  # what cannot be read tells no time

    def _refuse_remark(self, title: str) -> None:
        """Refuse a time column without a unit where a remark above the table states one that is not the second."""
        said: tuple[str, str] | None = getattr(self._source, "remarked", None)
        if said is not None:
            raise unlike_remark(title, *said).located(file=self.path)

    def _say(self, note: str) -> None:
        """Keep what was noticed, once."""
        if note not in self._said:
            self._said.append(note)

    def _dated(self, title: str, values: FloatArray) -> FloatArray | None:
        """Return dates and times that are written as digits alone in seconds from the first; None for other numbers."""
        if not values.size or not DIGITS[0] <= values[0] < DIGITS[1]:
            return None
        texts = getattr(self._source, "texts", None)
        if texts is None and values[0] > 2.0**53:  # milliseconds that a float cannot hold
            return None
        cells = [f"{value:.0f}" for value in values] if texts is None else texts(title)
        stamps = dated(cells)
        return None if stamps is None else clock(stamps, self._said, self.where)

    def _with_fraction(self, title: str, whole: FloatArray, part: str) -> FloatArray:
        """Return whole seconds with the fraction that another column holds.

        Raises InputError if either is no such number.
        """
        fraction = convert(self.read(part)[0], clock_unit(part, path=True) or "s", "s")
        bad = (whole != np.round(whole)) | (fraction < 0) | (fraction >= 1)
        if len(fraction) != len(whole) or bad.any():
            raise InputError(
                f"seconds in {title!r} with a fraction in {part!r}",
                expected="whole seconds, and a fraction of less than one",
                got=f"{whole[int(np.argmax(bad))]:.10g} and {fraction[int(np.argmax(bad))]:.10g} s",
                remedy="rename the column that is none of both, or write one time column",
                file=self.path,
            )
        self._say(f"time: whole seconds of {title!r} and their fraction in {part!r}")
        return np.asarray((whole - whole[0]) + fraction)

    def _of_parts(self, title: str) -> FloatArray | None:
        """Return the time [s] of which a column is the finest part (seconds beside minutes); None where it is none."""
        parts = parts_of(self.titles)
        if title not in list(parts.values())[-1:]:
            return None
        found = of_parts({part: self.read(one)[0] for part, one in parts.items()})
        if found is not None:
            self._say(f"time: {', '.join(map(repr, parts.values()))} together")
        return found

    def _with_dates(self, title: str) -> FloatArray | None:
        """Return times of day with the dates that another column gives; None where there is none."""
        texts = getattr(self._source, "texts", None)
        if texts is None or not all(map(is_time_of_day, texts(title, 1))):
            return None
        beside = [other for other in self.titles if other not in ("", title) and all(map(is_date, texts(other, 1)))]
        return with_dates(texts(title), texts(beside[0]), self.where) if beside else None

    def _dates_of(self, title: str) -> str | None:
        """Return the column of dates or times to which parts of a second belong that begin anew; else None."""
        texts = getattr(self._source, "texts", None)
        if texts is None or part_unit(self.split(title)[0]) is None or not (np.diff(self.read(title)[0]) < 0).any():
            return None
        return next((one for one in self.titles if one not in ("", title) and all(map(is_time, texts(one, 1)))), None)

    def _with_part(self, title: str, times: FloatArray, *, turns: bool = False) -> FloatArray:
        """Return dates or times [s] that stand still with the parts of a second that another column counts."""
        for other in self.titles if (np.diff(times) == 0).any() else ():
            unit = part_unit(self.split(other)[0])
            if other != title and unit is not None:
                found = with_part(times, convert(self.read(other)[0], unit, "s"), turns=turns)
                if found is not None:
                    self._say(f"time: {title!r}, and between its stamps {other!r}")
                    return found
        return times

    def read(self, column: str | int, like: str | None = None) -> tuple[FloatArray, str | None]:
        """Return one column (N,) and the unit that its title states, or None.

        - ``column, like``: as for :meth:`find`

        Raises
        ------
        InputError
            If the column is not there; the message names near matches. If a cell is no number.
        """
        try:
            title = self.find(column, like)
            if title is None and column in self.called:
                column = self.called[str(column)][0]
            if title is not None:
                number = column if isinstance(column, int) else None
                values = self._values(title, number)
                unit = self._source.unit(title)
                unit = unit if unit is not None else self.split(title)[1]
                if unit is None and like is not None and (parts := self.stated(title, like)) is not None:
                    unit = parts[1]
                return values, unit
            select = getattr(self._source, "select", None)  # of formats whose variables hold more than a column
            selected: FloatArray | None = select(column) if select is not None and isinstance(column, str) else None
        except InputError as error:
            raise error.located(file=self.path) from error
        if selected is not None:
            return selected, next((unit or None for way, unit in self.called.values() if way == column), None)
        raise self.missing(column)

    def _values(self, title: str, number: int | None) -> FloatArray:
        """Return a column by its title, or by its number where two have one title."""
        if number is None or self.titles.count(title) == 1:
            return self._source.values(title)
        numbered = getattr(self._source, "numbered", None)
        if numbered is None:
            raise InputError(
                f"{self.titles.count(title)} columns {title!r}",
                expected="titles of their own",
                got=f"column {number}",
                remedy="rename one",
            )
        places = [place for place, known in enumerate(self._source.titles) if not known.startswith(TRUTH)]
        found: FloatArray = numbered(places[number])
        return found

    def missing(self, column: str | int) -> InputError:
        """Return the refusal of a column that is not there."""
        titles = (*self.titles, *self.called)
        shown = ", ".join(repr(title) for title in titles[:12]) + (" ..." if len(titles) > 12 else "")
        if isinstance(column, int):
            remedy = f"give a number from 0 to {len(self.titles) - 1}"
        else:
            names = {split_header(title)[0].lower(): title for title in titles}
            near = difflib.get_close_matches(column.lower(), list(names), n=2, cutoff=0.5)
            word = column.lower()
            near = near or [one for one in names if one.startswith(f"{word}_")][:2]  # perhaps a unit behind it
            near = near or [one for one in names if min(len(one), len(word)) > 2 and (one in word or word in one)][:2]
            said = " or ".join(repr(names[name]) for name in near)
            remedy = (
                f"did you mean {said}?"
                if near
                else "correct the name, or say which column it is (sysid: --column NAME=TITLE)"
            )
            if len(several := [self.find(part.strip()) for part in column.split(",")]) > 1 and None not in several:
                remedy = "name each by itself (sysid: repeat the option; Python: a list)"
        return InputError(
            f"no column {column!r}",
            expected=f"one of {shown or '(none)'}",
            got=repr(column),
            remedy=remedy,
            file=self.path,
        )


def _is_element(title: str, name: str) -> bool:
    """Return True if a title is another element of an array than its element 1."""
    return title.startswith(f"{name}[") and re.fullmatch(r"\[(?:0|[2-9]|\d\d+)\]\s*", title[len(name) :]) is not None
