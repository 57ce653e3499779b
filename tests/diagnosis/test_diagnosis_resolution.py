"""No reading is more exact than its resolution, also of a plant that rests for most of its record."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harness.diagnosis.algorithm import diagnose
from harness.diagnosis.kinds import EquationsKind
from harness.diagnosis.records.prepare import checked
from harness.diagnosis.records.thinning import thinned_by
from harness.diagnosis.store import data_fingerprint
from harness.effects import builtin
from harness.effects.effect import Placed
from harness.physics import load_model
from harness.resolution import quantisation_test, resolution
from harness.signals import Channel, Dataset, PlantSpec, Run, Trajectory

DT, STEP = 0.01, 0.02


def resting(seed: int) -> Trajectory:
    """Return a pendulum that swings for a second of every six, read by an encoder of 0.02 rad."""
    plant, n = load_model("pendulum"), 1200
    t = np.arange(n) * DT
    u = np.where(t % 6 < 1, 0.5 * np.sin(2 * np.pi * t + seed), 0.0)[:, None]
    p = plant.vector({"J": 0.1, "b": 0.6, "mgl": 1.0})
    y = plant.simulator(DT, substeps=4).rollout(p, [0.0, 0.0], u)
    spec = PlantSpec((Channel("u", "N m"),), (Channel("theta", "rad"),), DT)
    return Trajectory(t, u, np.round(y / STEP) * STEP, spec)


DATA = Dataset("resting", (Run(resting(0), "estimation"), Run(resting(1), "validation")))


def test_the_noise_of_an_encoder_is_no_less_than_its_step_says() -> None:
    plant = load_model("pendulum")
    data = checked(DATA, plant)
    assert data.resolution == {"theta": pytest.approx(STEP)}
    form = EquationsKind().form(plant, data)
    fit = form.fit((), form.first_starts(), None)
    assert fit is not None
    assert fit.detail.points["estimation"].noise.r[0] >= STEP / np.sqrt(12) * (1 - 1e-9)
    assert fit.values["mgl"] == pytest.approx(1.0, rel=0.2)
    half = thinned_by(data, 2)
    assert half.dataset.resolution["theta"] == pytest.approx(STEP * half.noise[0])


def test_a_resolution_and_missing_readings_are_part_of_what_a_fit_is_known_by() -> None:
    fine = Dataset("resting", DATA.runs, resolution={"theta": 1e-3})
    record = DATA.runs[0].trajectory
    gone = Trajectory(record.t, record.u, record.y, record.spec, missing=np.arange(len(record))[:, None] % 7 == 0)
    holed = Dataset("resting", (Run(gone, "estimation"), DATA.runs[1]))
    assert len({data_fingerprint(one) for one in (DATA, fine, holed)}) == 3


@settings(max_examples=40, deadline=None)
@given(st.floats(1e-4, 1e-1), st.integers(0, 10**6))
def test_a_grid_is_found_where_there_is_one_and_nowhere_else(step: float, seed: int) -> None:
    read = np.cumsum(np.random.default_rng(seed).normal(size=3000)) * 3 * step
    assert resolution([np.round(read / step) * step]) == pytest.approx(step, rel=1e-6)
    assert resolution([read]) == 0.0
    assert resolution([np.round(read / step) * step, read]) == 0.0


def held(seed: int) -> Trajectory:
    """Return 6 s of a pendulum that a controller swings by an encoder of 14 bits, which alone is between them."""
    rng, n, dt, parts, step = np.random.default_rng(seed), 1500, 0.004, 40, 2 * np.pi / 2**14
    t = np.linspace(0.0, (n - 1) * dt, n)
    aim = rng.uniform(0.5, 1.0) * np.sin(2 * np.pi * rng.uniform(0.4, 0.8) * t) * np.minimum(t, 1.0)
    kp, kd = rng.uniform(8, 20), rng.uniform(0.3, 0.7)
    q = w = rate = last = 0.0
    u, y = np.zeros((n, 1)), np.zeros((n, 1))
    for k in range(n):
        y[k] = read = round(q / step) * step
        rate += 0.3 * ((read - last) / dt - rate)
        last = read
        u[k] = torque = float(np.clip(kp * (aim[k] - read) - kd * rate + 1.35 * np.sin(read), -3.0, 3.0))
        for _ in range(parts):
            w += dt / parts * (torque - 0.02 * w - 1.5 * math.sin(q)) / 0.05
            q += dt / parts * w
    return Trajectory(t, u, y, PlantSpec((Channel("u", "N m"),), (Channel("theta", "rad"),), dt))


@pytest.mark.parametrize("seed", [0, 4, 8])
def test_free_runs_deny_no_rounding(seed: int) -> None:
    """A rounded prediction errs by its own rounding as well: these runs err more with it than without."""
    data = Dataset("held", (Run(held(seed)), Run(held(seed + 1), "validation")), intersample="zoh")
    laws = [builtin()[name] for name in ("sensor_quantisation", "coulomb_friction")]
    found = diagnose(data, load_model("pendulum"), dictionary=laws)
    assert [str(one.placed) for one in found.outcome.accepted] == ["sensor_quantisation@theta"]
    assert (found.verdict, found.grade) == ("effects_found", "explained")


def test_a_wide_motion_on_a_grid_is_rounded_though_hardly_two_readings_are_equal() -> None:
    rng = np.random.default_rng(3)
    y = np.round(np.cumsum(rng.normal(size=1400)) * 5 / 0.01) * 0.01
    assert len(np.unique(y)) > 0.9 * len(y)
    assert quantisation_test(y).step == pytest.approx(0.01)
    decimals = np.round(rng.normal(size=3000), 6)
    assert not quantisation_test(decimals).quantised, "six decimals of a number are no sensor's step"


def test_the_step_of_a_sensor_stays_what_it_is_on_the_way_back_to_the_base() -> None:
    """A start a hair below its base was shortened with all that it holds: a step of 0.01 A was said to be 0.0003."""
    form = EquationsKind().form(load_model("pendulum"), DATA)
    base = form.fit((), form.first_starts(), None)
    assert base is not None
    rounded = Placed(builtin()["sensor_quantisation"], "theta")
    far = {**base.values, "J": 3 * base.values["J"], rounded.name("step"): 0.01}
    begun = form.begin([rounded], [far], base)
    assert begun is not None
    assert begun.values[rounded.name("step")] == pytest.approx(0.01)
