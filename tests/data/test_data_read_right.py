"""Whatever form a unit, a header or a row has: it is read as it is meant, or refused in one line; never read wrong."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harness.data import load_dataset
from harness.data.tables.headers import clock_of, clock_unit
from harness.errors import InputError
from harness.signals import Trajectory

DT, N = 0.01, 90
RNG = np.random.default_rng(0)
TIME = np.arange(N) * DT
TORQUE = np.round(RNG.normal(size=N), 6)
ANGLE = np.round(np.cumsum(np.cumsum(TORQUE)) * 1e-3, 6)

FORMS = ("{0} [{1}]", "{0} ({1})", "{0}({1})", "{0}<{1}>", "{0}_{1}", "{0}/{1}", "{0} / {1}", "{0}, {1}", "{0} {1}",
         "{0}.{1}", "{0}-{1}", "{0}: {1}", "{0} in {1}", "{0}..{1}.")  # fmt: skip
CLOCKS = ("time", "Time", "TIME", "t", "timestamp", "Timestamp", "Zeit", "Zeitstempel", "temps", "tiempo", "Время")
SECONDS = {"s": 1.0, "sec": 1.0, "ms": 1e-3, "msec": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9, "min": 60.0,
           "h": 3600.0, "Sekunden": 1.0, "Millisekunden": 1e-3, "secondes": 1.0, "seconds": 1.0}  # fmt: skip
ANGLES = {"rad": 1.0, "deg": np.pi / 180, "mrad": 1e-3, "rev": 2 * np.pi, "degrees": np.pi / 180}
TORQUES = {"Nm": 1.0, "N m": 1.0, "mNm": 1e-3, "Ncm": 1e-2, "N.m": 1.0}


def record(table: Any, **options: Any) -> Trajectory:
    """Return the estimation part of a table under the pendulum."""
    return load_dataset(table, model="pendulum", **options).dataset.estimation[0]


def right(found: Trajectory) -> None:
    n = len(found)
    assert found.spec.sample_time == pytest.approx(DT, rel=1e-6)
    assert found.u[:, 0] == pytest.approx(TORQUE[:n], abs=1e-9)
    assert found.y[:, 0] == pytest.approx(ANGLE[:n], abs=1e-9)


@settings(max_examples=60, deadline=None)
@given(
    st.sampled_from(FORMS), st.sampled_from(CLOCKS), st.sampled_from(sorted(SECONDS)),
    st.sampled_from(FORMS), st.sampled_from(sorted(ANGLES)),
    st.sampled_from(FORMS), st.sampled_from(sorted(TORQUES)),
)  # fmt: skip
def test_every_form_of_every_unit_is_read(
    clock: str, word: str, second: str, turned: str, angle: str, pushed: str, torque: str
) -> None:
    right(record({
        clock.format(word, second): TIME / SECONDS[second],
        pushed.format("u", torque): TORQUE / TORQUES[torque],
        turned.format("theta", angle): ANGLE / ANGLES[angle],
    }))  # fmt: skip


@settings(max_examples=40, deadline=None)
@given(st.text(alphabet="tTimeMsunz_ .()[]/,-0", min_size=1, max_size=10), st.sampled_from([1.0, 1e-3, 1e-6, 1e-9]))
def test_a_declared_time_column_is_never_taken_for_seconds_wrongly(title: str, unit: float) -> None:
    """Whatever the title is, milliseconds and less at 100 Hz come out right or are refused."""
    if title in ("u [Nm]", "theta [rad]"):
        return
    try:
        stated = clock_unit(title)
    except InputError:
        return
    if stated is not None:  # a title that states another unit than the column has is the user's mistake
        return
    table = {title: TIME / unit, "u [Nm]": TORQUE, "theta [rad]": ANGLE}
    try:
        right(record(table))
    except InputError:
        return


@pytest.mark.parametrize("title", ["TimeMs", "timeMs", "timeMS", "tms", "time_in_ms", "ms_time", "TIME_MS", "MS",
                                   "时间(毫秒)", "elapsed milliseconds", "time{ms}"])  # fmt: skip
def test_other_titles_of_milliseconds(title: str) -> None:
    right(record({title: TIME * 1e3, "u_Nm": TORQUE, "theta_rad": ANGLE}))


@pytest.mark.parametrize("title", ["time [Ms]", "time_m", "time_ticks", "time [100ns]", "time_100ns", "Time (count)",
                                   "time (since start)", "time_s [ms]", "time_a"])  # fmt: skip
def test_titles_that_may_mean_anything_are_refused(title: str) -> None:
    with pytest.raises(InputError, match=r"one unit of time"):
        clock_unit(title)
    with pytest.raises(InputError, match="remedy"):
        record({title: TIME, "u [Nm]": TORQUE, "theta [rad]": ANGLE})


def test_steps_of_a_second_and_more_need_a_stated_unit(tmp_path: Path) -> None:
    table = {"time": TIME * 1e3, "u [Nm]": TORQUE, "theta [rad]": ANGLE}
    with pytest.raises(InputError, match=r"states no unit.*0\.01 s in ms.*--unit time=UNIT"):
        record(table)
    write = "\n".join(",".join(map(repr, map(float, row))) for row in zip(TIME * 1e3, TORQUE, ANGLE, strict=True))
    (tmp_path / "a.csv").write_text(f"time,u [Nm],theta [rad]\n{write}\n")
    text = 'name = "a"\n{0}\n[signals.u]\nrole = "input"\n[signals.theta]\nrole = "output"\n[[runs]]\nfile = "a.csv"\n'
    (tmp_path / "a.toml").write_text(text.format('[time]\nunit = "ms"'))  # the remedy works
    right(record(tmp_path / "a.toml"))
    (tmp_path / "b.toml").write_text(text.format("sample_time = 10"))  # declared and agreeing: nothing to ask
    assert record(tmp_path / "b.toml").spec.sample_time == 10


def test_dates_are_seconds_whatever_the_title_says() -> None:
    stamps = np.datetime64("2024-05-01T23:59:59.8", "ns") + (TIME * 1e9).astype("timedelta64[ns]")
    for column in (stamps, np.array([f"{stamp}Z" for stamp in stamps])):
        right(record({"timestamp_ms": column, "u [Nm]": TORQUE, "theta [rad]": ANGLE}))


def test_two_clocks_are_one_too_many() -> None:
    with pytest.raises(InputError, match="2 columns may be the time"):
        clock_of(["t_s", "t_ms", "u", "theta"])
    assert clock_of(["time [s]", "t_ms", "u"]) == "time [s]"


@pytest.mark.parametrize("title", ["theta_s", "theta_raw", "theta (Grad)", "theta_Nm", "theta (V)"])
def test_units_that_do_not_fit_the_port_are_refused(title: str) -> None:
    with pytest.raises(InputError, match="remedy"):
        record({"time": TIME, "u [Nm]": TORQUE, title: ANGLE})


def test_a_certain_title_goes_before_a_likely_one() -> None:
    right(record({"time": TIME, "u [Nm]": TORQUE, "theta [rad]": ANGLE, "theta_deg": 7 * ANGLE}))
    with pytest.raises(InputError, match="there 2 times"):
        record({"time": TIME, "u [Nm]": TORQUE, "theta_rad": ANGLE, "theta_deg": 7 * ANGLE})


def test_complex_numbers_keep_or_stop() -> None:
    with pytest.raises(InputError, match="expected real numbers"):
        record({"time": TIME, "u [Nm]": TORQUE + 1j, "theta [rad]": ANGLE})


# ---- rows ---------------------------------------------------------------------------------------------------------

HEAD = "time [s],u [Nm],theta [rad]"
ROWS = [",".join(map(repr, map(float, row))) for row in zip(TIME, TORQUE, ANGLE, strict=True)]


def changed(row: int, text: str) -> list[str]:
    return [text if k == row else line for k, line in enumerate(ROWS)]


READ = {
    "plain": [HEAD, *ROWS],
    "separators at the end of rows": [HEAD, *(f"{row}," for row in ROWS)],
    "separators at the end of all lines": [HEAD + ",", *(f"{row}," for row in ROWS)],
    "a separator at the end of the header": [HEAD + ",", *ROWS],
    "some separators at the end": [HEAD, *(row + ",," * (k % 2) for k, row in enumerate(ROWS))],
    "R with quoted names": ['"time [s]","u [Nm]","theta [rad]"', *(f'"{k + 1}",{row}' for k, row in enumerate(ROWS))],
    "R with names of rows": [HEAD, *(f"row{k}, {row}" for k, row in enumerate(ROWS))],
    "R behind check.names": ["time..s.,u..Nm.,theta..rad.", *ROWS],
    "an index without a title": ["," + HEAD, *(f"{k},{row}" for k, row in enumerate(ROWS))],
    "all quoted": [HEAD, *(",".join(f'"{cell}"' for cell in row.split(",")) for row in ROWS)],
    "the last line cut": [HEAD, *ROWS, "0.9,0.1"],
    "commas in quotes": [HEAD + ",note", *(f'{row},"a, b"' for row in ROWS)],
    "fortran": [HEAD, *(",".join(f"{float(cell):.17E}" for cell in row.split(",")) for row in ROWS)],
}


@pytest.mark.parametrize("lines", READ.values(), ids=list(READ))
def test_rows_that_are_read(lines: list[str], tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("\n".join(lines) + "\n")
    right(record(tmp_path / "a.csv"))


REFUSED = {
    "all rows longer": ([HEAD, *(f"{row},1.0" for row in ROWS)], "line 2: a row of 4 cells"),
    "numbered rows without a title": ([HEAD, *(f"{k},{row}" for k, row in enumerate(ROWS))], "line 2: a row of 4"),
    "quoted and numbered rows": ([HEAD, *(",".join(f'"{c}"' for c in f"{k},{row}".split(","))
                                          for k, row in enumerate(ROWS))], "line 2: a row of 4"),
    "all rows shorter": ([HEAD + ",extra", *ROWS], "line 2: a row of 3 cells under 4 titles"),
    "one row longer": ([HEAD, *changed(40, ROWS[40] + ",5")], "line 42: a row of 4 cells"),
    "one row shorter": ([HEAD, *changed(40, "0.4,1.0")], "line 42: a row of 2 cells"),
    "a cell too many inside": ([HEAD, *changed(7, ROWS[7].replace(",", ",,", 1))], "line 9: a row of 4 cells"),
    "thousands": ([HEAD.replace(",", ";"), *(row.replace(",", ";").replace(ROWS[k].split(",")[0], f"{k + 1:,}000")
                   .replace("0000", "0,000", 1) for k, row in enumerate(ROWS))], "thousands"),
}  # fmt: skip


@pytest.mark.parametrize(("lines", "words"), REFUSED.values(), ids=list(REFUSED))
def test_rows_that_are_refused_with_their_line(lines: list[str], words: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("\n".join(lines) + "\n")
    with pytest.raises(InputError, match=words):
        record(tmp_path / "a.csv")


def test_columns_of_one_title_go_by_their_number(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("\n".join([HEAD + ",theta [rad]", *(row + f",{k}" for k, row in enumerate(ROWS))]))
    with pytest.raises(InputError, match="give its number"):
        record(tmp_path / "a.csv")
    text = 'name="a"\n[signals.u]\nrole="input"\n[signals.theta]\nrole="output"\ncolumn={0}\n[[runs]]\nfile="a.csv"\n'
    (tmp_path / "a.toml").write_text(text.format(2))
    right(record(tmp_path / "a.toml"))
    (tmp_path / "b.toml").write_text(text.format(3))
    assert record(tmp_path / "b.toml").y[:, 0].tolist() == list(range(N))


def test_a_record_of_seven_rows_is_none(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("\n".join([HEAD, *ROWS[:7]]))
    with pytest.raises(InputError, match=r"at least 20 rows: .*five unknowns"):
        record(tmp_path / "a.csv", validation=tmp_path / "a.csv")


@pytest.mark.parametrize("title", ["SN", "min", "Std", "STD", "Tag", "dia", "dag"])
def test_a_word_that_is_a_unit_of_time_elsewhere_is_no_clock(title: str) -> None:
    """A serial number is no second of Turkey, a minimum no minute, a label no day."""
    table = {title: np.arange(1.0, N + 1), "u [Nm]": TORQUE, "theta [rad]": ANGLE}
    with pytest.raises(InputError, match="no time"):
        record(table)
    right(record(table, sample_time=DT))


@pytest.mark.parametrize(("title", "right_title"), [("Hora", "Fecha/Hora"), ("Heure", "Date / heure"),
                                                    ("ora", "Data e ora"),
                                                    ("Saat", "Date Time"), ("Godzina", "DateTime")])  # fmt: skip
def test_numbers_below_a_word_for_hour_and_time_of_day_are_refused(title: str, right_title: str) -> None:
    signals = {"u [Nm]": TORQUE, "theta [rad]": ANGLE}
    with pytest.raises(InputError, match="one unit of time"):
        record({title: TIME, **signals})
    right(record({title: TIME, **signals}, unit={"time": "s"}))
    stamps = np.datetime64("2024-05-01T10:00:00") + (1e6 * TIME).round().astype("timedelta64[us]")
    right(record({title: np.char.partition(stamps.astype(str), "T")[:, 2].astype(object), **signals}))
    right(record({right_title: stamps.astype(str).astype(object), **signals}))


@pytest.mark.parametrize(("title", "second"), [("millis()", 1e-3), ("micros()", 1e-6), ("tempo decorrido (ms)", 1e-3)])
def test_what_boards_and_people_call_their_clock(title: str, second: float) -> None:
    right(record({title: TIME / second, "u [Nm]": TORQUE, "theta [rad]": ANGLE}))


@pytest.mark.parametrize("unit", ["Millisekunden", "msec", "ms", "мс", "milliseconds"])
def test_a_declared_unit_of_time_is_any_word_for_it(unit: str) -> None:
    table = {"time": 1e3 * TIME, "u [Nm]": TORQUE, "theta [rad]": ANGLE}
    right(record(table, unit={"time": unit}))
    for odd in ("Ms", "ks", "Gs"):
        with pytest.raises(InputError, match="unknown unit"):
            record(table, unit={"time": odd})


@pytest.mark.parametrize(("unit", "factor", "si"), [("L/min", 1e-3 / 60, "m^3/s"), ("N/mm", 1e3, "N/m"),
                                                    ("cm^2", 1e-4, "m^2"),
                                                    ("mT", 1e-3, "T"), ("K/min", 1 / 60, "K/s"), ("mF", 1e-3, "farad"),
                                                    ("m/s^2/V", 1.0, "m/s^2/V"), ("J/kg", 1.0, "J/kg")])  # fmt: skip
def test_every_si_unit_of_the_list_is_reached(unit: str, factor: float, si: str) -> None:
    """One text of the list with two readings refused every unit behind it."""
    table = {"time [s]": TIME, f"u [{unit}]": TORQUE, "y": ANGLE}
    found = load_dataset(table, input="u", output="y").dataset.estimation[0]
    assert found.u[:, 0] == pytest.approx(factor * TORQUE[: len(found)], rel=1e-6)
    assert found.spec.inputs[0].unit == si
