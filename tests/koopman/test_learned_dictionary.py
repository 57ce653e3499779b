"""Functions that are learned: the gradient of their search, few for many monomials, none that do not pay."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harness.errors import FitError
from harness.scoring import simulation_error
from harness.signals import Channel, PlantSpec, Trajectory
from identifiers.koopman.koopman import Edmdc, KoopmanModel
from identifiers.koopman.learned import Stretch, _Windows
from plants.equations.ode import pendulum_ode

STATES = PlantSpec((Channel("u", "N m"),), (Channel("theta", "rad"), Channel("theta_rate", "rad/s")), 0.05)


def swings(count: int, torque: float, seed: int) -> list[Trajectory]:
    """Return records of two seconds from anywhere below the top of a pendulum."""
    rng, plant, found = np.random.default_rng(seed), pendulum_ode(sample_time=0.05), []
    for _ in range(count):
        start = rng.uniform([-2, -3], [2, 3])
        u = np.repeat(rng.uniform(-torque, torque, (8, 1)), 5, axis=0)
        plant.reset(rng=rng, x0={"theta": start[0], "theta_rate": start[1]})
        x = np.vstack([start, plant.rollout_truth(u[:-1])[1]])
        found.append(Trajectory(0.05 * np.arange(40), u, x, STATES))
    return found


@pytest.fixture(scope="module")
def pendulum() -> tuple[list[Trajectory], list[Trajectory]]:
    return swings(60, 0.5, 0), swings(60, 0.0, 1)


def error(model: KoopmanModel, test: list[Trajectory]) -> float:
    """Return the error of free runs over two seconds, root mean square [rad]."""
    return float(np.sqrt(np.mean([simulation_error(model, one).rms[0] ** 2 for one in test])))


@given(st.integers(0, 10_000), st.integers(0, 2), st.integers(1, 2), st.integers(1, 6))
@settings(max_examples=10, deadline=None)
def test_the_gradient_is_that_of_the_error_with_the_matrix_eliminated(seed, nu, k, horizon):
    rng = np.random.default_rng(seed)
    stretches = []
    for _ in range(3):
        z = rng.normal(size=(20, k))
        stretches.append(Stretch(z, np.hstack([z, np.ones((20, 1))]), rng.normal(size=(20, nu))))
    windows, units = _Windows(stretches, k, horizon), rng.normal(size=(2, k + 1))
    found = windows.cost_and_gradient(units, 1e-10)[1]
    for place in np.ndindex(units.shape):
        ends = []
        for step in (1e-5, -1e-5):
            moved = units.copy()
            moved[place] += step
            ends.append(windows.cost_and_gradient(moved, 1e-10)[0])
        assert found[place] == pytest.approx((ends[0] - ends[1]) / 2e-5, rel=1e-4, abs=1e-6)


@pytest.mark.slow
def test_eight_learned_functions_predict_as_far_as_eighteen_monomials(pendulum):
    """Two seconds; measured 0.198 without, 0.076 with eight, 0.071 with the monomials of degree 2 to 5 [rad]."""
    learn, test = pendulum
    model = Edmdc(degree=1, learned=8, horizon=39).fit(learn, rng=np.random.default_rng(0))
    plain, monomials = (Edmdc(degree=n).fit(learn, rng=np.random.default_rng(0)) for n in (1, 5))
    assert (model.lifted, monomials.lifted) == (11, 21)
    assert error(model, test) < 0.5 * error(plain, test)
    assert error(model, test) < 1.15 * error(monomials, test)
    said = model.notes["learned"]
    assert said["kept"] == len(model.dictionary.units) == 8
    assert said["held_out_after"] < 0.95 * said["held_out_before"]
    again = KoopmanModel.from_dict(json.loads(json.dumps(model.to_dict())))
    assert np.array_equal(again.initial_state(test[0]), model.initial_state(test[0]))


def test_where_nothing_bends_nothing_is_learned():
    rng = np.random.default_rng(0)
    u, x = rng.normal(size=(400, 1)), np.zeros((400, 2))
    for k in range(399):
        x[k + 1] = np.array([[0.9, 0.2], [-0.1, 0.8]]) @ x[k] + [0.0, 1.0] * u[k]
    record = Trajectory(0.05 * np.arange(400), u, x + 0.05 * rng.normal(size=x.shape), STATES)
    model = Edmdc(degree=1, learned=4).fit([record], rng=rng)
    assert model.notes["learned"]["kept"] == 0
    assert model.lifted == 3


def test_too_little_to_hold_out_is_refused(pendulum):
    with pytest.raises(FitError, match=r"two stretches and more of over 39 samples"):
        Edmdc(learned=4, horizon=39).fit(pendulum[0][:1], rng=np.random.default_rng(0))
    with pytest.raises(FitError, match="learned >= 0"):
        Edmdc(learned=-1).fit(pendulum[0], rng=np.random.default_rng(0))
