"""Text tables: CSV and its relatives, with or without a header; every bad cell is named by its line."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from harness.data.tables.cells import (
    EMPTY,
    arrow_values,
    is_number,
    is_unit_cell,
    numbers_of,
    refuse_thousands,
    units_below,
    with_unit,
)
from harness.data.tables.headers import clock_of, remarked_unit, says_time
from harness.data.tables.keyed import keyed, printed
from harness.data.tables.labelled import labelled
from harness.data.tables.stacked import (
    CERTAIN,
    MOST_ABOVE,
    MOST_ROWS,
    SAMPLE,
    SIGNS,
    are_counted,
    are_stamps,
    begin_of,
    cells_of,
    first_reading,
    is_reading,
    kinds_of,
    lines_below,
    logger_titles,
    sign_of,
    stacked_titles,
    titles_of,
    units_among,
)
from harness.data.tables.texts import CODINGS, closed_lines, plainly_quoted, text_of
from harness.data.times.stamps import clock, is_date, is_time
from harness.errors import InputError
from harness.signals import FloatArray

_HINT = re.compile(r"sep=(.)?", re.IGNORECASE)
_COMMENTS = ("#", "%")
NUMBERED = 200  # Rows that are asked whether the first one numbers the columns.
_RULE = re.compile(r"[\s|+:=;,\-]*(?:-{3,}|={3,})[\s|+:=;,\-]*")
_FRAME = re.compile(r"\+[-=+]{3,}\+")
_OTHER_COMMENTS = (";", "//", "!", "*")
_SETTING = re.compile(r"\w+\s*=\s*[+-]?[\d.]+(?:[eE][+-]?\d+)?\s*[a-zA-Zµ]*")
_MINUS = re.compile("\u2212(?=[\\d.,])")
_PARTS = re.compile(r"[+-]?\d*(?:[.,](?P<decimals>\d*))?(?:[eEdD][+-]?(?P<power>\d*))?")
_THOUSANDS = re.compile(r"[+-]?[1-9]\d{0,2}(?:,\d{3})+")
_CERTAIN_COMMA = re.compile(r"(?<![\d.,:])[+-]?(?:0,\d+|\d+,\d{1,2}|\d+,\d{4,}|\d{1,3}(?:\.\d{3})+,\d+)(?![\d.,])")
_COMMA = re.compile(r"(?<!\d)[+-]?\d*,\d+(?:[eE][+-]?\d+)?(?!\d)")


class TextFile:
    r"""A CSV, TSV or white-space table, plain or packed by gzip.

    What parts the cells is the comma, semicolon, tab, bar or white space by which most cells of the last rows are
    readings (or what a first line ``sep=;`` of Excel names), and the titles stand right above the first rows that hold
    numbers and times where the last ones do; what stands above them is left aside and said. A first line of numbers
    only means that there is no header, unless a comment right above it names every column; the columns are then called
    ``0``, ``1``, ... A line of units below the header belongs to it. Lines that start with ``#`` or ``%`` and empty
    lines are skipped. Empty cells are NaN. Where the comma does not separate, it may be the decimal sign. Dates and
    times of ISO 8601 become seconds from the first.

    Raises
    ------
    InputError
        If the file is empty or no text.
    """

    def __init__(self, path: Path) -> None:
        text, coding = text_of(path)
        if "\u2212" in text:
            text = _MINUS.sub("-", text)
        text = plainly_quoted(text) if "'" in text else text
        lines = text.splitlines()
        self.titles: list[str] = []
        self.notes: list[str] = []
        self.remarked: tuple[str, str] | None = None
        """The unit of time that a remark above the table states, where it is not the second."""
        self._commas_read = False
        if coding in CODINGS:
            self.notes.append(f"the text is no UTF-8: its letters are read as {coding} ({CODINGS[coding]})")
        self._lines = _of_tables(closed_lines(lines) if '"' in text else enumerate(lines, start=1))
        self._leave_out_below()
        for other in (printed, labelled, keyed):
            if (found := other(self._lines)) is not None:
                self._lines = found[0]
                self.notes.append(found[1])
        while len(self._lines) > 1 and not self._lines[-1][1].strip(" ,;\t|"):  # rows of a workbook that hold nothing
            self._lines.pop()
        hint = _HINT.fullmatch(self._lines[0][1].strip(" \t")) if self._lines else None
        self._lines = self._lines if hint is None else self._lines[1:]
        if not self._lines:
            raise InputError("an empty file", expected="a header and rows of numbers", got="nothing", remedy="check it")
        self._leave_out_comments()
        # the tab was taken for an end of the line
        self._delimiter = (hint[1] or "\t") if hint is not None else sign_of([line for _, line in self._lines])
        self._leave_out_above()
        above = self._lines
        self._read_header(lines)
        self._leave_out_again({line for _, line in above[: len(above) - len(self._lines)]}, text)
        if not self._lines:
            raise InputError(
                "no rows", expected="rows of numbers below the header", got="only a header", remedy="check the export"
            )
        if not self._has_clock():
            self._look_between(lines)
        self.remarked = remarked_unit(lines[: min(self._lines[0][0] - 1, MOST_ABOVE)])
        self._accept_decimal_commas()
        self._square()
        if not text.endswith(("\n", "\r")):
            self._leave_out_cut_end()
        self._body: bytes | None = None
        self._stated: dict[str, str] = {}
        self._leave_out_twins()
        if self.titles[0] == "" and not self._has_clock() and clock(self.texts("", 3)) is not None:
            self.titles[0] = "time"  # the index of a table of pandas

    def _read_header(self, lines: list[str]) -> None:
        """Find the titles, and leave the rows of numbers."""
        self._first = self._lines[0][1]
        titles = self._cells(self._first)
        numbers = sum(is_number(title) or is_time(title) or is_date(title) for title in titles)
        mostly = any(titles) and 2 * numbers > len(titles) and not any(map(says_time, titles))
        named = self._named(lines, len(titles)) if mostly else None
        plain = any(titles) and (_are_numbers([cell for cell in titles if cell]) or is_reading(self._head()))
        if plain and named is None and are_counted([self._cells(line) for _, line in self._lines[:NUMBERED]]):
            self.titles, self._lines = titles, self._lines[1:]
        elif named is not None or plain:
            self.titles = named or [str(number) for number in range(len(titles))]
            if named is None:
                self.notes.append(f"line {self._lines[0][0]} holds numbers: the columns are called 0, 1, ... in order")
                if are_stamps([self._cells(line)[:2] for _, line in self._lines[:NUMBERED]]):
                    self.titles[:2] = ["sec", "nanosec"]
                    self.notes.append("columns 0 and 1 are seconds from 1970 and nanoseconds, as ROS writes a stamp")
        else:
            self._read_titles(titles)

    def _head(self) -> list[list[str]]:
        """Return the cells of the first rows."""
        return [self._cells(line) for _, line in self._lines[: MOST_ROWS + 2]]

    def _read_titles(self, titles: list[str]) -> None:
        """Take titles that are no numbers, with the lines below them that belong to them."""
        self.titles = titles
        head = self._head()
        stacked = logger_titles(head) or stacked_titles(head)
        count = 1 if stacked is None else stacked[1]
        if stacked is not None:
            self.titles = stacked[0]
            self.notes.append(f"lines {self._lines[0][0]} to {self._lines[count - 1][0]} are read as one header")
        self._lines = self._lines[count:]
        below = None
        if stacked is None and self._lines:
            kinds = kinds_of([self._cells(line) for _, line in self._lines[-SAMPLE - 1 :]])
            below = units_among(titles, self._cells(self._lines[0][1]), kinds)
        if below is not None:
            self.titles, self._lines = below, self._lines[1:]

    def values(self, title: str) -> FloatArray:
        """Return one column (N,)."""
        return self.numbered(self.titles.index(title))

    def numbered(self, column: int) -> FloatArray:
        """Return one column (N,) by its number, as two may have one title."""
        for read in (self._fast, self._plain):
            found = read(column)
            if found is not None:
                self._refuse_thousands(column, found)
                return found
        return self._slowly(column, self.titles[column])

    def unit(self, title: str) -> str | None:
        """Return s for dates and times, and the unit that all cells carry; other units stand in the titles."""
        return self._stated.get(title)

    def where(self, row: int) -> str:
        """Return the place of a row (from 0) as an editor counts it."""
        return f"line {self._lines[row][0]}"

    def _leave_out_comments(self) -> None:
        """Leave out lines of other comments before a table without their sign, and rules above its rows."""
        for mark in _OTHER_COMMENTS:
            begin = next((row for row, (_, line) in enumerate(self._lines) if not line.lstrip().startswith(mark)), 0)
            if begin and len(self._lines) - begin > 2 and mark not in self._lines[-2][1]:
                self._leave_out(begin)
        if self._lines[0][1].startswith("+-"):  # a table in a frame
            self._lines = [pair for pair in self._lines if not _FRAME.fullmatch(pair[1].strip())] or self._lines
        for row in range(min(MOST_ABOVE, len(self._lines) - 2), 0, -1):
            above = re.split(r"[\s,;|]+", self._lines[row - 1][1])
            if _RULE.fullmatch(self._lines[row][1]) and not any(map(is_number, above)):
                del self._lines[row]

    def _leave_out_again(self, head: set[str], text: str) -> None:
        """Leave out lines that repeat one of the header, where a logger began anew, and say so."""
        again = [line for line in head if text.count(line) > 1]
        numbers = [number for number, line in self._lines if line in again] if again else []
        if numbers and self._has_clock():  # whose steps show what was lost there
            self._lines = [pair for pair in self._lines if pair[1] not in again]
            shown = ", ".join(map(str, numbers[:6])) + (" ..." if len(numbers) > 6 else "")
            self.notes.append(f"line {shown} repeats the header: it is no row")

    def _look_between(self, lines: list[str]) -> None:
        """Refuse empty lines among rows that no clock tells apart, as they part two records; say which are comments.

        Raises InputError with the first of them, unless there is one behind every row.
        """
        numbers = [number for number, _ in self._lines]
        between = [
            (end - 1, lines[end - 2].strip())
            for begin, end in pairwise(numbers)
            if end > begin + 1 and lines[begin - 1].count('"') % 2 == 0  # else a cell goes on over these lines
        ]
        empty = [number for number, text in between if not text]
        if 0 < len(empty) < len(numbers) // 2:
            raise InputError(
                f"an empty line among the rows of a table without a time column ({len(empty)} in all)",
                expected="rows of one record: nothing but a clock would show what is lost between two",
                got=f"an empty line {empty[0]}",
                remedy="remove it, or put what stands below it into a file of its own",
                place=f"line {empty[0]}",
            )
        said = [f"line {number}, a comment among the rows, is left out" for number, text in between if text]
        self.notes += said[:3] + ([f"{len(said) - 3} more comments are left out"] if len(said) > 3 else [])

    def _has_clock(self) -> bool:
        """Return True if a title, or more of them, say time."""
        try:
            return clock_of(self.titles) is not None
        except InputError:
            return True

    def _leave_out_above(self) -> None:
        """Leave out what a logger writes above its table."""
        head = [cells_of(line, self._delimiter) for _, line in self._lines[: MOST_ABOVE + MOST_ROWS + CERTAIN]]
        last = [cells_of(line, self._delimiter) for _, line in self._lines[-SAMPLE - 1 :]]
        width = min(map(len, last))  # a sign may end the lines above alone
        head = [row[:-1] if len(row) == width + 1 and not row[-1] else row for row in head]
        if logger_titles(head) is None and (begin := begin_of(head, last) or self._begin_untitled(head, last)):
            self._leave_out(begin)

    def _begin_untitled(self, head: list[list[str]], last: list[list[str]]) -> int:
        """Return the first row of a table without titles below words that cannot be any; 0 where there are none."""
        begin, width = first_reading(head, kinds_of(last)), len(last[-1])
        above = [line for row, (_, line) in zip(head, self._lines[:begin], strict=False) if not _are_numbers(row)]
        titled = any(len(row) > 1 and not _are_numbers(row) for row in head[:begin])
        titled = titled or any(len(titles_of(line, sign, width)) == width for line in above for sign in SIGNS)
        return 0 if titled or self._delimiter is None or width < 2 or len(head) < begin + CERTAIN else begin

    def _leave_out_below(self) -> None:
        """Leave out what stands below the rows, such as statistics or the end of a report, and say so."""
        if count := lines_below([line for _, line in self._lines]):
            self._say_left_out(self._lines[-count:], "below")
            self._lines = self._lines[:-count]

    def _leave_out(self, begin: int) -> None:
        """Leave out the lines before one of them, and say so."""
        self._say_left_out(self._lines[:begin], "above")
        self._lines = self._lines[begin:]

    def _say_left_out(self, lines: list[tuple[int, str]], place: str) -> None:
        """Say that lines above or below the table are no rows of it."""
        first, last = lines[0][0], lines[-1][0]
        self.notes.append(
            f"lines {first} to {last} stand {place} the table: they are left aside"
            if last > first
            else f"line {first} stands {place} the table: it is left aside"
        )

    def _named(self, lines: list[str], width: int) -> list[str] | None:
        """Return the titles that a comment right above the numbers gives to all columns; None where it does not."""
        first, head = self._lines[0][0], []
        for line in reversed(lines[max(0, first - 1 - MOST_ROWS) : first - 1]):
            titles = titles_of(line.strip().lstrip("#%;/!* \t"), self._delimiter, width)
            if not line.strip().startswith((*_COMMENTS, *_OTHER_COMMENTS)) or len(titles) != width:
                break
            head.append(titles)
            if not all(map(is_unit_cell, titles)):
                break
        if not head or not all(head[-1]) or any(map(is_number, head[-1])):
            return None
        said = f"line {first - len(head)}, a comment above the numbers, gives their titles"
        self.notes.append(said + (f", line {first - len(head) + 1} their units" if len(head) > 1 else ""))
        return units_below(head[-1], head[-2]) if len(head) > 1 else head[-1]

    def _leave_out_cut_end(self) -> None:
        """Leave out the last row of a text without an end of its line, where its last cell lacks what all others have.

        A number that is cut is a number still, of another size where its exponent is lost.
        """
        if len(self._lines) < 3:
            return
        parts = [_PARTS.fullmatch(self._cells(line)[-1]) for _, line in self._lines[-50:]]
        kinds = [
            None
            if part is None
            else tuple(-1 if part[key] is None else len(part[key]) for key in ("decimals", "power"))
            for part in parts
        ]
        whole = [kind for kind in kinds[:-1] if kind is not None]
        last, line = kinds[-1], self._lines[-1][1]
        short = last is not None and bool(whole) and any(last[k] < min(kind[k] for kind in whole) for k in (0, 1))
        if line.count('"') % 2 or short:
            self.notes.append(f"line {self._lines[-1][0]}, the last one, ends in a cell that is cut: it is left out")
            self._lines = self._lines[:-1]

    def _accept_decimal_commas(self) -> None:
        """Read decimal commas as points, where the comma separates nothing and no number holds a point."""
        if self._delimiter == ",":
            return
        if not any("," in line for _, line in self._lines) or any("." in line for _, line in self._lines):
            return
        numbers = [cell for _, line in self._lines if "," in line for cell in self._cells(line) if "," in cell]
        if all(map(_THOUSANDS.fullmatch, numbers)):  # 1,234 is a thousand as likely as a fraction
            return
        if all(_COMMA.search(line) for _, line in self._lines if "," in line):
            self._lines = [(number, line.replace(",", ".")) for number, line in self._lines]
            self._commas_read = True
            self.notes.append("decimal commas are read as decimal points")

    def _square(self) -> None:
        """Make every row as long as the header where that is certain; refuse the others with their line.

        Empty cells behind the last column are surplus separators. A last line that stops short was cut. Row names of R
        are quoted while the numbers are not, and have no title. Anything else could belong to any column.
        """
        while len(self.titles) > 2 and _SETTING.fullmatch(self.titles[-1]):  # t0 = -0.5, tInc = 0.01 of a scope
            self.titles = self.titles[:-1]
        lengths = self._lengths()
        apart = titles_of(self._first, self._delimiter, int(lengths[0]))
        if lengths[0] != len(self.titles) and (lengths == len(apart)).all():
            self.titles = apart
        width = len(self.titles)
        if (lengths == width).all():
            return
        if self.titles[-1] == "" and (lengths == width - 1).all():  # the separator ends the header only
            self.titles = self.titles[:-1]
            return
        if (lengths == width + 1).all() and all(self._names_row(line) for _, line in self._lines):
            self.titles = ["", *self.titles]
            self.notes.append("the first cells are names of rows, as R writes them: the titles begin behind them")
            return
        if lengths[-1] < width and (lengths[:-1] == width).all() and len(lengths) > 1:
            self.notes.append(f"line {self._lines[-1][0]}, the last one, is cut short: it is left out")
            self._lines = self._lines[:-1]
            return
        for row in np.flatnonzero(lengths != width):
            number, line = self._lines[row]
            cells = self._cells(line)
            if len(cells) < width or any(cells[width:]):
                self._refuse_header(int(row))
                raise InputError(
                    f"a row of {len(cells)} cells under {width} titles",
                    expected=f"{width} cells ({', '.join(map(repr, self.titles[:6]))}{' ...' if width > 6 else ''})",
                    got="".join(sign if sign.isprintable() else "?" for sign in line.strip()[:80]),
                    remedy=self._remedy_of_kinds()
                    or "give every column a title and every row as many cells, empty where nothing was recorded",
                    place=f"line {number}",
                )
            self._lines[row] = (number, self._joined(cells[:width]))

    def _remedy_of_kinds(self) -> str:
        """Return what to do where rows of several kinds take turns, each behind its word; empty where they do not."""
        words = [self._cells(line)[0] for _, line in self._lines]
        kinds = list(dict.fromkeys(word for word in words if re.match(r"\$?[^\W\d]", word)))
        if len(kinds) < 2 or len(kinds) > len(words) // 4 or sum(map(words.count, kinds)) < len(words):
            return ""
        return (
            f"put the rows of each kind ({', '.join(kinds[:6])}) into a table of their own, as the exporter of the "
            "program that wrote them does"
        )

    def _lengths(self) -> npt.NDArray[np.int64]:
        """Return the number of cells of every row."""
        if self._delimiter is None or any('"' in line for _, line in self._lines):
            return np.array([len(self._cells(line)) for _, line in self._lines])
        return np.array([line.count(self._delimiter) + 1 for _, line in self._lines])

    def _leave_out_twins(self) -> None:
        """Leave out columns that repeat another with its title, as a clock stands beside each channel of TwinCAT."""
        for column, title in enumerate(self.titles):
            first = self.titles.index(title)
            if title and first < column and self.texts_of(column) == self.texts_of(first):
                self.titles[column] = ""
                self.notes.append(f"column {column} repeats column {first}, {title!r}: it is left out")

    def _names_row(self, line: str) -> bool:
        """Return True if the first cell of a row is a quoted name, or no number, and the others are numbers."""
        cells = self._cells(line)
        plain = not all(is_number(cell) or cell.lower() in EMPTY for cell in cells[:1])
        quoted = line.lstrip().startswith('"') and line.count('"') == 2
        return (plain or quoted) and any(map(is_number, cells[1:]))

    def _joined(self, cells: list[str]) -> str:
        """Return cells as a line."""
        text = io.StringIO()
        csv.writer(text, delimiter=self._delimiter or " ", lineterminator="").writerow(cells)
        return text.getvalue()

    def _fast(self, column: int) -> FloatArray | None:
        """Return a column by the C++ reader of Arrow; None where it cannot, or a cell is no number."""
        table = self._arrow(column, "float64")
        if table is None:
            return None
        return np.concatenate([arrow_values(chunk) for chunk in table.chunks] or [np.zeros(0)])

    def _arrow(self, column: int, kind: str) -> Any:
        """Return a column of Arrow, of numbers or of texts; None where its reader cannot."""
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
                    column_types={names[column]: pa.float64() if kind == "float64" else pa.string()},
                    null_values=sorted({*EMPTY, *map(str.upper, EMPTY), "NaN", "Null", "None", "N/a"}),
                    quoted_strings_can_be_null=True,
                ),
            )
        except pa.ArrowInvalid:
            return None
        found = table.column(0)
        return found if len(found) == len(self._lines) else None

    def _plain(self, column: int) -> FloatArray | None:
        """Return a column by the reader of numpy; None at the first cell that is no number."""
        try:
            found = np.loadtxt(
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
        return found if len(found) == len(self._lines) else None  # a quotation that nothing closes swallows rows

    def _slowly(self, column: int, title: str) -> FloatArray:
        """Return a column cell by cell: NaN for an empty one, a named refusal for one that is no number."""
        cells = []
        for _, line in self._lines:
            row = self._cells(line)
            cells.append(row[column] if column < len(row) else "")

        def where(row: int) -> str:
            return f"{self.where(row)}, column {title!r}"

        commas = self._decimal_commas()
        found = with_unit(cells, title, where, self.notes, self._stated, commas=commas)
        if found is not None:
            return found
        try:
            return numbers_of(cells, where, self.notes, commas=commas)
        except InputError:
            for number, cell in enumerate(cells):
                if cell[:1].isalpha():
                    self._refuse_header(number)
            raise

    def _refuse_header(self, row: int) -> None:
        """Refuse a row of words alone: other columns, or another order of them, begin there.

        Raises InputError if it is one.
        """
        number, line = self._lines[row]
        cells = [cell for cell in self._cells(line) if cell]
        if len(cells) > 1 and all(cell[:1].isalpha() and cell.lower() not in EMPTY for cell in cells):
            if not any(is_number(cell) for _, one in self._lines for cell in self._cells(one)):
                raise InputError(
                    "no table", expected="a header and rows of numbers", got="words alone", remedy="give the log itself"
                )
            raise InputError(
                "another header among the rows" if row else "two rows of titles",
                expected=f"one table, under {', '.join(map(repr, self.titles[:6]))}",
                got=line.strip()[:80],
                remedy="put what stands below it into a file of its own" if row else "remove one of the two",
                place=f"line {number}",
            )

    def _refuse_thousands(self, column: int, values: FloatArray) -> None:
        """Refuse numbers that were read with points which may stand between thousands."""
        size = np.abs(values[np.isfinite(values)])
        fractions = size[size != np.round(size)]
        if self._commas_read or not size.size or size.max() >= 1000 or (fractions < 1).any():
            return
        if np.abs(1000 * fractions - np.round(1000 * fractions)).max(initial=0.0) > 1e-6:
            return  # more than three decimals
        cells = [cell.strip() for cell in self.texts_of(column)]
        if any("." in cell for cell in cells):
            title = self.titles[column]
            refuse_thousands(cells, lambda row: f"{self.where(row)}, column {title!r}", commas=self._decimal_commas())

    def _decimal_commas(self) -> bool:
        """Return True if a cell of the table can only be a number with a decimal comma."""
        lines = (line for _, line in self._lines)
        if self._delimiter == ",":
            lines = (line for line in lines if '"' in line)
        return any(_CERTAIN_COMMA.search(line) for line in lines if "," in line)

    def texts_of(self, column: int) -> list[str]:
        """Return the cells of a column, by its number, as they are written."""
        found = self._arrow(column, "string")
        if found is not None:
            return [str(cell) for cell in found.to_pylist()]
        rows = (self._cells(line) for _, line in self._lines)
        return [row[column] if column < len(row) else "" for row in rows]

    def texts(self, title: str, most: int | None = None) -> list[str]:
        """Return the cells of a column as they are written, at most so many."""
        column = self.titles.index(title)
        if most is None:
            return [cell.strip() for cell in self.texts_of(column)]
        rows = (self._cells(line) for _, line in self._lines[:most])
        return [row[column] if column < len(row) else "" for row in rows]

    def _cells(self, line: str) -> list[str]:
        """Return the cells of a line."""
        return cells_of(line, self._delimiter)


def _of_tables(lines: Iterable[tuple[int, str]]) -> list[tuple[int, str]]:
    """Return the lines that are neither empty nor comments; behind a tab a cell begins, which is none."""
    return [(number, line) for number, line in lines if line.strip() and not line.lstrip(" ").startswith(_COMMENTS)]


def _are_numbers(cells: list[str]) -> bool:
    """Return True if all cells are numbers, perhaps with decimal commas."""
    return all(is_number(cell) or is_number(cell.replace(",", ".", 1)) for cell in cells)
