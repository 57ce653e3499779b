"""Linear dynamics around a static curve: found again, its gradients exact, its state told by a window."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import lfilter

from harness.errors import FitError, InputError
from harness.scoring import simulation_error
from harness.signals import Channel, PlantSpec, Trajectory
from identifiers.blocks.curve import Knots
from identifiers.blocks.wiener_hammerstein import WienerHammerstein, WienerHammersteinModel
from identifiers.blocks.wiener_hammerstein_fit import Blocks, shared_out
from identifiers.linear.prediction_error import PredictionError

SPEC = PlantSpec((Channel("u", "V"),), (Channel("y", "m"),), 0.1)
CURVES = {"tanh": np.tanh, "bent": lambda x: 0.4 * x + np.tanh(2.0 * x), "diode": lambda x: np.maximum(x, -0.3)}


def record(front: float, back: float, curve: str, seed: int, samples: int = 2500, noise: float = 0.0) -> Trajectory:
    """Return a record of two first-order blocks around a curve."""
    rng = np.random.default_rng(seed)
    u = rng.uniform(-2.0, 2.0, samples)
    inner = lfilter([np.sqrt(1.0 - front**2)], [1.0, -front], u)
    y = 3.0 + lfilter([0.0, 1.0 - back], [1.0, -back], CURVES[curve](inner))
    y = y + noise * y.std() * rng.normal(size=samples)
    return Trajectory(np.arange(samples) * 0.1, u[:, None], y[:, None], SPEC)


@settings(max_examples=3)
@given(st.floats(0.3, 0.9), st.floats(0.3, 0.9), st.sampled_from(sorted(CURVES)), st.integers(0, 1000))
def test_two_blocks_around_a_curve_are_found_again(front: float, back: float, curve: str, seed: int) -> None:
    learn, test = (record(front, back, curve, seed + k, noise=0.01 * (1 - k)) for k in (0, 1))
    model = WienerHammerstein(order=2, knots=14).fit([learn], rng=np.random.default_rng(0))
    assert simulation_error(model, test).nrmse[0] < 0.02
    assert model.std[0] == pytest.approx(0.01 * learn.y.std(), rel=0.3)


@pytest.mark.parametrize(("front", "back", "ends"), [(0.0, 0.8, (0, 1)), (0.8, 0.0, (1, 0))])
def test_hammerstein_and_wiener_models_are_among_them(front: float, back: float, ends: tuple[int, int]) -> None:
    learn, test = (record(front, back, "tanh", seed) for seed in (0, 1))
    model = WienerHammerstein(order=1, knots=14).fit([learn], rng=np.random.default_rng(0))
    assert (model.notes["front"], model.notes["back"]) == ends
    assert simulation_error(model, test).nrmse[0] < 0.01


@given(st.integers(0, 2**32 - 1), st.integers(0, 1), st.integers(1, 3))
def test_gradients_are_those_of_differences(seed: int, first: int, points: int) -> None:
    rng = np.random.default_rng(seed)
    poles = rng.uniform(-0.8, 0.8, (2, 2))
    a1, a2 = (np.poly(one) for one in poles)
    b2 = np.hstack([np.zeros((points, first)), rng.normal(size=(points, 3 - first))])
    blocks = Blocks(rng.normal(size=(points, 3)), a1, b2, a2, rng.normal(size=6), Knots(-1.0, 1.0, 6))
    u = rng.normal(size=40)
    _, columns = blocks.gradients(u, first)
    assert columns.shape == (40, points * 3 + 2 + points * (3 - first) + 2 + 6)
    for k in range(columns.shape[1]):
        by = 1e-6 * np.eye(columns.shape[1])[k]
        difference = (blocks.moved(by, first).outputs(u)[2] - blocks.moved(-by, first).outputs(u)[2]) / 2e-6
        assert columns[:, k] == pytest.approx(difference, rel=1e-4, abs=1e-5 * (1.0 + np.abs(difference).max()))


def test_the_state_is_told_by_a_window_and_kept_by_steps() -> None:
    learn = record(0.8, 0.9, "tanh", 0)
    model = WienerHammerstein(order=2).fit([learn], rng=np.random.default_rng(0))
    again = WienerHammersteinModel.from_dict(model.to_dict())
    late = learn[1500:1800]
    x = again.initial_state(late[:50])
    run = again.free_run(x[None], late.u[None])[0]
    assert np.sqrt(np.mean((run - late.y) ** 2)) < 0.01 * late.y.std()
    states = np.tile(x, (2, 1))
    for k in range(20):
        assert again.output(states, late.u[k]) == pytest.approx(np.tile(run[k], (2, 1)), abs=1e-12)
        states = again.step(states, late.u[k])


@pytest.mark.parametrize("direct", [False, True])
def test_points_between_samples_step_as_they_run_and_are_kept_in_a_file(direct: bool) -> None:
    """A curve at several points of a sample interval has one state, and steps along it are its free run."""
    rng = np.random.default_rng(5)
    u = rng.uniform(-2.0, 2.0, 3000)
    inner = lfilter([0.3], [1.0, -0.7], u)
    fine = 0.5 * (np.abs(inner) + np.abs(0.5 * (inner + np.concatenate([[0.0], inner[:-1]]))))
    y = lfilter([0.0 if not direct else 0.4, 0.3], [1.0, -0.6], fine) + 1e-3 * rng.normal(size=len(u))
    learn, test = (
        Trajectory(np.arange(1500) * 0.1, u[part, None], y[part, None], SPEC)
        for part in (slice(0, 1500), slice(1500, None))
    )
    plain, finer = (
        WienerHammerstein(order=2, knots=14, direct=direct, between=k).fit([learn], rng=np.random.default_rng(0))
        for k in (1, 2)
    )
    assert len(finer.blocks.b1) == 2
    assert simulation_error(finer, test).rms[0] < 0.8 * simulation_error(plain, test).rms[0]
    again = WienerHammersteinModel.from_dict(json.loads(json.dumps(finer.to_dict())))
    x = again.initial_state(test)
    run = again.free_run(x[None], test.u[None])[0]
    for k in range(200):
        assert again.output(x, test.u[k]) == pytest.approx(run[k], abs=1e-9)
        x = again.step(x, test.u[k])


def test_a_model_of_an_earlier_version_is_refused() -> None:
    content = WienerHammerstein(order=1, knots=14).fit(
        [record(0.0, 0.8, "tanh", 0)], rng=np.random.default_rng(0)
    ).to_dict()  # fmt: skip
    with pytest.raises(InputError, match="fit it again"):
        WienerHammersteinModel.from_dict(content | {"b1": content["b1"][0], "b2": content["b2"][0]})


def test_beyond_its_knots_a_curve_is_straight() -> None:
    knots = Knots(-1.0, 2.0, 8)
    coefficients = np.random.default_rng(0).normal(size=8)
    x = np.linspace(-4.0, 5.0, 91)
    assert knots.basis(x) @ coefficients == pytest.approx(knots.values(coefficients, x))
    assert np.diff(knots.values(coefficients, x[x <= -1.0]), 2) == pytest.approx(0.0, abs=1e-12)
    slopes = (knots.values(coefficients, x + 1e-6) - knots.values(coefficients, x - 1e-6)) / 2e-6
    assert knots.slopes(coefficients, x) == pytest.approx(slopes, abs=1e-5)


def test_a_linear_model_with_a_pole_at_the_rim_is_a_start_all_the_same() -> None:
    data = record(0.9, 0.5, "tanh", 0, samples=1500)
    pairs = [((data.u - data.u.mean())[:, 0], (data.y - data.y.mean())[:, 0])]
    starts = shared_out(np.array([0.1]), np.poly([0.9999, 0.5]), pairs, 8, 1)
    assert starts
    assert all(start.stable() for start in starts)


def hardening(seed: int, samples: int = 700) -> Trajectory:
    """Return a record of a mass on a spring that hardens: no curve in a row of blocks does that."""
    rng = np.random.default_rng(seed)
    u = 4.0 * lfilter([1.0], [1.0, -0.8], rng.normal(size=samples))
    q, v, fine, seen = 0.0, 0.0, 20, np.zeros(samples)
    for k in range(samples):
        seen[k] = q
        for _ in range(fine):
            v += 0.1 / fine * (u[k] - 0.5 * v - 4.0 * q - q**3)
            q += 0.1 / fine * v
    seen += 0.005 * rng.normal(size=samples)
    return Trajectory(np.arange(samples) * 0.1, u[:, None], seen[:, None], SPEC)


@pytest.mark.parametrize("seed", [0, 6])
def test_a_plant_that_bends_elsewhere_does_not_pull_the_ends_of_the_curve(seed: int) -> None:
    learn, test = hardening(seed), hardening(seed + 1)
    model = WienerHammerstein(order=2).fit([learn], rng=np.random.default_rng(0))
    linear = PredictionError(structure="oe", order=2).fit([learn], rng=np.random.default_rng(0))
    free, straight = (simulation_error(one, test).nrmse[0] for one in (model, linear))
    assert free < 1.3 * straight
    assert "straight line" in model.notes["warning"]


def test_what_it_cannot_take_is_refused() -> None:
    two = PlantSpec((Channel("u"), Channel("v")), SPEC.outputs, 0.1)
    u = np.random.default_rng(0).normal(size=(500, 2))
    with pytest.raises(FitError, match="one input, one output"):
        WienerHammerstein().fit([Trajectory(np.arange(500) * 0.1, u, u[:, :1], two)], rng=np.random.default_rng(0))
    with pytest.raises(FitError, match="knots at least 4"):
        WienerHammerstein(knots=3).fit([record(0.5, 0.5, "tanh", 0)], rng=np.random.default_rng(0))
    with pytest.raises(FitError, match="too short"):
        WienerHammerstein().fit([record(0.5, 0.5, "tanh", 0)[:100]], rng=np.random.default_rng(0))
