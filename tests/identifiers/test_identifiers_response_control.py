"""Control straight from a response: beside the optimal regulator of the true plant, and inside its certificate."""

from __future__ import annotations

import functools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import lfilter

from harness.errors import FitError, InputError
from harness.models.lqr import kalman_gain, lqr_gain
from harness.registry import create
from harness.signals import Channel, Dataset, PlantSpec, Run, Trajectory
from identifiers.linear.response_control import (
    ResponseController,
    StateController,
    UncertainResponse,
    _cost,
    _largest_gain,
    _unexplained,
    estimated_response,
    response_controller,
)

A = 0.95 * np.array([[0.9, 0.2], [-0.2, 0.9]])
B, C = np.array([[0.0], [1.0]]), np.array([[1.0, 0.0]])
SPEC = PlantSpec((Channel("u"),), (Channel("y"),), 1.0)
Q, R = np.eye(1), 0.1 * np.eye(1)
TRUE = np.array([np.zeros((1, 1)), *(C @ np.linalg.matrix_power(A, i) @ B for i in range(150))])


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


@functools.cache
def record(samples: int, seed: int, a: float = 1.0, pole: float = 0.0, gain: float = 0.0) -> Trajectory:
    """Return a record under inputs of one pole and feedback, white disturbances of both states and sensor noise."""
    draw, x, y = rng(seed), np.zeros(2), np.zeros((samples, 1))
    u = draw.normal(size=(samples, 1))
    u = lfilter([np.sqrt(1.0 - pole**2)], [1.0, -pole], u, axis=0)
    for k in range(samples):
        y[k] = C @ x + 0.1 * draw.normal()
        u[k] -= gain * y[k]
        x = a * A @ x + B @ u[k] + 0.3 * draw.normal(size=2)
    return Trajectory(np.arange(samples, dtype=float), u, y, SPEC)


@functools.cache
def natural() -> np.ndarray:
    long = record(3200, 999)
    return _unexplained(TRUE, long.y, long.u)[200:]


def wrong_by(found: UncertainResponse) -> float:
    """Return the largest gain over all frequencies of what an estimate is wrong by."""
    return _largest_gain(TRUE - np.pad(found.markov, ((0, len(TRUE) - len(found.markov)), (0, 0), (0, 0))))


def optimal() -> float:
    """Return the cost of the LQG regulator that knows the plant and the covariances."""
    feedback = lqr_gain(A, B, C.T @ Q @ C, R)
    gain = kalman_gain(A, C, 0.09 * np.eye(2), 0.01 * np.eye(1))
    assert feedback is not None
    assert gain is not None
    known = StateController(A, B, C, feedback, np.linalg.solve(A, gain))
    return _cost(known, [natural()], TRUE, Q, R)


def test_it_comes_to_the_optimal_regulator_as_the_record_grows():
    best, lost = optimal(), {}
    for samples in (1000, 10_000):
        made = [response_controller(estimated_response([record(samples, s)], 50), Q, R, 10) for s in range(2)]
        lost[samples] = np.mean([_cost(one, [natural()], TRUE, Q, R) for one in made]) / best - 1.0
    assert best < 0.7 * _cost(None, [natural()], TRUE, Q, R)
    assert lost[10_000] < 0.015
    assert lost[10_000] < 0.5 * lost[1000]


def test_the_bound_holds_and_falls_as_the_root_of_the_record():
    bounds = {}
    for samples in (1500, 6000):
        found = [estimated_response([record(samples, s)], 50) for s in range(6)]
        assert all(wrong_by(one) <= one.bound for one in found)
        bounds[samples] = np.mean([one.bound for one in found])
    # the shorter record loses more than the root: its inputs are less even, and its spectrum is rougher
    assert 1.9 < bounds[1500] / bounds[6000] < 3.0


def test_smooth_inputs_tell_less_and_the_bound_says_so():
    """Of inputs with a pole at 0.97 the bound for white ones lay below the error."""
    bounds = {}
    for pole in (0.0, 0.97):
        found = [estimated_response([record(2000, s, pole=pole)], 50) for s in range(5)]
        assert all(wrong_by(one) <= one.bound for one in found)
        bounds[pole] = np.mean([one.bound for one in found])
    assert bounds[0.97] > 4.0 * bounds[0.0]


def test_a_loop_and_inputs_that_act_at_once_are_refused():
    with pytest.raises(FitError, match="past outputs predict the inputs"):
        estimated_response([record(2000, 0, gain=0.3)], 50)
    one = record(2000, 0)
    with pytest.raises(FitError, match="move the inputs on by a sample"):
        estimated_response([Trajectory(one.t, one.u, one.y + one.u, SPEC)], 50)


@pytest.mark.parametrize("modulus", [1.0, 1.01])
@pytest.mark.parametrize("pole", [0.0, 0.8])
@pytest.mark.parametrize("turn", [0.0, 0.4])
def test_a_plant_that_does_not_forget_is_refused(modulus, pole, turn):
    """An integrator and undamped or unstable modes, among noise that they do not forget either."""
    draw, x = rng(5), np.zeros(2)
    u, y = lfilter([np.sqrt(1.0 - pole**2)], [1.0, -pole], draw.normal(size=(1500, 1)), axis=0), np.zeros((1500, 1))
    mode = modulus * np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    for k in range(1500):
        y[k] = x[0] + 0.1 * draw.normal()
        x = mode @ x + np.array([1.0, 0.5]) * u[k] + 0.1 * draw.normal(size=2)
    with pytest.raises(FitError, match="has not died out"):
        estimated_response([Trajectory(np.arange(1500.0), u, y, SPEC)], 50)


def test_a_load_that_wanders_is_no_memory_of_the_plant():
    one = record(1500, 0)
    load = 0.1 * np.cumsum(rng(9).normal(size=(1500, 1)), axis=0)
    estimated_response([Trajectory(one.t, one.u, one.y + load, SPEC)], 50)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000), st.floats(0.05, 0.9))
def test_what_is_vouched_for_is_stable(seed, share):
    """Small gain: any error Delta with ``|Delta| |M| < 1`` leaves the inputs within ``1 / (1 - |Delta| |M|)``."""
    draw = rng(seed)
    markov = np.concatenate([np.zeros((1, 1, 1)), draw.normal(size=(9, 1, 1)) * 0.8 ** np.arange(9)[:, None, None]])
    made = ResponseController(draw.normal(size=(4, 1, 1)), markov)
    delta = np.concatenate([np.zeros((1, 1, 1)), draw.normal(size=(9, 1, 1))])
    delta *= share / (made.gain * _largest_gain(delta))
    noise = draw.normal(size=(600, 1))
    _, wanted = made.closed(noise, markov)
    _, given_ = made.closed(noise, markov + delta)
    assert np.linalg.norm(given_) <= np.linalg.norm(wanted) / (1.0 - share) * 1.01


def data(samples: int) -> Dataset:
    first, second = record(samples, 0), record(1500, 1)
    return Dataset("lightly damped", (Run(first, "estimation"), Run(second, "validation")))


def test_the_analysis_says_whether_the_data_suffice():
    short, long = (create("analyses", "response-control", length=50).of(data(n), rng=rng()) for n in (400, 20_000))
    assert "do not suffice" in short.words[1]
    costs = {row["controller"]: row["cost"] for row in long.rows}
    assert costs["response"] < 1.05 * costs["LQG"] < costs["none"]
    margins = {row["controller"]: row["bound x gain"] for row in long.rows}
    assert margins["response, vouched for"] < 0.9
    with pytest.raises(InputError, match="taps"):
        create("analyses", "response-control", taps=0).of(data(400), rng=rng())
    slow = record(2000, 3, a=1.1)
    with pytest.raises(FitError, match="died out"):
        estimated_response([slow], 20)
