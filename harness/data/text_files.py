"""Text tables: CSV and its relatives, with or without a header; every bad cell is named by its line."""

from __future__ import annotations

import csv
import gzip
import io
import re
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from harness.data.cells import EMPTY, clock, is_number, units_below
from harness.data.packing import most_unpacked
from harness.errors import InputError
from harness.signals import FloatArray

__all__ = ["TextFile"]

_DELIMITERS = (",", ";", "\t")
_COMMA = re.compile(r"(?<!\d)[+-]?\d*,\d+(?:[eE][+-]?\d+)?(?!\d)")


class TextFile:
    r"""A CSV, TSV or white-space table, plain or packed by gzip.

    The delimiter is the comma, semicolon or tab that the first line holds most of, else white space. A first line of
    numbers only means that there is no header; the columns are then called ``0``, ``1``, ... A line of units below the
    header belongs to it. Lines that start with ``#`` or ``%`` and empty lines are skipped. Empty cells are NaN. Where
    the comma does not separate, it may be the decimal sign. Dates and times of ISO 8601 become seconds from the first.

    Raises
    ------
    InputError
        If the file is empty or no text.
    """

    def __init__(self, path: Path) -> None:
        lines = _text(path).splitlines()
        self.notes: list[str] = []
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
        if all(is_number(cell) for cell in titles if cell) and any(titles):
            self.titles = [str(number) for number in range(len(titles))]
        else:
            self.titles = titles
            self._lines = self._lines[1:]
            if self._lines and (named := units_below(titles, self._cells(self._lines[0][1]))) is not None:
                self.titles = named
                self._lines = self._lines[1:]
        if not self._lines:
            raise InputError(
                "no rows", expected="rows of numbers below the header", got="only a header", remedy="check the export"
            )
        self._accept_decimal_commas()
        self._body: bytes | None = None

    def values(self, title: str) -> FloatArray:
        """Return one column (N,)."""
        column = self.titles.index(title)
        for read in (self._fast, self._plain):
            found = read(column)
            if found is not None:
                return found
        return self._slowly(column, title)

    def select(self, text: str) -> FloatArray | None:
        """Return None: text tables have plain columns only."""
        return None

    def unit(self, title: str) -> str | None:
        """Return None: units stand in the titles."""
        return None

    def where(self, row: int) -> str:
        """Return the place of a row (from 0) as an editor counts it."""
        return f"line {self._lines[row][0]}"

    def _accept_decimal_commas(self) -> None:
        """Read decimal commas as points, where the comma separates nothing and no number holds a point."""
        if self._delimiter == ",":
            return
        if not any("," in line for _, line in self._lines) or any("." in line for _, line in self._lines):
            return
        if all(_COMMA.search(line) for _, line in self._lines if "," in line):
            self._lines = [(number, line.replace(",", ".")) for number, line in self._lines]
            self.notes.append("decimal commas are read as decimal points")

    def _fast(self, column: int) -> FloatArray | None:
        """Return a column by the C++ reader of Arrow; None where it cannot, or a cell is no number."""
        if self._delimiter is None:
            return None
        import pyarrow as pa
        from pyarrow import csv as arrow

        if self._body is None:
            self._body = "\n".join(line for _, line in self._lines).encode()
        names = [str(number) for number in range(len(self.titles))]
        try:
            table = arrow.read_csv(
                io.BytesIO(self._body),
                read_options=arrow.ReadOptions(column_names=names, use_threads=False),
                parse_options=arrow.ParseOptions(delimiter=self._delimiter),
                convert_options=arrow.ConvertOptions(
                    include_columns=[names[column]],
                    column_types={names[column]: pa.float64()},
                    null_values=sorted({*EMPTY, *map(str.upper, EMPTY), "NaN", "Null", "None", "N/a"}),
                    quoted_strings_can_be_null=True,
                ),
            )
        except pa.ArrowInvalid:
            return None
        found = np.concatenate([_values(chunk) for chunk in table.column(0).chunks] or [np.zeros(0)])
        return found if len(found) == len(self._lines) else None

    def _plain(self, column: int) -> FloatArray | None:
        """Return a column by the reader of numpy; None at the first cell that is no number."""
        try:
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
            return None

    def _slowly(self, column: int, title: str) -> FloatArray:
        """Return a column cell by cell: NaN for an empty one, a named refusal for one that is no number."""
        cells = []
        for _, line in self._lines:
            row = self._cells(line)
            cells.append(row[column] if column < len(row) else "")
        if (stamps := clock(cells)) is not None:
            return stamps
        numbers = []
        commas = not any("." in cell for cell in cells)
        for k, cell in enumerate(cells):
            if cell.lower() in EMPTY:
                numbers.append(np.nan)
                continue
            try:
                numbers.append(float(cell.replace(",", ".") if commas and _COMMA.fullmatch(cell) else cell))
            except ValueError:
                comma = "," in cell
                raise InputError(
                    "a cell that is no number",
                    expected="a number" + (" with one kind of decimal sign" if comma else ""),
                    got=repr(cell),
                    remedy="export with decimal points" if comma else "correct or empty the cell",
                    place=f"{self.where(k)}, column {title!r}",
                ) from None
        return np.array(numbers)

    def _cells(self, line: str) -> list[str]:
        """Return the cells of a line."""
        if self._delimiter is None:
            return [cell.strip('"') for cell in line.split()]
        return [cell.strip() for cell in next(csv.reader(io.StringIO(line), delimiter=self._delimiter))]


def _text(path: Path) -> str:
    """Return the text of a file, unpacked where it is packed."""
    raw = path.read_bytes()
    if path.suffix.lower() == ".gz":
        try:
            with gzip.GzipFile(fileobj=io.BytesIO(raw)) as packed:
                most = most_unpacked(len(raw))
                raw = packed.read(most + 1)
        except (OSError, EOFError, zlib.error) as error:
            raise InputError(
                "not a gzip file", expected="a table packed by gzip", got=str(error), remedy="check the file"
            ) from error
        if len(raw) > most:
            raise InputError(
                "a packed table",
                expected=f"at most {most >> 20} MiB unpacked",
                got="more",
                remedy="unpack it yourself, or cut or thin it",
            )
    coding = "utf-16" if raw[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
    try:
        return raw.decode(coding)
    except UnicodeDecodeError as error:
        raise InputError(
            "not a text file", expected="UTF-8 text", got=str(error), remedy="save it as UTF-8 CSV"
        ) from error


def _values(array: Any) -> FloatArray:
    """Return an Arrow array of floats with NaN for what is missing, by its buffers: ``to_numpy`` imports pandas."""
    valid, data = array.buffers()
    found = np.frombuffer(data, np.float64, len(array), 8 * array.offset).copy()
    if valid is not None:
        bits = np.unpackbits(np.frombuffer(valid, np.uint8), bitorder="little")
        found[bits[array.offset : array.offset + len(array)] == 0] = np.nan
    return found
