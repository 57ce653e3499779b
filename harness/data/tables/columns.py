"""Columns of numbers, texts and times that are in memory, as a reader of a file shows its own."""

from __future__ import annotations

import datetime
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from harness.data.tables.cells import numbers_of, say_truths, seconds_of, with_unit
from harness.data.tables.headers import TRUTH, split_header
from harness.errors import InputError
from harness.signals import Channel, FloatArray, Trajectory


class MemoryTable:
    """Columns in memory.

    - ``columns``: one-dimensional arrays by title (``"u [N m]"``)
    - ``first``: what a person calls the first row
    - ``word``: what a person calls a row
    """

    def __init__(self, columns: Mapping[str, Any], *, first: int = 0, word: str = "row") -> None:
        self._columns = {str(title): values for title, values in columns.items()}
        self.titles = list(self._columns)
        self.notes: list[str] = []
        self._stated: dict[str, str] = {}
        self._first, self._word = first, word

    def values(self, title: str) -> FloatArray:
        """Return one column (N,)."""
        return self._numbers(title, self._columns[title])

    def _numbers(self, title: str, column: Any) -> FloatArray:
        """Return the numbers of a column."""
        if isinstance(column, np.ma.MaskedArray) and column.dtype.kind in "biuf":
            column = np.ma.filled(np.ma.asarray(column, np.float64), np.nan)  # what is masked was not measured
        array = np.asarray(column)
        if array.ndim != 1:
            raise InputError(
                f"column {title!r}",
                expected="one dimension",
                got=f"shape {array.shape}",
                remedy="give each channel a column of its own",
            )
        if array.dtype.kind in "mM":
            self._stated[title] = "s"
            return seconds_of(array)
        if array.dtype.kind == "b":
            say_truths(self.notes, title)
        if array.dtype.kind in "biuf":
            return array.astype(np.float64)
        if array.dtype.kind == "c":
            raise InputError(
                f"column {title!r}",
                expected="real numbers",
                got=f"complex ones ({array.dtype})",
                remedy="give real and imaginary part a column each",
            )
        return self._slowly(title, list(array))

    def unit(self, title: str) -> str | None:
        """Return s for dates and times, and the unit that all cells carry; other units stand in the titles."""
        return self._stated.get(title)

    def where(self, row: int) -> str:
        """Return the place of a row (from 0) as the table's owner counts it."""
        return f"{self._word} {row + self._first}"

    def _slowly(self, title: str, cells: list[Any]) -> FloatArray:
        """Return a column of objects: numbers, texts of numbers, times, None."""
        if any(isinstance(cell, datetime.timedelta) for cell in cells):
            cells = [cell.total_seconds() if isinstance(cell, datetime.timedelta) else cell for cell in cells]
            self._stated[title] = "s"

        def where(row: int) -> str:
            return f"{self.where(row)}, column {title!r}"

        texts = ["" if cell is None else str(cell) for cell in cells]
        found = with_unit(texts, title, where, self.notes, self._stated)
        return numbers_of(texts, where) if found is None else found

    def texts(self, title: str, most: int | None = None) -> list[str]:
        """Return the cells of a column as they are written, at most so many."""
        return ["" if cell is None else str(cell) for cell in self._columns[title][:most]]


def columns_of(trajectory: Trajectory) -> dict[str, FloatArray]:
    """Return the columns of a record by title: time, inputs, outputs, true states.

    Examples
    --------
    >>> import numpy as np
    >>> from harness.signals import Channel, PlantSpec, Trajectory
    >>> spec = PlantSpec((Channel("u", "N m"),), (Channel("theta", "rad"),), 0.5)
    >>> list(columns_of(Trajectory(np.arange(2) * 0.5, np.zeros((2, 1)), np.ones((2, 1)), spec)))
    ['time [s]', 'u [N m]', 'theta [rad]']
    """
    spec = trajectory.spec
    columns = {"time [s]": trajectory.t}
    groups: list[tuple[str, Sequence[Channel], FloatArray | None]] = [
        ("", spec.inputs, trajectory.u),
        ("", spec.outputs, trajectory.y),
        (TRUTH, spec.states, trajectory.x),
    ]
    for prefix, channels, values in groups:
        if values is None:
            continue
        named = list(channels) or [Channel(f"x{i + 1}") for i in range(values.shape[1])]
        for i, channel in enumerate(named):
            title = f"{prefix}{channel}"
            if title in columns or split_header(title)[0] != f"{prefix}{channel.name}":
                raise InputError(
                    "a record that cannot be written as a table",
                    expected="channels with names of their own that a title can carry",
                    got=repr(title),
                    remedy="rename the channel",
                )
            columns[title] = values[:, i]
    return columns
