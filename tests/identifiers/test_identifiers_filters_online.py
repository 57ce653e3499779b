"""Filters that learn parameters online: near the batch fit, pure, across seams, with a drift where asked."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from harness.errors import InputError
from harness.physics.models import cart_pole, pendulum
from harness.scoring import regret
from harness.signals import Channel, PlantSpec, Trajectory
from identifiers.filters_online import ekf, ukf

TRUTH = {"J": 0.2, "b": 0.05, "mgl": 1.3}


def stream(seed=0, n=1200, noise=2e-3, truth=TRUTH):
    system = pendulum().system()
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-1, 1, size=(n // 10, 1)), 10, axis=0)
    y = system.simulator(0.02).rollout(list(truth.values()), [0.5, 0.0], u)
    spec = PlantSpec(system.inputs, system.outputs, 0.02)
    return Trajectory(np.arange(n) * 0.02, u, y + noise * rng.normal(size=y.shape), spec)


def run(online, records):
    state = online.init(records[0].spec, rng=np.random.default_rng(0))
    for one in records:
        state = online.start(state, one.y[0])
        for k in range(len(one) - 1):
            state = online.update(state, one.u[k], one.y[k + 1])
    return state


@pytest.mark.parametrize("make", [ekf, ukf])
def test_parameters_converge_from_half_and_double(make):
    """Fifty per cent off at the start, one angle measured; sensor noise is learned, too."""
    start = {"J": 0.1, "b": 0.1, "mgl": 2.0}
    state = run(make("pendulum", start=start), [stream(0), stream(1)])
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
    state = run(make("cart-pole", start={"mc": 1.5, "mp": 0.3, "l": 0.4}), [data])
    for name in ("mc", "mp", "l"):
        assert state.parameters[name] == pytest.approx(system.values()[name], rel=0.05), name


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


def test_a_drift_is_followed_where_it_is_allowed():
    first, second = stream(0), stream(1, truth={"J": 0.2, "b": 0.05, "mgl": 1.8})
    still, walking = (run(ekf("pendulum", walk=walk), [first, second]).parameters["mgl"] for walk in (0.0, 0.1))
    assert abs(walking - 1.8) < 0.05
    assert abs(walking - 1.8) < 0.5 * abs(still - 1.8)


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
