"""Headers of companies' loggers, columns that are only numbered, fields of structures and links: read as meant."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from scipy.io import savemat

from harness.api import default_identifier, identify
from harness.cli.results import print_identified
from harness.data import load_dataset, si_unit
from harness.data.recipe.contents import contents_of
from harness.data.tables.bags import BagFile
from harness.data.tables.table import Table
from harness.errors import InputError
from harness.signals import Channel, PlantSpec
from harness.units import convert

N, DT = 90, 0.01
TIME = np.arange(N) * DT
DRIVE = np.random.default_rng(4866).normal(size=N).round(5) + 1e-6
ANSWER = (np.cumsum(DRIVE) * 1e-2).round(6) + 1e-7
CELLS = [(f"{t:.2f}", f"{u:.7f}", f"{y:.8f}") for t, u, y in zip(TIME, DRIVE, ANSWER, strict=True)]


def same(path: Any, *, inputs: str = "u", output: str = "y", millimetres: bool = True, **options: Any) -> list[str]:
    """Read a log; it is what was measured, in volts and (milli)metres. Returns what was said."""
    data = load_dataset(path, input=inputs, output=output, **options).dataset
    size = 1e-3 if millimetres else 1.0
    assert data.spec.sample_time == pytest.approx(DT)
    assert np.concatenate([run.trajectory.u[:, 0] for run in data]) == pytest.approx(DRIVE)
    assert np.concatenate([run.trajectory.y[:, 0] for run in data]) == pytest.approx(size * ANSWER)
    return list(data.warnings)


def table(folder: Path, head: Sequence[str], rows: Sequence[str], name: str = "log.csv") -> Path:
    (folder / name).write_text("\n".join([*head, *rows]) + "\n", encoding="utf-8")
    return folder / name


def test_campbell_says_names_units_and_kinds_in_four_lines(tmp_path: Path) -> None:
    head = ['"TOA5","CR6","CR6","77","CR6.Std.12","CPU:a.CR6","4711","Fast"', '"TIMESTAMP","RECORD","u","y"']
    head += ['"TS","RN","Volts","mm"', '"","","Smp","Avg"']
    rows = [f'"2024-03-01 12:00:0{t}",{k},{u},{y}' for k, (t, u, y) in enumerate(CELLS)]
    same(table(tmp_path, head, rows, "fast.dat"))


def test_motec_quotes_everything_below_settings(tmp_path: Path) -> None:
    head = ['"Format","MoTeC CSV File",,,"Workbook",""', '"Sample Rate","100.000","Hz",,"End Time","0.9","s"']
    head += ['"Beacon Markers","1.0 2.0"', "", '"Time","u","y"', '"s","V","mm"', ""]
    same(table(tmp_path, head, [",".join(f'"{cell}"' for cell in row) for row in CELLS]))


@pytest.mark.parametrize("title", ["Time  1 - default sample rate [s]", "Zeit  1 - Standardmessrate [s]",
                                   "x-axis [second]", "X (s)"])  # fmt: skip
def test_a_title_that_begins_with_time_and_ends_in_its_unit_is_the_clock(title: str, tmp_path: Path) -> None:
    same(table(tmp_path, [f"{title}\tu [V]\ty [mm]"], ["\t".join(row) for row in CELLS]))


def test_a_scope_counts_samples_from_a_start_by_an_increment(tmp_path: Path) -> None:
    head = ["X,u,y,Start,Increment,", "Sequence,Volt,Volt,-2.0e+00,1.0e-02"]
    rows = [f"{k},{u},{y}," for k, (_, u, y) in enumerate(CELLS)]
    said = same(table(tmp_path, head, rows), millimetres=False)
    assert any("sample 0 at -2 s, every 0.01 s" in note for note in said)
    assert contents_of(tmp_path / "log.csv").start == pytest.approx(-2.0)
    rows[5] = rows[5].replace("5,", "x,", 1)
    with pytest.raises(InputError, match=r"no number.*'x'"):
        same(table(tmp_path, head, rows))


def test_a_scope_writes_its_settings_beside_the_first_rows(tmp_path: Path) -> None:
    beside = ["Record Length,9.0e+01", "Sample Interval,1.0e-02", "Trigger Point,0", ",", "Source,CH1"]
    beside += ["Vertical Units,V", "Vertical Scale,1.0e+00", "Horizontal Units,s", "Model Number,TDS2014"]
    rows = [f"{beside[k] if k < len(beside) else ','},,{t},  {u}," for k, (t, u, _) in enumerate(CELLS)]
    path = table(tmp_path, [], rows, "F0000CH1.CSV")
    data = load_dataset(path, input="none", output="CH1").dataset
    assert np.concatenate([run.trajectory.y[:, 0] for run in data]) == pytest.approx(DRIVE)
    assert (data.spec.sample_time, data.spec.outputs[0].unit) == (pytest.approx(DT), "V")
    with pytest.raises(InputError, match="columns beside the channels of the scope"):  # not left out without a word
        load_dataset(table(tmp_path, [], [f"{row},0.5," for row in rows]), input="none", output="CH1")
    rows[7] = rows[7].replace("Units,s", "Units,Hz")  # a spectrum
    with pytest.raises(InputError):
        load_dataset(table(tmp_path, [], rows), input="none", output="CH1")


def test_each_signal_of_a_long_form_has_the_unit_of_its_own_cells(tmp_path: Path) -> None:
    rows = [text for t, u, y in CELLS for text in (f"{t},u,{1e3 * float(u):.4f} mV", f"{t},y,{y} mm")]
    same(table(tmp_path, ["time [s],name,value"], rows))
    alike = [text for t, u, y in CELLS for text in (f"{t},u,{u} V", f"{t},y,{1e3 * float(y):.5f} mV")]
    same(table(tmp_path, ["time [s],name,value"], alike), millimetres=False)


@pytest.mark.parametrize("titles", ["0,1", "1,2"])
def test_columns_that_are_only_numbered_are_titled_so(titles: str, tmp_path: Path) -> None:
    first, second = titles.split(",")
    path = table(tmp_path, [titles], [",".join(row[1:]) for row in CELLS])
    same(path, inputs=first, output=second, millimetres=False, sample_time=DT)
    indexed = table(tmp_path, [f",{titles}"], [f"{k},{','.join(row[1:])}" for k, row in enumerate(CELLS)])
    same(indexed, inputs=first, output=second, millimetres=False, sample_time=DT)


@pytest.mark.parametrize("rows", [["0,1", "0.01,0.98", "0.02,0.95"], ["1,2", "2,3", "3,5"], ["1,2", "0.5,3", "0.7,9"]])
def test_rows_that_may_be_readings_stay_rows(rows: list[str], tmp_path: Path) -> None:
    found = contents_of(table(tmp_path, [], rows + rows[-1:] * 30))
    assert found.rows == 33
    assert any("line 1 holds numbers" in note for note in found.notes)


def test_the_one_time_in_a_structure_or_group_is_the_clock(tmp_path: Path) -> None:
    savemat(tmp_path / "a.mat", {"log": {"motor": {"t": TIME, "u": DRIVE}, "y": ANSWER}})
    names = {"inputs": "log.motor.u", "output": "log.y", "millimetres": False}
    said = same(tmp_path / "a.mat", **names)
    told = (
        "log.motor.t: no unit is stated: it is taken for seconds, 100 rows a second over 0.89 s (else --unit time=UNIT)"
    )
    assert said.count(told) == 1
    assert [channel.column for channel in contents_of(tmp_path / "a.mat").channels] == ["log.motor.u", "log.y"]
    savemat(tmp_path / "b.mat", {"log": {"t": TIME, "u": DRIVE, "y": ANSWER}, "old": {"t": 2 * TIME}})
    assert Table(tmp_path / "b.mat").clock() is None
    with h5py.File(tmp_path / "c.h5", "w") as file:
        file["fast/u"], file["fast/y"], file["slow/time"] = DRIVE, ANSWER, TIME[:30]
    names = {"inputs": "fast/u", "output": "fast/y", "millimetres": False}
    assert not any("seconds" in said for said in same(tmp_path / "c.h5", sample_time=DT, **names))


@pytest.mark.parametrize("units", ["{s},{V},{mm}", "<s>,<V>,<mm>"])
def test_a_row_of_units_may_stand_in_any_brackets(units: str, tmp_path: Path) -> None:
    same(table(tmp_path, ["t,u,y", units], [",".join(row) for row in CELLS]))


def test_a_span_of_time_is_no_clock() -> None:
    same({"Time constant [s]": 3 + 0 * TIME, "u [V]": DRIVE, "y [mm]": ANSWER}, sample_time=DT)


def test_links_in_a_file_lead_to_its_data_sets(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for name, values, unit in (("t", TIME, "s"), ("u", DRIVE, "V"), ("y", ANSWER, "mm")):
            file[f"runs/7/{name}"] = values
            file[f"runs/7/{name}"].attrs["unit"] = unit
        file["latest"], file["u"] = h5py.SoftLink("/runs/7"), h5py.SoftLink("runs/7/u")
        file["gone"], file["runs/all"] = h5py.SoftLink("/nowhere"), h5py.SoftLink("/")
    same(tmp_path / "a.h5", inputs="u", output="latest/y")
    with pytest.raises(InputError, match="no column 'gone'"):
        same(tmp_path / "a.h5", inputs="gone", output="latest/y")


def test_a_sample_time_is_the_grid_of_signals_with_clocks_of_their_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The last third of the grid validates, not that of the slowest signal; another way to say [resample]."""
    slow = slice(None, None, 5)
    columns = {"u": (TIME, DRIVE), "y": (TIME[slow], TIME[slow])}
    monkeypatch.setattr(BagFile, "__init__", lambda self, path: setattr(self, "titles", list(columns)))
    monkeypatch.setattr(BagFile, "clocks", lambda self, titles: ([columns[one][0] for one in titles], "stamps"))
    monkeypatch.setattr(BagFile, "values", lambda self, title: columns[title][1])
    monkeypatch.setattr(BagFile, "unit", lambda self, title: None)
    (tmp_path / "a.bag").write_bytes(b"#ROSBAG V2.0")
    with pytest.raises(InputError, match="--sample-time"):
        load_dataset(tmp_path / "a.bag", input="u", output="y")
    data = load_dataset(tmp_path / "a.bag", input="u", output="y", sample_time=DT).dataset
    assert [len(run.trajectory) for run in data] == [57, 29]  # 86 samples until the last reading
    assert np.concatenate([run.trajectory.y[:, 0] for run in data]) == pytest.approx(TIME[:86])
    assert np.concatenate([run.trajectory.u[:, 0] for run in data]) == pytest.approx(DRIVE[:86])
    assert any("put on one grid of 0.01 s, 86 samples" in note for note in data.warnings)


@pytest.mark.parametrize(("unit", "factor", "si"), [
    ("kWh", 3.6e6, "J"), ("cal", 4.184, "J"), ("BTU", 1055.05585, "J"), ("eV", 1.602176634e-19, "J"),
    ("Nmm", 1e-3, "N m"), ("ft lbf", 1.355817948, "N m"), ("kgf cm", 0.0980665, "N m"), ("mN m/s", 1e-3, "N m/s"),
    ("mN s/m", 1e-3, "N s/m"), ("g/s", 1e-3, "kg/s"), ("V/krpm", 0.00954929659, "V s/rad"),
    ("Nm/deg", 57.2957795, "N m/rad"), ("mm/rev", 1e-3 / (2 * np.pi), "m/rad"),
    ("mV/(m/s^2)", 1e-3, "V s^2/m"), ("kJ/(kg K)", 1e3, "J/(kg K)"),
    ("cP", 1e-3, "kg/(m s)"), ("RPM/A", np.pi / 30, "rad/(s A)"),
])  # fmt: skip
def test_what_shares_its_dimension_keeps_its_kind_and_products_are_composed(unit: str, factor: float, si: str) -> None:
    assert si_unit(unit) == si
    assert convert(np.ones(1), unit, si) == pytest.approx(factor)


def test_errors_are_shown_in_the_unit_in_which_the_log_came(capsys: pytest.CaptureFixture[str]) -> None:
    cold = 280.0 + ANSWER
    signals = {"time [s]": TIME, "u [V]": DRIVE, "y [mm]": ANSWER, "T [degC]": cold, "n [rpm]": ANSWER, "c": ANSWER}
    found = identify(signals, input="u", output=["y", "T", "n", "c"], identifier="hold")
    shown = {row[2]: row[-1] for row in found._rows() if row[0] == "validation"}
    rms = dict(zip("yTnc", found.simulation_error["validation"][0].rms, strict=True))
    assert shown["y"] == f"{1e3 * rms['y']:.3g} mm"
    assert shown["T"] == f"{rms['T']:.3g} degC"  # a difference, which has no zero
    assert shown["n"] == f"{rms['n'] * 30 / np.pi:.3g} rpm"
    assert shown["c"] == f"{rms['c']:.3g}"
    print_identified(found, "hold")
    assert f"({1e3 * rms['y']:.3g} mm)" in capsys.readouterr().out


def test_records_of_categories_are_counted_where_nothing_is_asked() -> None:
    state = [Channel(name, "1", 0.0, 3.0, "category") for name in "abc"]
    assert default_identifier(PlantSpec((state[0],), (state[1],), 1.0)) == "mdp-counting"
    assert default_identifier(PlantSpec((state[0],), (state[1], state[2]), 1.0)) == "factored-counting"
    assert default_identifier(PlantSpec((state[0],), (Channel("y", "m"),), 1.0)) == "prediction-error"


@pytest.mark.parametrize("title", ["timestamp (ns since boot)", "t [ns from start]"])
def test_words_behind_a_unit_of_time_say_nothing_of_it(title: str) -> None:
    same({title: 1e9 * TIME, "u [V]": DRIVE, "y [mm]": ANSWER})


# ---- the rows tell where a table begins and what parts its cells -----------------------------------------------------


def test_quoted_cells_below_lines_of_titles(tmp_path: Path) -> None:
    quoted = [",".join(f'"{cell}"' for cell in row) for row in CELLS]
    hioki = ['"File name","RIG.MEM"', '"Title comment",""', '"Number of data","90"', "", '"Time[s]","u[V]","y[mm]"']
    same(table(tmp_path, hioki, quoted))
    hobo = ['"Plot Title: Rig 10"', '"#","Date Time, GMT+01:00","u, V","y, mm"']
    rows = [f'{k},"03/01/2024 12:00:0{t}","{u}",{y}' for k, (t, u, y) in enumerate(CELLS)]
    found = Table(table(tmp_path, hobo, rows))
    assert found.titles == ("#", "Date Time, GMT+01:00", "u, V", "y, mm")
    assert found.read("y, mm")[0] == pytest.approx(ANSWER)
    assert found.clock() == "Date Time, GMT+01:00"


def test_commas_in_titles_do_not_part_cells_that_semicolons_part(tmp_path: Path) -> None:
    rows = [";".join(row).replace(".", ",") for row in CELLS]
    same(table(tmp_path, ["Rig 3, tried", "", "Zeit, s;u, V;y, mm"], rows), column={"u": "u, V", "y": "y, mm"},
         unit={"u": "V", "y": "mm"})  # fmt: skip


def test_words_that_settings_hold_are_no_titles_where_others_name_a_clock(tmp_path: Path) -> None:
    head = ["Model,MSO54,", "Waveform,analog,fine", "Label,left,right", "time [s],u [V],y [mm]"]
    same(table(tmp_path, head, [",".join(row) for row in CELLS]))
    both = table(tmp_path, ["Weg,Kraft,Spannung", "y,f,u"], [",".join(row) for row in CELLS])
    with pytest.raises(InputError, match="two rows of titles"):
        Table(both).read("Spannung")


def test_the_clock_is_the_first_of_columns_without_titles(tmp_path: Path) -> None:
    path = table(tmp_path, [], [f"{10 * k} {u} {y}" for k, (_, u, y) in enumerate(CELLS)], "log.txt")
    for first in (0, "0"):
        same(path, column={"time": first, "u": 1, "y": 2}, unit={"time": "ms", "u": "V", "y": "mm"})


def test_a_row_of_units_needs_none_for_a_column_of_words(tmp_path: Path) -> None:
    head = ["Vendor,GRAPHTEC", "Interval,10ms", "", "Number,Time [s],u,y,Alarm1-10", "NO.,,V,mm,A1234567890"]
    rows = [f"{k},{t},{'+-'[u[0] == '-']} {u.lstrip('-')},{y},LLLL" for k, (t, u, y) in enumerate(CELLS)]
    same(table(tmp_path, head, rows))


@pytest.mark.parametrize(("off", "on"), [("OFF", "ON"), ("Aus", "Ein"), ("false", "true")])
def test_what_is_switched_is_nought_and_one(off: str, on: str, tmp_path: Path) -> None:
    rows = [f"{t},{on if float(u) > 0 else off},{y}" for t, u, y in CELLS]
    path = table(tmp_path, ["time [s],valve,y [mm]"], rows)
    data = load_dataset(path, input="valve", output="y").dataset
    assert np.concatenate([run.trajectory.u[:, 0] for run in data]).tolist() == (DRIVE > 0).astype(float).tolist()
    assert any(
        f"valve holds {on.lower()} and {off.lower()}: they are read as 1 and 0" in note for note in data.warnings
    )
    mixed = table(tmp_path, ["time [s],valve,y [mm]"], [row.replace(off, "-1") for row in rows])
    with pytest.raises(InputError, match="no number"):
        load_dataset(mixed, input="valve", output="y")


def test_dashes_hold_nothing_and_hexadecimal_numbers_are_read_where_they_have_no_sign(tmp_path: Path) -> None:
    rows = [f"{t},{u},{'---' if k == 40 else y}" for k, (t, u, y) in enumerate(CELLS)]
    assert np.flatnonzero(np.isnan(Table(table(tmp_path, ["t,u,y"], rows)).read("y")[0])).tolist() == [40]
    rows = [f"{t},{u},0x{k:02X}" for k, (t, u, _) in enumerate(CELLS)]
    assert Table(table(tmp_path, ["t,u,y"], rows)).read("y")[0].tolist() == list(range(len(CELLS)))
    rows[40] = rows[40][:-2] + "D4"  # 212, or -44
    with pytest.raises(InputError, match="'0xD4'; remedy: export decimal numbers, as the first bit may be a sign"):
        Table(table(tmp_path, ["t,u,y"], rows)).read("y")


def test_dates_of_parquet_are_a_clock_whatever_they_are_called(tmp_path: Path) -> None:
    pandas = pytest.importorskip("pandas")
    stamps = pandas.Timestamp("2024-03-01") + pandas.to_timedelta(10 * np.arange(N), unit="ms")
    pandas.DataFrame({"Aufnahme": stamps, "u [V]": DRIVE, "y [mm]": ANSWER}).to_parquet(tmp_path / "a.parquet")
    same(tmp_path / "a.parquet")


def test_units_above_the_titles_are_never_left_aside(tmp_path: Path) -> None:
    rows = [f"{10 * k},{u},{y}" for k, (_, u, y) in enumerate(CELLS)]
    same(table(tmp_path, ["Rig 3", "ms,V,mm", "time,u,y"], rows))
    unclear = table(tmp_path, ["Rig 3", "ms,V,mm", "x,u,y"], rows)
    with pytest.raises(InputError, match="two rows of titles"):
        Table(unclear).read("V")
