"""Filters that learn parameters online: near the batch fit, pure, across seams, with a drift where asked."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from harness.effects import Placed, builtin, compose
from harness.errors import InputError
from harness.models.estimate import estimate_of
from harness.physics.models import cart_pole, double_pendulum, pendulum
from harness.scoring import regret
from harness.signals import Channel, PlantSpec, Trajectory
from identifiers.mechanics.surprise import Surprise
from identifiers.online.filters_online import ekf, ukf

from .conftest import passed

TRUTH = {"J": 0.2, "b": 0.05, "mgl": 1.3}


def stream(seed=0, n=1200, noise=2e-3, truth=TRUTH):
    system = pendulum().system()
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-1, 1, size=(n // 10, 1)), 10, axis=0)
    y = system.simulator(0.02).rollout(list(truth.values()), [0.5, 0.0], u)
    spec = PlantSpec(system.inputs, system.outputs, 0.02)
    return Trajectory(np.arange(n) * 0.02, u, y + noise * rng.normal(size=y.shape), spec)


@pytest.mark.parametrize("make", [ekf, ukf])
def test_parameters_converge_from_half_and_double(make):
    """Fifty per cent off at the start, one angle measured; sensor noise is learned, too."""
    start = {"J": 0.1, "b": 0.1, "mgl": 2.0}
    state = passed(make("pendulum", start=start), [stream(0), stream(1)])
    for name, value in TRUTH.items():
        assert state.parameters[name] == pytest.approx(value, rel=0.05), name
        assert state.estimate.deviation(name) < 0.1 * value
    assert np.sqrt(state.noise[0]) == pytest.approx(2e-3, rel=0.5)


@pytest.mark.parametrize("make", [ekf, ukf])
def test_a_cart_pole_with_every_state_measured(make):
    system = cart_pole().system()
    rng = np.random.default_rng(0)
    u = 5 * np.repeat(rng.uniform(-1, 1, size=(60, 1)), 10, axis=0)
    x = system.simulator(0.02).states(system.vector(), [0.0, 0.5, 0.0, 0.0], u)
    spec = PlantSpec(system.inputs, (*system.outputs, Channel("x_rate", "m/s"), Channel("theta_rate", "rad/s")), 0.02)
    data = Trajectory(np.arange(600) * 0.02, u, x + 1e-3 * rng.normal(size=x.shape), spec)
    state = passed(make("cart-pole", start={"mc": 1.5, "mp": 0.3, "l": 0.4}), [data])
    for name in ("mc", "mp", "l"):
        assert state.parameters[name] == pytest.approx(system.values()[name], rel=0.05), name


def test_a_fit_is_one_pass_over_the_records():
    records = [stream(0), stream(1)]
    fitted = ekf("pendulum", start={"J": 0.1}).fit(records, rng=np.random.default_rng(0))
    assert fitted.parameters == passed(ekf("pendulum", start={"J": 0.1}), records).parameters
    estimate = estimate_of(fitted)
    assert estimate is not None
    assert estimate.deviation("J") > 0
    assert estimate.intervals is None


def test_an_update_changes_nothing_that_was_there_and_states_travel():
    data = stream(n=50)
    online = ekf("pendulum")
    state = online.start(online.init(data.spec, rng=np.random.default_rng(0)), data.y[0])
    before = state.mean.copy()
    later = online.update(state, data.u[0], data.y[1])
    assert np.array_equal(state.mean, before)
    assert not np.array_equal(later.mean, before)
    copy = pickle.loads(pickle.dumps(later))
    assert np.array_equal(online.predict(copy, data.u[1]), online.predict(later, data.u[1]))


def test_a_sudden_change_is_followed_because_predictions_surprise():
    first, second = stream(0), stream(1, truth={"J": 0.2, "b": 0.05, "mgl": 1.8})
    assert passed(ekf("pendulum"), [first, second]).parameters["mgl"] == pytest.approx(1.8, rel=2e-3)


def test_a_steady_drift_is_followed_where_it_is_allowed():
    streams = [stream(k, n=300, truth={**TRUTH, "mgl": 1.3 + 0.05 * k}) for k in range(8)]
    still, walking = (passed(ekf("pendulum", walk=walk), streams) for walk in (0.0, 0.02))
    assert abs(walking.parameters["mgl"] - 1.65) < 0.05
    assert walking.surprise.widened <= still.surprise.widened


@pytest.mark.parametrize("make", [ekf, ukf])
def test_a_double_pendulum_is_learned_from_a_fifth_of_six_parameters(make):
    """Errors of the model at the start are not taken for noise of the sensors."""
    system = double_pendulum().system()
    rng = np.random.default_rng(2)
    u = 3 * np.repeat(rng.uniform(-1, 1, size=(80, 2)), 25, axis=0)
    x = system.simulator(0.005).states(system.vector(), np.zeros(4), u)
    y = x[:, :2] + 1e-3 * rng.normal(size=(2000, 2))
    data = Trajectory(np.arange(2000) * 0.005, u, y, PlantSpec(system.inputs, system.outputs, 0.005))
    learned = [one.name for one in system.parameters if not one.fixed]
    state = passed(make("double-pendulum", start={name: 0.2 * system.values()[name] for name in learned}), [data])
    for name in ("lc1", "lc2", "I2", "b1", "b2"):
        assert state.parameters[name] == pytest.approx(system.values()[name], rel=0.05), name
    assert np.sqrt(state.noise) == pytest.approx(1e-3, rel=0.1)


def test_what_no_parameters_explain_becomes_noise_and_the_estimate_stays():
    system = pendulum().system()
    hidden = compose(system, [Placed(builtin()["coulomb_friction"], "theta", {"Fc": 0.15})])
    rng = np.random.default_rng(0)
    u = np.repeat(rng.uniform(-1, 1, size=(300, 1)), 10, axis=0)
    y = hidden.simulator(0.02).rollout(hidden.vector(TRUTH), np.zeros(hidden.nx), u)
    spec = PlantSpec(system.inputs, system.outputs, 0.02)
    state = passed(ekf("pendulum"), [Trajectory(np.arange(3000) * 0.02, u, y + 1e-4 * rng.normal(size=y.shape), spec)])
    assert np.sqrt(state.noise[0]) > 3e-4
    for name in ("J", "mgl"):
        assert state.parameters[name] == pytest.approx(TRUTH[name], rel=0.3), name


def test_regret_is_small_beside_the_noise_and_said_to_be_best_found():
    data = stream(n=600)
    found = regret(ekf("pendulum"), [data], rng=np.random.default_rng(0))
    assert not found.exact
    assert np.isfinite(found.total)
    # after the first hundred samples the filter predicts as the batch fit does, to half of the noise's power
    tail = (found.cumulative[-1] - found.cumulative[100]) / (len(found.cumulative) - 100)
    assert abs(tail) < 0.5 * (2e-3) ** 2


def test_options_out_of_range_are_refused():
    with pytest.raises(InputError, match="doubt"):
        ekf("pendulum", doubt=0.0).init(stream(n=20).spec, rng=np.random.default_rng(0))


@given(seed=st.integers(0, 2**32 - 1), unit=st.floats(1e-3, 1e3))
def test_the_noise_of_the_sensors_needs_no_model_and_units_scale_it(seed, unit):
    rng = np.random.default_rng(seed)
    y = np.sin(0.02 * np.arange(400))[:, None] + 1e-3 * rng.normal(size=(400, 1))

    def noise(signal):
        surprise = Surprise.none(1).begun(signal[0])
        for row in signal[1:]:
            surprise = surprise.heard([Channel("y", "m")], row)
        return float(surprise.noise[0])

    assert np.sqrt(noise(y)) == pytest.approx(1e-3, rel=0.35)
    assert noise(unit * y) == pytest.approx(unit**2 * noise(y), rel=1e-9)


@given(seed=st.integers(0, 2**32 - 1))
def test_predictions_as_wrong_as_they_say_are_no_surprise_and_worse_ones_are(seed):
    rng = np.random.default_rng(seed)
    surprise = replace(Surprise.none(1).begun(np.zeros(1)), begin=np.ones(1), misfit=np.ones(1))
    spread = np.array([[3.0]])
    for _ in range(100):
        factor, surprise = surprise.factor(np.clip(2.0 * rng.normal(size=1), -5, 5), spread)
    assert surprise.widened <= 10
    for _ in range(100):
        factor, surprise = surprise.factor(np.array([30.0]), spread)
    assert factor > 10
