"""Logs whose readings carry their names, whose heads begin with keys, whose time stands in parts, or without titles."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import savemat

from harness.api import spectrum
from harness.data import load_dataset
from harness.data.recipe.contents import contents_of
from harness.data.tables.headers import parts_of, split_header
from harness.errors import InputError
from harness.parts.contents import describe_file
from harness.parts.stored import read_model

N, DT = 60, 0.02
K = range(N)
RNG = np.random.default_rng(68)
U = np.round(np.repeat(RNG.normal(size=N // 3), 3), 4)
Y = np.round(np.cumsum(U) * 0.01 + 1e-3 * RNG.normal(size=N), 6)


def joined(*columns: Sequence[Any], sign: str = ",") -> str:
    return "".join(sign.join(map(str, row)) + "\n" for row in zip(*columns, strict=True))


def clock(step: float, form: str = "10:{:02d}:{:06.3f}") -> list[str]:
    return [form.format(int(k * step // 60), k * step % 60) for k in K]


MS = [20 * k for k in K]
SECONDS = [f"{k * DT:.2f}" for k in K]
SERIAL = {
    "blanks": "".join(f"ms:{t} u:{u} y:{y}\n" for t, u, y in zip(MS, U, Y, strict=True)),
    "equal signs, tabs": "".join(f"ms={t}\tu={u}\ty={y}\n" for t, u, y in zip(MS, U, Y, strict=True)),
    "boot lines, units, a cut end": "Booting v1.2\nBaud: 115200\n"
    + "".join(f"t: {t} ms, u: {u} V, y: {y} rad\n" for t, u, y in zip(MS, U, Y, strict=True))
    + "t: 12",
    "stamps before an arrow": "".join(f"{t} -> u:{u}, y:{y}\n" for t, u, y in zip(clock(DT), U, Y, strict=True)),
    "ESP-IDF, in colour, boot lines": "I (312) main: Starting\n"
    + "".join(f"\x1b[0;32mI ({500 + t}) pid: u={u} y={y}\x1b[0m\n" for t, u, y in zip(MS, U, Y, strict=True)),
    "ROS 2": "".join(
        f"[INFO] [{1732874400 + k * DT:.6f}] [ctl]: u={u}, y={y}\n" for k, u, y in zip(K, U, Y, strict=True)
    ),
    "Zephyr": "".join(f"[{t},000] <inf> ctl: u={u} y={y}\n" for t, u, y in zip(clock(DT), U, Y, strict=True)),
    "logfmt": "".join(f"ts=2024-11-29T{t}Z level=info u={u} y={y}\n" for t, u, y in zip(clock(DT), U, Y, strict=True)),
    "InfluxDB": "".join(
        f"motor,id=1 u={u},y={y} {1732874400000000000 + 20000000 * k}\n" for k, u, y in zip(K, U, Y, strict=True)
    ),
    "JSON lines": "".join(json.dumps({"t": k * DT, "u": u, "y": y}) + "\n" for k, u, y in zip(K, U, Y, strict=True)),
}


def read(path: Path, text: str, **chosen: Any) -> Any:
    path.write_text(text, encoding="utf-8")
    return same(path, **chosen)


def same(path: Path, step: float = DT, scale: float = 1.0, **chosen: Any) -> Any:
    """Return the data set, which holds U and Y at the step."""
    data = load_dataset(path, **{"input": "u", "output": "y", **chosen}).dataset
    records = [run.trajectory for run in data.runs]
    assert records[0].spec.sample_time == pytest.approx(step, rel=1e-4)
    assert np.concatenate([one.u[:, 0] for one in records]) == pytest.approx(U)
    assert np.concatenate([one.y[:, 0] for one in records]) == pytest.approx(Y * scale)
    return data


@pytest.mark.parametrize("kind", SERIAL)
def test_readings_that_carry_their_names(kind: str, tmp_path: Path) -> None:
    data = read(tmp_path / "a.txt", SERIAL[kind])
    assert any("carry their names" in note for note in data.warnings)
    assert contents_of(tmp_path / "a.txt").sample_time == pytest.approx(DT)


def test_settings_above_a_table_are_no_readings(tmp_path: Path) -> None:
    head = "Rate: 50\nGain: 2\nOffset: 0\nName: rig\n"
    read(tmp_path / "a.csv", head + "t,u,y\n" + joined(SECONDS, U, Y))


def test_a_line_without_readings_among_them_is_named(tmp_path: Path) -> None:
    lines = SERIAL["blanks"].splitlines()
    lines[30] = "watchdog reset!"
    with pytest.raises(InputError, match="line 31: a line without readings"):
        read(tmp_path / "a.txt", "\n".join(lines))


VECTOR = "date Fri Nov 29 10:00:00.000 am 2024\nbase hex  timestamps absolute\ninternal events logged\n"


def test_a_can_log_holds_variables_and_its_messages_nothing_without_a_dbc(tmp_path: Path) -> None:
    message = "   {:.6f} 1  123  Rx   d 8 00 00 1A 2B 00 00 00 00\n"
    with pytest.raises(InputError, match=r"bytes of messages hold them only by a DBC file.*asammdf"):
        read(tmp_path / "bus.asc", VECTOR + "".join(message.format(k * DT) for k in K))
    lines = [
        message.format(k * DT) + f"   {k * DT:.6f} SV: 2 0 1 ::Eng::u = {U[k]}\n   {k * DT:.6f} y := {Y[k]}\n"
        for k in K
    ]
    read(tmp_path / "variables.asc", VECTOR + "".join(lines), input="::Eng::u", column={"y": "y"})


LABVIEW = (
    "LabVIEW Measurement\t\nSeparator\tTab\nX_Columns\t{}\n***End_of_Header***\t\n\t\nChannels\t2\t\nSamples\t60\t60\n"
    "X_Dimension\tTime\tTime\nX0\t0.0E+0\t0.0E+0\nDelta_X\t0.020000\t0.020000\n***End_of_Header***\t\t\n"
)
HEADS = {
    "LabVIEW, one clock": LABVIEW.format("One") + "X_Value\tu\ty\tComment\n" + joined(SECONDS, U, Y, sign="\t"),
    "LabVIEW, a clock for each": LABVIEW.format("Multi")
    + "X_Value\tu\tX_Value\ty\tComment\n"
    + joined(SECONDS, U, SECONDS, Y, sign="\t"),
    "LabVIEW, no clock": LABVIEW.format("No") + "X_Value\tu\ty\tComment\n" + joined([""] * N, U, Y, sign="\t"),
    "Yokogawa": '"Model","DL850"\n"TraceName","u","y"\n"VUnit","V","V"\n"HResolution",0.02,0.02\n"HOffset",0,0\n'
    '"HUnit","s","s"\n"Time","10:00:00","10:00:00"\n\n' + joined([""] * N, U, Y),
    "ControlDesk": "ControlDesk,CSV,1.0\npath,,u,y\nunit,s,V,V\ntrace_values,x,y,y\n" + joined([""] * N, SECONDS, U, Y),
    "TwinCAT": "Name,Scope\nFile,C:\\a.tcscopex\n\nName,u,Name,y\nSampleTime[ms],20,SampleTime[ms],20\nPort,1,Port,1\n"
    "\n" + joined(MS, U, MS, Y),
    "National Instruments, a clock for each channel": "Timestamp,2024-11-29 10:00:00,Timestamp,2024-11-29 10:00:00\n"
    'Interval,0.02,Interval,0.02\nChannel name,"u",Channel name,"y"\nUnit,"V",Unit,"V"\n'
    + joined(SECONDS, U, SECONDS, Y),
    "a drive's log: the clock's unit among what others measure": "Axis1\nNumber of sampling data,60\n"
    "Time,u,y,Digital 1,Digital 2\nms,Servo motor speed,Torque,Not selected,Not selected\n"
    + joined(MS, U, Y, [0] * N, [0] * N),
    "Rigol, settings in the titles": "Time(s),u,y,t0 = -0.3s, tInc = 0.02\n" + joined(SECONDS, U, Y, [""] * N),
    "pandas, two levels": ",motor,motor\n,u,y\ntime,,\n" + joined(SECONDS, U, Y),
    "pandas, spans as index": ",u,y\n" + joined(clock(DT, "0 days 00:{:02d}:{:09.6f}"), U, Y),
    "titles of two words": "Time (s)   u    y\n" + joined(SECONDS, U, Y, sign="   "),
    "Excel fills lines above up": "Rig 7;;;\nDate: 29.11.2024;;;\nt / ms;u;y;\n" + joined(MS, U, Y, [""] * N, sign=";"),
    "titles between apostrophes": "'t [s]','u','y'\n" + joined(SECONDS, U, Y),
    "a comment apart by blanks": "# rig 7\n# t [s]   u   y\n" + joined(SECONDS, U, Y, sign="   "),
    "comments of names and units": "% t  u  y\n% s  V  V\n" + joined(SECONDS, U, Y, sign="\t"),
    "Origin: short and long names, units, comments": "A(X)\tB(Y)\tC(Y)\nt\tu\ty\nms\tV\tV\n\tDAC\tLVDT, 2 kHz\n"
    + joined(MS, U, Y, sign="\t"),
    "a comment of one cell below the units": "t,u,y\nms,V,V\nrig 7,,\n" + joined(MS, U, Y),
    "fractional seconds": "Date,Time,Fractional Seconds,u,y\n"
    + "".join(f"2024-11-29,10:00:0{k // 50},{k % 50 * DT:.2f},{U[k]},{Y[k]}\n" for k in K),
    "HOBO": '"Plot Title: 7"\n"#","Date Time, GMT+01:00","u, V (LGR S/N: 7, SEN S/N: 8, LBL: in)","y, V (LGR S/N: 7)"\n'
    + joined(range(1, N + 1), clock(DT, "11/29/24 10:{:02d}:{:06.3f}"), U, Y),
    "Gamry": "EXPLAIN\nTAG\tCHRONOA\nCURVE\tTABLE\t60\n\tPt\tT\tu\ty\n\t#\ts\tV vs. Ref.\tV\n"
    + joined([""] * N, K, SECONDS, U, Y, sign="\t"),
    "a battery's cycler": "Data_Point,Test_Time(s),Step_Time(s),u,y\n" + joined(K, SECONDS, SECONDS[:30] * 2, U, Y),
    "PASCO, units before the run": "Time (s) Run #1,u (V) Run #1,y (V) Run #1\n" + joined(SECONDS, U, Y),
    "units behind their word": "time,u,y\nUnit: s,Unit: V,Unit: V\n" + joined(SECONDS, U, Y),
    "dates of Java and of a trend": "GPS Time,u,y\n"
    + joined(clock(DT, "Tue Feb 11 10:{:02d}:{:06.3f} GMT+01:00 2025"), U, Y),
    "a date apart by a semicolon": "Time,u,y\n" + joined(clock(DT, "02/11/2025;10:{:02d}:{:06.3f}"), U, Y),
    "Home Assistant": "entity_id,state,last_changed\n"
    + "".join(
        f"{name},{value},2025-02-11T{t}Z\n"
        for k, t in enumerate(clock(DT))
        for name, value in (("u", U[k]), ("y", Y[k]))
    ),
    "a flight time": "OSD.flyTime,OSD.flyTime [s],u,y\n" + joined(["0m"] * N, SECONDS, U, Y),
    "dates under another title": "Datum,u,y\n" + joined(clock(DT, "2024-11-29 10:{:02d}:{:06.3f}"), U, Y),
    "WinCC's two clocks": "VarName;TimeString;VarValue;Time_ms\n"
    + "".join(
        f"{name};29.11.2024 {t};{value};{45625416.6 + 0.23 * k:.4f}\n"
        for k, t in enumerate(clock(DT))
        for name, value in (("u", U[k]), ("y", Y[k]))
    ),
}


@pytest.mark.parametrize("kind", HEADS)
def test_heads_of_loggers(kind: str, tmp_path: Path) -> None:
    run = {one: f"{one} Run #1" for one in ("u", "y")} if "PASCO" in kind else {}
    read(tmp_path / ("a.lvm" if "LabVIEW" in kind else "a.csv"), HEADS[kind], column=run)
    assert contents_of(next(tmp_path.iterdir())).sample_time == pytest.approx(DT)


UNTITLED = {
    "ROS": joined([1732874400 + k // 50 for k in K], [k % 50 * 20000000 for k in K], ["base"] * N, U, Y),
    "dates": joined(clock(DT, "2024-11-29 10:{:02d}:{:06.3f}"), U, Y),
    "dates, decimal commas": joined(clock(DT, "2024-11-29 10:{:02d}:{:06.3f}"), U, Y, sign=";").replace(".", ","),
    "a word behind the stamp": joined(clock(DT, "2024-11-29T10:{:02d}:{:06.3f}"), ["base"] * N, U, Y, sign=" "),
    "Tera Term": "".join(f"[2025-02-11 {t}] {u},{y}\n" for t, u, y in zip(clock(DT), U, Y, strict=True)),
    "ESP-IDF": "".join(f"I ({t}) adc: {u}, {y}\n" for t, u, y in zip(MS, U, Y, strict=True)),
    "arrow": "".join(f"{t} -> {u}\t{y}\n" for t, u, y in zip(clock(DT), U, Y, strict=True)),
}


@pytest.mark.parametrize("kind", UNTITLED)
def test_a_first_row_of_readings_is_no_title(kind: str, tmp_path: Path) -> None:
    at = {"ROS": 3, "a word behind the stamp": 2}.get(kind, 1)
    read(tmp_path / "a.csv", UNTITLED[kind], input=str(at), output=str(at + 1))


def parts(step: float, names: str, *, first: int = 0) -> dict[str, list[float]]:
    """Return the columns of some parts of a time that passes midnight, a year, and a full hour."""
    begin = np.datetime64("2024-12-31T23:59:40", "ms")
    times = begin + (np.arange(N) * step * 1000).astype("timedelta64[ms]")
    day = times.astype("datetime64[D]")
    month = times.astype("datetime64[M]")
    of_day = (times - day).astype(int)
    found = {
        "year": times.astype("datetime64[Y]").astype(int) + 1970, "month": month.astype(int) % 12 + 1,
        "day": (day - month.astype("datetime64[D]")).astype(int) + 1, "hour": of_day // 3600000,
        "minute": of_day // 60000 % 60, "second": of_day // 1000 % 60, "ms": of_day % 1000,
    }  # fmt: skip
    return {name: list(found[name]) for name in names.split()}


@pytest.mark.parametrize(
    ("titles", "step"),
    [
        ("year month day hour minute second", 1.0), ("hour minute second", 1.0), ("minute second", 1.0),
        ("second ms", 0.02), ("year month day hour minute second ms", 0.5), ("year month day hour minute", 60.0),
    ],
)  # fmt: skip
def test_parts_of_a_time_make_one(titles: str, step: float, tmp_path: Path) -> None:
    columns = parts(step, titles)
    if titles == "second ms":  # counts on: seconds since a start
        columns["second"] = [int(k * step) + 100 for k in K]
    data = read(tmp_path / "a.csv", ",".join([*columns, "u", "y"]) + "\n" + joined(*columns.values(), U, Y), step=step)
    assert any("together" in note for note in data.warnings)


def test_parts_of_a_time_in_other_words_and_with_a_fraction(tmp_path: Path) -> None:
    columns = parts(1.0, "year month day hour minute second")
    columns["second"] = [f"{value},5" for value in columns["second"]]
    head = "Jahr;Monat;Tag;Stunde;Minute;Sekunde;u;y\n"
    read(tmp_path / "a.csv", head + joined(*columns.values(), U, Y, sign=";").replace(".", ","), step=1.0)
    assert list(parts_of(["Année", "Mois", "Jour", "Heure", "Minute", "Seconde"])) == "year month day h min s".split()


def test_statistics_and_a_count_of_its_own_are_no_parts(tmp_path: Path) -> None:
    assert parts_of(["min", "max", "std"]) == {} == parts_of(["Month", "Day"])
    head = "s,ms,u,y\n"  # the same time twice
    read(tmp_path / "a.csv", head + joined([k * 20 // 1000 for k in K], MS, U, Y))


def test_a_node_of_spice_is_no_unit_and_slashes_are(tmp_path: Path) -> None:
    assert [split_header(one)[1] for one in ("V(in)", "V(s)", "I(L)", "y / u")] == [None] * 4
    assert [split_header(one)[1] for one in ("V(m/s)", "I(mA)", "u / V", "CH1 in mV")] == ["m/s", "mA", "V", "mV"]
    assert [split_header(one)[1] for one in ("Phase, A", "Leg, fl", "Temp, in")] == [None, None, None]


def test_a_row_that_holds_a_number_below_units_is_no_comment(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"line 3.*'ERR'"):
        read(tmp_path / "a.csv", "t,u,y\nms,V,V\n0,ERR,0\n" + joined(MS, U, Y))
    data = read(
        tmp_path / "a.txt",
        "time\tV(in)\tI(R1)\n" + joined(SECONDS, U, Y, sign="\t"), input="V(in)", output="I(R1)",
    )  # fmt: skip
    assert any("no unit is stated for V(in)" in note for note in data.warnings)
    read(tmp_path / "b.csv", "Time / s,u / V,y / mm\n" + joined(SECONDS, U, Y), scale=1e-3)


def test_a_result_of_modelica_holds_variables_by_name(tmp_path: Path) -> None:
    names = ["time", "J", "u", "y", "minus"]
    said = ["Time [s]", "Inertia [kg.m2]", "[V]", "position [mm]", "[mm]"]
    across = [["".join(cell) for cell in zip(*(one.ljust(20) for one in some), strict=True)] for some in (names, said)]
    content = {
        "Aclass": np.array(["Atrajectory", "1.1        ", "           ", "binTrans   "]),
        "name": np.array(across[0]), "description": np.array(across[1]),
        "dataInfo": np.array([[0, 1, 2, 2, 2], [1, 2, 2, 3, -3], [0] * 5, [-1] * 5], dtype=np.int32),
        "data_1": np.array([[0.0, 1.0], [1.5, 1.5]]), "data_2": np.vstack([np.arange(N) * DT, U, Y]),
    }  # fmt: skip
    savemat(tmp_path / "a.mat", content, format="4")
    same(tmp_path / "a.mat", scale=1e-3)
    same(tmp_path / "a.mat", scale=-1e-3, output="minus")
    assert [channel.name for channel in contents_of(tmp_path / "a.mat").channels] == ["u", "y", "minus"]


def test_a_short_table_is_told_by_its_own_rows(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("t,u,y\n" + joined(SECONDS[:7], U[:7], Y[:7]))
    with pytest.raises(InputError, match=r"a record of 7 rows: expected at least 58 rows.*--run validation=FILE"):
        load_dataset(tmp_path / "a.csv", input="u", output="y")
    (tmp_path / "b.csv").write_text("t,u,y\n" + joined(SECONDS[:58], U[:58], Y[:58]))
    assert len(load_dataset(tmp_path / "b.csv", input="u", output="y").dataset.runs) == 2


def test_remedies_lead_on(tmp_path: Path) -> None:
    (tmp_path / "old.json").write_text(json.dumps({"kind": "hybrid-automaton", "guard": [1.0, 0.0], "reset": [[1.0]]}))
    with pytest.raises(InputError, match="fit it again: other versions wrote other files"):
        read_model(tmp_path / "old.json")
    (tmp_path / "a.csv").write_text("t,u,y\n" + joined(SECONDS, U, Y))
    with pytest.raises(InputError, match=r"name the input \(sysid: --input NAME\); sysid modes finds resonances"):
        spectrum(tmp_path / "a.csv", input="none", output="y")
    with pytest.raises(InputError, match=r"counts and other plain numbers are in '1' \(sysid: --unit NAME=1\)"):
        load_dataset(tmp_path / "a.csv", input="u", output="y", unit={"y": "cnt"})
    assert len(load_dataset(tmp_path / "a.csv", input="u", output="y", unit={"y": "1"}).dataset.runs) == 2


# ---- JSON, archives, waveforms ---------------------------------------------------------------------------------------

RECORDS = [{"t": k * DT, "u": float(U[k]), "y": float(Y[k])} for k in K]
COLUMNS = {name: [row[name] for row in RECORDS] for name in ("t", "u", "y")}
JSON: dict[str, Any] = {
    "columns": COLUMNS,
    "records": RECORDS,
    "records below their names": {"rig": 3, "about": {"by": "me"}, "log": RECORDS},
    "as pandas writes it": {name: {str(k): v for k, v in enumerate(column)} for name, column in COLUMNS.items()},
    "split": {"columns": ["t", "u", "y"], "index": list(K), "data": [list(row.values()) for row in RECORDS]},
}


@pytest.mark.parametrize("kind", JSON)
def test_a_table_in_json(kind: str, tmp_path: Path) -> None:
    data = read(tmp_path / "a.json", json.dumps(JSON[kind], indent=1))
    assert any("beside the table is left aside: rig" in note for note in data.warnings) == (kind[-5:] == "names")
    assert describe_file(tmp_path / "a.json")["content"]["sample_time"] == pytest.approx(DT)


@pytest.mark.parametrize("content", ['{"t": [0, 1], "u": [1]}', '{"a": {"t": [0, 1], "u": [1, 2]}, "b": {"t": [0, 1], '
                                     '"u": [1, 2]}}', "[1, 2, 3]", '{"t": [0, 1', "3"])  # fmt: skip
def test_json_that_holds_no_table_or_two_is_refused(content: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="JSON"):
        read(tmp_path / "a.json", content)


def test_the_one_log_of_an_archive_is_read(tmp_path: Path) -> None:
    table = "t,u,y\n" + joined(SECONDS, U, Y)
    for name, files in (("one", ["export/run.csv"]), ("two", ["a.csv", "b.csv"]), ("none", ["photo.png"])):
        with zipfile.ZipFile(tmp_path / f"{name}.zip", "w", zipfile.ZIP_DEFLATED) as archive:
            for file in [*files, "__MACOSX/._run.csv", "../notes.md"]:
                archive.writestr(file, table)
    same(tmp_path / "one.zip")
    assert not list(tmp_path.rglob("*.csv"))
    for name, count in (("two", 2), ("none", 0)):
        with pytest.raises(InputError, match=f"an archive with {count} logs.*remedy: unpack it"):
            same(tmp_path / f"{name}.zip")


@pytest.mark.parametrize("kind", ["waveforms", "a column of time"])
def test_tdms(kind: str, tmp_path: Path) -> None:
    nptdms = pytest.importorskip("nptdms")
    sampling: dict[str, Any] = {"wf_increment": DT, "wf_start_offset": 0.0} if kind == "waveforms" else {}
    channels = [
        nptdms.ChannelObject("rig", "u", U, {**sampling, "unit_string": "V"}),
        nptdms.ChannelObject("rig", "y", Y, {**sampling, "unit_string": "mm"}),
    ]
    if not sampling:
        channels.insert(0, nptdms.ChannelObject("rig", "Time", np.array(MS, dtype=float), {"unit_string": "ms"}))
    with nptdms.TdmsWriter(tmp_path / "a.tdms") as writer:
        writer.write_segment(channels)
    data = same(tmp_path / "a.tdms", scale=1e-3)
    assert str(data.spec.outputs[0]) == "y [m]"
    (tmp_path / "b.tdms").write_bytes(b"TDSm" + bytes(40))
    with pytest.raises(InputError, match=r"b\.tdms"):
        same(tmp_path / "b.tdms")


def test_words_of_a_program_before_its_readings(tmp_path: Path) -> None:
    lines = [f"2024-11-29 {t.replace('.', ',')} INFO rig: u={u} y={y}" for t, u, y in zip(clock(DT), U, Y, strict=True)]
    read(tmp_path / "a.log", "\n".join(lines) + "\n")


def test_rows_of_several_kinds_and_messages_of_a_bus_are_refused_with_what_to_do(tmp_path: Path) -> None:
    kinds = "".join(f"ATT, {t}, {u}, {y}\nIMU, {t}, {u}, {y}, 0.5, 1\n" for t, u, y in zip(MS, U, Y, strict=True))
    with pytest.raises(InputError, match=r"put the rows of each kind \(FMT, ATT, IMU\) into a table of their own"):
        read(tmp_path / "flight.log", "FMT, 128, 89\n" * 3 + kinds)
    bus = "".join(f"({1709294400 + k * DT:.6f}) can0 1A3#0011{k:02X}FF\n" for k in K)
    with pytest.raises(InputError, match=r"bytes of messages hold them only by a DBC file.*asammdf"):
        read(tmp_path / "candump.log", bus)
