"""Estimates of mechanical models: rank relative to the noise, offsets, estimators, doubts that are said."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harness.errors import FitError
from harness.models.estimate import estimate_of
from harness.physics import load_model
from harness.physics.lumps.identifiability import determined
from harness.physics.models import pendulum
from harness.signals import PlantSpec, Trajectory
from identifiers.mechanics.grey_box import OutputError
from identifiers.mechanics.lumped import lumped_energy, lumped_momentum, lumped_torque
from identifiers.mechanics.motion import noise_level

TRUTH = {"J": 0.2, "b": 0.05, "mgl": 1.0}


def swing(noise=1e-3, seed=0, n=1500, dt=0.01):
    system = pendulum().system()
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-1, 1, size=(n // 10 + 1, 1)), 10, axis=0)[:n]
    y = system.simulator(dt).rollout(list(TRUTH.values()), [0.4, 0.0], u)
    return Trajectory(
        np.arange(n) * dt, u, y + noise * rng.normal(size=y.shape), PlantSpec(system.inputs, system.outputs, dt)
    )


@given(st.integers(0, 10_000), st.floats(-9, -3))
@settings(max_examples=30, deadline=None)
def test_a_dependent_column_is_found_under_any_noise_and_its_partners_are_named(seed, exponent):
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(500, 3)) * 10.0 ** rng.uniform(-2, 2, size=3)
    exact = np.column_stack([x, x[:, 0] * 3.0])
    size = 10.0**exponent * np.linalg.norm(exact, axis=0) / np.sqrt(500)
    once, twice = (size * rng.normal(size=exact.shape) for _ in range(2))
    decision, kept, _ = determined(exact + once, ["a", "b", "c", "d"], twice)
    assert decision.rank == 3
    assert decision.undetermined == ("a", "d")
    assert kept.shape == (4, 3)
    full = determined(exact[:, :3] + once[:, :3], ["a", "b", "c"], twice[:, :3])[0]
    assert full.full


def test_the_noise_of_a_record_is_measured():
    for noise in (1e-4, 1e-2):
        assert noise_level(swing(noise).y[:, 0]) == pytest.approx(noise, rel=0.15)


def quadrotor_record(noise):
    from harness.physics.models import planar_quadrotor

    system = planar_quadrotor().system()
    rng = np.random.default_rng(0)
    n, dt = 1000, 0.01
    u = 2.4 + 0.3 * np.repeat(rng.uniform(-1, 1, size=(n // 20, 2)), 20, axis=0)
    x = system.simulator(dt).states([0.486, 0.00383, 0.25], np.zeros(6), u)
    y = x[:, :3] + noise * rng.normal(size=(n, 3))
    return Trajectory(np.arange(n) * dt, u, y, PlantSpec(system.inputs, system.outputs, dt))


CRAFT = """
from dataclasses import replace
from harness.physics.models import planar_quadrotor

def craft():
    m = planar_quadrotor()
    m.parameters(r=("m", 0.25))
    return m
"""


@pytest.mark.parametrize("noise", [0.0, 1e-8, 1e-4])
def test_a_quadrotor_shows_only_inertia_over_arm_and_says_so(noise, tmp_path):
    """They came out as 0 without a word."""
    data = quadrotor_record(noise)
    file = tmp_path / "craft.py"
    file.write_text(CRAFT)
    for make in (lumped_torque, lumped_momentum):
        with pytest.raises(FitError, match=r"(I and r|r and I) only in proportion"):
            make(f"{file}:craft").fit([data], rng=np.random.default_rng(0))
    # the registered one declares r fixed
    found = lumped_momentum("planar-quadrotor").fit([data], rng=np.random.default_rng(0)).parameters
    assert found["m"] == pytest.approx(0.486, rel=1e-2)
    assert found["I"] == pytest.approx(0.00383, rel=2e-2)
    assert found["r"] == 0.25


def test_areas_and_inertia_of_the_glider_come_back():
    system = load_model("perching-glider")
    rng = np.random.default_rng(0)
    runs = []
    for k in range(3):
        u = 2.0 * np.repeat(rng.uniform(-1, 1, size=(10, 1)), 8, axis=0)
        x0 = [-3.5, 0.1, 0.1 * (k - 1), 0.0, 7.0, 0.0, 0.0]
        y = system.simulator(0.01).rollout(system.vector(), x0, u)
        y = y + 1e-3 * rng.normal(size=y.shape)
        runs.append(Trajectory(np.arange(80) * 0.01, u, y, PlantSpec(system.inputs, system.outputs, 0.01)))
    start = {"I": 0.003, "S_w": 0.05, "S_e": 0.03}
    model = OutputError(model="perching-glider", start=start).fit(runs, rng=rng)
    for name in start:
        assert model.parameters[name] == pytest.approx(system.values()[name], rel=0.03), name


OFFSET = """
from sympy import cos, sin
from harness.physics import Mechanism

def arm():
    m = Mechanism("arm", q="theta", u="u", p="J mgl offset", parameters={
        "J": ("kg m^2", 0.1), "mgl": ("N m", 1.0), "offset": ("rad", 0.0)})
    (theta,), (rate,), (u,), (J, mgl, offset) = m.q, m.v, m.u, m.p
    m.body(J, (sin(theta + offset), -cos(theta + offset)), weight=mgl)
    m.Q = [u - 0.05 * rate]
    return m
"""


@pytest.mark.parametrize("identifier", [lumped_momentum, OutputError])
@pytest.mark.parametrize("offset", [0.08, -0.08])
def test_an_offset_declared_zero_is_fitted_either_way(identifier, offset, tmp_path):
    file = tmp_path / "arm.py"
    file.write_text(OFFSET)
    system = load_model(f"{file}:arm")
    rng = np.random.default_rng(1)
    u = np.repeat(rng.uniform(-1, 1, size=(100, 1)), 10, axis=0)
    y = system.simulator(0.01).rollout([0.2, 1.2, offset], [0.3, 0.0], u)
    data = Trajectory(np.arange(1000) * 0.01, u, y, PlantSpec(system.inputs, system.outputs, 0.01))
    model = identifier(model=f"{file}:arm").fit([data], rng=rng)
    assert model.parameters["offset"] == pytest.approx(offset, abs=2e-4)
    assert estimate_of(model).value("offset") == model.parameters["offset"]


@pytest.mark.parametrize("estimator", ["least-squares", "total", "instruments", "huber", "l1"])
def test_every_estimator_comes_near_the_truth(estimator):
    model = lumped_momentum("pendulum", estimator=estimator).fit([swing()], rng=np.random.default_rng(0))
    for name, value in TRUTH.items():
        assert model.parameters[name] == pytest.approx(value, rel=0.02), name


def test_total_and_instruments_take_the_bias_of_the_torque_form():
    """Rates and accelerations are noisy: least squares shrinks, the other two hardly."""
    off = {}
    for estimator in ("least-squares", "total", "instruments"):
        found = [
            lumped_torque("pendulum", smoothing="spline", estimator=estimator)
            .regress(pendulum().system(), [swing(4e-5, seed=seed)])[0]
            .values["J"]
            for seed in range(5)
        ]
        off[estimator] = abs(np.mean(found) / TRUTH["J"] - 1)
    assert off["least-squares"] > 0.03
    assert off["instruments"] < 0.2 * off["least-squares"]


def test_outliers_hardly_move_the_robust_ones():
    data = swing(1e-4)
    y = data.y.copy()
    rng = np.random.default_rng(0)
    u = data.u.copy()
    u[rng.choice(len(u), size=40, replace=False)] += 20.0  # wrong readings of the torque
    bad = Trajectory(data.t, u, y, data.spec)
    off = {}
    for estimator in ("least-squares", "huber", "l1"):
        found = lumped_torque("pendulum", estimator=estimator).regress(pendulum().system(), [bad])[0].values
        off[estimator] = max(abs(found[name] / value - 1) for name, value in TRUTH.items())
    assert off["huber"] < 0.3 * off["least-squares"]
    assert off["l1"] < 0.3 * off["least-squares"]


def test_no_interval_is_claimed_where_the_model_does_not_come_back_to_the_record():
    """Backlash-like truth: the free run of the fitted pendulum leaves the record."""
    data = swing(1e-4)
    wrong = Trajectory(data.t, data.u, data.y + 0.02 * np.sign(data.y), data.spec)
    found = estimate_of(lumped_momentum("pendulum", intervals=20).fit([wrong], rng=np.random.default_rng(0)))
    assert found.intervals is None
    assert "free run" in found.method
    plain = estimate_of(lumped_energy("pendulum").fit([data], rng=np.random.default_rng(0)))
    assert plain.intervals is None
    assert "not asked" in plain.method


def test_output_error_says_that_it_did_not_converge():
    data = swing(1e-3, n=400)
    model = OutputError(model="pendulum", start={"J": 5.0, "mgl": 1e-3}, horizon="record").fit(
        [data], rng=np.random.default_rng(0)
    )
    found = estimate_of(model)
    if found.converged:
        assert simulation_rms(model, data) < 2e-3
    else:
        assert found.intervals is None
        assert "not converge" in found.method


def simulation_rms(model, data):
    from harness.scoring import simulation_error

    return float(simulation_error(model, data).rms[0])
