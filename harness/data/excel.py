"""Excel workbooks: the first sheet as a table."""

from __future__ import annotations

from pathlib import Path

from harness.data.binary_files import broken, optional
from harness.data.cells import units_below
from harness.data.columns import MemoryTable
from harness.data.packing import refuse_bomb
from harness.errors import InputError

__all__ = ["ExcelFile"]


class ExcelFile(MemoryTable):
    """The first sheet of an Excel workbook: a header, perhaps a row of units, and rows of numbers."""

    def __init__(self, path: Path) -> None:
        openpyxl = optional("openpyxl", "Excel")
        refuse_bomb(path)
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
