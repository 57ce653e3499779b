"""Output-error fits: they find the parameters within the covariance they claim, and say so when they cannot."""

from __future__ import annotations

import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harness.errors import FitError, InputError
from harness.physics import Mechanism, fit_output_error, models, simulate_error
from harness.physics.fitting.smoothing import smooth
from harness.signals import PlantSpec, Trajectory


def sines(count, dt, nu, rng, top=2.0, size=1.0):
    """Return a random-phase multisine (count, nu) of given standard deviation."""
    t = np.arange(count) * dt
    f = np.linspace(0.1, top, 12)
    phases = rng.uniform(0, 2 * np.pi, (nu, 12))
    waves = [np.cos(2 * np.pi * np.outer(t, f) + phase).sum(axis=1) for phase in phases]
    return size * np.sqrt(2 / 12) * np.array(waves).reshape(nu, count).T


def record(system, p, x0, u, dt, noise, rng, substeps=8):
    """Return a noisy record of a system."""
    y = system.simulator(dt, substeps=substeps).rollout(p, x0, u)
    spec = PlantSpec(system.inputs, system.outputs, dt)
    return Trajectory(np.arange(len(u)) * dt, u, y + noise * rng.normal(size=y.shape), spec)


def score(fit, truth):
    """Return the squared Mahalanobis distance of the fit from the truth."""
    miss = np.array([fit.parameters[name] - truth[name] for name in fit.names])
    return float(miss @ np.linalg.solve(fit.covariance, miss))


@settings(max_examples=15)
@given(seed=st.integers(0, 10**6))
def test_a_pendulum_is_found_within_the_claimed_covariance(seed):
    rng = np.random.default_rng(seed)
    system = models.pendulum().system()
    truth = dict(zip(("J", "b", "mgl"), np.array([0.1, 0.05, 1.0]) * np.exp(rng.normal(size=3) * 0.7), strict=True))
    data = record(system, list(truth.values()), rng.normal(size=2) * 0.3, sines(1500, 0.01, 1, rng), 0.01, 3e-3, rng)
    fit = fit_output_error(system, [data], substeps=8)
    assert fit.converged
    assert fit.rms[0] == pytest.approx(3e-3, rel=0.1)
    assert fit.chi2 == pytest.approx(1.0, abs=0.1)
    assert score(fit, truth) < 26  # chi-squared, 3 degrees of freedom: 1e-5


def test_the_covariance_covers_as_often_as_it_says():
    system = models.pendulum().system()
    truth = {"J": 0.12, "b": 0.08, "mgl": 1.4}
    inside = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        data = record(system, list(truth.values()), [0.2, 0.0], sines(600, 0.02, 1, rng), 0.02, 5e-3, rng)
        fit = fit_output_error(system, [data], start=truth, substeps=8, continuation=(None,))
        inside += [abs(fit.parameters[n] - truth[n]) < 1.96 * d for n, d in fit.deviations.items()]
    assert 0.88 <= np.mean(inside) <= 0.995


@pytest.mark.parametrize(
    ("name", "p", "size"),
    [
        ("cart-pole", [0.7, 0.15, 0.6, 0.3, 0.01], 3.0),
        ("acrobot", [1, 1, 1, 0.6, 1.1, 0.1, 0.3, 0.2, 0.1], 2.0),
        ("drive", [20.0, 5.0, 0.3], 30.0),
        ("oscillator", [5e-6, 2e-4, 1.0], 0.1),
    ],
)
def test_models_are_found_from_their_default_start(name, p, size):
    rng = np.random.default_rng(3)
    system = models.load_model(name)
    dt = 1.6e-3 if name == "oscillator" else 0.004
    u = sines(5000, dt, 1, rng, top=120.0 if name == "oscillator" else 2.0, size=size)
    x0 = np.zeros(system.nx) if name == "oscillator" else rng.normal(size=system.nx) * 0.3
    level = 1e-3
    fit = fit_output_error(system, [record(system, p, x0, u, dt, level, rng, 4)], substeps=4)
    truth = dict(zip(system.parameter_names, p, strict=True))
    assert fit.converged, fit.message
    assert fit.rms == pytest.approx(level, rel=0.05)
    assert score(fit, truth) < 40


@pytest.mark.parametrize("seed", range(3))
def test_a_linear_model_starts_from_the_data(seed):
    rng = np.random.default_rng(seed)
    system = models.linear(3, inputs="u1 u2", outputs="y1 y2", time_scale=0.5).system()
    poles = -np.exp(rng.uniform(0, 1.5, 3)) + 0j
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    a = turn @ np.diag(poles.real) @ turn.T
    b, c = rng.normal(size=(3, 2)), rng.normal(size=(2, 3))
    # Into the canonical form: chains of length 2 and 1, free motion in units of 0.5 s.
    rows = np.array([c[0], c[0] @ a * 0.5, c[1]])
    form_a, form_b = rows @ (a * 0.5) @ np.linalg.inv(rows), 0.5 * rows @ b
    truth = {f"a{i + 1}_{k + 1}": -form_a[row, k] for i, row in enumerate((1, 2)) for k in range(3)}
    truth |= {f"b{row + 1}_{k + 1}": form_b[row, k] for row in range(3) for k in range(2)}
    truth |= {"offset_1": 3.0, "offset_2": -1.0}
    u = rng.choice([-1.0, 1.0], size=(2000, 2))
    data = record(system, list(truth.values()), [0.1, 0.0, 0.0], u, 0.1, 0.01, rng, 4)
    assert list(truth) == list(system.parameter_names)
    fit = fit_output_error(system, [data], substeps=4)
    assert fit.converged, fit.message
    # Against the truth with its own best initial state: twice the gain is chi-squared with 14 degrees of freedom.
    errors = simulate_error(system, truth, [data], horizon=None, substeps=4)
    gain = np.sum(errors[0] ** 2) - np.sum(fit.residuals[0] ** 2)
    assert -1e-3 < gain / 0.01**2 < 45


def test_two_tanks_are_found_although_the_upper_level_is_not_measured():
    rng = np.random.default_rng(1)
    system = models.two_tanks().system()
    u = np.repeat(rng.uniform(1.0, 4.0, size=(40, 1)), 25, axis=0)
    truth = {"k_pump": 0.04, "k_upper": 0.06, "k_lower": 0.05}
    data = record(system, list(truth.values()), [2.0, 3.0], u, 4.0, 0.02, rng)
    fit = fit_output_error(system, [data])
    assert fit.converged, fit.message
    assert fit.rms[0] == pytest.approx(0.02, rel=0.1)
    assert score(fit, truth) < 25


@pytest.mark.slow
def test_the_way_to_a_chaotic_record_is_found_over_horizons_in_between():
    rng = np.random.default_rng(3)
    system = models.acrobot().system()
    p = [1, 1, 1, 0.6, 1.1, 0.1, 0.3, 0.2, 0.1]
    u = sines(5000, 0.004, 1, rng, size=4.0)
    data = record(system, p, rng.normal(size=4) * 0.3, u, 0.004, 1e-3, rng, 4)
    fit = fit_output_error(system, [data], substeps=4)
    # Straight from 6 s windows to the whole record the fit ends at 0.5 rad, in another minimum.
    assert fit.rms == pytest.approx(1e-3, rel=0.05)


def test_perfect_data_give_perfect_parameters():
    rng = np.random.default_rng(0)
    system = models.cart_pole().system()
    p = np.array([0.8, 0.1, 0.4, 0.1, 0.01])
    data = record(system, p, [0, 0.4, 0, 0], sines(1000, 0.01, 1, rng, size=2), 0.01, 0.0, rng, 4)
    fit = fit_output_error(system, [data], substeps=4)
    assert [fit.parameters[n] for n in system.parameter_names] == pytest.approx(p, rel=1e-7)


def test_several_records_each_with_its_own_start_and_a_period():
    rng = np.random.default_rng(5)
    m = Mechanism("swing", q="theta", p="w2 d")
    from sympy import cos, sin

    m.body(1, (sin(m.q[0]), -cos(m.q[0])), weight=m.p[0])
    m.Q = [-m.p[1] * m.v[0]]
    system = m.system()
    free = [record(system, [60.0, 0.05], [a, v], np.zeros((2000, 0)), 0.005, 2e-3, rng) for a, v in
            ((2.5, 0.0), (1.0, 20.0), (-0.5, 0.0))]  # fmt: skip
    assert np.abs(free[1].y).max() > 7  # it turns over
    turned = [Trajectory(r.t, r.u, (r.y + np.pi) % (2 * np.pi) - np.pi, r.spec) for r in free]
    for records in (free, turned):
        fit = fit_output_error(system, records, start={"w2": 50.0})
        assert fit.converged
        assert len(fit.x0) == 3
        assert score(fit, {"w2": 60.0, "d": 0.05}) < 30
        assert max(np.abs(r).max() for r in fit.residuals) < 0.05


def test_windows_for_a_plant_that_integrates():
    rng = np.random.default_rng(6)
    system = models.drive().system()
    u = sines(4000, 0.005, 1, rng, size=20.0)
    data = record(system, [20.0, 5.0, 0.0], [0.0, 0.1], u, 0.005, 1e-3, rng)
    fit = fit_output_error(system, [data], horizon=1.0)
    assert fit.horizon == 1.0
    assert len(fit.x0) == 20
    assert score(fit, {"M": 20.0, "Fv": 5.0, "offset": 0.0}) < 25
    errors = simulate_error(system, fit.parameters, [data], horizon=1.0)
    assert np.sqrt(np.mean(errors[0] ** 2)) == pytest.approx(fit.rms[0], rel=1e-4)
    whole = simulate_error(system, fit.parameters, [data], horizon=None)
    assert whole[0].shape == data.y.shape
    assert np.sqrt(np.mean(whole[0] ** 2)) < 0.05


def test_simulate_error_needs_no_start_and_returns_nan_where_it_diverges():
    rng = np.random.default_rng(7)
    system = models.cart_pole().system()
    p = system.vector()
    data = record(system, p, [0, 2.5, 0, 0.0], sines(2000, 0.005, 1, rng, size=3.0), 0.005, 1e-3, rng)
    errors = simulate_error(system, system.values(), [data], horizon=2.0)
    assert np.sqrt(np.mean(errors[0] ** 2, axis=0)) == pytest.approx([1e-3, 1e-3], rel=0.1)
    given = simulate_error(system, system.values(), [data], horizon=None, x0=[np.array([0, 2.5, 0, 0.0])], substeps=8)
    assert np.sqrt(np.mean(given[0] ** 2, axis=0)) == pytest.approx([1e-3, 1e-3], rel=0.1)
    unstable = {**system.values(), "bx": 0.2, "mp": 1e-9, "btheta": 1e6}
    broken = simulate_error(system, unstable, [data], horizon=None, x0="data")
    assert broken[0].shape == data.y.shape


def test_the_projected_jacobian_explains_a_change_of_a_parameter():
    rng = np.random.default_rng(8)
    system = models.pendulum().system()
    data = record(system, [0.1, 0.05, 1.0], [0.3, 0.0], sines(800, 0.01, 1, rng), 0.01, 1e-4, rng)
    fit = fit_output_error(system, [data], continuation=(None,))
    jacobian = fit.jacobian()
    assert jacobian.shape == (800, 3)
    other = {**fit.parameters, "b": fit.parameters["b"] * 1.001}
    moved = simulate_error(system, other, [data], horizon=None, continuation=(None,))
    change = (moved[0] - fit.residuals[0])[:, 0] / fit.sigma[0]
    wanted = -jacobian[:, 1] * (other["b"] - fit.parameters["b"])
    assert np.linalg.norm(change - wanted) < 0.02 * np.linalg.norm(wanted)


def test_what_the_data_do_not_show_is_said():
    rng = np.random.default_rng(9)
    m = models.drive()
    system = m.system()
    u = np.full((500, 1), 2.0)
    data = record(system, [2.0, 1.0, 0.5], [0.0, 1.5], u, 0.01, 1e-4, rng)  # at its final speed from the start
    fit = fit_output_error(system, [data], start={"M": 2.0, "Fv": 1.0, "offset": 0.5}, continuation=(None,))
    assert (
        np.isinf(np.diag(fit.covariance)).any()
        or max(fit.deviations[n] / max(abs(fit.parameters[n]), 1e-9) for n in ("Fv", "offset")) > 10
    )
    rows = fit.unidentified
    assert "do not determine" in fit.message or not rows


def test_fixed_parameters_stay_and_starts_agree():
    rng = np.random.default_rng(10)
    system = models.pendulum().system()
    data = record(system, [0.1, 0.05, 1.0], [0.3, 0.0], sines(800, 0.01, 1, rng), 0.01, 1e-3, rng)
    fit = fit_output_error(system, [data], fixed=["J"], starts=3, rng=np.random.default_rng(0))
    assert fit.parameters["J"] == 0.1
    assert fit.names == ("b", "mgl")
    assert fit.converged
    assert "of 3 starts reached this minimum" in fit.message


def test_known_noise_sets_the_weights():
    rng = np.random.default_rng(11)
    system = models.cart_pole().system()
    data = record(system, system.vector(), [0, 0.4, 0, 0], sines(800, 0.01, 1, rng, size=2.0), 0.01, 1e-3, rng)
    fit = fit_output_error(system, [data], noise={"x": 0.01, "theta": 0.02})
    assert fit.sigma.tolist() == [0.01, 0.02]


def test_records_that_do_not_fit_are_refused():
    system = models.pendulum().system()
    spec = PlantSpec(system.inputs, system.outputs, 0.01)
    wrong = PlantSpec(system.inputs, models.drive().system().outputs, 0.01)
    with pytest.raises(InputError, match="outputs of the record"):
        fit_output_error(system, [Trajectory(np.arange(9) * 0.01, np.zeros((9, 1)), np.zeros((9, 1)), wrong)])
    with pytest.raises(FitError):
        fit_output_error(system, [Trajectory(np.arange(2) * 0.01, np.zeros((2, 1)), np.zeros((2, 1)), spec)])
    with pytest.raises(InputError):
        fit_output_error(system, [])
    good = Trajectory(np.arange(99) * 0.01, np.zeros((99, 1)), np.zeros((99, 1)), spec)
    with pytest.raises(InputError, match="mass"):
        fit_output_error(system, [good], start={"mass": 1.0})
    with pytest.raises(InputError, match="rng"):
        fit_output_error(system, [good], starts=2)


def test_a_hundred_thousand_samples_take_seconds():
    rng = np.random.default_rng(12)
    system = models.oscillator().system()
    u = sines(100_000, 1.6e-3, 1, rng, top=100.0, size=0.1)
    data = record(system, [5e-6, 2e-4, 1.0], [0.0, 0.0], u, 1.6e-3, 1e-3, rng, 3)
    start = time.process_time()
    fit = fit_output_error(system, [data], substeps=3)
    assert time.process_time() - start < 20
    assert score(fit, {"m": 5e-6, "c": 2e-4, "k": 1.0}) < 25


@given(seed=st.integers(0, 10**6), noise=st.sampled_from([1e-4, 1e-3, 1e-2]))
def test_smoothing_beats_the_noise_and_tells_its_size(seed, noise):
    rng = np.random.default_rng(seed)
    t = np.arange(800) * 0.01
    signal = np.sin(2 * np.pi * 0.5 * t + rng.uniform(0, 6))
    found = smooth(signal + noise * rng.normal(size=800), 0.01)
    assert np.sqrt(np.mean((found.value - signal) ** 2)) < 0.7 * noise
    assert found.error == pytest.approx(noise, rel=0.25)
