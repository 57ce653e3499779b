"""Where the reading of a table changes its mind: one line, cell, column or row to either side of every edge."""

from __future__ import annotations

import json
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from harness.data import load_dataset
from harness.data.recipe.contents import _channel
from harness.data.tables.bags import is_bag_folder
from harness.data.tables.binary_files import MOST_INSIDE, _inside, broken
from harness.data.tables.cells import numbers_of, units_below
from harness.data.tables.stacked import begin_of
from harness.data.tables.table import Table
from harness.data.tables.text_files import MOST_ABOVE, TextFile
from harness.errors import InputError


def itself(value: object) -> object:
    return value


def text(folder: Path, content: str) -> TextFile:
    (folder / "a.csv").write_text(content, encoding="utf-8")
    return TextFile(folder / "a.csv")


# ---- texts ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("above", "read"), [(1, True), (2, True), (100, True), (101, False)])
def test_so_many_lines_may_stand_above_a_table(tmp_path: Path, above: int, read: bool) -> None:
    assert MOST_ABOVE == 100
    content = "a remark\n" * above + "time [s],u [V],y [m]\n0,1,2\n0.1,3,4\n0.2,5,6\n"
    if read:
        found = text(tmp_path, content)
        assert found.titles == ["time [s]", "u [V]", "y [m]"]
        assert found.values("y [m]").tolist() == [2.0, 4.0, 6.0]
        said = "line 1 stands above the table" if above == 1 else f"lines 1 to {above} stand above the table"
        assert said in found.notes[0]
    else:
        with pytest.raises(InputError):
            text(tmp_path, content)


@pytest.mark.parametrize("sign", [",", ";", "\t"])
@pytest.mark.parametrize(("rows", "read"), [(0, True), (1, True), (2, True), (3, False), (4, False)])
def test_three_rows_of_numbers_above_are_a_table_of_their_own(tmp_path: Path, sign: str, rows: int, read: bool) -> None:
    content = ["log of a day", *(sign.join(["5", "6"]) for _ in range(rows)), sign.join(["time [s]", "u", "v", "y"])]
    content += [sign.join([f"0.{k}", "1.5", "2", "3"]) for k in range(5)]
    if read:
        found = text(tmp_path, "\n".join(content) + "\n")
        assert found.titles == ["time [s]", "u", "v", "y"]
        assert found.values("u").tolist() == [1.5] * 5
    else:
        with pytest.raises(InputError):
            text(tmp_path, "\n".join(content) + "\n")


@pytest.mark.parametrize(("line", "read"), [("12 samples", True), ("12 13", False), ("rate 12 13", True)])
def test_lines_of_one_number_above_columns_of_blanks_are_settings(tmp_path: Path, line: str, read: bool) -> None:
    """Three lines of two numbers are a table."""
    content = f"{line}\n" * 3 + "time u v y\n" + "".join(f"0.{k} 1.5 2 {k}\n" for k in range(5))
    if read:
        found = text(tmp_path, content)
        assert found.titles == ["time", "u", "v", "y"]
        assert found.values("y").tolist() == [0.0, 1.0, 2.0, 3.0, 4.0]
    else:
        with pytest.raises(InputError):
            text(tmp_path, content)


@pytest.mark.parametrize("place", [1, 3, 4, 5, 9])
def test_a_quoted_cell_does_not_hide_where_titles_begin(tmp_path: Path, place: int) -> None:
    rows = [f"0.{k},1.5,2,{k}" for k in range(9)]
    rows[-place] = rows[-place].replace("1.5", '"1.5"')
    content = "\n".join(["a remark", "another one", "time,u,v,y", *rows]) + "\n"
    assert text(tmp_path, content).values("u").tolist() == [1.5] * 9


def test_a_remark_and_one_row_are_refused_as_such(tmp_path: Path) -> None:
    with pytest.raises(InputError):
        text(tmp_path, "a remark\n1,2,3,4\n")


@pytest.mark.parametrize(
    ("cells", "kept"),
    [
        (("0.125", "0.250", "0.375", "0.50"), 3),  # cut: all others have three decimals
        (("0.125", "0.250", "0.5", "0.50"), 4),  # the one before has as few
        (("0.5", "0.250", "0.375", "0.50"), 4),
        (("1.5e-03", "1.5e-03", "1.5e-03", "1.5e"), 3),
        (("1.5e-03", "1.5e-03", "1.5e-03", "1.5"), 3),
        (("1.5e-03", "1.5e-03", "1.5", "1.5"), 4),
    ],
)
def test_a_last_cell_is_cut_only_where_it_lacks_what_all_others_have(
    tmp_path: Path, cells: tuple[str, ...], kept: int
) -> None:
    found = text(tmp_path, "time,y\n" + "\n".join(f"{k},{cell}" for k, cell in enumerate(cells)))
    assert found.values("y").tolist() == [float(cell) for cell in cells[:kept]]
    assert any("cut" in note for note in found.notes) == (kept < 4)
    ended = text(tmp_path, "time,y\n" + "\n".join(f"{k},{cell}" for k, cell in enumerate(cells[:3])) + "\n")
    assert len(ended.values("y")) == 3


def test_columns_between_blanks_may_have_quoted_titles_and_tabs(tmp_path: Path) -> None:
    found = text(tmp_path, '"time [s]"  "the torque"   y\n' + "".join(f"0.{k}   1.5    {k}\n" for k in range(5)))
    assert found.titles == ["time [s]", "the torque", "y"]
    assert found.values("the torque").tolist() == [1.5] * 5
    assert found.texts("y", 2) == ["0", "1"]


@pytest.mark.parametrize("row", ["1,pump,3", "1,2,pump"])
def test_a_row_whose_first_cell_is_a_number_has_no_name(tmp_path: Path, row: str) -> None:
    with pytest.raises(InputError, match="3 cells under 2 titles"):
        text(tmp_path, "u,y\n" + f"{row}\n" * 4)


# ---- cells ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("cells", "numbers"),
    [
        (["1 234,5", "2 345,75"], [1234.5, 2345.75]),
        (["1 234.5", "2 345.75"], [1234.5, 2345.75]),
        (["1.234.567,5", "12,25"], [1234567.5, 12.25]),
        (["1,234,567.5", "12.25"], [1234567.5, 12.25]),
        (["1.234,5", "12"], [1234.5, 12.0]),
        (["1,234.5", "12"], [1234.5, 12.0]),
        (["1,234,567", "12"], [1234567.0, 12.0]),
        (["1 234 567", "12"], [1234567.0, 12.0]),
    ],
)
def test_signs_between_thousands_and_before_decimals(cells: list[str], numbers: list[float]) -> None:
    assert numbers_of(cells, str).tolist() == numbers


@pytest.mark.parametrize(
    ("titles", "cells", "found"),
    [
        (["t", "u"], ["s", "V"], ["t [s]", "u [V]"]), (["t", "u"], ["s", ""], ["t [s]", "u"]),
        (["t", "u"], ["s"], None), (["t"], ["s", "V"], None), (["t", "u"], ["", ""], None),
        (["t", "u"], ["1", "1"], None), (["t", "u"], ["1", "V"], ["t [1]", "u [V]"]), (["t", "u"], ["s", "2"], None),
    ],
)  # fmt: skip
def test_a_row_of_units_has_one_for_each_title_and_no_numbers(
    titles: list[str], cells: list[str], found: list[str] | None
) -> None:
    assert units_below(titles, cells) == found


@pytest.mark.parametrize(("above", "found"), [(0, 0), (1, 1), (99, 99), (100, 100), (101, 0)])
def test_so_many_rows_of_a_sheet_may_stand_above_its_table(above: int, found: int) -> None:
    rows = [["a remark", "", ""] for _ in range(above)]
    rows += [["time [s]", "u [V]", "y [m]"], *([f"0.{k}", "1.0", "2.0"] for k in range(4))]
    assert begin_of(rows) == found


# ---- other files ----------------------------------------------------------------------------------------------------


def test_what_a_reader_says_is_told_up_to_two_hundred_letters(tmp_path: Path) -> None:
    for letters in (150, 400):
        said = broken(tmp_path / "a.mat", "MAT", ValueError("x" * letters)).got
        assert said == ("ValueError: " + "x" * letters)[:200]


def test_a_folder_is_a_bag_by_its_metadata(tmp_path: Path) -> None:
    assert not is_bag_folder(tmp_path)
    (tmp_path / "metadata.yaml").write_text("")
    assert is_bag_folder(tmp_path)
    assert not is_bag_folder(tmp_path / "metadata.yaml")


def test_what_cells_and_structs_hold() -> None:
    cells = np.empty((1, 3), dtype=object)
    cells[0, :] = [np.zeros(5), np.zeros((5, 2)), np.zeros((2, 5))]
    assert _inside("c", cells, itself) == ["c{0}", "c{1}[:,0]", "c{1}[:,1]", "c{2}[0]", "c{2}[1]"]
    one = np.zeros((1, 1), dtype=[("m", object), ("v", object), ("n", float)])
    one["m"][0, 0], one["v"][0, 0] = np.zeros((5, 2)), np.zeros(5)
    assert _inside("s", one, itself) == ["s.m[:,0]", "s.m[:,1]", "s.v", "s.n"]
    several = np.zeros(2, dtype=[("m", object)])
    several["m"][:] = [np.zeros(5), np.zeros(6)]
    assert _inside("s", several, itself) == ["s.m{0}", "s.m{1}"]
    assert len(_inside("w", np.zeros((200, MOST_INSIDE + 1)), itself) or []) == MOST_INSIDE
    assert len(_inside("w", np.zeros((200, MOST_INSIDE)), itself) or []) == MOST_INSIDE


@pytest.mark.parametrize(("hole", "note"), [(5.0, ""), (5.125, "1 holes")])
def test_a_hole_of_a_channel_is_longer_than_five_of_its_steps(hole: float, note: str) -> None:
    stamps = np.cumsum(np.r_[0.0, np.full(20, 0.125), hole * 0.125, np.full(20, 0.125)])
    table: Any = SimpleNamespace(
        split=lambda title: (title, None),
        read=lambda title: (np.arange(len(stamps), dtype=float), "V"),
        clocks=lambda titles: ([stamps], "the log's own"),
    )
    found = _channel(table, "/a", "/a")
    assert (found.note, found.every, found.rows, found.empty) == (note, 0.125, 42, 0)
    assert (found.begin, found.end, found.minimum, found.maximum) == (0.0, stamps[-1], 0.0, 41.0)


@pytest.mark.parametrize(
    ("title", "parts"),
    [
        ("/imu.angle [rad]", ("/imu.angle", "rad")), ("/joints.position[m]", ("/joints.position[m]", None)),
        ("/imu.angle  [rad]", ("/imu.angle", "rad")), ("/command.data", ("/command.data", None)),
    ],
)  # fmt: skip
def test_brackets_right_behind_a_path_name_a_joint_and_no_unit(title: str, parts: tuple[str, str | None]) -> None:
    source: Any = SimpleNamespace(paths=True, titles=[title], notes=[])
    assert Table(Path("a.mcap"), source).split(title) == parts
    plain: Any = SimpleNamespace(titles=["q[m]"], notes=[])
    assert Table(Path("a.csv"), plain).split("q[m]") == ("q", "m")


def test_a_log_of_messages_has_a_clock_in_seconds_and_values_without_units(tmp_path: Path) -> None:
    writer_of = pytest.importorskip("mcap.writer", reason="mcap is not installed: pip install 'sysid-harness[data]'")
    from harness.data.tables.log_files import McapFile

    with (tmp_path / "a.mcap").open("wb") as stream:
        writer = writer_of.Writer(stream)
        writer.start()
        schema = writer.register_schema("j", "jsonschema", b"{}")
        channels = [writer.register_channel(topic, "json", schema) for topic in ("/a", "/b")]
        for k in range(4):
            for channel, late in zip(channels, (0, 5_000_000), strict=True):
                writer.add_message(channel, 1_000_000_000 + k * 125_000_000 + late, json.dumps({"x": k}).encode(), 0)
        writer.finish()
    log = McapFile(tmp_path / "a.mcap")
    assert log.titles == ["time", "/a.x", "/b.x"]
    assert [log.unit(title) for title in log.titles] == ["s", None, None]
    stamps, _ = log.clocks(log.titles)
    assert np.array(stamps) == pytest.approx(np.array([[0, 0.125, 0.25, 0.375]] * 2 + [[0.005, 0.13, 0.255, 0.38]]))


def test_channels_of_a_measurement_keep_the_stamps_of_their_raster(tmp_path: Path) -> None:
    asammdf = pytest.importorskip("asammdf", reason="asammdf is not installed: pip install 'sysid-harness[data]'")
    from harness.data.tables.log_files import MdfFile

    with asammdf.MDF(version="4.10") as log:
        for name, step in (("u", 0.01), ("y", 0.02)):
            stamps = 1.0 + step * np.arange(6)
            log.append([asammdf.Signal(samples=np.arange(6.0), timestamps=stamps, name=name, unit="V")])
        log.save(tmp_path / "a.mf4")
    read = MdfFile(tmp_path / "a.mf4")
    (time, u, y), _ = read.clocks(["time", "u", "y"])
    assert time == pytest.approx(1.0 + 0.01 * np.arange(6))
    assert u == pytest.approx(time)
    assert y == pytest.approx(1.0 + 0.02 * np.arange(6))


def test_the_index_of_a_frame_is_its_clock() -> None:
    pandas = pytest.importorskip("pandas", reason="pandas is not installed")
    polars = pytest.importorskip("polars", reason="polars is not installed")
    from harness.data.tables.memory import input_and_output

    index = pandas.Index(0.25 * np.arange(4), name="time [s]")
    u, y = pandas.Series(np.arange(4.0), index, name="u"), pandas.DataFrame({"a": np.ones(4), "b": np.zeros(4)}, index)
    table, inputs, outputs = input_and_output(u, y)
    assert (list(table), inputs, outputs) == (["time [s]", "u", "a", "b"], ["u"], ["a", "b"])
    assert list(table["time [s]"]) == [0.0, 0.25, 0.5, 0.75]
    other = y.set_axis(pandas.Index(np.arange(4.0), name="time [s]"))
    assert list(input_and_output(u, other)[0]) == ["u", "a", "b"]  # two clocks are none
    assert list(input_and_output(polars.Series("u", [1.0, 2.0]), polars.DataFrame({"a": [1.0, 2.0]}))[0]) == ["u", "a"]


# ---- which columns --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("columns", [3, 24, 25, 40])
def test_a_file_whose_columns_are_not_chosen_shows_them(tmp_path: Path, columns: int) -> None:
    titles = ["time [s]", *(f"c{k}x" for k in range(1, columns))]
    rows = [",".join([f"0.{k}", *["1"] * (columns - 1)]) for k in range(5)]
    (tmp_path / "a.csv").write_text("\n".join([",".join(titles), *rows]) + "\n")
    with pytest.raises(InputError, match="which columns are inputs and which are outputs") as refusal:
        load_dataset(tmp_path / "a.csv")
    shown = ", ".join(map(repr, titles[:24])) + (" ..." if columns > 24 else "")
    assert re.search(re.escape(shown) + r"(?!, ')", refusal.value.got)
    assert f"c{24}x" not in refusal.value.got


def test_a_column_that_is_said_to_be_another_is_that_one(tmp_path: Path) -> None:
    """Though its title is the name of a port."""
    rng = np.random.default_rng(1)
    u, x, theta = rng.normal(size=120), np.sin(0.05 * np.arange(120)), np.cos(0.03 * np.arange(120))
    table = np.column_stack([np.arange(120) * 0.01, u, theta, x])
    header = "time [s],x [N],theta [rad],way [m]"
    np.savetxt(tmp_path / "a.csv", table, delimiter=",", header=header, comments="", fmt="%.9g")
    for column in ({"u": "x [N]", "x": "way [m]"}, {"u": "x [N]"}):
        data = load_dataset(tmp_path / "a.csv", model="cart-pole", column=column).dataset
        assert [channel.name for channel in data.spec.outputs] == (["x", "theta"] if "x" in column else ["theta"])
        assert np.concatenate([run.trajectory.u[:, 0] for run in data]) == pytest.approx(u, abs=1e-8)
        assert np.concatenate([run.trajectory.y[:, -1] for run in data]) == pytest.approx(theta, abs=1e-8)
