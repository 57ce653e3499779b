"""Logs as tools write them: what pandas prints, spans of time, sentences of NMEA, scopes, points of InfluxDB."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from harness.data import load_dataset
from harness.data.oddities.spikes import spikes_of
from harness.data.tables.table import Table
from harness.errors import InputError
from harness.signals import FloatArray

N = 90
T = np.arange(N) * 0.05
U = np.round(np.sin(1.3 * T), 3)
Y = np.round(np.cos(0.7 * T), 4)


def read(path: Path, text: str, u: str = "u", y: str = "y", **said: str) -> tuple[FloatArray, FloatArray, float]:
    path.write_text(text)
    data = load_dataset(path, input=u, output=y, **said).dataset  # type: ignore[arg-type]
    runs = [run.trajectory for run in data]
    found = (np.concatenate([getattr(run, name)[:, 0] for run in runs]) for name in ("u", "y"))
    return (*found, data.spec.sample_time)  # type: ignore[return-value]


def is_the_log(found: tuple[FloatArray, FloatArray, float], dt: float = 0.05) -> None:
    assert found[0] == pytest.approx(U)
    assert found[1] == pytest.approx(Y)
    assert found[2] == pytest.approx(dt)


@pytest.mark.parametrize("index", [None, "time [s]", "k", "dates", False])
def test_what_pandas_prints_is_read_by_where_its_columns_end(index: str | bool | None, tmp_path: Path) -> None:
    pandas = pytest.importorskip("pandas")
    frame = pandas.DataFrame({"time [s]": T, "motor torque [N m]": U, "y": Y})
    if index == "dates":
        frame.index = pandas.date_range("2024-01-01", periods=N, freq="50ms")
        frame = frame.drop(columns="time [s]")
    elif index == "k":
        frame.index.name = "k"
    elif index:
        frame = frame.set_index(index)
    text = frame.to_string(index=index is not False)
    is_the_log(read(tmp_path / "a.txt", text + "\n", "motor torque"))
    with pytest.raises(InputError, match="without all its rows"):
        read(tmp_path / "b.txt", str(frame) if index is not False else str(frame.reset_index()), "motor torque")


@pytest.mark.parametrize("form", ["{m}m {s}s", "{h}h{m:02d}m{s:02d}s", "{m} min {s} sec"])
def test_spans_of_time_in_parts_are_seconds(form: str, tmp_path: Path) -> None:
    spans = [form.format(h=5 * k // 3600, m=5 * k % 3600 // 60 if "h" in form else 5 * k // 60, s=5 * k % 60)
             for k in range(N)]  # fmt: skip
    rows = [f"{span},{u},{y}" for span, u, y in zip(spans, U, Y, strict=True)]
    is_the_log(read(tmp_path / "a.csv", "\n".join(["time,u,y", *rows, ""])), 5.0)


def test_sentences_of_nmea_lose_their_sums_and_those_that_are_wrong_are_left_out(tmp_path: Path) -> None:
    words = [f"PMOT,{t:.2f},{u},{y}" for t, u, y in zip(T, U, Y, strict=True)]
    sums = [int(np.bitwise_xor.reduce(np.frombuffer(one.encode(), np.uint8))) for one in words]
    lines = [f"${one}*{total:02X}" for one, total in zip(words, sums, strict=True)]
    path = tmp_path / "a.log"
    is_the_log(read(path, "\n".join([*lines, ""]), "2", "3", column={"time": "1"}))  # type: ignore[arg-type]
    lines[60] = lines[60].replace("0", "1", 1)
    path.write_text("\n".join([*lines, ""]))
    assert len(Table(path).read("2")[0]) == N - 1


def test_a_file_without_titles_loses_no_row_where_cells_hold_more_than_numbers(tmp_path: Path) -> None:
    rows = [f"M1,{t:.2f},{u},{y},x{k}-{k + 1}" for k, (t, u, y) in enumerate(zip(T, U, Y, strict=True))]
    path = tmp_path / "a.csv"
    path.write_text("\n".join(rows) + "\n")
    assert Table(path).read("2")[0] == pytest.approx(U)


@pytest.mark.parametrize("title", ["tick_ms", "cycle (ms)", "counter ticks us"])
def test_a_count_with_a_unit_of_time_is_a_clock_unless_it_may_be_another(title: str, tmp_path: Path) -> None:
    step = 50000 if "us" in title else 50
    rows = [f"{k * step},{u},{y}" for k, (u, y) in enumerate(zip(U, Y, strict=True))]
    path, text = tmp_path / "a.csv", "\n".join([f"{title},u,y", *rows, ""])
    if title == "tick_ms":
        is_the_log(read(path, text))
    else:  # the words do not say that one row follows the other
        is_the_log(read(path, text, column={"time": title}))  # type: ignore[arg-type]


def test_a_siglent_names_the_units_of_its_channels_below_their_names(tmp_path: Path) -> None:
    head = ["Record Length,Analog:90,Analog:90", "Vertical Units,CH1:V,CH2:A", "Horizontal Units,s"]
    rows = [f"{t:.10f},{u},{y}" for t, u, y in zip(T, U, Y, strict=True)]
    text = "\n".join([*head, "Source,CH1,CH2", "Second,Volt,Ampere", *rows, ""])
    is_the_log(read(tmp_path / "a.csv", text, "CH1", "CH2"))


def test_the_channels_of_a_tektronix_stand_beside_each_other(tmp_path: Path) -> None:
    head = ["Record Length,9.0e+01", "Sample Interval,5.0e-02", "Source,{}", "Vertical Units,V", "Horizontal Units,s"]
    blocks = [[f"{head[k].format(name) if k < len(head) else ','},,{t:.6f},{value}," for k, (t, value)
               in enumerate(zip(T, values, strict=True))] for name, values in (("CH1", U), ("CH2", Y))]  # fmt: skip
    text = "\n".join([",".join(row) for row in zip(*blocks, strict=True)] + [""])
    is_the_log(read(tmp_path / "a.csv", text, "CH1", "CH2"))


def test_a_sign_behind_the_titles_alone_hides_no_settings_above_them(tmp_path: Path) -> None:
    head = ["Model,MSO46,", "Waveform Type,ANALOG,,", "Vertical Units,V,A,", ",Label,motor volts,motor current"]
    rows = [f"{t:.6e},{u},{y}" for t, u, y in zip(T, U, Y, strict=True)]
    is_the_log(read(tmp_path / "a.csv", "\n".join([*head, "TIME,CH1,CH2,", *rows, ""]), "CH1", "CH2"))


def test_words_beside_readings_decide_nothing_about_what_parts_the_cells(tmp_path: Path) -> None:
    at = [f"05/22/2024 {7 + k // 60:02d}:{k % 60:02d}:00 PM" for k in range(N)]
    rows = [f"{a},{u},Good,{y},Good" for a, u, y in zip(at, U, Y, strict=True)]
    text = "\n".join(["Timestamp,FIC101.OP (%),FIC101.OP Status,TI205.PV (m),TI205.PV Status", *rows, ""])
    found = read(tmp_path / "a.csv", text, "FIC101.OP", "TI205.PV")
    is_the_log((100 * found[0], *found[1:]), 60.0)


def test_points_of_influxdb_have_escaped_blanks_and_opc_ua_names_its_nodes(tmp_path: Path) -> None:
    at = range(10**9, 10**9 + N)
    points = [
        f"motor,host=rig\\ 2 u={u},y={y},ok=true {1690 * 10**15 + a * 10**6}" for a, u, y in zip(at, U, Y, strict=True)
    ]
    is_the_log(read(tmp_path / "a.lp", "\n".join([*points, ""])), 1e-3)
    each = [(k, name, values[k]) for k in range(N) for name, values in (("u", U), ("y", Y))]
    rows = [f"ns=2;s={name},2024-05-22T19:{k // 60:02d}:{k % 60:02d}.000Z,{value},Good" for k, name, value in each]
    text = "\n".join(["NodeId,SourceTimestamp,Value,StatusCode", *rows, ""])
    is_the_log(read(tmp_path / "b.csv", text, "ns=2;s=u", "ns=2;s=y"), 1.0)


def test_an_input_that_is_written_where_it_changes_is_held_where_that_is_declared(tmp_path: Path) -> None:
    held = np.repeat(U[::9], 9)[:N]
    cells = [f"{u}" if k % 9 == 0 else "" for k, u in enumerate(held)]
    rows = [f"{t:.2f},{u},{y}" for t, u, y in zip(T, cells, Y, strict=True)]
    (tmp_path / "a.csv").write_text("\n".join(["time [s],u [V],y [V]", *rows, ""]))
    with pytest.raises(InputError, match=r'remedy: declare intersample = "zoh" in a dataset.toml if u was written'):
        load_dataset(tmp_path / "a.csv", input="u", output="y")
    text = 'name = "a"\nintersample = "zoh"\n[signals]\nu = { role = "input" }\ny = { role = "output" }\n'
    (tmp_path / "a.toml").write_text(text + '[[runs]]\nfile = "a.csv"\nuse = "estimation"\n')
    (run,) = load_dataset(tmp_path / "a.toml").dataset
    assert run.trajectory.u[:, 0] == pytest.approx(held)
    assert run.trajectory.y[:, 0] == pytest.approx(Y)


def test_a_reading_is_not_contradicted_by_less_than_its_last_digit() -> None:
    t = np.arange(300)
    y = 1.05 * np.sin(0.02 * t)
    written = np.array([float(f"{value:.2e}") for value in y])  # steps of 0.001, and of 0.01 beyond 1
    assert spikes_of(written, np.zeros((300, 0))).rows.size == 0
    written[120] += 0.3
    assert spikes_of(written, np.zeros((300, 0))).rows.tolist() == [120]
