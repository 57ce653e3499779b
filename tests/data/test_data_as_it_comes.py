"""Tables as people have them: commas, units in a row, clocks, packed, Excel, Feather, in memory."""

from __future__ import annotations

import gzip
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from harness import api, diagnosis
from harness.data import load_dataset, to_pandas, to_polars, to_xarray
from harness.errors import InputError
from harness.signals import Trajectory

DT, N = 0.01, 90
RNG = np.random.default_rng(0)
TIME = np.round(np.arange(N) * DT, 6)
FORCE = np.round(RNG.normal(size=N), 6)
ANGLE = np.round(np.cumsum(np.cumsum(FORCE)) * 1e-3, 6)


def text(titles: str, *columns: Any, sign: str = ",", above: str = "") -> str:
    """Return a table as text."""
    rows = zip(*[[str(value) for value in column] for column in columns], strict=True)
    return above + "\n".join([titles, *(sign.join(row) for row in rows)]) + "\n"


def loaded(path: Any, **options: Any) -> Trajectory:
    """Return the whole record: the estimation part and, behind it, the last third."""
    data = load_dataset(path, model="pendulum", **options).dataset
    whole = [run.trajectory for run in data.runs]
    assert [str(channel) for channel in data.spec.outputs] == ["theta [rad]"]
    return Trajectory(
        np.concatenate([one.t for one in whole]),
        np.concatenate([one.u for one in whole]),
        np.concatenate([one.y for one in whole]),
        data.spec,
    )


def same(record: Trajectory, *, angle: np.ndarray = ANGLE, force: np.ndarray = FORCE) -> None:
    assert np.array_equal(record.u[:, 0], force)
    assert record.y[:, 0] == pytest.approx(angle, abs=1e-12)
    assert record.spec.sample_time == pytest.approx(DT)


def test_decimal_commas(tmp_path: Path) -> None:
    plain = text("time [s];u [Nm];theta [rad]", TIME, FORCE, ANGLE, sign=";")
    (tmp_path / "a.csv").write_text(plain.replace(".", ","))
    same(loaded(tmp_path / "a.csv"))
    notes = load_dataset(tmp_path / "a.csv", model="pendulum").dataset.warnings
    assert any("decimal commas" in note for note in notes)
    quoted = ["time [s],u [Nm],theta [rad]"]
    quoted += [",".join(f'"{str(v).replace(".", ",")}"' for v in row) for row in zip(TIME, FORCE, ANGLE, strict=True)]
    (tmp_path / "b.csv").write_text("\n".join(quoted) + "\n")
    same(loaded(tmp_path / "b.csv"))


def test_commas_and_points_in_one_table_are_refused(tmp_path: Path) -> None:
    table = text("time [s];u [Nm];theta [rad]", TIME, FORCE, ANGLE, sign=";").splitlines()
    table[6] = table[6].replace(".", ",")
    (tmp_path / "a.csv").write_text("\n".join(table))
    with pytest.raises(InputError, match=r"line 7, column.*one kind of decimal sign"):
        loaded(tmp_path / "a.csv")


@pytest.mark.parametrize("units", ["s,Nm,°", "[s],[N m],[deg]", "(s),(N.m),(deg)"])
def test_a_row_of_units_below_the_header(units: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(text(f"time,u,theta\n{units}", TIME, FORCE, ANGLE))
    same(loaded(tmp_path / "a.csv"), angle=np.radians(ANGLE))


def test_a_row_of_words_is_no_row_of_units(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(text("time,u [Nm],theta [rad]\nclock,motor,encoder", TIME, FORCE, ANGLE))
    with pytest.raises(InputError, match="line 2"):
        loaded(tmp_path / "a.csv")


def test_clocks_of_iso_8601(tmp_path: Path) -> None:
    start = np.datetime64("2024-12-31T23:59:59.700")
    stamps = [str(start + np.timedelta64(10 * k, "ms")) + "Z" for k in range(N)]
    (tmp_path / "a.csv").write_text(text("time,u [Nm],theta [rad]", stamps, FORCE, ANGLE))
    same(loaded(tmp_path / "a.csv"))
    day = [f"12:00:0{k // 100},{10 * (k % 100):03d}" for k in range(N)]
    (tmp_path / "b.csv").write_text(text("Time;u [Nm];theta [rad]", day, FORCE, ANGLE, sign=";"))
    same(loaded(tmp_path / "b.csv"))


def test_the_unit_of_a_time_column_counts_whatever_its_name(tmp_path: Path) -> None:
    for title in ("t [ms]", "time [ms]", "Time [ms]"):
        (tmp_path / "a.csv").write_text(text(f"{title},u [Nm],theta [rad]", 1000 * TIME, FORCE, ANGLE))
        same(loaded(tmp_path / "a.csv"))


def test_packed_tables(tmp_path: Path) -> None:
    content = text("time [s],u [Nm],theta [rad]", TIME, FORCE, ANGLE).encode()
    (tmp_path / "a.csv.gz").write_bytes(gzip.compress(content))
    same(loaded(tmp_path / "a.csv.gz"))
    (tmp_path / "b.csv.gz").write_bytes(gzip.compress(content)[:-20])
    with pytest.raises(InputError, match="not a gzip file"):
        loaded(tmp_path / "b.csv.gz")


def test_feather_and_excel(tmp_path: Path) -> None:
    pandas = pytest.importorskip("pandas", reason="pandas is not installed: pip install 'sysid-harness[data]'")
    pytest.importorskip("openpyxl", reason="openpyxl is not installed: pip install 'sysid-harness[data]'")
    frame = pandas.DataFrame({"time [s]": TIME, "u [Nm]": FORCE, "theta [rad]": ANGLE})
    frame.to_feather(tmp_path / "a.feather")
    same(loaded(tmp_path / "a.feather"))
    frame.to_excel(tmp_path / "a.xlsx", index=False)
    same(loaded(tmp_path / "a.xlsx"))
    units = pandas.concat([pandas.DataFrame([["s", "Nm", "rad"]], columns=["time", "u", "theta"]).astype(object),
                           frame.set_axis(["time", "u", "theta"], axis=1).astype(object)])  # fmt: skip
    with pandas.ExcelWriter(tmp_path / "b.xlsx") as book:
        units.to_excel(book, sheet_name="run", index=False)
        frame.to_excel(book, sheet_name="other", index=False)
    same(loaded(tmp_path / "b.xlsx"))
    notes = load_dataset(tmp_path / "b.xlsx", model="pendulum").dataset.warnings
    assert any("'run', the first, is read" in note for note in notes)
    frame.loc[4, "u [Nm]"] = None
    frame.to_excel(tmp_path / "c.xlsx", index=False)
    with pytest.raises(InputError, match="row 6"):  # as Excel counts
        loaded(tmp_path / "c.xlsx")
    frame["time [s]"] = pandas.Timestamp("2024-01-01") + pandas.to_timedelta(TIME, unit="s")
    frame["u [Nm]"] = FORCE
    frame.rename(columns={"time [s]": "time"}).to_parquet(tmp_path / "d.parquet")
    same(loaded(tmp_path / "d.parquet"))
    (tmp_path / "e.xlsx").write_bytes(b"PK\x03\x04 no workbook")
    with pytest.raises(InputError, match="not an Excel file"):
        loaded(tmp_path / "e.xlsx")


def test_rows_are_those_of_the_file(tmp_path: Path) -> None:
    above = "# a comment\n# another\n\n"
    gap = text(
        "time [s],u [Nm],theta [rad]", np.delete(TIME, 40), np.delete(FORCE, 40), np.delete(ANGLE, 40), above=above
    )
    (tmp_path / "a.csv").write_text(gap)
    with pytest.raises(InputError, match=r"between line 44 and line 45"):
        loaded(tmp_path / "a.csv")
    lines = text("time [s],u [Nm],theta [rad]", TIME, FORCE, ANGLE, above=above).splitlines()
    lines[23] = lines[23].rsplit(",", 1)[0] + ","
    (tmp_path / "b.csv").write_text("\n".join(lines))
    with pytest.raises(InputError, match=r"line 24, signal theta"):
        loaded(tmp_path / "b.csv")


@pytest.mark.parametrize(("rule", "value"), [("first", 3.0), ("last", 5.0), ("mean", 4.0)])
def test_duplicate_stamps_need_a_declared_remedy(rule: str, value: float, tmp_path: Path) -> None:
    time = np.insert(TIME, 30, TIME[30])
    angle = np.insert(ANGLE, 30, 0.0)
    angle[30:32] = 3.0, 5.0
    (tmp_path / "a.csv").write_text(text("time [s],u [Nm],theta [rad]", time, np.insert(FORCE, 30, 0.0), angle))
    head = 'name = "twice"\n'
    body = '[nominal]\nmodel = "pendulum"\n[signals.u]\nrole = "input"\n[signals.theta]\nrole = "output"\n'
    body += '[[runs]]\nfile = "a.csv"\n'
    (tmp_path / "dataset.toml").write_text(head + body)
    with pytest.raises(InputError, match=r'line 33.*time stands still.*duplicates = "first"'):
        load_dataset(tmp_path / "dataset.toml")
    (tmp_path / "dataset.toml").write_text(head + f'duplicates = "{rule}"\n' + body)
    data = load_dataset(tmp_path / "dataset.toml").dataset
    assert data.estimation[0].y[30, 0] == value
    assert len(data.estimation[0]) == N
    assert any("1 rows repeat" in note for note in data.warnings)


def test_a_declared_unit_overrides_the_title(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(text("time [s],u [Nm],theta [rad]", TIME, FORCE, ANGLE))
    (tmp_path / "dataset.toml").write_text(
        'name = "a"\n[nominal]\nmodel = "pendulum"\n[signals.u]\nrole = "input"\n'
        '[signals.theta]\nrole = "output"\nunit = "deg"\n[[runs]]\nfile = "a.csv"\n'
    )
    data = load_dataset(tmp_path / "dataset.toml").dataset
    assert data.estimation[0].y[:, 0] == pytest.approx(np.radians(ANGLE))
    assert any("the title says 'rad'; 'deg', as declared, counts" in note for note in data.warnings)


def test_a_unit_with_two_readings_is_answered_with_both(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(text("time [s],u [Nm],theta [Grad]", TIME, FORCE, ANGLE))
    with pytest.raises(InputError, match=r"'Grad' has two readings: expected 'gradian' or 'degree'"):
        loaded(tmp_path / "a.csv")
    (tmp_path / "a.csv").write_text(text("time [s],u [Nm],theta [rad],theta_rate [Hz]", TIME, FORCE, ANGLE, ANGLE))
    with pytest.raises(InputError, match=r"'Hz' has two readings: .*turn/s.*rad/s"):
        load_dataset(tmp_path / "a.csv", model="pendulum")


def test_tables_in_memory() -> None:
    columns = {"time [s]": TIME, "u [Nm]": FORCE, "theta [rad]": ANGLE}
    same(loaded(columns))
    structured = np.rec.fromarrays(list(columns.values()), names=list(columns))
    same(loaded(np.asarray(structured)))
    record = loaded(columns)
    tables: list[Any] = [record]
    for name, view in (("pandas", to_pandas), ("polars", to_polars), ("xarray", to_xarray)):
        pytest.importorskip(name, reason=f"{name} is not installed: pip install 'sysid-harness[data]'")
        tables.append(view(record))
    for one in tables:
        same(loaded(one))
    with pytest.raises(InputError, match=r"named columns.*got numpy.ndarray.*give names"):
        loaded(np.zeros((3, 3)))
    with pytest.raises(InputError, match=r"\(data\).*u \[N m\]"):
        load_dataset({"time [s]": TIME, "theta [rad]": ANGLE}, model="pendulum")


def test_identify_and_close_loop_take_them(tmp_path: Path) -> None:
    rows = api.simulate(
        "pendulum-ode", scenario="multisine", options={"sample_time": 0.02}, scenario_options={"noise": 1e-3}
    )
    other = api.simulate(
        "pendulum-ode",
        scenario="multisine",
        options={"sample_time": 0.02},
        scenario_options={"noise": 1e-3},
        role="validation/0",
    )
    fitted = api.identify(rows.measured(), model="pendulum", identifier="output-error", validation=other.measured())
    assert fitted.simulation_error["validation"][0].nrmse[0] < 0.02
    report = api.close_loop(rows.measured(), validation=other.measured(), model="pendulum", out=tmp_path / "out")
    assert report.verdict == "nothing_missing"
    read = api.close_loop(rows.measured(), validation=other.measured(), model="pendulum", dictionary="*friction*?")
    assert (read.verdict, read.folder) == ("nothing_missing", None)
    with pytest.raises(InputError, match=r"expected a Dataset, got a str.*harness.close_loop reads files"):
        diagnosis.close_loop("log.csv", "pendulum")  # type: ignore[arg-type]


def test_a_recording_is_loaded_by_its_name(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("SYSID_HARNESS_DATA", str(tmp_path))
    with pytest.raises(InputError, match="emps"):  # found, and its files are said to be missing
        api.load_dataset("emps")
    with pytest.raises(InputError, match="did you mean emps"):
        api.load_dataset("empss")
