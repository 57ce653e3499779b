"""Excel workbooks: one sheet as a table."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from harness.data.tables.binary_files import broken
from harness.data.tables.columns import MemoryTable
from harness.data.tables.headers import split_header
from harness.data.tables.packing import refuse_bomb
from harness.data.tables.stacked import (
    CERTAIN,
    MOST_ABOVE,
    MOST_ROWS,
    SAMPLE,
    begin_of,
    kinds_of,
    stacked_titles,
    units_among,
)
from harness.errors import InputError
from harness.extras import optional
from harness.signals import FloatArray


class ExcelFile(MemoryTable):
    """A sheet of an Excel workbook, by default the first: a header, perhaps a row of units, and rows of numbers."""

    def __init__(self, path: Path, sheet: str | None = None) -> None:
        sheets, read, rows = _chosen(path, sheet)
        rows, skipped = _without_empty(rows)
        head, last = (
            list(map(_texts, some)) for some in (rows[: MOST_ABOVE + MOST_ROWS + CERTAIN], rows[-SAMPLE - 1 :])
        )
        above = begin_of(head, last)
        rows, skipped = rows[above:], skipped + above
        said = [f"what stands above the table, to row {skipped}, is left aside"] if above else []
        if len(rows) < 2:
            raise InputError("no rows", expected="a header and rows of numbers", got="fewer", remedy="check the sheet")
        head = [_texts(row) for row in rows[: MOST_ROWS + 2]]
        stacked = stacked_titles(head)
        named = units_among(head[0], head[1], kinds_of(last)) if stacked is None else stacked[0]
        count = stacked[1] if stacked is not None else 1 if named is None else 2
        body, titles = rows[count:], head[0] if named is None else named
        if stacked is not None:
            said.append(f"rows {skipped + 1} to {skipped + count} are read as one header")
        named_columns = [k for k, title in enumerate(titles) if title]
        self._cells = [[row[k] for row in body] for k in named_columns]
        first = len(rows) - len(body) + skipped + 1
        for place, k in enumerate(named_columns):
            cells = self._cells[place] if split_header(titles[k])[1] == "%" else []
            if cells and (shown := _as_per_cent(path, read, k, first, cells)):
                self._cells[place] = shown
                said.append(f"{titles[k]}: cells that show per cent hold a hundredth of it: what they show is read")
        names = [titles[k] for k in named_columns]
        columns = dict(zip(names, self._cells, strict=True))
        _refuse_truths(columns, first, path)
        _refuse_header(body, titles, head[0], first, path)
        super().__init__(columns, first=first)
        self.titles = names  # two columns may have one
        self.notes += said
        if len(sheets) > 1 and sheet is None:
            self.notes.append(_of_sheets(sheets, read))

    def numbered(self, column: int) -> FloatArray:
        """Return one column (N,) by its number, as two may have one title."""
        return self._numbers(self.titles[column], self._cells[column])


def _of_sheets(sheets: list[str], read: str) -> str:
    """Return what is said of the sheet that is read, where nobody named it."""
    others = [repr(name) for name in sheets if name != read]
    why = "the first, is read" if read == sheets[0] else "the only one with rows of numbers, is read"
    return (
        f"the workbook has {len(sheets)} sheets: {read!r}, {why}; --sheet names another "
        f"({', '.join(others[:5])}{' ...' if len(others) > 5 else ''})"
    )


def _as_per_cent(path: Path, sheet: str, column: int, first: int, cells: list[Any]) -> list[Any] | None:
    """Return a column of per cent as its cells show it; None where none has the format of per cent.

    A cell that shows 12 % holds 0.12, while one that was typed below a title with ``[%]`` holds 12.
    """
    openpyxl = optional("openpyxl", "Excel")
    book = openpyxl.load_workbook(path, read_only=True, data_only=True)
    below = book[sheet].iter_rows(min_row=first, max_row=first + len(cells) - 1, min_col=column + 1, max_col=column + 1)
    formats = [getattr(row[0], "number_format", "") or "" for row in below]
    book.close()
    if not any("%" in one for one in formats):
        return None
    return [
        100.0 * cell if "%" in shown and isinstance(cell, int | float) else cell
        for cell, shown in zip(cells, formats, strict=True)
    ]


def sheets_of(path: Path) -> list[str]:
    """Return the sheets that have rows of numbers, where the first has none; empty where there is no choice to make.

    Raises InputError if it is no workbook.
    """
    sheets, rows = _read(path, None)
    if len(sheets) < 2 or _has_numbers(rows):
        return []
    return [name for name in sheets[1:] if _has_numbers(_read(path, name)[1])]


def _chosen(path: Path, sheet: str | None) -> tuple[list[str], str, list[list[Any]]]:
    """Return all sheets, the one that is read and its rows: the first, or the only one that has rows of numbers."""
    if sheet is None and (tables := sheets_of(path)):
        if len(tables) > 1:
            raise InputError(
                f"the first sheet holds no rows of numbers, and {len(tables)} others do",
                expected="the sheet that is meant",
                got=", ".join(map(repr, tables[:8])) + (" ..." if len(tables) > 8 else ""),
                remedy=f'name it: --sheet "{tables[0]}", or sheet = "{tables[0]}" in a dataset.toml',
                file=path,
            )
        sheet = tables[0]
    sheets, rows = _read(path, sheet)
    return sheets, sheet or sheets[0], rows


def _without_empty(rows: list[list[Any]]) -> tuple[list[list[Any]], int]:
    """Return rows without the empty ones before and after them, and how many stood before."""
    filled = [k for k, row in enumerate(rows) if any(cell is not None for cell in row)]
    return (rows[filled[0] : filled[-1] + 1], filled[0]) if filled else ([], len(rows))


def _refuse_header(body: list[list[Any]], titles: list[str], head: list[str], first: int, path: Path) -> None:
    """Refuse a second row of titles, and the header among the rows."""
    names = [cell for cell in body[0] if cell is not None] if body else []
    if len(names) > 1 and all(isinstance(cell, str) and cell[:1].isalpha() for cell in names):
        raise InputError(
            "two rows of titles",
            expected=f"rows of numbers under {', '.join(map(repr, titles[:6]))}",
            got=", ".join(map(repr, names[:6])),
            remedy="remove one of the two",
            file=path,
            place=f"row {first}",
        )
    again = [row + first for row, cells in enumerate(map(_texts, body)) if cells == head and any(cells)]
    if again:
        raise InputError(
            "the header stands again among the rows",
            expected="one table",
            got=f"its titles in row {again[0]}",
            remedy="remove that row and what is empty above it, or put what stands below into a sheet of its own",
            file=path,
            place=f"row {again[0]}",
        )


def _has_numbers(rows: list[list[Any]]) -> bool:
    """Return True if a row holds two numbers."""
    return any(sum(isinstance(cell, int | float) and not isinstance(cell, bool) for cell in row) > 1 for row in rows)


def _texts(row: list[Any]) -> list[str]:
    """Return the cells of a row as texts without blanks about them, in one line."""
    return ["" if cell is None else re.sub(r"\s*[\r\n]+\s*", " ", str(cell).strip()) for cell in row]


def _refuse_truths(columns: dict[str, list[Any]], first: int, path: Path) -> None:
    """Refuse TRUE or FALSE among numbers: nobody has measured them, and as 1 and 0 they would pass for readings."""
    for title, cells in columns.items():
        marked = [isinstance(cell, bool) for cell in cells]
        if any(marked) and any(isinstance(cell, int | float) and not isinstance(cell, bool) for cell in cells):
            row = marked.index(True)
            raise InputError(
                "a cell that is no number",
                expected="a number",
                got=str(cells[row]).upper(),
                remedy="correct or empty the cell",
                file=path,
                place=f"row {row + first}, column {title!r}",
            )


def _read(path: Path, sheet: str | None) -> tuple[list[str], list[list[Any]]]:
    """Return the names of the sheets, and the rows of one of them (the first unless named)."""
    openpyxl = optional("openpyxl", "Excel")
    refuse_bomb(path)
    try:
        book = openpyxl.load_workbook(path, read_only=True, data_only=True)
        sheets = list(book.sheetnames)
        chosen = sheets[0] if sheet is None else sheet
        rows = [list(row) for row in book[chosen].iter_rows(values_only=True)] if chosen in sheets else []
        book.close()
    except Exception as error:
        raise broken(path, "Excel", error) from error
    if chosen not in sheets:
        raise InputError(
            f"no sheet {chosen!r}",
            expected=f"one of {', '.join(map(repr, sheets[:12]))}",
            got=repr(chosen),
            remedy="correct sheet = ...",
            file=path,
        )
    return sheets, rows
