"""Files of several loggers as one table: each column keeps the stamps of its own file, brought onto one clock."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from harness.data.conditioning.offset import offset_between
from harness.data.sections import BesideSection
from harness.data.tables.named import NamedColumns
from harness.errors import InputError
from harness.signals import FloatArray


class BesideFile:
    """The columns of a run's file and of those beside it.

    A title that an earlier file has too goes by ``FILE: TITLE``.

    - ``main``: the run's file
    - ``time``: returns its stamps (N,) [s]; asked when they are needed
    - ``others``: the files beside it, and what is declared of their clocks
    """

    def __init__(
        self,
        main: NamedColumns,
        time: Callable[[], FloatArray | None],
        others: Sequence[tuple[NamedColumns, BesideSection]],
    ) -> None:
        self._main, self._time, self._others = main, time, list(others)
        self._homes: dict[str, tuple[int, str]] = {title: (0, title) for title in main.titles}
        for number, (table, section) in enumerate(self._others, start=1):
            for title in table.titles:
                if title != self._clock(table, section):
                    name = title if title not in self._homes else f"{section.file}: {title}"
                    self._homes[name] = (number, title)
        self._stamps: dict[int, FloatArray] = {}
        self.titles = list(self._homes)
        self.notes: list[str] = []
        """The offsets; what else there is to say of a file, its own table says."""

    def values(self, title: str) -> FloatArray:
        """Return one column, as long as its own file."""
        return self._read(title)[0]

    def unit(self, title: str) -> str | None:
        """Return the unit that its file states."""
        return self._read(title)[1]

    def select(self, text: str) -> FloatArray | None:
        """Return None: columns go by their titles."""
        return None

    def clocks(self, titles: Sequence[str]) -> tuple[list[FloatArray], str]:
        """Return the stamps [s] of some columns on the clock of the run's file."""
        return [self._clock_of(self._homes[title][0]) for title in titles], "the clock of the run's file"

    def _read(self, title: str) -> tuple[FloatArray, str | None]:
        number, own = self._homes[title]
        return self._table(number).read(own)

    def _table(self, number: int) -> NamedColumns:
        return self._main if number == 0 else self._others[number - 1][0]

    def _clock(self, table: NamedColumns, section: BesideSection) -> str | int | None:
        """Return the title of a file's clock."""
        return table.clock([]) if section.time is None else table.find(section.time) or section.time

    def _clock_of(self, number: int) -> FloatArray:
        """Return the stamps of a file [s] on the clock of the run's file."""
        if number not in self._stamps:
            self._stamps[number] = self._main_time() if number == 0 else self._brought(*self._others[number - 1])
        return self._stamps[number]

    def _main_time(self) -> FloatArray:
        time = self._time()
        if time is None:
            raise _no_clock(str(self._main.path.name))
        return time

    def _brought(self, table: NamedColumns, section: BesideSection) -> FloatArray:
        """Return the stamps of a file beside, with its offset declared or estimated."""
        column = self._clock(table, section)
        if column is None:
            raise _no_clock(section.file)
        own, stated = table.read_time(column, None)
        if not stated:
            self.notes.append(f"{section.file}: {column} states no unit: it is taken for seconds")
        if section.offset is not None:
            self.notes.append(f"{section.file}: its clock is taken to be {section.offset:g} s behind, as declared")
            return own + section.offset
        if len(section.same) != 2:
            raise InputError(
                f"the clock of {section.file}",
                expected="offset = ... (s to be added to its stamps; 0 for a clock in common), or "
                "same = [TITLE, TITLE]: a quantity that both files hold",
                got="neither" if not section.same else f"{len(section.same)} titles",
                remedy="declare one of them",
                place="runs.beside",
            )
        first, second = section.same
        found = offset_between(self._clock_of(0), self._main.read(first)[0], own, table.read(second)[0])
        self.notes.append(
            f"{section.file}: its clock is {found.seconds:.6g} s behind, standard deviation {found.deviation:.2g} s, "
            f"estimated from {first!r} and {second!r} (correlation {found.correlation:.4f})"
        )
        return np.asarray(own + found.seconds, dtype=np.float64)


def _no_clock(file: str) -> InputError:
    return InputError(
        f"no time in {file}",
        expected="a column of times in each of the files of a run",
        got="none that a title calls so",
        remedy="name it (time = TITLE beside the file's name; [time] column of the first)",
        place="runs.beside",
    )
