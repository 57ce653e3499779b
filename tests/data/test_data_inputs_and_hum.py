"""Inputs that the log lost for a while, and lines above the motion: named, kept out, never seen in clean records."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

from harness.data.oddities import examined
from harness.diagnosis.close import close_loop
from harness.diagnosis.records.inputs_check import inputs_checked
from harness.diagnosis.records.stretches import parted
from harness.judgement import law_of
from harness.physics.compiled.system import System
from harness.physics.symbolic.typed import read_equations
from harness.signals import Channel, Dataset, FloatArray, Oddity, PlantSpec, Run, Trajectory

N, DT = 1000, 0.5
WALL = """
input P [W]
input Ta [K]
level T [K]
g = 0.002 K/J >= 0
a = 0.003 1/s >= 0
T' = g*P - a*(T - Ta)
output T
"""
MOTOR = """
input v [V]
state i [A], w [rad/s]
motion shaft: w, J
R = 2 ohm >= 0
L = 0.05 H >= 0
K = 0.05 N m/A >= 0
J = 1e-3 kg m^2 >= 0
b = 1e-4 N m s/rad >= 0
i' = (v - R*i - K*w) / L
w' = (K*i - b*w) / J
output i
output w
"""
SPEC = PlantSpec((Channel("P", "W"), Channel("Ta", "K")), (Channel("T", "K"),), DT)


def room(seed: int) -> tuple[FloatArray, FloatArray]:
    """Return power and outdoor temperature (N, 2), and the temperature of a room (N,) with noise."""
    rng = np.random.default_rng(seed)
    power = np.repeat(rng.uniform(50.0, 300.0, 20), 50)
    out = 15.0 + np.cumsum(rng.normal(0.0, 0.02, N))
    y = np.zeros(N)
    for k in range(N - 1):
        y[k + 1] = y[k] + DT * (0.002 * power[k] - 0.02 * (y[k] - out[k]))
    return np.column_stack([power, out]), y + 0.02 * rng.standard_normal(N)


def looked(u: FloatArray, y: FloatArray) -> tuple[Dataset, list[Oddity]]:
    found = examined(Dataset("room", (Run(Trajectory(np.arange(N) * DT, u, y[:, None], SPEC)),)))
    return found, [odd for odd in found.oddities or () if odd.fault]


def test_a_drop_out_of_an_input_is_named_and_its_rows_are_left_out() -> None:
    u, y = room(0)
    u[420:450, 0] = 0.0
    found, odd = looked(u, y)
    assert [(one.kind, one.channel, one.rows[0], len(one.rows)) for one in odd] == [("dropout", "P", 420, 30)]
    assert (found.runs[0].trajectory.u[420:450, 0] > 1.0).all()
    assert [len(run.trajectory) for run in parted(found)] == [420, 550]


def test_equations_tell_whether_a_plant_felt_a_jump_of_an_input_that_no_output_shows_at_once() -> None:
    """The wall answers so slowly that the next rows do not show it; over the record the temperature does."""
    model = read_equations(WALL, "wall")
    for felt in (False, True):
        out = 15.0 + np.cumsum(np.random.default_rng(1).normal(0.0, 0.02, N))
        logged = out.copy()
        logged[420:450] = 0.0
        u = np.column_stack([room(0)[0][:, 0], logged if felt else out])
        system = model.system()
        y = system.simulator(DT).rollout(system.vector(), [15.0], u)[:, 0]
        y += 0.05 * np.random.default_rng(2).standard_normal(N)
        u[:, 1] = logged
        found = inputs_checked(system, looked(u, y)[0])
        assert [(one.channel, one.used) for one in found.oddities or ()] == ([] if felt else [("Ta", True)])
        assert (found.runs[0].trajectory.u[420:450, 1] > 10.0).all() == (not felt)


def test_a_late_input_that_an_output_answers_at_once_is_told_by_the_plant_although_it_follows_a_law() -> None:
    rng, dt, n = np.random.default_rng(4), 0.01, 500
    system = read_equations(MOTOR, "motor").system()
    r, inductance, gain, inertia, b = 1.6, 0.04, 0.06, 1.2e-3, 2e-4
    rates = np.array([[-r / inductance, -gain / inductance, 1.0 / inductance], [gain / inertia, -b / inertia, 0.0]])
    step = expm(dt * np.vstack([rates, np.zeros(3)]))[:2]
    v, y, x = np.repeat(rng.uniform(-8.0, 8.0, n // 25), 25)[:, None], np.zeros((n, 2)), np.zeros(2)
    v += 1e-6 * np.arange(n)[:, None]  # one that rests to the bit follows no controller's law
    for k in range(n):
        y[k] = x + [0.02, 0.3] * rng.standard_normal(2)
        x = step @ np.append(x, v[k])
    record = Trajectory(np.arange(float(n)) * dt, np.vstack([v[:1], v[:-1]]), y, _spec(system, dt))
    assert law_of([record]) is not None
    found = inputs_checked(system, Dataset("motor", (Run(record),)))
    assert [odd.kind for odd in found.oddities or ()] == ["shift"]
    assert np.array_equal(found.runs[0].trajectory.u, v[:-1])


OVENS = {
    "one mass": "g = 0.2 K/J\na = 0.03 1/s\nT' = g*P - a*T",
    "heater and room": "level H [K]\ng = 0.2 K/J\na = 0.1 1/s\nb = 0.03 1/s\n"
    "H' = g*P - a*(H - T)\nT' = a*(H - T) - b*T",
}


@pytest.mark.parametrize("equations", OVENS.values(), ids=OVENS)
@pytest.mark.parametrize(("taken_up", "late"), [(1.2, 0), (-0.8, 0), (0.0, 0), (0.0, 1)])
def test_crosstalk_of_a_held_input_is_told_from_an_input_that_was_written_late(
    equations: str, taken_up: float, late: int
) -> None:
    """Both make a reading move before the plant could: how it goes on from there is not the same."""
    system = read_equations(f"input P [W]\nlevel T [K]\n{equations}\noutput T", "oven").system()
    rng, n = np.random.default_rng(5), 500
    u = np.repeat(rng.uniform(0.0, 10.0, n // 20), 20)[:, None]
    true = system.simulator(1.0).rollout(system.vector(), [0.0] * system.nx, u) + 0.02 * rng.standard_normal((n, 1))
    logged = np.vstack([u[:1]] * late + [u])[:n]
    record = Trajectory(np.arange(float(n)), logged, true + taken_up * logged, _spec(system, 1.0))
    found = inputs_checked(system, examined(Dataset("oven", (Run(record),))))
    told = [odd.kind for odd in found.oddities or () if odd.kind == "shift" or odd.used]
    assert told == (["crosstalk"] if taken_up else ["shift"] if late else [])
    read = found.runs[0].trajectory
    assert np.allclose(read.y, true[: len(read)], atol=0.06 * 10.0 if taken_up else 0.0)
    assert np.array_equal(read.u, u[: len(read)])


def test_a_loop_over_readings_that_lost_their_crosstalk_ends_with_a_report() -> None:
    system = read_equations(f"input P [W]\nlevel T [K]\n{OVENS['one mass']}\noutput T", "oven").system()
    runs, n = [], 400
    for seed, use in ((1, "estimation"), (2, "validation")):
        rng = np.random.default_rng(seed)
        u = np.repeat(rng.uniform(0.0, 10.0, n // 20), 20)[:, None]
        y = system.simulator(1.0).rollout(system.vector(), [0.0], u) + 0.02 * rng.standard_normal((n, 1))
        runs.append(Run(Trajectory(np.arange(float(n)), u, y + 1.2 * u, _spec(system, 1.0)), use))
    report = close_loop(Dataset("oven", tuple(runs)), system)
    assert [odd["kind"] for odd in report.data["oddities"]] == ["crosstalk"]
    assert "as the record is read here" in report.data["oddities"][0]["text"]
    assert report.data["verdict"] == "nothing_missing"


@pytest.mark.parametrize("law", [0.6, 1.0, 2.0])
def test_a_controller_in_time_is_no_late_input_although_a_plant_of_other_values_would_say_so(law: float) -> None:
    """Read a row early its law tells the next output to the noise, by a gain of the plant that nobody declared."""
    rng, n = np.random.default_rng(1), 400
    system = read_equations("input P [W]\nlevel T [K]\ng = 0.2 K/J\na = 0.3 1/s\nT' = g*P - a*T\noutput T", "").system()
    u, y, x, decay = np.zeros((n, 1)), np.zeros((n, 1)), 0.0, np.exp(-0.3 * DT)
    for k in range(n):
        y[k] = x + 1e-2 * rng.standard_normal()
        u[k] = -law * y[k]
        x = decay * x + (1.0 - decay) / 0.3 * (0.2 * float(u[k, 0]) + 0.3 * rng.standard_normal())
    record = Trajectory(np.arange(float(n)) * DT, u, y, _spec(system, DT))
    found = inputs_checked(system, Dataset("room", (Run(record),)))
    assert "shift" not in [odd.kind for odd in found.oddities or ()]
    assert np.array_equal(found.runs[0].trajectory.u, u)


def _spec(system: System, dt: float) -> PlantSpec:
    return PlantSpec(tuple(system.inputs), tuple(system.outputs), dt)


@pytest.mark.parametrize("seed", range(3))
def test_an_input_that_was_off_is_no_drop_out(seed: int) -> None:
    u, y = room(seed)
    assert looked(u, y)[1] == []
    power = u[:, 0].copy()
    power[300:330] = 0.0
    u[:, 0] = power
    y[:] = 0.0
    for k in range(N - 1):
        y[k + 1] = y[k] + DT * (0.002 * power[k] - 0.02 * (y[k] - u[k, 1]))
    assert looked(u, y + 0.02 * np.random.default_rng(seed).standard_normal(N))[1] == []


@pytest.mark.parametrize("frequency", [0.11, 0.32])
def test_a_line_above_the_motion_is_named_and_taken_out(frequency: float) -> None:
    u, y = room(7)
    hum = 0.08 * np.sin(2 * np.pi * frequency * np.arange(N) + 0.4)
    found, odd = looked(u, y + hum)
    assert [(one.kind, one.channel) for one in odd] == [("hum", "T")]
    assert f"{frequency / DT:.3g} Hz" in odd[0].words
    assert np.abs(found.runs[0].trajectory.y[:, 0] - y).max() < 0.01


def test_a_burst_of_noise_is_named_where_it_is() -> None:
    u, y = room(8)
    y[600:660] += 0.15 * np.random.default_rng(8).standard_normal(60)
    odd = looked(u, y)[1]
    assert [(one.kind, one.channel) for one in odd] == [("burst", "T")]
    assert len(set(odd[0].rows) & set(range(600, 660))) > 45
    assert set(odd[0].rows) <= set(range(570, 690))


def test_a_load_that_comes_and_goes_is_no_burst() -> None:
    """A draught for a minute moves the room from row to row, and the sensor is as it was."""
    u, y = room(9)
    rng, load = np.random.default_rng(9), np.zeros(N)
    for k in range(N - 1):
        load[k + 1] = 0.99 * load[k] + (0.05 * rng.standard_normal() if 600 <= k < 660 else 0.0)
    assert looked(u, y + load)[1] == []


def test_a_line_that_an_input_has_is_no_hum() -> None:
    u, y = room(6)
    line = np.sin(2 * np.pi * 0.2 * np.arange(N))
    u[:, 0] += 100.0 * line
    answer = np.zeros(N)
    for k in range(N - 1):
        answer[k + 1] = answer[k] + DT * (0.2 * line[k] - 0.02 * answer[k])
    assert np.ptp(answer) > 0.1
    assert looked(u, y + answer)[1] == []
