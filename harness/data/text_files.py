"""Text tables: CSV and its relatives, with or without a header; every bad cell is named by its line."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np

from harness.errors import InputError
from harness.signals import FloatArray

__all__ = ["TextFile"]

_EMPTY = {"", "na", "n/a", "nan", "null", "none", "-nan", "#n/a"}
_DELIMITERS = (",", ";", "\t")


class TextFile:
    r"""A CSV, TSV or white-space table.

    The delimiter is the comma, semicolon or tab that the first line holds most of, else white space. A first line of
    numbers only means that there is no header; the columns are then called ``0``, ``1``, ... Lines that start with
    ``#`` or ``%`` and empty lines are skipped. Empty cells are NaN.

    Raises
    ------
    InputError
        If the file is empty or no text.
    """

    def __init__(self, path: Path) -> None:
        try:
            text = path.read_text(encoding="utf-8-sig")
        except UnicodeDecodeError as error:
            raise InputError(
                "not a text file", expected="UTF-8 text", got=str(error), remedy="save it as UTF-8 CSV"
            ) from error
        lines = text.splitlines()
        self._lines = [
            (number, line)
            for number, line in enumerate(lines, start=1)
            if line.strip() and not line.lstrip().startswith(("#", "%"))
        ]
        if not self._lines:
            raise InputError("an empty file", expected="a header and rows of numbers", got="nothing", remedy="check it")
        first = self._lines[0][1]
        counts = {sign: first.count(sign) for sign in _DELIMITERS}
        best = max(_DELIMITERS, key=lambda sign: counts[sign])
        self._delimiter = best if counts[best] else None
        titles = self._cells(first)
        if all(_is_number(cell) for cell in titles if cell) and any(titles):
            self.titles = [str(number) for number in range(len(titles))]
        else:
            self.titles = titles
            self._lines = self._lines[1:]
        if not self._lines:
            raise InputError(
                "no rows", expected="rows of numbers below the header", got="only a header", remedy="check the export"
            )

    def values(self, title: str) -> FloatArray:
        """Return one column (N,)."""
        column = self.titles.index(title)
        try:
            # fast path: C parser of numpy, correctly rounded; fails on the first cell that is no number
            return np.loadtxt(
                (line for _, line in self._lines),
                delimiter=self._delimiter,
                usecols=column,
                ndmin=1,
                comments=None,
                quotechar='"',
                dtype=np.float64,
            )
        except (ValueError, IndexError):
            return self._slowly(column, title)

    def select(self, text: str) -> FloatArray | None:
        """Return None: text tables have plain columns only."""
        return None

    def unit(self, title: str) -> str | None:
        """Return None: units stand in the titles."""
        return None

    def _slowly(self, column: int, title: str) -> FloatArray:
        """Return a column cell by cell: NaN for an empty one, a named refusal for one that is no number."""
        numbers = []
        for number, line in self._lines:
            cells = self._cells(line)
            cell = cells[column] if column < len(cells) else ""
            if cell.lower() in _EMPTY:
                numbers.append(np.nan)
                continue
            try:
                numbers.append(float(cell))
            except ValueError:
                comma = "," in cell and self._delimiter != ","
                raise InputError(
                    "a cell that is no number",
                    expected="a number" + (" with a decimal point" if comma else ""),
                    got=repr(cell),
                    remedy="export with decimal points" if comma else "correct or empty the cell",
                    place=f"line {number}, column {title!r}",
                ) from None
        return np.array(numbers)

    def _cells(self, line: str) -> list[str]:
        """Return the cells of a line."""
        if self._delimiter is None:
            return [cell.strip('"') for cell in line.split()]
        return [cell.strip() for cell in next(csv.reader(io.StringIO(line), delimiter=self._delimiter))]


def _is_number(text: str) -> bool:
    """Return True if a cell holds a number (the word nan in a header is a title, not a number)."""
    try:
        float(text)
    except ValueError:
        return False
    return not text.strip().lower().lstrip("+-").startswith(("nan", "inf"))
