"""Exports of loggers, meters and scopes are read as meant and it is said what was done, or refused with a way out."""

from __future__ import annotations

import datetime
import gzip
import io
import tomllib
import zipfile
import zoneinfo
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from harness.data import load_dataset
from harness.data.recipe.draft import draft_dataset
from harness.data.times.counts import unwrapped
from harness.data.times.stamps import clock
from harness.errors import InputError
from harness.signals import Dataset

N, DT = 120, 0.01
RNG = np.random.default_rng(4830)
TIME = np.round(np.arange(N) * DT, 6)
TORQUE = np.round(RNG.normal(size=N), 5)
ANGLE = np.round(np.cumsum(np.cumsum(TORQUE)) * 1e-3, 6)
HEAD = "time [s],u [N m],theta [rad]"
CELLS = [(f"{t:g}", f"{u:.5f}", f"{y:.6f}") for t, u, y in zip(TIME, TORQUE, ANGLE, strict=True)]
ROWS = [",".join(row) for row in CELLS]
CHOSEN: dict[str, Any] = {"input": "u", "output": "theta", "unit": {"u": "N m", "theta": "rad"}}
UTC = datetime.UTC


def text(folder: Path, lines: Sequence[str], name: str = "log.csv") -> Path:
    (folder / name).write_text("\n".join(lines) + "\n", encoding="utf-8")
    return folder / name


def same(path: Path, said: str = "", rows: int = N, **options: Any) -> Dataset:
    """Read a log; it is what was measured, and something is said."""
    data = load_dataset(path, **(options or {"model": "pendulum"})).dataset
    assert data.spec.sample_time == pytest.approx(DT, rel=1e-6)
    assert np.concatenate([run.trajectory.u[:, 0] for run in data]) == pytest.approx(TORQUE[:rows], abs=1e-5)
    assert np.concatenate([run.trajectory.y[:, 0] for run in data]) == pytest.approx(ANGLE[:rows], abs=1e-6)
    assert not said or any(said in note for note in data.warnings)
    return data


def refused(path: Path, match: str, **options: Any) -> None:
    with pytest.raises(InputError, match=match):
        load_dataset(path, **(options or {"model": "pendulum"}))


def timed(folder: Path, stamps: Sequence[str], title: str = "time") -> Path:
    rows = [f"{stamp};{u};{y}" for stamp, (_, u, y) in zip(stamps, CELLS, strict=True)]
    return text(folder, [f"{title};u [N m];theta [rad]", *rows])


def instants(begin: datetime.datetime) -> list[datetime.datetime]:
    return [begin + datetime.timedelta(milliseconds=10 * k) for k in range(N)]


# ---- what was read wrong without a word -----------------------------------------------------------------------------


def test_a_clock_that_another_one_contradicts_is_refused(tmp_path: Path) -> None:
    """WinCC's ``Time_ms`` counts millionths of a day; the dates beside it show that it does."""
    at = instants(datetime.datetime(2024, 5, 1, 10))
    days = [45413416666.6 + k * 1e6 * DT / 86400 for k in range(N)]
    rows = [f"{x:%Y-%m-%d %H:%M:%S.%f};{u};{y};{d:.7f}" for x, (_, u, y), d in zip(at, CELLS, days, strict=True)]
    path = text(tmp_path, ["TimeString;u [N m];theta [rad];Time_ms", *rows])
    refused(path, r"two clocks that disagree: 'Time_ms' and 'TimeString'.*--column time='TimeString'")
    same(path, model="pendulum", column={"time": "TimeString"})


@pytest.mark.parametrize(("factor", "agree"), [(1.0, True), (1.01, True), (2.0, False), (0.5, False)])
def test_two_columns_of_seconds_run_at_one_pace(factor: float, agree: bool, tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", time=TIME, t=TIME * factor, u=TORQUE, theta=ANGLE)
    if agree:
        same(tmp_path / "a.npz", **CHOSEN)
    else:
        refused(tmp_path / "a.npz", "two clocks that disagree", **CHOSEN)
        same(tmp_path / "a.npz", **CHOSEN, column={"time": "time"})


def test_the_clock_of_another_group_contradicts_nothing(tmp_path: Path) -> None:
    """It has rows of its own."""
    with pytest.importorskip("h5py").File(tmp_path / "a.h5", "w") as file:
        file["time"], file["u"], file["theta"] = TIME, TORQUE, ANGLE
        file["t"], file["slow/time"] = TIME[::4], 4 * TIME[:30]
    same(tmp_path / "a.h5", **CHOSEN)


def test_what_tells_no_pace_contradicts_nothing(tmp_path: Path) -> None:
    """A date, a count down, a lap clock and a duration that jitters stand beside the clock of many logs."""
    lap, jitter = TIME % 0.5, 10 + RNG.normal(size=N)
    rows = [f"{r},2024-05-01,{9 - t:g},{a:g},{j:g}" for r, t, a, j in zip(ROWS, TIME, lap, jitter, strict=True)]
    same(text(tmp_path, [HEAD + ",date,time remaining [s],lap time [s],cycle time [ms]", *rows]))


def test_a_remark_on_the_unit_of_time_counts(tmp_path: Path) -> None:
    rows = [f"{float(t) / 60:.10g},{u},{y}" for t, u, y in CELLS]
    path = text(tmp_path, ["# time in minutes", "time,u [N m],theta [rad]", *rows])
    refused(path, r"states no unit.*'# time in minutes'.*--unit time=min")
    same(path, model="pendulum", unit={"time": "min"})
    same(text(tmp_path, ["# time in s", "# started 5 minutes late", "time,u [N m],theta [rad]", *ROWS], "b.csv"))


def test_cells_that_show_per_cent_are_read_as_they_show(tmp_path: Path) -> None:
    openpyxl = pytest.importorskip("openpyxl")
    for name, form in (("a.xlsx", "0.00%"), ("b.xlsx", "0.00")):
        book = openpyxl.Workbook()
        book.active.append(["time [s]", "u [%]", "theta [rad]"])
        for k in range(N):
            book.active.append([TIME[k], TORQUE[k] * (1 if name == "a.xlsx" else 100), ANGLE[k]])
            book.active.cell(k + 2, 2).number_format = form
        book.save(tmp_path / name)
        same(tmp_path / name, "show per cent" if name == "a.xlsx" else "", input="u", output="theta",
             unit={"theta": "rad"})  # fmt: skip


def truths(path: Path) -> list[str]:
    on = TORQUE > 0
    if path.suffix == ".npz":
        np.savez(path, t=TIME, u=on, theta=ANGLE)
    elif path.suffix == ".mat":
        from scipy.io import savemat

        savemat(path, {"t": TIME, "u": on, "theta": ANGLE})
    else:
        pandas = pytest.importorskip("pandas")
        table = pandas.DataFrame({"t": TIME, "u": on, "theta": ANGLE})
        table.to_parquet(path) if path.suffix == ".parquet" else table.to_excel(path, index=False)
    data = load_dataset(path, **CHOSEN).dataset
    assert np.concatenate([run.trajectory.u[:, 0] for run in data]) == pytest.approx(on.astype(float))
    return list(data.warnings)


@pytest.mark.parametrize("suffix", [".npz", ".mat", ".parquet", ".xlsx"])
def test_true_and_false_are_said_to_be_numbers(suffix: str, tmp_path: Path) -> None:
    pytest.importorskip("openpyxl")
    assert sum("u holds true and false" in note for note in truths(tmp_path / f"a{suffix}")) == 1


@pytest.mark.parametrize(("attribute", "value", "said"), [("gain", 1e-4, True), ("Scaling", 2, True),
                                                          ("gain", 1.0, False), ("range", 10, False)])  # fmt: skip
def test_a_factor_that_no_convention_explains_is_said(attribute: str, value: float, said: bool, tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["time"], file["theta"] = TIME, ANGLE
        file.create_dataset("u", data=TORQUE).attrs[attribute] = value
    notes = same(tmp_path / "a.h5", **CHOSEN).warnings
    assert any(f"u has {attribute} = {value:g}" in note for note in notes) is said


def test_a_row_of_factors_is_not_split_off(tmp_path: Path) -> None:
    """With gaps = "split" the raw numbers below it would be a record: that is no remedy."""
    raw = [f"{t},{float(u) * 1e3:g},{float(y) * 1e3:g}" for t, u, y in CELLS]
    path = text(tmp_path, ["time,u,theta", "s,N m,rad", "1,0.001,0.001", *raw])
    with pytest.raises(InputError, match="line 4: time runs back") as caught:
        load_dataset(path, model="pendulum")
    assert "factors" in str(caught.value)
    assert "split" not in str(caught.value)


@pytest.mark.parametrize(("title", "head", "said"), [("run", "", True), ("Trial", "", True), ("gear", "", False),
                                                     ("run", "time [s],", False)])  # fmt: skip
def test_records_that_follow_each_other_without_a_clock_are_said(
    title: str, head: str, said: bool, tmp_path: Path
) -> None:
    rows = [f"{f'{t},' if head else ''}{1 + k // 60},{u},{y}" for k, (t, u, y) in enumerate(CELLS)]
    path = text(tmp_path, [f"{head}{title},u [N m],theta [rad]", *rows])
    notes = load_dataset(path, model="pendulum", sample_time=DT).dataset.warnings
    assert any(f"'{title}' changes in line 62 (1x)" in note for note in notes) is said


# ---- clocks ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("place", "at"), [
    ("Europe/Berlin", (2024, 5, 1, 8)), ("Europe/Berlin", (2024, 3, 31, 0, 59, 59)),
    ("Europe/Berlin", (2024, 10, 27, 0, 59, 59)), ("America/New_York", (2024, 11, 3, 5, 59, 59)),
    ("Asia/Kolkata", (2024, 5, 1, 8)), ("Australia/Lord_Howe", (2024, 4, 6, 14, 59, 59)),
    ("Europe/Berlin", (2024, 10, 27, 0, 59, 58, 900000)), ("Europe/Berlin", (2024, 10, 27, 1, 59, 59)),
])  # fmt: skip
@pytest.mark.parametrize("form", ["{} {}", "{} [{}]"])
def test_places_count_with_their_summer_time(place: str, at: tuple[int, ...], form: str, tmp_path: Path) -> None:
    """Local times that begin before, at, within and after the hour in which clocks are set."""
    local = [x.astimezone(zoneinfo.ZoneInfo(place)) for x in instants(datetime.datetime(*at, tzinfo=UTC))]  # type: ignore[arg-type, misc]
    same(timed(tmp_path, [form.format(x.strftime("%Y-%m-%d %H:%M:%S.%f"), place) for x in local]))


def test_an_hour_that_came_twice_is_not_guessed() -> None:
    berlin = "Europe/Berlin"
    assert clock([f"2024-10-27 {x} {berlin}" for x in ("01:59:59", "02:00:00", "03:00:00")]) is None
    twice = clock([f"2024-10-27 {x} {berlin}" for x in ("02:59:59", "02:00:00", "03:00:00")])
    assert twice is not None
    assert twice.tolist() == [0.0, 1.0, 3601.0]
    alone = clock([f"2024-10-27 {x} {berlin}" for x in ("02:00:00", "02:00:01")])
    assert alone is not None
    assert alone.tolist() == [0.0, 1.0]
    assert clock([f"10:00:0{k} {berlin}" for k in range(3)]) is None  # which day, and so which offset?
    assert clock([f"2024-05-01 10:00:0{k} Europe/Atlantis" for k in range(3)]) is None


@pytest.mark.parametrize(("first", "second", "ahead"), [
    ("CET", "CEST", 3600), ("EST", "EDT", 3600), ("BST", "GMT", -3600), ("IST", "IST", 0), ("MEZ", "MESZ", 3600),
    ("UTC", "+01:00", 3600), ("GMT+02:30", "Z", -9000), ("-0500", "-04:00", 3600),
])  # fmt: skip
def test_abbreviations_and_offsets_of_zones(first: str, second: str, ahead: int) -> None:
    found = clock([f"2024-03-31 10:00:00 {first}", f"2024-03-31 12:00:01 {second}"])
    assert found is not None
    assert found.tolist() == [0.0, 7201.0 - ahead]


@pytest.mark.parametrize("zones", [("GMT", "IST"), ("CET", "EST"), ("CST", "+01:00"), ("ABC", "ABC")])
def test_abbreviations_of_two_zones_are_no_clock(zones: tuple[str, str]) -> None:
    assert clock([f"2024-03-31 10:00:0{k} {zone}" for k, zone in enumerate(zones)]) is None


@pytest.mark.parametrize("form", [
    "%G-W%V-%uT%H:%M:%S.%f", "%GW%V%uT%H%M%S.%f", "%G-W%V-%u %H:%M:%S.%fZ", "%Y-%jT%H:%M:%S.%f", "%Y%jT%H%M%S.%f",
    "%Y:%j:%H:%M:%S.%f", "%a %b %e %H:%M:%S.%f CET %Y", "%B %d, %Y at %I:%M:%S.%f %p", "%Y-%m-%dt%H:%M:%S.%fz",
    "%Y-%m-%dT%H:%M:%S.%fZ[UTC]", "%d/%m/%Y %I:%M:%S.%f\u00a0%p",
])  # fmt: skip
@pytest.mark.parametrize("begin", [(2024, 12, 29, 23, 59, 59), (2023, 12, 31, 23, 59, 59), (2024, 2, 28, 23, 59, 59)])
def test_dates_in_forms_of_weeks_days_and_programs(form: str, begin: tuple[int, ...], tmp_path: Path) -> None:
    """Over the end of a week, a year and a February of 29 days; Spanish writes ``p. m.``."""
    stamps = [x.strftime(form) for x in instants(datetime.datetime(*begin))]  # type: ignore[arg-type]
    stamps = [x.replace("AM", "a.\u00a0m.").replace("PM", "p.\u00a0m.") if "\u00a0" in form else x for x in stamps]
    same(timed(tmp_path, stamps))


@pytest.mark.parametrize(
    "cell", ["2024-W54-1T10:00:00", "2023-366T10:00:00", "2024-000T10:00:00", "2024-W01-8T10:00:00"]
)
def test_days_that_are_none_are_refused(cell: str, tmp_path: Path) -> None:
    refused(timed(tmp_path, [cell] * N), "no number")


def test_a_clock_of_twelve_hours_goes_on_after_one_o_clock(tmp_path: Path) -> None:
    at = instants(datetime.datetime(2024, 5, 1, 12, 59, 59, 500000))
    same(timed(tmp_path, [x.strftime("%I:%M:%S.%f") for x in at]), "a clock of twelve hours")
    same(timed(tmp_path, [x.strftime("%Y-%m-%d %I:%M:%S.%f") for x in at]), "a clock of twelve hours")


@pytest.mark.parametrize(("bits", "step", "begin"), [(8, 10, 151), (10, 10, 800), (20, 10000, 500001), (12, 7, 3000)])
def test_narrow_counters_that_go_on_off_zero(bits: int, step: int, begin: int) -> None:
    counts = (begin + step * np.arange(200)) % 2**bits
    stamps, period, times = unwrapped(counts.astype(float))
    assert stamps.tolist() == (begin + step * np.arange(200)).tolist()
    assert (period, times) == (2.0**bits, (begin + step * 199) // 2**bits)


@pytest.mark.parametrize("counts", [
    np.tile(np.arange(256), 2)[100:],  # a second record of 256 rows
    np.r_[np.arange(0, 1000, 10), np.arange(0, 1000, 10)], np.r_[136:240:10, 9:100:10],
])  # fmt: skip
def test_a_second_record_is_no_counter_that_goes_on(counts: np.ndarray) -> None:
    assert unwrapped(counts.astype(float))[2] == 0


@pytest.mark.parametrize(("title", "factor"), [
    ("Zeit in 1/100 s", 100), ("Zeit [1/1000 s]", 1000), ("t (1/10 sec)", 10), ("Zeit in Zehntelsekunden", 10),
    ("Zeit (Hundertstelsekunden)", 100), ("time [centiseconds]", 100),
])  # fmt: skip
def test_parts_of_a_second_as_the_unit(title: str, factor: int, tmp_path: Path) -> None:
    same(timed(tmp_path, [f"{t * factor:g}" for t in TIME], title))


@pytest.mark.parametrize("title", ["Time (0.01 s)", "time [10 ms]", "Zeit in 1/3 s", "time [1/100]"])
def test_factors_that_may_be_rates_are_refused(title: str, tmp_path: Path) -> None:
    refused(timed(tmp_path, [f"{k}" for k in range(N)], title), "unit of time|no time")


@pytest.mark.parametrize("tail", [["0,0,0"] * 30, [ROWS[-1]] * 30, [ROWS[-1]] * 3])
def test_space_that_was_never_written_to_is_left_out(tail: list[str], tmp_path: Path) -> None:
    same(text(tmp_path, [HEAD, *ROWS, *tail]), f"the last {len(tail)} rows repeat one row")


def test_rows_at_rest_under_a_coarse_clock_stay(tmp_path: Path) -> None:
    rows = [f"{k // 20 / 5:g},{u},{y}" for k, (_, u, y) in enumerate(CELLS)]
    rest = [f"{1.0 + (k // 20) / 5:g},0,0.5" for k in range(40)]
    data = load_dataset(text(tmp_path, [HEAD, *rows[:100], *rest]), model="pendulum", sample_time=DT).dataset
    assert sum(len(run.trajectory) for run in data) == 140


# ---- units in cells -------------------------------------------------------------------------------------------------


def measured(folder: Path, u: Callable[[float], str], y: Callable[[float], str], head: str, sep: str = ",") -> Path:
    rows = [sep.join((t, u(a), y(b))) for (t, _, _), a, b in zip(CELLS, TORQUE, ANGLE, strict=True)]
    return text(folder, [head, *rows])


def test_units_that_stand_in_every_cell(tmp_path: Path) -> None:
    head = "time [s],u,theta"
    same(measured(tmp_path, "{:.5f} N·m".format, "{:.6f} rad".format, head), "u: units stand in the cells (N·m)")
    same(measured(tmp_path, lambda u: f"{1e3 * u:.2f}mNm", "{:.6f}rad".format, head), "units stand in the cells (mNm)")
    same(measured(tmp_path, "{:.5f} N m".format, "{:.6f}".format, HEAD))
    degrees = measured(tmp_path, "{:.5f} Nm".format, lambda y: f"{np.degrees(y):.8f}°", head)
    same(degrees, "units stand in the cells (°)")
    commas = [";".join(row).replace(".", ",").replace(";", " s;", 1) for row in CELLS]
    same(text(tmp_path, ["Zeit;u [N m];theta [rad]", *commas]), "Zeit: units stand in the cells (s)")


def test_a_meter_that_changes_its_range(tmp_path: Path) -> None:
    ranged = measured(tmp_path, lambda u: f"{1e3 * u:.2f} mNm" if abs(u) < 1 else f"{u:.5f} Nm", "{:.6f} rad".format,
                      "time [s],u,theta")  # fmt: skip
    same(ranged, "u: units stand in the cells (")
    stamps = [f"{1e3 * t:g} ms" if t < 0.5 else f"{t:g} s" for t in TIME]
    same(timed(tmp_path, stamps), "time: units stand in the cells (ms, s): they are read in s")


@pytest.mark.parametrize(("u", "match"), [
    ("{:.5f} mN m".format, "two units of column 'u \\[N m\\]'"), ("{:.5f}m".format, "two units"),
    (lambda u: f"{u:.5f} Nm" if u > 0 else f"{u:.5f}", "no number"),
    (lambda u: f"{u:.5f} Nm" if u > 0 else f"{u:.5f} A", "no number"), ("0x{:.0f}".format, "no number"),
])  # fmt: skip
def test_cells_whose_unit_is_not_certain_are_refused(u: Callable[[float], str], match: str, tmp_path: Path) -> None:
    refused(measured(tmp_path, u, "{:.6f}".format, HEAD), match)


# ---- forms of loggers -----------------------------------------------------------------------------------------------

LABVIEW = ["LabVIEW Measurement", "Writer_Version\t2", "X_Columns\tOne", "***End_of_Header***", "", "Channels\t2\t\t",
           "Y_Unit_Label\tN m\trad\t", "X_Dimension\tTime\tTime\t", "Delta_X\t0.01\t0.01\t",
           "***End_of_Header***\t\t\t"]  # fmt: skip


def test_labview_files(tmp_path: Path) -> None:
    head = "X_Value\tu [N m]\ttheta [rad]\tComment"
    same(text(tmp_path, [*LABVIEW, head, *("\t".join(row) + "\t" for row in CELLS)], "a.lvm"), "stand above the table")
    bare = text(tmp_path, [*LABVIEW, head, *(f"\t{u}\t{y}\t" for _, u, y in CELLS)], "b.lvm")
    same(bare, model="pendulum", sample_time=DT)
    other = [line.replace("Time\tTime", "Length\tLength") for line in LABVIEW]
    refused(text(tmp_path, [*other, head, *("\t".join(row) + "\t" for row in CELLS)], "c.lvm"), "no time")


def test_settings_above_the_titles_of_a_scope(tmp_path: Path) -> None:
    settings = ["Model,MSO54", "Firmware Version,1.26.6", "", "Point Format,Y,", "Sample Interval,0.01,",
                "Record Length,120,", "Probe Attenuation,1,1", "Label,u,theta"]  # fmt: skip
    same(text(tmp_path, [*settings, "TIME,u [N m],theta [rad]", *ROWS]), "stand above the table")


def test_settings_beside_dates_with_decimal_commas(tmp_path: Path) -> None:
    """A waveform of LabVIEW: as many cells above the titles as below them, and more commas than tabs in a row."""
    at = [f"{x:%d.%m.%Y %H:%M:%S,%f}" for x in instants(datetime.datetime(2024, 5, 1, 10))]
    rows = [
        "\t".join((stamp, u, y)).replace(".", ",").replace("01,05,", "01.05.")
        for stamp, (_, u, y) in zip(at, CELLS, strict=True)
    ]
    head = ["waveform\tu\ty", f"t0\t{at[0]}\t{at[0]}", "delta t\t0,010000\t0,010000"]
    same(text(tmp_path, [*head, "time\tu [N m]\ttheta [rad]", *rows], "a.txt"), "stand above the table")


@pytest.mark.parametrize("words", [("True", "False"), ("TRUE", "FALSE"), ("true", "false")])
def test_true_and_false_in_text_are_one_and_nought(words: tuple[str, str], tmp_path: Path) -> None:
    rows = [f"{t},{words[float(u) < 0]},{y}" for t, u, y in CELLS]
    data = load_dataset(
        text(tmp_path, [HEAD.replace(" [N m]", ""), *rows]), model="pendulum", unit={"u": "N m"}
    ).dataset
    assert np.concatenate([run.trajectory.u[:, 0] for run in data]).tolist() == [
        float(float(u) >= 0) for _, u, _ in CELLS
    ]
    assert sum("u holds true and false" in note for note in data.warnings) == 1


@pytest.mark.parametrize("cell", ["missing", "#NV", "#WERT!", "#VALEUR!", "#N/D"])
def test_what_spreadsheets_and_julia_write_for_nothing_is_a_gap(cell: str, tmp_path: Path) -> None:
    rows = [f"{t},{u},{cell if k == 50 else y}" for k, (t, u, y) in enumerate(CELLS)]
    refused(text(tmp_path, [HEAD, *rows]), "nothing recorded in 1 of")
    data = load_dataset(tmp_path / "log.csv", model="pendulum", gaps="split").dataset
    assert [len(run.trajectory) for run in data] == [50, 29, 40]


@pytest.mark.parametrize("mark", ["%", "# ", "//"])
def test_titles_in_a_comment_above_rows_that_hold_a_name(mark: str, tmp_path: Path) -> None:
    """``rostopic echo -p`` begins so."""
    rows = [f"{1e9 * float(t):.0f},{k},joint,{u},{y}" for k, (t, u, y) in enumerate(CELLS)]
    path = text(tmp_path, [f"{mark}time,field.seq,field.name0,field.effort0,field.position0", *rows])
    signals = {**CHOSEN, "column": {"u": "field.effort0", "theta": "field.position0"}}
    refused(path, "states no unit", **signals)
    same(path, "gives their titles", **{**signals, "unit": {**CHOSEN["unit"], "time": "ns"}})


def test_titles_that_are_numbers_stay_titles(tmp_path: Path) -> None:
    rows = [f"{row},0" for row in ROWS]
    path = text(tmp_path, ["# clock,left,right,none", "time,1,2,3", *rows])
    same(path, input="1", output="2", unit={"1": "N m", "2": "rad"})


@pytest.mark.parametrize("name", ["LOG.TXT", "a.dat", "a.log", "a.asc", "a.prn", "a.tab"])
def test_a_table_in_text_needs_no_other_suffix(name: str, tmp_path: Path) -> None:
    same(text(tmp_path, [HEAD, *ROWS], name))


LONG = {
    "in turn": ["time [s],name,value", *(x for t, u, y in CELLS for x in (f"{t},u,{u}", f"{t},theta,{y}"))],
    "in blocks": ["tag;t [s];Wert", *(f"u;{t};{u}" for t, u, _ in CELLS), *(f"theta;{t};{y}" for t, _, y in CELLS)],
    "units": ["time [s],signal,value,unit",
              *(x for t, u, y in CELLS for x in (f"{t},u,{1e3 * float(u):g},mN m", f"{t},theta,{y},rad"))],
}  # fmt: skip


@pytest.mark.parametrize("form", list(LONG))
def test_tables_in_long_form(form: str, tmp_path: Path) -> None:
    signals = {"input": "u", "output": "theta"} if form == "units" else CHOSEN
    same(text(tmp_path, LONG[form]), "names the signal of each row", **signals)


@pytest.mark.parametrize("end", ["9,rare,1", ",$COUNT$,120"])
def test_names_of_few_rows_are_left_out_of_a_long_form(end: str, tmp_path: Path) -> None:
    same(text(tmp_path, [*LONG["in turn"], end]), "names in less than 20 rows are left out", **CHOSEN)


def test_a_long_form_with_stamps_of_their_own_asks_for_a_grid(tmp_path: Path) -> None:
    rows = [x for t, u, y in CELLS for x in (f"{t},u,{u}", f"{float(t) + 0.003:g},theta,{y}")]
    path = text(tmp_path, ["time [s],name,value", *rows])
    refused(path, r"nothing recorded.*\[resample\]", **CHOSEN)
    (tmp_path / "dataset.toml").write_text(
        'name = "x"\nintersample = "zoh"\n[resample]\nsample_time = 0.01\n[signals.u]\nrole = "input"\nunit = "N m"\n'
        '[signals.theta]\nrole = "output"\nunit = "rad"\n[[runs]]\nfile = "log.csv"\n'
    )
    (run,) = load_dataset(tmp_path / "dataset.toml").dataset
    grid = run.trajectory.t - run.trajectory.t[0]
    assert run.trajectory.y[:, 0] == pytest.approx(np.interp(grid, TIME, ANGLE), abs=1e-6)


@pytest.mark.parametrize("change", [
    lambda lines: ["time [s],name,other", *lines[1:]],  # no word for readings
    lambda lines: [lines[0], *(line.replace(",u,", ",1,") for line in lines[1:])],  # a number is no name
    lambda lines: ["time [s],name,value,time of day", *(f"{line},10:00:00" for line in lines[1:])],  # which time?
])  # fmt: skip
def test_what_is_no_certain_long_form_is_left_alone(change: Callable[[list[str]], list[str]], tmp_path: Path) -> None:
    refused(text(tmp_path, change(LONG["in turn"])), "no column 'u'", **CHOSEN)


def test_two_units_of_a_signal_in_long_form(tmp_path: Path) -> None:
    lines = LONG["units"]
    refused(
        text(tmp_path, [*lines[:41], lines[41].replace("mN m", "N m"), *lines[42:]]), "line 42: two units", **CHOSEN
    )


def test_the_draft_of_two_columns_of_one_name_can_be_read(tmp_path: Path) -> None:
    rows = [f"{row},{np.degrees(y):.8f}" for row, y in zip(ROWS, ANGLE, strict=True)]
    draft = draft_dataset([text(tmp_path, [HEAD + ",theta [deg]", *rows])], model="pendulum", folder=tmp_path)
    assert tomllib.loads(draft)["signals"]["theta"]["column"] == "theta [rad]"
    assert "another column is called theta too" in draft
    (tmp_path / "dataset.toml").write_text(draft)
    same(tmp_path / "dataset.toml", model="pendulum")


# ---- files of another kind than they say -----------------------------------------------------------------------------


def zipped(names: Sequence[str]) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name in names:
            archive.writestr(name, b"\0")
    return stream.getvalue()


PLAIN = ("\n".join([HEAD, *ROWS]) + "\n").encode()


@pytest.mark.parametrize(("name", "content", "remedy"), [
    ("a.csv", zipped(["log.csv"]), r"end in \.zip"), ("a.csv", zipped(["xl/workbook.xml"]), r"end in \.xlsx"),
    ("a.csv", zipped(["t.npy"]), r"end in \.npz"), ("a.zip", zipped(["a.csv", "b.csv"]), "unpack it"),
    ("a.csv.xz", b"\xfd7zXZ", "unxz"), ("a.csv.gz", gzip.compress(gzip.compress(PLAIN)), "gunzip"),
    ("a.csv.gz", PLAIN, r"text: rename it to end in \.csv"), ("a.xlsx", PLAIN, r"text: rename it to end in \.csv"),
    ("a.parquet", PLAIN, r"text: rename it to end in \.csv"), ("a.xlsx", b"PAR1" + bytes(99), r"end in \.parquet"),
    ("a.csv.gz", gzip.compress(PLAIN)[:-200], "copied whole"),
])  # fmt: skip
def test_the_remedy_names_what_the_file_is(name: str, content: bytes, remedy: str, tmp_path: Path) -> None:
    pytest.importorskip("openpyxl")
    (tmp_path / name).write_bytes(content)
    refused(tmp_path / name, f"remedy: .*{remedy}", **CHOSEN)


@pytest.mark.parametrize("suffix", [".h5", ".mat", ".npz"])
def test_dates_in_texts_of_binary_files_are_a_clock(suffix: str, tmp_path: Path) -> None:
    stamps = [x.isoformat(sep=" ") for x in instants(datetime.datetime(2024, 5, 1, 10))]
    path = tmp_path / f"a{suffix}"
    if suffix == ".h5":
        with pytest.importorskip("h5py").File(path, "w") as file:
            file["time"], file["u"], file["theta"] = np.array(stamps, dtype="S"), TORQUE, ANGLE
    elif suffix == ".mat":
        from scipy.io import savemat

        savemat(path, {"time": np.array(stamps), "u": TORQUE, "theta": ANGLE})
    else:
        np.savez(path, time=np.array(stamps), u=TORQUE, theta=ANGLE)
    same(path, **CHOSEN)
