"""Logs of strangers in the forms that programs give them: each is read right, or refused with a line; none otherwise.

Forms of titles, of dates, of what stands above, below and beside a table, and what binary files say of their numbers.
"""

from __future__ import annotations

import datetime
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_data import workbook

from harness.command import main
from harness.data import load_dataset
from harness.data.tables.cells import numbers_of
from harness.data.tables.excel import ExcelFile
from harness.data.tables.headers import split_header
from harness.data.tables.table import Table
from harness.data.times.stamps import clock, with_dates
from harness.errors import InputError
from harness.signals import FloatArray

DT, N = 0.01, 90
RNG = np.random.default_rng(3)
TIME = np.round(np.arange(N) * DT, 6)
FORCE = np.round(RNG.normal(size=N), 4)
ANGLE = np.round(np.cumsum(np.cumsum(RNG.normal(size=N))) * 1e-3 + 0.3, 6)
HEAD = "time [s],u [Nm],theta [rad]"
ROWS = [f"{t},{u},{y}" for t, u, y in zip(TIME, FORCE, ANGLE, strict=True)]
TURN = 180 / np.pi


def read(path: Path, **options: Any) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return time from 0, input and output of a whole file."""
    data = load_dataset(path, **({"model": "pendulum"} if path.suffix != ".toml" else {}), **options).dataset
    records = [run.trajectory for run in data.runs]
    t = np.concatenate([one.t for one in records])
    return t - t[0], np.concatenate([one.u[:, 0] for one in records]), np.concatenate([one.y[:, 0] for one in records])


def same(path: Path, **options: Any) -> None:
    t, u, y = read(path, **options)
    assert t == pytest.approx(TIME, abs=1e-6)
    assert u == pytest.approx(FORCE, abs=1e-6)
    assert y == pytest.approx(ANGLE, abs=1e-6)


def file(folder: Path, head: str, times: Any = TIME, sign: str = ",", u: Any = FORCE, y: Any = ANGLE) -> Path:
    rows = [sign.join(map(str, row)) for row in zip(times, u, y, strict=True)]
    path = folder / "a.csv"
    path.write_text("\n".join([head, *rows]) + "\n", encoding="utf-8")
    return path


# ---- titles -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("head", "scales"),
    [
        ("time{ms},u{mN m},theta{deg}", (1e3, 1e3, TURN)),
        ("t / (ms),u / (mN m),theta / (deg)", (1e3, 1e3, TURN)),
        ("t=ms,u=mNm,theta=deg", (1e3, 1e3, TURN)),
        ("t,u,theta\n[ms],[mN･m],[˚]", (1e3, 1e3, TURN)),
        ("時間 [ms],u [mN・m],theta [∘]", (1e3, 1e3, TURN)),
        ("Zeit (min),u: kNm,theta: turn", (1 / 60, 1e-3, 1 / (2 * np.pi))),
    ],
)
def test_units_between_other_signs(head: str, scales: tuple[float, float, float], tmp_path: Path) -> None:
    t, u, y = (column * scale for column, scale in zip((TIME, FORCE, ANGLE), scales, strict=True))
    same(file(tmp_path, head, t, u=u, y=y))


def test_bars_before_a_unit(tmp_path: Path) -> None:
    same(file(tmp_path, "time [s],u | mNm,theta | deg", u=FORCE * 1e3, y=ANGLE * TURN))


@given(
    st.sampled_from(["u", "theta_rate", "q1"]),
    st.sampled_from(["", " ", "  "]),
    st.sampled_from(["/", ":", ",", ";", "|", "=", ""]),
    st.sampled_from(["[]", "()", "{}", "<>"]),
    st.sampled_from(["N m", "mNm", "deg/s", "m/s^2", "µm"]),
)
def test_a_title_is_a_name_and_a_unit_whatever_is_between(
    name: str, space: str, sign: str, brackets: str, unit: str
) -> None:
    assert split_header(f"{name}{space}{sign}{space}{brackets[0]}{unit}{brackets[1]}") == (name, unit)


def test_a_title_and_the_row_below_must_agree(tmp_path: Path) -> None:
    same(file(tmp_path, "time,u [N m],theta\ns,N·m,rad"))
    with pytest.raises(InputError, match=r"two units of column 'u \[Nm\]'.*'mNm' in the row below"):
        read(file(tmp_path, "time,u [Nm],theta\ns,mNm,rad"))


# ---- numbers ------------------------------------------------------------------------------------------------------


def test_a_minus_of_a_typesetter_is_one(tmp_path: Path) -> None:
    path = file(tmp_path, HEAD)
    path.write_text(path.read_text().replace("-", "\u2212"), encoding="utf-8")
    same(path)


@pytest.mark.parametrize("cell", ["1_000", "0x1F", "TRUE", "1.2.3", "(0.5)", "5e", "1/2", "0.5-"])
def test_what_is_no_number_elsewhere_is_none_here(cell: str, tmp_path: Path) -> None:
    lines = [HEAD, *ROWS]
    lines[41] = lines[41].rsplit(",", 1)[0] + f",{cell}"
    (tmp_path / "a.csv").write_text("\n".join(lines) + "\n")
    with pytest.raises(InputError, match="line 42"):
        read(tmp_path / "a.csv")


@given(st.lists(st.integers(-99_999, 99_999), min_size=8, max_size=40), st.sampled_from([",", ".", "'", " ", "_"]))
def test_thousands_are_never_taken_for_fractions(values: list[int], sign: str) -> None:
    cells = [f"{value:,}".replace(",", sign) for value in values]
    marked = [cell for cell in cells if sign in cell]
    try:
        found = numbers_of(cells, str)
    except InputError:
        return
    if sign == "." and len(marked) < 3:  # two numbers say nothing of a column
        return
    assert found.tolist() == values


def test_numbers_of_three_decimals_are_numbers() -> None:
    assert numbers_of(["1.234", "2.500", "1.002"], str).tolist() == [1.234, 2.5, 1.002]
    assert numbers_of(["1.234", "2.5", "2"], str).tolist() == [1.234, 2.5, 2.0]
    assert numbers_of(["1.234", "2.125", "2", "0.5"], str).tolist() == [1.234, 2.125, 2.0, 0.5]
    with pytest.raises(InputError, match="two readings"):
        numbers_of(["998", "999", "1.000", "1.001", "1.002"], str)


# ---- dates --------------------------------------------------------------------------------------------------------

FORMS: dict[str, Callable[[datetime.datetime], str]] = {
    "ISO": lambda at: at.isoformat(timespec="microseconds"),
    "ISO with a zone": lambda at: at.isoformat(timespec="microseconds") + "+05:30",
    "ISO without signs": lambda at: at.strftime("%Y%m%dT%H%M%S.%f"),
    "years first, slashes": lambda at: at.strftime("%Y/%m/%d %H:%M:%S.%f"),
    "days first, points": lambda at: at.strftime("%d.%m.%Y %H:%M:%S,%f"),
    "days first, no zeros": lambda at: f"{at.day}.{at.month}.{at.year} {at.hour}:{at.strftime('%M:%S.%f')}",
    "days first, slashes": lambda at: at.strftime("%d/%m/%Y %H:%M:%S.%f"),
    "months first, slashes": lambda at: at.strftime("%m/%d/%Y %H:%M:%S.%f"),
    "twelve hours": lambda at: at.strftime("%Y-%m-%d %I:%M:%S.%f %p"),
    "time of day": lambda at: at.strftime("%H:%M:%S.%f"),
    "time of day, twelve hours": lambda at: at.strftime("%I:%M:%S.%f %p"),
}


@settings(max_examples=150, deadline=None)
@given(
    st.sampled_from(list(FORMS)),
    st.datetimes(datetime.datetime(1980, 1, 1), datetime.datetime(2090, 1, 1)),
    st.sampled_from([0.001, 0.01, 0.5, 1.0, 59.0, 600.0, 3600.0, 40_000.0]),
)
def test_dates_in_any_form_are_read_right_or_refused(form: str, begin: datetime.datetime, step: float) -> None:
    begin = begin.replace(microsecond=begin.microsecond // 1000 * 1000)
    cells = [FORMS[form](begin + datetime.timedelta(seconds=step * k)) for k in range(30)]
    expected = step * np.arange(30)
    if "slashes" in form and "years" not in form:  # two orders may be possible
        try:
            found = clock(cells)
        except InputError:
            return
    else:
        found = clock(cells)
    assert found is not None
    assert found == pytest.approx(expected, abs=1e-6)


def test_midnight_is_said_and_half_a_day_back_is_refused(tmp_path: Path) -> None:
    begin = datetime.datetime(2024, 1, 1, 23, 59, 59, 600_000)
    stamps = [(begin + datetime.timedelta(seconds=float(t))).strftime("%H:%M:%S.%f") for t in TIME]
    path = file(tmp_path, "time,u [Nm],theta [rad]", stamps)
    same(path)
    notes = load_dataset(path, model="pendulum").dataset.warnings
    assert len([note for note in notes if "midnight is passed (1x)" in note]) == 1
    back = [*stamps[:30], *["23:59:58.000000"] * 60]
    with pytest.raises(InputError, match="runs back"):
        read(file(tmp_path, "time,u [Nm],theta [rad]", back))


def test_a_date_beside_a_time_of_day_counts(tmp_path: Path) -> None:
    begin = datetime.datetime(2024, 1, 31, 23, 59, 59, 600_000)
    at = [begin + datetime.timedelta(seconds=float(t)) for t in TIME]
    days, times = [f"{one:%d.%m.%Y}" for one in at], [f"{one:%H:%M:%S.%f}" for one in at]
    rows = [f"{d},{t},{u},{y}" for d, t, u, y in zip(days, times, FORCE, ANGLE, strict=True)]
    (tmp_path / "a.csv").write_text("\n".join(["Date,Time,u [Nm],theta [rad]", *rows]) + "\n")
    same(tmp_path / "a.csv")
    later = [row.replace("01.02.2024", "02.02.2024") for row in rows]  # the second part is a day later
    (tmp_path / "b.csv").write_text("\n".join(["Date,Time,u [Nm],theta [rad]", *later]) + "\n")
    with pytest.raises(InputError, match="not uniform"):
        read(tmp_path / "b.csv")
    assert with_dates(["12:00:00"], ["12:00:00"]) is None


def test_a_date_that_two_orders_read_differently_is_refused() -> None:
    evening, morning = "01/02/2024 23:59:59", "02/02/2024 00:00:00"
    with pytest.raises(InputError, match="one reading"):
        clock([evening, morning])
    assert np.asarray(clock([evening, "01/02/2024 23:59:59.5"])).tolist() == [0.0, 0.5]


def test_one_cell_among_times_that_is_none_is_named() -> None:
    with pytest.raises(InputError, match=r"row 1.*'noon'"):
        clock(["12:00:00", "noon", "12:00:02", "12:00:03"])


# ---- what stands about a table ------------------------------------------------------------------------------------


def test_lines_above_and_empty_rows_below_are_left_aside(tmp_path: Path) -> None:
    above = ["Logger v2", "Serial: 4711, rig 3", ""]
    (tmp_path / "a.csv").write_text("\n".join([*above, HEAD, *ROWS, ",,", ",,"]) + "\n")
    same(tmp_path / "a.csv")
    notes = load_dataset(tmp_path / "a.csv", model="pendulum").dataset.warnings
    assert any("lines 1 to 2 stand above the table" in note for note in notes)
    (tmp_path / "b.csv").write_text("\n".join(["time [s],u [Nm]", *ROWS]) + "\n")
    with pytest.raises(InputError, match="a row of 3 cells under 2 titles"):
        read(tmp_path / "b.csv")
    other = ["time [s],u [Nm]", *(row.rsplit(",", 1)[0] for row in ROWS[:30])]  # a run with a column less
    (tmp_path / "d.csv").write_text("\n".join([*other, HEAD, *ROWS]) + "\n")
    with pytest.raises(InputError, match="line 32: another header among the rows"):
        read(tmp_path / "d.csv")
    (tmp_path / "c.csv").write_text("\n".join([*above, *ROWS]) + "\n")  # no titles: nothing says what they are
    with pytest.raises(InputError):
        read(tmp_path / "c.csv")


@pytest.mark.parametrize("coding", ["utf-32", "utf-16", "cp1252"])
def test_codings(coding: str, tmp_path: Path) -> None:
    text = "\n".join(["time [s],u [N·m],theta [°]", *(f"{t},{u},{y * TURN}" for t, u, y in
                      zip(TIME, FORCE, ANGLE, strict=True))])  # fmt: skip
    (tmp_path / "a.csv").write_bytes((text + "\n").encode(coding))
    same(tmp_path / "a.csv")


# ---- workbooks ----------------------------------------------------------------------------------------------------


def book(path: Path, **sheets: list[list[Any]]) -> Path:
    return workbook(path, sheets)


def table(**columns: Any) -> list[list[Any]]:
    return [list(columns), *map(list, zip(*columns.values(), strict=True))]


PLAIN = table(**{"time [s]": TIME.tolist(), "u [Nm]": FORCE.tolist(), "theta [rad]": ANGLE.tolist()})


def test_the_sheet_with_the_numbers_is_read(tmp_path: Path) -> None:
    path = book(tmp_path / "a.xlsx", info=[["made by me"]], data=PLAIN)
    same(path)
    assert any("'data', the only one with rows of numbers" in note for note in ExcelFile(path).notes)
    two = book(tmp_path / "b.xlsx", info=[["made by me"]], one=PLAIN, two=PLAIN)
    with pytest.raises(InputError):
        read(two)


def test_rows_above_and_below_the_table_of_a_sheet(tmp_path: Path) -> None:
    rows = [["Run 7"], [], *PLAIN, [None] * 3, [None] * 3]
    same(book(tmp_path / "a.xlsx", data=rows))


def test_spans_times_of_day_and_decimal_commas_in_a_sheet(tmp_path: Path) -> None:
    spans = [datetime.timedelta(seconds=float(t)) for t in TIME]
    same(book(tmp_path / "a.xlsx", data=[["time", *PLAIN[0][1:]], *[[s, *r[1:]] for s, r in
              zip(spans, PLAIN[1:], strict=True)]]))  # fmt: skip
    begin = datetime.datetime(2024, 1, 1, 23, 59, 59, 600_000)
    times = [(begin + span).time() for span in spans]
    same(book(tmp_path / "b.xlsx", data=[["time", *PLAIN[0][1:]], *[[s, *r[1:]] for s, r in
              zip(times, PLAIN[1:], strict=True)]]))  # fmt: skip
    words = [[str(cell).replace(".", ",") for cell in row] for row in PLAIN[1:]]
    same(book(tmp_path / "c.xlsx", data=[PLAIN[0], *words]))


def test_a_truth_among_numbers_of_a_sheet_is_refused(tmp_path: Path) -> None:
    rows = [list(row) for row in PLAIN]
    rows[7][2] = True
    with pytest.raises(InputError, match=r"row 8, column 'theta.*TRUE"):
        read(book(tmp_path / "a.xlsx", data=rows))


def test_what_is_masked_was_not_measured() -> None:
    masked = np.ma.masked_where(np.arange(N) == 40, FORCE)
    table = {"time [s]": TIME, "u [Nm]": masked, "theta [rad]": ANGLE}
    with pytest.raises(InputError, match="nothing recorded in 1 of"):
        load_dataset(table, model="pendulum")


# ---- binary files -------------------------------------------------------------------------------------------------


def described(folder: Path, name: str, time: str, u: str, theta: str, more: str = "") -> Path:
    """Write a dataset.toml for a binary file."""
    path = folder / "dataset.toml"
    path.write_text(
        f'name = "x"\n[time]\ncolumn = "{time}"\n{more}\n[nominal]\nmodel = "pendulum"\n'
        f'[signals.u]\nrole = "input"\ncolumn = "{u}"\n[signals.theta]\nrole = "output"\ncolumn = "{theta}"\n'
        f'[[runs]]\nfile = "{name}"\n'
    )
    return path


def test_numbers_that_netcdf_packed_are_unpacked(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py", reason="h5py is not installed: pip install 'sysid-harness[data]'")
    with h5py.File(tmp_path / "a.h5", "w") as made:
        made["t"] = TIME * 1e3
        made["t"].attrs["units"] = "milliseconds since 2024-01-01 00:00"
        made["u"] = np.round((FORCE - 1.0) * 1e4).astype("int32")
        made["u"].attrs.update({"scale_factor": 1e-4, "add_offset": 1.0, "units": "N m"})
        made["theta"] = ANGLE
        made["theta"].attrs["units"] = b"rad"
    same(described(tmp_path, "a.h5", "t", "u", "theta"))
    with h5py.File(tmp_path / "a.h5", "r+") as made:
        made["theta"].attrs["_FillValue"] = ANGLE[50]
    assert np.isnan(Table(tmp_path / "a.h5").read("theta")[0]).tolist() == (ANGLE == ANGLE[50]).tolist()
    with pytest.raises(InputError, match="nothing recorded in 1 of"):
        read(described(tmp_path, "a.h5", "t", "u", "theta"))


def test_elements_of_rows_of_structs_and_rows_of_matrices(tmp_path: Path) -> None:
    from scipy.io import savemat

    signals = np.array(
        [(FORCE[:, None], "u"), (ANGLE[:, None], "theta")], dtype=[("values", object), ("label", object)]
    )
    savemat(tmp_path / "a.mat", {"out": {"time": TIME[:, None], "signals": signals}, "m": np.vstack([FORCE, ANGLE])})
    found = Table(tmp_path / "a.mat")
    for text in ("out.signals[1].values", "m[1,:]", "m[1]", "m[1, :]"):
        assert np.array_equal(found.read(text)[0], ANGLE), text
    with pytest.raises(InputError, match="is not there"):
        found.read("out.signals[2].values")


def test_dates_of_numpy_and_units_of_arrow(tmp_path: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    stamps = np.datetime64("2024-03-31T00:59:59.5") + np.round(TIME * 1e6).astype("timedelta64[us]")
    np.savez(tmp_path / "a.npz", t=stamps, u=FORCE, theta=ANGLE)
    assert Table(tmp_path / "a.npz").read_time("t") == (pytest.approx(TIME), True)
    fields = [pa.field(name, pa.float64(), metadata={"unit": unit}) for name, unit in (("u", "mNm"), ("theta", "deg"))]
    kinds = pa.schema([pa.field("time", pa.time32("ms")), *fields])
    ticks = pa.array(np.round(TIME * 1e3).astype("int32"), pa.time32("ms"))
    pq.write_table(pa.table([ticks, FORCE * 1e3, ANGLE * TURN], schema=kinds), tmp_path / "a.parquet")
    same(tmp_path / "a.parquet")


def test_two_channels_of_one_name_are_refused(tmp_path: Path) -> None:
    asammdf = pytest.importorskip("asammdf", reason="asammdf is not installed: pip install 'sysid-harness[data]'")
    with asammdf.MDF() as log:
        for sign in (1, -1):
            log.append([asammdf.Signal(sign * ANGLE, TIME, name="theta", unit="rad")])
        log.append([asammdf.Signal(FORCE, TIME, name="u", unit="Nm")])
        log.save(tmp_path / "a.mf4", overwrite=True)
    with pytest.raises(InputError, match="two channels 'theta'"):
        read(described(tmp_path, "a.mf4", "time", "u", "theta"))


def test_the_folder_of_a_bag_is_listed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bags = pytest.importorskip("rosbags.rosbag2", reason="rosbags is not installed: pip install 'sysid-harness[data]'")
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    number = store.types["std_msgs/msg/Float64"]
    with bags.Writer(tmp_path / "bag", version=9, storage_plugin=bags.StoragePlugin.MCAP) as log:
        topic = log.add_connection("/u", "std_msgs/msg/Float64", typestore=store)
        for k in range(30):
            log.write(topic, 10**7 * k, store.serialize_cdr(number(data=float(k)), "std_msgs/msg/Float64"))
    with pytest.raises(SystemExit) as left:
        main(["list", str(tmp_path / "bag")])
    assert left.value.code == 0
    assert "/u.data" in capsys.readouterr().out
