"""What files hold and what is said of them, figure by figure: contents, titles, clocks, sheets, views, writing."""

from __future__ import annotations

import errno
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_data import workbook

from harness.data import read_trajectory
from harness.data.conditioning.clock import TimeRules
from harness.data.conditioning.timebase import pieces_of
from harness.data.recipe.contents import contents_of
from harness.data.recipe.ports import nearest
from harness.data.sections import ResampleSection
from harness.data.tables.named import _is_element
from harness.data.tables.table import Table, open_table
from harness.data.views import from_fmpy
from harness.data.whole_files import refused_by_system, whole_file, write_json, write_text
from harness.errors import InputError
from harness.signals import Channel

UNLIKE = "correct the name, or say which column it is (sysid: --column NAME=TITLE)"


def written(folder: Path, text: str, name: str = "log.csv") -> Path:
    (folder / name).write_text(text, encoding="utf-8")
    return folder / name


def csv(*columns: Any, titles: str) -> str:
    rows = [",".join("" if np.isnan(cell) else repr(float(cell)) for cell in row) for row in zip(*columns, strict=True)]
    return "\n".join([titles, *rows]) + "\n"


def test_what_is_in_a_file_is_what_numpy_says_of_it(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    time = 5.0 + 0.02 * np.delete(np.arange(103.0), [40, 70, 71])
    time[90:] -= time[90] - time[89]  # it stands still once
    u, y = rng.normal(size=100), rng.normal(size=100)
    y[1::4] = np.nan
    found = contents_of(written(tmp_path, csv(time * 1e3, u, y, titles="time [ms],u [V],y")))
    assert (found.path, found.rows, found.clock, found.clock_stated) == ("log.csv", 100, "time [ms]", True)
    assert found.start == pytest.approx(5.0)
    assert found.length == pytest.approx(time[-1] - 5.0)
    assert found.sample_time == pytest.approx(0.02)
    assert (found.holes, found.unsteady, found.back, found.unlikely, found.rough) == (2, 1, 0, False, False)
    one, other = found.channels
    assert (one.column, one.name, one.unit, one.rows, one.empty, one.every) == ("u [V]", "u", "V", 100, 0, None)
    assert (one.minimum, one.maximum, one.mean, one.deviation) == pytest.approx((u.min(), u.max(), u.mean(), u.std()))
    assert (other.unit, other.empty) == ("", 25)
    assert other.mean == pytest.approx(np.nanmean(y))
    assert other.every == pytest.approx(0.02)
    lines = found.facts()
    assert lines[0] == "log.csv: 100 rows, 2 channels"
    assert lines[1] == f"time: time [ms], {found.length:.6g} s from 5 s, every 0.02 s (50 Hz)"
    assert lines[2:4] == ["2 holes", "1 steps that stand still or run back"]
    back = contents_of(written(tmp_path, csv([0.0, 1.0, 0.5, 2.0], [1.0] * 4, titles="time [s],u")))
    assert (back.unsteady, back.back, back.start, back.length) == (1, 1, 0.0, 2.0)
    still = contents_of(written(tmp_path, csv([3.0] * 4, [1.0, 2.0, 3.0, 4.0], titles="time [s],u")))
    assert still.facts()[1] == "time: time [s], which does not run"
    assert contents_of(written(tmp_path, csv([3.0] * 4, titles="u"))).facts()[1].startswith("no time column")
    assert "hardly seconds" in contents_of(
        written(tmp_path, csv(np.arange(9.0), np.arange(9.0), titles="time,u"))
    ).facts()[1]  # fmt: skip


def test_a_column_is_found_by_its_name_or_number_and_its_empty_cells_are_none(tmp_path: Path) -> None:
    rows = ["time [s],u [V],y [m]", *(f"{k},{k}.5,{k}.25" for k in range(20))]
    rows[7] = "6,6.5,"
    table = Table(written(tmp_path, "\n".join(rows) + "\n"))
    y, unit = table.read("y")
    assert unit == "m"
    assert np.isnan(y[6])
    assert np.delete(y, 6) == pytest.approx(np.delete(np.arange(20) + 0.25, 6))
    assert table.read("u")[0] == pytest.approx(np.arange(20) + 0.5)
    assert table.read(2)[0][0] == 0.25
    rows[9] = "8,8.5"
    with pytest.raises(InputError, match="line 10: a row of 2 cells under 3 titles"):
        Table(written(tmp_path, "\n".join(rows) + "\n"))


def test_a_column_that_is_not_there_is_refused_with_what_may_be_meant(tmp_path: Path) -> None:
    titles = ["time [s]", "motor_current [A]", "theta [rad]", *(f"x{k}" for k in range(12))]
    table = Table(written(tmp_path, csv(*([0.0, 1.0] for _ in titles), titles=",".join(titles))))
    for asked, remedy in (
        ("thetta", "did you mean 'theta [rad]'?"), ("current", "did you mean 'motor_current [A]'?"),
        ("the_motor_current_of_it", "did you mean 'motor_current [A]'?"), ("qqq", UNLIKE),
        (99, "give a number from 0 to 14"), (-1, "give a number from 0 to 14"),
    ):  # fmt: skip
        with pytest.raises(InputError) as refused:
            table.read(asked)
        assert refused.value.remedy == remedy
        assert refused.value.expected.endswith("'x8' ...")
    assert table.find("theta") == table.find("theta [rad]") == table.find(2) == "theta [rad]"
    assert table.find("theta_deg", "rad") is None
    few = Table(written(tmp_path, csv([0.0, 1.0], [0.0, 1.0], titles="a,b"), "few.csv"))
    with pytest.raises(InputError, match="expected one of 'a', 'b', got"):
        few.read("nothing")
    twice = Table(written(tmp_path, csv(*[[0.0, 1.0]] * 3, titles="q [m],w,q [rad]"), "twice.csv"))
    with pytest.raises(
        InputError, match=r"there 2 times.*name its title with the unit, or give its number \(--column NAME=2"
    ):
        twice.read("q")
    cache: dict[Path, Table] = {}
    assert open_table(tmp_path / "few.csv", cache) is open_table(tmp_path / "few.csv", cache)
    assert [_is_element(f"a[{text}]", "a") for text in ("0", "1", "2", "10", "x", "0,1")] == [
        True, False, True, True, False, False
    ]  # fmt: skip
    assert nearest(Channel("u", "V"), [f"c{k}" for k in range(9)] + ["u [V]"])[0] == "u [V]"
    assert len(nearest(Channel("u", "V"), [f"c{k}" for k in range(9)])) == 6


def test_sheets_of_a_workbook(tmp_path: Path) -> None:
    body = [["time [s]", "u [%]"], *([0.1 * k, 0.01 * k] for k in range(30))]
    one = Table(workbook(tmp_path / "book.xlsx", {"Log": body}, {"B": "0%"}))
    assert one.read("u")[0] == pytest.approx(np.arange(30.0))  # per cent as they are shown
    assert list(one.notes) == ["u [%]: cells that show per cent hold a hundredth of it: what they show is read"]
    assert one._source.where(0) == "row 2"
    names = list("ABCDEFGH")
    sheets = dict.fromkeys(names, body)
    many = Table(workbook(tmp_path / "book.xlsx", sheets))
    (said,) = [note for note in many.notes if "sheets" in note]
    assert said.startswith("the workbook has 8 sheets: ")
    assert said.endswith(" ...)")
    assert said.count("'") == 2 * 6
    chosen = open_table(tmp_path / "book.xlsx", {}, "C")
    assert not any("sheets" in note for note in chosen.notes)
    two = Table(workbook(tmp_path / "book.xlsx", {"A": body, "B": body}))
    assert [note for note in two.notes if "sheets" in note] == [
        "the workbook has 2 sheets: 'A', the first, is read; --sheet names another ('B')"
    ]
    with pytest.raises(InputError, match="an Excel workbook"):
        open_table(written(tmp_path, "a,b\n1,2\n"), {}, "C")


def test_a_plain_table_becomes_a_record_by_its_titles(tmp_path: Path) -> None:
    time = 2.0 + 0.05 * np.arange(40)
    path = written(tmp_path, csv(time, np.sin(time), np.cos(time), titles="time [s],u [N m],theta [rad]"))
    found = read_trajectory(path, inputs=["u"])
    assert found.spec.sample_time == pytest.approx(0.05, rel=1e-12)
    assert ([str(one) for one in found.spec.inputs], [str(one) for one in found.spec.outputs]) == (
        ["u [N m]"], ["theta [rad]"]
    )  # fmt: skip
    assert found.u[:, 0] == pytest.approx(np.sin(time))
    assert (
        read_trajectory(written(tmp_path, csv([0.0, 3.0], [1.0, 2.0], titles="time [s],y")), inputs=[]).spec.sample_time
        == 3.0
    )
    with pytest.raises(InputError, match="at least two rows"):
        read_trajectory(written(tmp_path, "time [s],y\n0,1\n"), inputs=[])


def test_inputs_of_fmpy_move_up_by_a_row() -> None:
    rows = [(0.5 * k, 10.0 + k, float(k) ** 2) for k in range(5)]
    result = np.array(rows, dtype=[("time", float), ("u", float), ("y", float)])
    found = from_fmpy(result, inputs=("u",), units={"y": "m"})
    assert found.u[:, 0].tolist() == [11.0, 12.0, 13.0, 14.0, 14.0]
    assert found.y[:, 0].tolist() == [0.0, 1.0, 4.0, 9.0, 16.0]
    assert [str(one) for one in (*found.spec.inputs, *found.spec.outputs)] == ["u [1]", "y [m]"]
    assert found.spec.sample_time == 0.5
    two = from_fmpy(result[:2])
    assert (len(two), two.spec.sample_time, two.spec.nu) == (2, 0.5, 0)
    with pytest.raises(InputError, match="at least two instants, got 1"):
        from_fmpy(result[:1])
    with pytest.raises(InputError, match="'v'"):
        from_fmpy(result, inputs=("v",))


def test_a_file_is_written_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "x.txt"
    write_text(path, "old")

    def half() -> None:
        with whole_file(path) as scratch:
            scratch.write_text("half")
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        half()
    assert path.read_text() == "old"
    assert [one.name for one in tmp_path.iterdir()] == ["x.txt"]
    write_json(path, {"a": [1]})
    assert path.read_text() == '{\n "a": [\n  1\n ]\n}\n'
    with pytest.raises(ValueError, match="JSON"):
        write_json(path, {"a": float("nan")})
    with pytest.raises(InputError, match="got no space left on device"), whole_file(path):
        raise OSError(errno.ENOSPC, "No space left on device")
    with pytest.raises(OSError, match="odd"), whole_file(path):
        raise OSError(errno.EDOM, "odd")
    assert refused_by_system(OSError("without a number")) is None
    named = refused_by_system(OSError(errno.EACCES, "", "/a/b"))
    assert named is not None
    assert "/a/b" in str(named)


def pieces(time: Any, values: Any, inputs: tuple[bool, ...], **rules: Any) -> Any:
    names = tuple("uvw"[: len(inputs)])
    return pieces_of(np.asarray(time), np.asarray(values), names=names, inputs=inputs, rules=TimeRules(**rules))


@pytest.mark.parametrize("method", ["linear", "cubic"])
def test_a_resampled_record_has_its_signals_at_the_instants_of_the_grid(method: Any) -> None:
    """Inputs are held from their stamps on, outputs interpolated; pieces between long gaps stay apart."""
    rng = np.random.default_rng(0)
    time = np.cumsum(rng.uniform(0.06, 0.14, 120))
    time[60:] += 3.0
    y, u = np.sin(time), np.sign(np.sin(3.0 * time))
    section = ResampleSection(sample_time=0.05, method=method, max_gap=1.0)
    found, notes = pieces(
        time, np.column_stack([u, y]), (True, False), resample=section, gaps="split", intersample="foh"
    )
    assert len(found) == 2
    for piece, rows in zip(found, (slice(0, 60), slice(60, 120)), strict=True):
        own = time[rows]
        grid = own[0] + 0.05 * np.arange(int((own[-1] - own[0]) / 0.05 + 1e-6) + 1)
        assert piece.start == own[0]
        assert piece.sample_time == 0.05
        assert len(piece.values) == len(grid)
        assert piece.values[:, 0] == pytest.approx(np.interp(grid, own, u[rows]))
        assert piece.values[:, 1] == pytest.approx(np.sin(grid), abs=4e-3 if method == "linear" else 1e-4)
        assert piece.between is not None
        assert not piece.between[:, 0].any()
    steps = np.diff(time)
    count = sum(len(piece.values) for piece in found)
    made = sum(int(piece.between[:, 1].sum()) for piece in found)
    assert notes[-1].startswith(
        f"resampled to 0.05 s ({method} outputs, linear inputs): 120 rows with steps of {steps.min():g} to "
        f"{steps.max():g} s became {count} samples in 2 pieces; {made} samples lie between readings"
    )
    with pytest.raises(InputError, match=r"at most 1 s \(resample.max_gap\)"):
        pieces(time, np.column_stack([u, y]), (True, False), resample=section, intersample="foh")


def test_order_of_stamps_is_refused_with_its_row_and_what_it_may_be() -> None:
    steady = 0.1 * np.arange(60)
    values = np.random.default_rng(0).normal(size=(60, 1))
    for change, says in (
        ({30: steady[29]}, "row 30: time stands still: expected more than 2.9 s in row 30, got 2.9 s"),
        ({30: 2.85}, "row 30: time runs back: expected more than 2.9 s in row 30, got 2.85 s"),
        ({30: np.nan}, "no time stamp.*nan in row 30"),
    ):
        time = steady.copy()
        for row, stamp in change.items():
            time[row] = stamp
        with pytest.raises(InputError, match=says):
            pieces(time, values, (False,))
    with pytest.raises(InputError, match="two rows in one sample of the declared clock"):
        pieces(np.insert(steady[:-1], 31, 3.02), values, (False,), sample_time=0.1)
