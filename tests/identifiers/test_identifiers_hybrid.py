"""Models that switch, series, trees: exact data give exact models, and a real engine's wall is found."""

from __future__ import annotations

import functools
import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from harness.errors import FitError, InputError
from harness.registry import create
from harness.rng import Streams
from harness.rollout import run
from harness.scoring import equation_error, predict, simulation_error
from harness.scoring.predictive import probability_score
from harness.signals import Channel, PlantSpec, Trajectory
from identifiers.common.lag_state import regression_data
from identifiers.hybrid.piecewise_affine import PiecewiseAffine
from identifiers.learned.trees import RandomForest, grow_tree
from identifiers.learned.volterra import Volterra
from identifiers.linear.least_squares import Arx

SPEC = PlantSpec((Channel("u", "V"),), (Channel("y", "m"),), 0.1)


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def record(u: np.ndarray, y: np.ndarray) -> Trajectory:
    return Trajectory(0.1 * np.arange(len(u)), u[:, None], y[:, None], SPEC)


def switching(samples: int, seed: int, noise: float = 0.0) -> tuple[Trajectory, np.ndarray]:
    """Return a record of two affine modes, and the mode of each transition."""
    draw = rng(seed)
    u, y, modes = draw.uniform(-2, 2, samples), np.zeros(samples), np.zeros(samples, dtype=int)
    for k in range(samples - 1):
        modes[k] = y[k] > 0.4
        a, b, c = ((0.8, 0.5, 0.0), (-0.4, 0.3, 0.7))[modes[k]]
        y[k + 1] = a * y[k] + b * u[k] + c + noise * draw.normal()
    return record(u, y), modes[:-1]


@functools.cache
def wall(noise: float) -> tuple[Trajectory, Trajectory]:
    plant = create("plants", "cart-wall-pymunk", outputs=["x", "x_rate"], substeps=60)
    options = dict(duration=40.0, amplitude=4.0, band=[0.05, 4.0], noise=noise)
    scenario, streams = create("scenarios", "multisine", **options), Streams("cart-wall-pymunk", "multisine", 0)
    first, second = (run(plant, scenario, streams=streams, role=f"{role}/0") for role in ("estimation", "validation"))
    return first, second


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 10_000))
def test_exact_switching_data_give_the_exact_model(seed):
    data, _ = switching(400, seed)
    held, modes = switching(300, seed + 1)
    model = PiecewiseAffine(starts=3).fit([data], rng=rng(seed))
    assert model.coefficients[0, 0] == pytest.approx([0.8, 0.5, 0.0], abs=1e-6)
    assert model.coefficients[1, 0] == pytest.approx([-0.4, 0.3, 0.7], abs=1e-6)
    assert (model.mode(regression_data([held], 1)[0]) == modes).mean() > 0.97


def test_noise_moves_coefficients_little_and_bands_are_honest():
    data, _ = switching(2000, 1, noise=0.02)
    held, modes = switching(2000, 2, noise=0.02)
    model = PiecewiseAffine(starts=3).fit([data], rng=rng())
    assert model.coefficients[:, 0] == pytest.approx(np.array([[0.8, 0.5, 0.0], [-0.4, 0.3, 0.7]]), abs=0.01)
    assert (model.mode(regression_data([held], 1)[0]) == modes).mean() > 0.98
    assert probability_score(model, held).coverage[2, 0] == pytest.approx(0.9, abs=0.03)


def test_a_cart_at_a_soft_wall_of_another_engine():
    data, held = wall(1e-4)
    model = PiecewiseAffine(starts=2).fit([data.measured()], rng=rng())
    touching = held.x[:-1, 0] > 0.2
    assert 0.02 < touching.mean() < 0.2
    assert (model.mode(regression_data([held], 1)[0]) == touching).mean() > 0.984

    def sampled(wall_stiffness: float) -> np.ndarray:
        slope = np.array([[0, 1, 0, 0], [-4 - wall_stiffness, -1, 1, 0.2 * wall_stiffness], [0] * 4, [0] * 4])
        return expm(0.02 * slope)[:2]

    assert model.coefficients[0] == pytest.approx(sampled(0.0), abs=1e-3)
    assert model.coefficients[1] == pytest.approx(sampled(200.0), abs=0.02)
    affine = Arx(order=1).fit([data.measured()], rng=rng())
    assert (simulation_error(model, held).nrmse < 0.02 * simulation_error(affine, held).nrmse).all()


def test_one_mode_is_a_linear_regression():
    data, _ = switching(300, 3)
    one = PiecewiseAffine(modes=1).fit([data], rng=rng())
    other = Arx(order=1).fit([data], rng=rng())
    assert predict(one, data)[1:] == pytest.approx(predict(other, data)[1:], abs=1e-6)


def test_a_volterra_plant_is_identified_and_forgets_its_start():
    u = rng().normal(size=3000)
    y = np.zeros(3000)
    for k in range(3, 3000):
        y[k] = 0.5 + u[k] + 0.4 * u[k - 1] + 0.3 * u[k] * u[k - 2] - 0.2 * u[k - 1] ** 2
    data, held = record(u[:2000], y[:2000]), record(u[2000:], y[2000:])
    quadratic = Volterra(memory=4).fit([data], rng=rng())
    assert simulation_error(quadratic, held).nrmse[0] < 1e-5
    linear = Volterra(memory=4, order=1).fit([data], rng=rng())
    assert simulation_error(linear, held).nrmse[0] > 0.3
    x = quadratic.initial_state(held)
    slow = []
    for k in range(60):
        slow.append(quadratic.output(x, held.u[k]))
        x = quadratic.step(x, held.u[k])
    assert quadratic.free_run(quadratic.initial_state(held)[None], held.u[None, :60])[0] == pytest.approx(
        np.array(slow)
    )


def test_trees_by_hand_and_a_forest_smooths():
    x = np.array([[0.0, 5.0], [1.0, 5.0], [2.0, 5.0], [3.0, 5.0]])
    tree = grow_tree(x, np.array([[0.0], [0.0], [4.0], [4.0]]), leaf=1, features=2, rng=rng())
    assert tree.feature.tolist() == [0, -1, -1]
    assert tree.threshold[0] == 1.5
    data, _ = switching(1500, 4, noise=0.05)
    held, _ = switching(800, 5, noise=0.05)
    single, many = (RandomForest(order=1, trees=n, increments=False).fit([data], rng=rng()) for n in (1, 20))
    score = probability_score(many, held)
    assert equation_error(many, held).nrmse[0] < equation_error(single, held).nrmse[0] < 0.5
    assert score.coverage[2, 0] == pytest.approx(0.9, abs=0.06)


@settings(max_examples=15, deadline=None)
@given(st.integers(1, 4), st.integers(0, 10_000))
def test_a_tree_never_leaves_the_range_of_its_targets(leaf, seed):
    draw = rng(seed)
    x, y = draw.normal(size=(60, 3)), draw.normal(size=(60, 2))
    tree = grow_tree(x, y, leaf=leaf, features=2, rng=draw)
    far = tree(100 * draw.normal(size=(40, 3)))
    assert (far >= y.min(axis=0) - 1e-12).all()
    assert (far <= y.max(axis=0) + 1e-12).all()
    if leaf == 1:
        assert tree(x) == pytest.approx(y), "distinct rows are told apart"


def test_refusals():
    data, _ = switching(20, 0)
    with pytest.raises(FitError, match="too few"):
        PiecewiseAffine(modes=4).fit([data], rng=rng())
    with pytest.raises(InputError, match="order"):
        Volterra(order=3).fit([data], rng=rng())
    alone = Trajectory(data.t, np.zeros((20, 0)), data.y, PlantSpec((), SPEC.outputs, 0.1))
    with pytest.raises(FitError, match="no inputs"):
        Volterra(memory=4).fit([alone], rng=rng())


@pytest.mark.parametrize(("lines", "said"), [(1, True), (4, True), (15, False)])
def test_an_input_of_few_lines_leaves_most_of_a_kernel_open_and_that_is_said(lines: int, said: bool) -> None:
    rng, k = np.random.default_rng(0), np.arange(1000)
    u = sum(
        np.sin(w * k + phase) for w, phase in zip(np.linspace(0.1, 3.0, lines), rng.uniform(0, 6, lines), strict=True)
    )
    y = np.r_[0.0, np.convolve(u, 0.5 ** np.arange(30))[:999]] + 0.01 * rng.standard_normal(1000)
    spec = PlantSpec((Channel("u"),), (Channel("y"),), 0.1)
    model = Volterra(memory=20, order=1).fit([Trajectory(k * 0.1, u[:, None], y[:, None], spec)], rng=rng)
    assert (f"the inputs excite {2 * lines} lags of 20" in model.notes.get("warning", "")) == said


def test_where_the_second_mode_begins_is_said():
    data, _ = switching(600, 3)
    found = PiecewiseAffine().fit([data], rng=rng()).findings
    assert found[0].startswith("2 modes, in which ")
    level = re.fullmatch(r"the second where y (?:[+-] \S+ u )?- (\S+) > 0", found[1])
    assert level is not None
    assert float(level[1]) == pytest.approx(0.4, abs=0.05)


def test_a_mode_in_which_no_sample_lies_is_no_mode_that_was_found():
    plant = create("plants", "cart-wall-pymunk", outputs=["x", "x_rate"])
    push = create("scenarios", "multisine", duration=14.0, amplitude=4.0, band=[0.05, 4.0], noise=1e-4)
    data = run(plant, push, streams=Streams("w", "s", 0), role="estimation/0").measured()
    given = PiecewiseAffine(starts=1).fit([data], rng=rng())
    assert 0 in given.notes["samples"], "the record holds two samples of contact"
    assert "no sample lies in 1 of 2 modes" in given.notes["warning"]
    chosen = PiecewiseAffine(modes=None, starts=2).fit([data], rng=rng())
    assert 0 not in chosen.notes["samples"]
    assert len(chosen.coefficients) == chosen.notes["modes"]
