"""Excel workbooks: one sheet as a table."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from harness.data.tables.binary_files import broken
from harness.data.tables.cells import units_below
from harness.data.tables.columns import MemoryTable
from harness.data.tables.packing import refuse_bomb
from harness.errors import InputError
from harness.extras import optional

__all__ = ["ExcelFile"]


class ExcelFile(MemoryTable):
    """A sheet of an Excel workbook, by default the first: a header, perhaps a row of units, and rows of numbers."""

    def __init__(self, path: Path, sheet: str | None = None) -> None:
        sheets, rows = _read(path, sheet)
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
        twice = sorted({title for title in titles if title and titles.count(title) > 1})
        if twice:
            raise InputError(
                f"two columns {twice[0]!r}",
                expected="titles of their own",
                got=", ".join(titles[:12]),
                remedy="rename one",
                file=path,
            )
        columns = {title: [row[k] for row in body] for k, title in enumerate(titles) if title}
        super().__init__(columns, first=len(rows) - len(body) + skipped + 1)
        if len(sheets) > 1 and sheet is None:
            others = ", ".join(map(repr, sheets[1:6])) + (" ..." if len(sheets) > 6 else "")
            self.notes.append(
                f"the workbook has {len(sheets)} sheets: {sheets[0]!r}, the first, is read; sheet = ... names another "
                f"({others})"
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
