"""Tables that are in memory already: pandas, polars, xarray, numpy, dictionaries, and records of ours; Excel sheets."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from harness.data.binary_files import broken, optional
from harness.data.cells import EMPTY, clock, seconds_of, units_below
from harness.data.headers import split_header
from harness.errors import InputError
from harness.signals import FloatArray, Trajectory

__all__ = ["ExcelFile", "MemoryTable", "in_memory"]


class MemoryTable:
    """Columns in memory.

    Parameters
    ----------
    columns : mapping
        One-dimensional arrays by title (``"u [N m]"``).
    first : int
        What a person calls the first row.
    word : str
        What a person calls a row.
    """

    def __init__(self, columns: Mapping[str, Any], *, first: int = 0, word: str = "row") -> None:
        self._columns = {str(title): values for title, values in columns.items()}
        self.titles = list(self._columns)
        self.notes: list[str] = []
        self._first, self._word = first, word

    def values(self, title: str) -> FloatArray:
        """Return one column (N,)."""
        array = np.asarray(self._columns[title])
        if array.ndim != 1:
            raise InputError(
                f"column {title!r}",
                expected="one dimension",
                got=f"shape {array.shape}",
                remedy="give each channel a column of its own",
            )
        if array.dtype.kind in "mM":
            return seconds_of(array)
        if array.dtype.kind in "biuf":
            return array.astype(np.float64)
        return self._slowly(title, list(array))

    def select(self, text: str) -> FloatArray | None:
        """Return None: there are plain columns only."""
        return None

    def unit(self, title: str) -> str | None:
        """Return None: units stand in the titles."""
        return None

    def where(self, row: int) -> str:
        """Return the place of a row (from 0) as the table's owner counts it."""
        return f"{self._word} {row + self._first}"

    def _slowly(self, title: str, cells: list[Any]) -> FloatArray:
        """Return a column of objects: numbers, texts of numbers, times, None."""
        texts = ["" if cell is None else str(cell) for cell in cells]
        if (stamps := clock(texts)) is not None:
            return stamps
        numbers = []
        for row, text in enumerate(texts):
            try:
                numbers.append(np.nan if text.strip().lower() in EMPTY else float(text))
            except ValueError:
                raise InputError(
                    "a cell that is no number",
                    expected="a number",
                    got=repr(text),
                    remedy="correct or empty the cell",
                    place=f"{self.where(row)}, column {title!r}",
                ) from None
        return np.array(numbers)


class ExcelFile(MemoryTable):
    """The first sheet of an Excel workbook: a header, perhaps a row of units, and rows of numbers."""

    def __init__(self, path: Path) -> None:
        openpyxl = optional("openpyxl", "Excel")
        try:
            book = openpyxl.load_workbook(path, read_only=True, data_only=True)
            sheets = list(book.sheetnames)
            rows = [list(row) for row in book[sheets[0]].iter_rows(values_only=True)]
            book.close()
        except Exception as error:
            raise broken(path, "Excel", error) from error
        skipped = 0
        while rows and not any(cell is not None for cell in rows[0]):
            rows, skipped = rows[1:], skipped + 1
        if len(rows) < 2:
            raise InputError("no rows", expected="a header and rows of numbers", got="fewer", remedy="check the sheet")
        titles = ["" if cell is None else str(cell).strip() for cell in rows[0]]
        below = ["" if cell is None else str(cell) for cell in rows[1]]
        named = units_below(titles, below)
        body = rows[1:] if named is None else rows[2:]
        titles = titles if named is None else named
        columns = {title: [row[k] for row in body] for k, title in enumerate(titles) if title}
        super().__init__(columns, first=len(rows) - len(body) + skipped + 1)
        if len(sheets) > 1:
            self.notes.append(f"the workbook has {len(sheets)} sheets: {sheets[0]!r}, the first, is read")


def in_memory(data: Any) -> MemoryTable | None:
    """Return the table of data in memory; None for a path.

    Parameters
    ----------
    data : DataFrame, Dataset of xarray, structured array, mapping of arrays, or Trajectory

    Raises
    ------
    InputError
        If its columns have no names.

    Examples
    --------
    >>> table = in_memory({"time": np.arange(3), "u [Nm]": np.zeros(3)})
    >>> table.titles, table.values("time").tolist()
    (['time', 'u [Nm]'], [0.0, 1.0, 2.0])
    """
    if isinstance(data, str | Path):
        return None
    if isinstance(data, Trajectory):
        from harness.data.trajectories import columns_of

        return MemoryTable(columns_of(data))
    if isinstance(data, Mapping) and not hasattr(data, "data_vars"):
        return MemoryTable(data)
    if isinstance(data, np.ndarray) and data.dtype.names:
        return MemoryTable({name: data[name] for name in data.dtype.names})
    kind = type(data).__module__.partition(".")[0]
    if kind == "pandas" and hasattr(data, "columns"):
        return MemoryTable({**_index(data), **{str(name): data[name].to_numpy() for name in data.columns}})
    if kind == "polars" and hasattr(data, "columns"):
        return MemoryTable({name: data[name].to_numpy() for name in data.columns})
    if kind == "xarray" and hasattr(data, "data_vars"):
        return MemoryTable(
            {_titled(name, data[name]): data[name].to_numpy() for name in (*data.coords, *data.data_vars)}
        )
    raise InputError(
        "data",
        expected="a file, or a table with named columns (DataFrame, xarray.Dataset, mapping of arrays, Trajectory)",
        got=f"{type(data).__module__}.{type(data).__qualname__}",
        remedy='give names: {"time [s]": t, "u [N m]": u, "theta [rad]": theta}',
    )


def _index(frame: Any) -> dict[str, Any]:
    """Return the index of a pandas frame as the time column, where it is one."""
    index = frame.index
    if index.dtype.kind in "mM":
        return {str(index.name or "time [s]"): index.to_numpy()}
    return {} if index.name is None else {str(index.name): index.to_numpy()}


def _titled(name: Any, variable: Any) -> str:
    """Return the title of a variable of xarray, its unit from the attributes."""
    unit = variable.attrs.get("units", variable.attrs.get("unit"))
    return str(name) if unit is None or split_header(str(name))[1] is not None else f"{name} [{unit}]"
