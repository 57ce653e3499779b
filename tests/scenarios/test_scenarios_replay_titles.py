"""The columns of a replayed input: clocks and units in every form that a log may have, in every kind of plant."""

from __future__ import annotations

import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from harness import api
from harness.errors import InputError
from harness.signals import Trajectory

T = np.round(np.arange(41) * 0.01, 6)
U = np.round(0.1 * np.sin(9.0 * T), 6)
DAY = datetime.datetime(2024, 3, 31, 23, 59, 59, 800_000)


def played(place: Path, head: str, times: Any, scale: float, plant: str = "pendulum-ode", **options: Any) -> Trajectory:
    sign = ";" if ";" in head else ","
    rows = [f"{t}{sign}{u * scale:.10g}" for t, u in zip(times, U, strict=True)]
    (place / "u.csv").write_text("\n".join([head, *rows]) + "\n", encoding="utf-8")
    given = {"file": str(place / "u.csv"), **options}
    return api.simulate(plant, scenario="replay", scenario_options=given)


@pytest.mark.parametrize(
    ("head", "times", "scale"),
    [
        ("time_ms,u_kNm", T * 1e3, 1e-3),
        ("Zeit (ms);u [Nmm]", T * 1e3, 1e3),
        ("t/us,u / (mN m)", T * 1e6, 1e3),
        ("timestamp_ns,u", np.round(T * 1e9), 1.0),
        ("elapsed_hours,u [Nm]", T / 3600, 1.0),
        ("time,u", T, 1.0),
        ("time,u [Nm]", [(DAY + datetime.timedelta(seconds=float(t))).isoformat() for t in T], 1.0),
        ("time,u [Nm]", [f"{DAY + datetime.timedelta(seconds=float(t)):%H:%M:%S.%f}" for t in T], 1.0),
    ],
)
def test_clocks_and_units_are_read(head: str, times: Any, scale: float, tmp_path: Path) -> None:
    record = played(tmp_path, head, times, scale)
    assert record.t[-1] - record.t[0] == pytest.approx(0.4)
    assert record.u[:-1, 0] == pytest.approx(U[:-1], abs=1e-9)


@pytest.mark.parametrize("plant", ["pendulum-ode", "pendulum-fmu"])
@pytest.mark.parametrize("interpolation", ["hold", "linear"])
def test_breakpoints_act_at_their_times(plant: str, interpolation: str, tmp_path: Path) -> None:
    (tmp_path / "u.csv").write_text("time [ms],u [mN m]\n0,100\n200,-50\n300,80\n400,0\n")
    options = {"file": str(tmp_path / "u.csv"), "interpolation": interpolation}
    record = api.simulate(plant, scenario="replay", scenario_options=options)
    t = record.t[:-1] - record.t[0]
    at, values = np.array([0.0, 0.2, 0.3, 0.4]), np.array([0.1, -0.05, 0.08, 0.0])
    held = values[np.searchsorted(at, t + 1e-9, side="right") - 1]
    assert record.u[:-1, 0] == pytest.approx(held if interpolation == "hold" else np.interp(t, at, values), abs=1e-9)


@pytest.mark.parametrize(
    ("head", "words"),
    [
        ("t [samples],u", "one unit of time"),
        ("time [ms],u [V]", "a unit that converts to 'N m'"),
        ("time x1000,u", "no time column"),
        ("time [s],u_V", "column of input 'u'"),
    ],
)
def test_what_states_something_else_is_refused(head: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=words):
        played(tmp_path, head, T, 1.0)
