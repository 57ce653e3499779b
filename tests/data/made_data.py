"""Workbooks and pieces of records that several tests of data make."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from harness.data.conditioning.clock import TimeRules
from harness.data.conditioning.timebase import pieces_of


def workbook(path: Path, sheets: Mapping[str, Any], formats: Mapping[str, str] | None = None) -> Path:
    """Write rows of cells by sheet; ``formats`` by column letter hold below the titles."""
    openpyxl = pytest.importorskip("openpyxl", reason="openpyxl is not installed: pip install 'sysid-harness[data]'")
    made = openpyxl.Workbook()
    made.remove(made.active)
    for name, rows in sheets.items():
        sheet = made.create_sheet(name)
        for row in rows:
            sheet.append(row)
        for column, text in (formats or {}).items():
            for cell in sheet[column][1:]:
                cell.number_format = text
    made.save(path)
    return path


def pieces(time: np.ndarray | None, values: np.ndarray, **rules: Any) -> tuple[list, list[str]]:
    """Return the pieces of a record of an input and an output, and what is said of them."""
    return pieces_of(time, values, names=("u", "y"), inputs=(True, False), rules=TimeRules(**rules))
