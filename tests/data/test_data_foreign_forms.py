"""Forms of other programs: units behind slashes, lines below a table, rows without titles, clocks that repeat."""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import savemat

from harness.data import load_dataset
from harness.data.recipe.contents import contents_of
from harness.data.tables.headers import behind_slashes
from harness.errors import InputError

N, DT = 60, 0.02
K = range(N)
U = np.round(np.repeat(np.random.default_rng(707).normal(size=N // 3), 3), 4)
Y = np.round(np.cumsum(U) * 0.01 + 1e-6, 6)
SECONDS = [f"{k * DT:.2f}" for k in K]
MS = [20 * k for k in K]


def stamps(step: float = DT, late: float = 0.0) -> list[str]:
    begin = datetime.datetime(2024, 11, 29, 10)
    times = [begin + datetime.timedelta(seconds=k * step + late) for k in K]
    return [f"{at:%Y-%m-%d %H:%M:%S}.{at.microsecond // 1000:03d}" for at in times]


def joined(*columns: Any, sign: str = ",") -> str:
    return "".join(sign.join(map(str, row)) + "\n" for row in zip(*columns, strict=True))


def read(path: Path, text: str, step: float = DT, scale: float = 1.0, **chosen: Any) -> Sequence[str]:
    """Return what is said of a file, which holds U and Y at the step."""
    path.write_text(text, encoding="utf-8")
    data = load_dataset(path, **{"input": "u", "output": "y", **chosen}).dataset
    records = [run.trajectory for run in data.runs]
    assert records[0].spec.sample_time == pytest.approx(step, rel=1e-4)
    assert np.concatenate([one.u[:, 0] for one in records]) == pytest.approx(U)
    assert np.concatenate([one.y[:, 0] for one in records]) == pytest.approx(Y * scale)
    return data.warnings


@pytest.mark.parametrize("titles", ["time/s,u/V,y/mm", "Zeit,u/V,y/mm", "采样时间,u/V,y/mm"])
def test_units_behind_slashes_are_the_form_of_the_table(titles: str, tmp_path: Path) -> None:
    read(tmp_path / "a.csv", f"{titles}\n" + joined(SECONDS, U, Y), scale=1e-3)
    assert [one.unit for one in contents_of(tmp_path / "a.csv").channels] == ["V", "mm"]


@pytest.mark.parametrize("titles", ["u/max,y/min", "left/V,right/A", "arm/u,arm/y", "m/kg,s/mm", "arm/mm,arm/deg"])
def test_paths_and_ratios_state_no_unit(titles: str, tmp_path: Path) -> None:
    assert behind_slashes(["time", *titles.split(",")]) == {}
    names = titles.split(",")
    said = read(tmp_path / "a.csv", f"time [s],{titles}\n" + joined(SECONDS, U, Y), input=names[0], output=names[1])
    assert any(f"no unit is stated for {', '.join(names)}" in note for note in said)


def test_what_a_title_seems_to_say_is_asked_and_the_answer_works(tmp_path: Path) -> None:
    text = "time [s],u,y_mm\n" + joined(SECONDS, U, Y)
    said = read(tmp_path / "a.csv", text, output="y_mm")
    assert any(note == "y_mm seems to say mm: --unit y_mm=mm if it does" for note in said)
    read(tmp_path / "a.csv", text, output="y_mm", unit={"y_mm": "mm"}, scale=1e-3)


TABLE = "t [s],u [V],y [mm]\n" + joined(SECONDS, U, Y)
BELOW = {
    "a count": "Total samples: 60\n",
    "statistics": "\nMinimum,-1.5,-2\nMaximum,1.5,2\n",
    "the end of a report": '\n" ***** End of Report *****"\n',
    "what a data base says": "(60 rows affected)\n",
}


@pytest.mark.parametrize("kind", BELOW)
def test_words_below_the_rows_are_left_aside_and_said(kind: str, tmp_path: Path) -> None:
    said = read(tmp_path / "a.csv", TABLE + BELOW[kind], scale=1e-3)
    assert any("below the table" in note for note in said)
    assert contents_of(tmp_path / "a.csv").rows == N


def test_rows_in_which_nothing_was_recorded_and_a_second_table_are_no_words_below(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("u [V],y [mm]\n" + joined(U, Y) + "nan,nan\nN/A,0.5\n-,0.5\n")
    assert contents_of(tmp_path / "a.csv").rows == N + 3
    with pytest.raises(InputError, match=f"line {N + 2}"):
        read(tmp_path / "b.csv", TABLE + "Summary\nt [s],u [V],y [mm]\n0,1,2\n1,2,3\n", scale=1e-3)


@pytest.mark.parametrize("above", ["=~=~= PuTTY log 2024.11.29 10:00:00 =~=~=\n.31,0.2\n", "ready\nCalibrating ...\n"])
def test_rows_without_titles_below_what_a_board_says_first(above: str, tmp_path: Path) -> None:
    options: dict[str, Any] = {"input": "1", "output": "2", "column": {"time": "0"}, "unit": {"time": "ms"}}
    read(tmp_path / "a.log", above + joined(MS, U, Y), **options)


@pytest.mark.parametrize("above", ["t u y\n", "t,u,y,z\n", "t;u;y\n", "a,b\n"])
def test_words_that_may_be_titles_are_never_left_aside(above: str, tmp_path: Path) -> None:
    with pytest.raises(InputError):
        read(tmp_path / "a.csv", above + joined(MS, U, Y), input="1", output="2", column={"time": "0"})


@pytest.mark.parametrize("between", [" - INFO - ", " - rig.pid - DEBUG - ", " | INFO | "])
def test_what_a_program_says_between_dashes_is_no_reading(between: str, tmp_path: Path) -> None:
    plain = [f"{at.replace('.', ',')}{between}{u}, {y}\n" for at, u, y in zip(stamps(), U, Y, strict=True)]
    named = [f"{at.replace('.', ',')}{between}u={u} y={y}\n" for at, u, y in zip(stamps(), U, Y, strict=True)]
    if "|" not in between:
        read(tmp_path / "a.log", "".join(plain), input="1", output="2")
    read(tmp_path / "b.log", "".join(named))


@pytest.mark.parametrize("titles", ["u time,u,y time,y", "Zeit A (s),u,Zeit B (s),y", "A,u,B,y"])
def test_a_clock_that_repeats_beside_each_channel_is_one(titles: str, tmp_path: Path) -> None:
    numbers = titles.startswith("Zeit")
    clock = SECONDS if numbers else stamps()
    read(tmp_path / "a.csv", f"{titles}\n" + joined(clock, U, clock, Y))
    other = [f"{k * DT + 0.005:.3f}" for k in K] if numbers else stamps(late=0.005)
    with pytest.raises(InputError, match="no time"):
        read(tmp_path / "b.csv", f"{titles}\n" + joined(clock, U, other, Y))


def test_a_word_that_the_clock_shares_with_its_channel_is_no_unit(tmp_path: Path) -> None:
    text = "Time - Plot 0\tAmplitude - Plot 0\tTime - Plot 1\tAmplitude - Plot 1\n"
    names = {"input": "Amplitude - Plot 0", "output": "Amplitude - Plot 1"}
    said = read(tmp_path / "a.txt", text + joined(SECONDS, U, SECONDS, Y, sign="\t"), **names)
    assert any("taken for seconds, 50 rows a second" in note for note in said)
    with pytest.raises(InputError, match="'ticks'"):
        read(tmp_path / "b.csv", "time ticks,u ticks,y\n" + joined(SECONDS, U, Y), input="u ticks")
    with pytest.raises(InputError, match="'foo'"):
        read(tmp_path / "c.csv", "time foo,u,y\n" + joined(SECONDS, U, Y), column={"time": "time foo"})


def test_of_two_clocks_the_one_that_runs_on_counts(tmp_path: Path) -> None:
    again = [f"00:00:{k % 25:02d}" for k in K]
    total = [f"00:{k // 60:02d}:{k % 60:02d}" for k in K]
    said = read(tmp_path / "a.csv", "Time,Total Time,u,y\n" + joined(again, total, U, Y), step=1.0)
    assert any("'Time' runs back: 'Total Time', which runs on, is the time" in note for note in said)
    with pytest.raises(InputError, match="runs back"):
        read(tmp_path / "b.csv", "Time,DataPoint,u,y\n" + joined(again, K, U, Y))
    spans = [f"0d 00:{k // 60:02d}:{k % 60:02d}.50" for k in K]
    read(tmp_path / "c.csv", "Rec\tTestTime\tu\ty\n" + joined(K, spans, U, Y, sign="\t"), step=1.0)


def long(head: str, row: str) -> str:
    at, late = stamps(1.0), stamps(1.0, late=0.04)
    return head + "".join(
        row.format(name=name, value=value, at=at[k], late=late[k], k=k) + "\n"
        for k in K
        for name, value in (("u", U[k]), ("y", Y[k]))
    )


LONG = {
    "two stamps": long("NodeId,DisplayName,SourceTimestamp,ServerTimestamp,Value\n", "ns=2,{name},{at},{late},{value}"),
    "in other words": long("tag,received_at,measured_at,value\n", "{name},{late},{at},{value}"),
    "units in the clock's cells": long("time,signal,value\n", "{k} s,{name},{value}"),
    "and a name of one row": long("time,signal,value\n", "{k} s,{name},{value}") + "60 s,stop,1\n",
}


@pytest.mark.parametrize("kind", LONG)
def test_a_long_form_reads_its_clock_in_one_way(kind: str, tmp_path: Path) -> None:
    said = read(tmp_path / "a.csv", LONG[kind], step=1.0)
    assert any("count, not" in note for note in said) == ("clock" not in kind and "row" not in kind)


def test_a_long_form_whose_time_stands_in_several_columns(tmp_path: Path) -> None:
    rows = [
        f"{channel},{value},{unit},11/29/2024,10:00:{k // 2:02d},{k % 2 * 0.5:.9f}\n"
        for k in K
        for channel, value, unit in ((101, U[k], "V"), (102, Y[k], "mm"))
    ]
    text = "Channel,Reading,Unit,Date,Time,Fractional Seconds\n" + "".join(rows)
    said = read(tmp_path / "a.csv", text, input="101", output="102", step=0.5, scale=1e-3)
    assert any("between its stamps 'Fractional Seconds'" in note for note in said)
    days = [f"{29 + (k > 29)}.11.2024;{'23:59:' + str(30 + k) if k < 30 else f'00:00:{k - 30:02d}'}" for k in K]
    text = "Datum;Zeit;Name;Wert\n" + "".join(
        f"{days[k]};{name};{str(value).replace('.', ',')}\n" for k in K for name, value in (("u", U[k]), ("y", Y[k]))
    )
    read(tmp_path / "b.csv", text, step=1.0)


def test_a_comment_titles_rows_that_begin_with_a_date_and_a_time(tmp_path: Path) -> None:
    dates = [at.replace(" ", "T").split("T") for at in stamps(1.0)]
    text = "# date time u[V] y[mm]\n" + joined([one[0] for one in dates], [one[1] for one in dates], U, Y, sign=" ")
    read(tmp_path / "a.txt", text, step=1.0, scale=1e-3)


def test_numbers_of_channels_are_names_where_they_take_turns(tmp_path: Path) -> None:
    text = long("channel,time [s],reading\n", "{name},{k},{value}").replace("u,", "101,").replace("y,", "102,")
    read(tmp_path / "a.csv", text, input="101", output="102", step=1.0)
    levels = "parameter,time [s],value\n" + joined([1 + (k > 29) for k in K], K, Y)
    (tmp_path / "b.csv").write_text(levels)
    assert [one.name for one in contents_of(tmp_path / "b.csv").channels] == ["parameter", "value"]


def test_two_stamps_of_which_nobody_says_which_counts_are_left_alone(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no column 'u'"):
        read(tmp_path / "a.csv", long("tag,stamp_a,stamp_b,value\n", "{name},{at},{late},{value}"), step=1.0)


@pytest.mark.parametrize("size", [1e120, 1e200, 1e308])
def test_outputs_whose_squares_overflow_are_refused_with_a_remedy_that_works(size: float, tmp_path: Path) -> None:
    text = "time [s],u,y\n" + joined(SECONDS, U, [repr(float(y) * size) for y in Y])
    with pytest.raises(InputError, match=r"y is too large to count with.*scale it"):
        read(tmp_path / "a.csv", text)
    (tmp_path / "dataset.toml").write_text(
        'name = "a"\n[signals.u]\nrole = "input"\nunit = "1"\n[signals.y]\nrole = "output"\nunit = "1"\n'
        f'scale = {1 / size}\n[[runs]]\nfile = "a.csv"\n'
    )
    (run,) = load_dataset(tmp_path / "dataset.toml").dataset
    assert run.trajectory.y[:, 0] == pytest.approx(Y)


def struct_rows(**fields: Sequence[Any]) -> Any:
    """Return a row of structs."""
    rows = np.zeros(len(next(iter(fields.values()))), dtype=[(name, object) for name in fields])
    for name, values in fields.items():
        for k, value in enumerate(values):
            rows[name][k] = value
    return rows


def saved(path: Path, **variables: Any) -> Path:
    savemat(path, variables)
    return path


@pytest.mark.parametrize(("unit", "scale"), [("s", 1.0), ("ms", 1e3), ("us", 1e6)])
def test_signals_in_rows_of_structs_go_by_the_names_and_units_beside_them(
    unit: str, scale: float, tmp_path: Path
) -> None:
    rec = {
        "X": struct_rows(Name=["time"], Unit=[unit], Data=[scale * DT * np.arange(N)]),
        "Y": struct_rows(Name=["Model Root/u", "Model Root/y"], Unit=["V", "mm"], Data=[U, Y]),
    }
    path = saved(tmp_path / "a.mat", rec1_001=rec)
    data = load_dataset(path, input="Model Root/u", output="Model Root/y").dataset
    assert data.spec.sample_time == pytest.approx(DT)
    assert np.concatenate([run.trajectory.y[:, 0] for run in data]) == pytest.approx(1e-3 * Y)
    shown = {one.column: one.unit for one in contents_of(path).channels}
    assert shown["Model Root/u"] == "V"
    assert contents_of(path).clock_stated


def test_scopes_of_simulink_go_by_their_labels_and_names_that_two_have_by_their_places(tmp_path: Path) -> None:
    scope = {"time": DT * np.arange(N), "signals": struct_rows(values=[U, Y], label=["u", "y"]), "blockName": "rig"}
    data = load_dataset(saved(tmp_path / "a.mat", ScopeData=scope), input="u", output="y").dataset
    assert np.concatenate([run.trajectory.u[:, 0] for run in data]) == pytest.approx(U)
    scope["signals"] = struct_rows(values=[U, Y], label=["u", "u"])
    path = saved(tmp_path / "b.mat", ScopeData=scope)
    with pytest.raises(InputError, match="no column 'u'"):
        load_dataset(path, input="u", output="ScopeData.signals.values{1}")
    load_dataset(path, input="ScopeData.signals.values{0}", output="ScopeData.signals.values{1}")
