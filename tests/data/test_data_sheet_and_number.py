"""A sheet of a workbook and one of two columns with one title are chosen without a dataset.toml, by every command."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from harness import api
from harness.command import main
from harness.errors import InputError


@pytest.fixture
def log(tmp_path: Path) -> Path:
    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook()
    for name, rows, factor in (("first", 90, 1.0), ("second", 120, 3.0)):
        sheet = book.active if name == "first" else book.create_sheet(name)
        sheet.title = name
        sheet.append(["time [s]", "u [V]", "y [mm]", "y [mm]"])
        for k in range(rows):
            sheet.append([0.1 * k, float(k % 7), factor * k, 10.0 * factor * k])
    book.save(tmp_path / "log.xlsx")
    return tmp_path / "log.xlsx"


@pytest.mark.parametrize(("sheet", "column", "last"), [(None, 2, 0.059), ("second", "2", 0.237), ("second", 3, 2.37)])
def test_the_sheet_and_the_column_that_were_said_are_read(log: Path, sheet: str | None, column: str | int, last: float):
    found = api.load_dataset(log, input="u", output="y", column={"y": column}, sheet=sheet).dataset
    assert found.estimation[0].y[-1, 0] == pytest.approx(last)
    assert found.recorded["y"] == "mm"


def test_a_title_that_is_there_twice_is_refused_with_a_number_that_is_read(log: Path) -> None:
    with pytest.raises(InputError, match=r"--column NAME=3"):
        api.load_dataset(log, input="u", output="y")


def test_commands_take_a_sheet(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for words in (
        ["list", str(log), "--sheet", "second"],
        ["new", "dataset", str(log), "--sheet", "second", "--folder", str(log.parent)],
    ):
        with pytest.raises(SystemExit) as ended:
            main(words)
        assert ended.value.code == 0
    assert "120 rows" in capsys.readouterr().out
    assert 'sheet = "second"\n' in (log.parent / "dataset.toml").read_text()
    np.savetxt(log.parent / "a.csv", np.zeros((3, 2)), delimiter=",", header="u,y", comments="")
    with pytest.raises(InputError, match="Excel workbook"):
        api.load_dataset(log.parent / "a.csv", input="u", output="y", sheet="second")
