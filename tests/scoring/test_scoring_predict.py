"""Predictions of every horizon, errors in windows and scores equal what one computes by hand."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from harness.errors import InputError
from harness.scoring import Score, equation_error, errors, predict, simulation_error
from harness.signals import Channel, FloatArray, PlantSpec, Trajectory
from identifiers.finite.mdp import MdpModel
from identifiers.linear.least_squares import LinearModel

SPEC = PlantSpec((Channel("u", "V"),), (Channel("y", "m"),), 0.5)


def record(y: Any, u: Any = None, spec: PlantSpec = SPEC) -> Trajectory:
    y = np.asarray(y, dtype=float).reshape(-1, spec.ny)
    u = np.zeros((len(y), spec.nu)) if u is None else np.asarray(u, dtype=float).reshape(len(y), spec.nu)
    return Trajectory(np.arange(len(y)) * spec.sample_time, u, y, spec)


@dataclass(frozen=True)
class Scalar:
    """x+ = a x + b u, y = x; a seen output replaces the state. The initial state is the first output."""

    a: float
    b: float = 0.0
    spec: PlantSpec = SPEC
    burn_in: int = 0

    def initial_state(self, data: Trajectory) -> FloatArray:
        assert data.x is None, "the truth was shown to a model"
        return np.array(data.y[0])

    def output(self, x: FloatArray, u: FloatArray) -> FloatArray:
        return x

    def step(self, x: FloatArray, u: FloatArray) -> FloatArray:
        return self.a * x + self.b * u.sum(axis=-1, keepdims=True)

    def correct(self, x: FloatArray, u: FloatArray, y: FloatArray) -> FloatArray:
        return np.array(y)

    def to_dict(self) -> dict[str, Any]:
        return {"kind": "scalar"}


def test_one_step_ahead_is_the_map_of_the_last_output():
    data = record([1.0, 4.0, -2.0], [10.0, 20.0, 30.0])
    found = predict(Scalar(0.5, 0.1), data, 1)
    assert np.isnan(found[0, 0])
    assert found[1:, 0].tolist() == [0.5 * 1.0 + 1.0, 0.5 * 4.0 + 2.0]


def test_three_steps_ahead_use_the_inputs_between():
    data = record([1.0, 4.0, -2.0, 8.0, 3.0], [10.0, 20.0, 30.0, 40.0, 50.0])
    found = predict(Scalar(0.5, 0.1), data, 3)[:, 0]
    assert np.isnan(found[:3]).all()
    assert found[3] == pytest.approx(((1.0 * 0.5 + 1.0) * 0.5 + 2.0) * 0.5 + 3.0)
    assert found[4] == pytest.approx(((4.0 * 0.5 + 2.0) * 0.5 + 3.0) * 0.5 + 4.0)


def test_free_run_uses_no_output_after_the_initial_state():
    data = record([1.0, 77.0, 77.0, 77.0], [1.0, 2.0, 3.0, 4.0])
    assert predict(Scalar(0.5, 1.0), data, None)[:, 0].tolist() == [1.0, 1.5, 2.75, 4.375]
    given = predict(Scalar(0.5, 1.0), data, None, initial=np.array([9.0]))
    assert given[0, 0] == 9.0


def test_a_horizon_as_long_as_the_record_predicts_nothing():
    assert np.isnan(predict(Scalar(0.5), record([1.0, 2.0, 3.0]), 3)).all()


def test_the_longest_horizon_is_the_free_run_from_a_corrected_start():
    model, data = Scalar(0.9, 0.3), record(np.arange(6.0), np.ones(6))
    assert predict(model, data, 5)[5, 0] == pytest.approx(predict(model, data, None)[5, 0])


@pytest.mark.parametrize("horizon", [0, -1])
def test_a_horizon_that_is_not_positive_is_refused(horizon):
    with pytest.raises(InputError, match="horizon"):
        predict(Scalar(0.5), record([1.0, 2.0]), horizon)


@pytest.mark.parametrize("horizon", [0.0, -1.0, np.nan, np.inf])
def test_a_window_that_is_no_time_is_refused(horizon):
    with pytest.raises(InputError, match="horizon"):
        errors(Scalar(0.5), record([1.0, 2.0]), horizon)


def test_the_true_states_are_not_shown_to_the_model():
    data = replace(record([1.0, 2.0, 3.0]), x=np.full((3, 2), 5.0))
    assert np.isfinite(predict(Scalar(1.0), data, None)).all()


@pytest.mark.parametrize(
    "other",
    [
        PlantSpec((Channel("u", "V"),), (Channel("y", "m"),), 0.25),
        PlantSpec((Channel("v", "V"),), (Channel("y", "m"),), 0.5),
        PlantSpec((Channel("u", "V"),), (Channel("y", "mm"),), 0.5),
        PlantSpec((), (Channel("y", "m"),), 0.5),
    ],
)
def test_other_channels_units_or_sample_time_are_refused(other):
    data = record([1.0, 2.0, 3.0], spec=other)
    for use in (
        lambda: predict(Scalar(1.0), data),
        lambda: errors(Scalar(1.0), data),
        lambda: errors(Scalar(1.0), data, 1.0),
    ):
        with pytest.raises(InputError, match=r"expected.*remedy"):
            use()


def test_windows_start_anew_and_the_last_one_is_short():
    data = record([1.0, 0.0, 8.0, 0.0, 2.0], np.zeros(5))
    miss, how = errors(Scalar(0.5), data, horizon=1.0)  # two samples of 0.5 s
    assert miss[:, 0].tolist() == [0.0, -0.5, 0.0, -4.0, 0.0]
    assert "each window" in how


def test_windows_of_a_model_with_memory_start_from_the_filtered_state():
    class Remembers(Scalar):
        def correct(self, x: FloatArray, u: FloatArray, y: FloatArray) -> FloatArray:
            return x + 0.5 * (y - x)

    data = record([1.0, 3.0, 5.0, 7.0], np.zeros(4))
    miss, how = errors(Remembers(1.0, burn_in=1), data, horizon=1.0)
    # filtered states: 1, 2, 3.5, 5.25; windows [0, 1] and [2, 3] run freely from 1 and 3.5
    assert miss[:, 0].tolist() == [0.0, 2.0, 1.5, 3.5]
    assert "filtered" in how


def test_scores_by_hand():
    data = record([0.0, 2.0, 4.0, 6.0], np.zeros(4))
    score = equation_error(Scalar(1.0), data)
    assert score.rms.tolist() == [2.0]
    assert score.nrmse[0] == pytest.approx(2.0 / np.std([2.0, 4.0, 6.0]))
    assert score.fit_percent[0] == pytest.approx(100 * (1 - score.nrmse[0]))
    assert (score.burn_in, score.samples, score.horizon) == (1, 3, 0.5)
    free = simulation_error(Scalar(1.0), data)
    assert free.rms[0] == pytest.approx(np.sqrt(np.mean([0.0, 4.0, 16.0, 36.0])))
    assert (free.burn_in, free.samples, free.horizon) == (0, 4, None)


def test_burn_in_of_the_model_and_of_the_caller():
    data = record([9.0, 9.0, 0.0, 2.0, 4.0], np.zeros(5))
    assert equation_error(Scalar(1.0, burn_in=3), data).samples == 2
    assert equation_error(Scalar(1.0, burn_in=3), data, burn_in=0).samples == 4, "the first output has no prediction"
    assert simulation_error(Scalar(1.0, burn_in=3), data).burn_in == 3
    assert simulation_error(Scalar(1.0, burn_in=3), data, burn_in=1).samples == 4
    with pytest.raises(InputError, match="too short"):
        simulation_error(Scalar(1.0), data, burn_in=5)


def test_a_periodic_output_wraps():
    spec = PlantSpec((), (Channel("theta", "rad", period=2 * np.pi),), 0.5)
    data = record([3.1, -3.1, -3.1], spec=spec)
    score = equation_error(Scalar(1.0, spec=spec), data)
    assert score.rms[0] == pytest.approx(np.sqrt((2 * np.pi - 6.2) ** 2 / 2))
    turning = record(np.angle(np.exp(1j * np.arange(200) * 0.5)), spec=spec)
    spread = equation_error(Scalar(1.0, spec=spec), turning)
    assert spread.rms[0] == pytest.approx(0.5)
    assert spread.nrmse[0] == pytest.approx(0.5 / np.std(0.5 * np.arange(199))), "the angle's spread is unwrapped"


def test_a_category_output_is_right_or_wrong():
    spec = PlantSpec((), (Channel("s", kind="category", minimum=0, maximum=2),), 1.0)
    P = np.zeros((3, 1, 3))
    P[0, 0, 2] = P[1, 0, 0] = P[2, 0, 0] = 1.0
    model = MdpModel(spec, P, np.ones((3, 1)))
    data = record([0.0, 2.0, 0.0, 1.0, 1.0], spec=spec)
    score = equation_error(model, data)  # predictions 2 0 2 0 against 2 0 1 1
    assert score.rms[0] == pytest.approx(np.sqrt(2 / 4)), "a category two off counts as one wrong answer"
    assert score.nrmse[0] == pytest.approx(np.sqrt(2 / 4) / np.sqrt(2 / 4)), "naming 1 always is wrong twice of four"


def test_divergence_is_infinity_and_no_exception():
    data = record(np.ones(2000), np.zeros(2000))
    score = simulation_error(Scalar(1e6), data)
    assert score.rms[0] == np.inf
    assert score.nrmse[0] == np.inf
    assert not score.finite
    found = predict(Scalar(1e6), data, None)[:, 0]
    first = int(np.argmax(~np.isfinite(found)))
    assert 10 < first < 2000
    assert np.isnan(found[first:]).all()


def test_a_run_that_only_grows_has_diverged_though_it_is_a_number():
    data = record(np.sin(np.arange(200)))
    grows, drifts = (simulation_error(Scalar(a), replace(data, y=data.y + 1.0)) for a in (1.1, 1.02))
    assert np.isfinite(grows.nrmse).all()
    assert not grows.finite
    assert drifts.nrmse[0] > 1
    assert drifts.finite


def test_a_miss_of_a_million_times_the_scatter_has_diverged():
    for nrmse, finite in ((0.99e6, True), (1.01e6, False), (np.inf, True)):  # an output that stands still has none
        assert Score(np.ones(1), np.array([nrmse]), None, 0, "", 9).finite == finite
    assert not Score(np.array([np.inf]), np.ones(1), None, 0, "", 9).finite


def test_a_start_is_estimated_from_fifty_samples_where_more_come_later():
    seen = []

    class Watches(Scalar):
        def initial_state(self, data: Trajectory) -> FloatArray:
            seen.append(len(data))
            return super().initial_state(data)

    data = record(np.ones(120))
    score = equation_error(Watches(1.0), data)
    errors(Watches(1.0, burn_in=1), data, 10.0)
    errors(Watches(1.0), data, 20.0)
    simulation_error(Watches(1.0), data)
    assert seen == [50, 50, 40, 40, 40, 120]
    assert score.initial_state == "estimated from the first 50 samples, corrected at each sample"


def test_windows_that_diverge_are_infinity_too():
    model = Scalar(1e200)
    assert simulation_error(model, record(np.ones(8), np.zeros(8)), horizon=2.0).rms[0] == np.inf


def test_an_output_that_stands_still():
    still = record(np.full(4, 3.0), np.zeros(4))
    assert equation_error(Scalar(1.0), still).nrmse[0] == 0.0
    assert equation_error(Scalar(0.5), still).nrmse[0] == np.inf


def test_two_outputs_are_scored_apart():
    spec = PlantSpec((), (Channel("a", "m"), Channel("b", "m")), 0.5)
    model = LinearModel(
        spec, np.diag([1.0, 0.5]), np.zeros((2, 0)), np.eye(2), np.zeros((2, 0)), np.eye(2), np.zeros(2), np.zeros(2)
    )
    y = np.column_stack([np.arange(5.0), 0.5 ** np.arange(5.0)])
    score = equation_error(model, record(y, spec=spec))
    assert score.rms == pytest.approx([1.0, 0.0])


def linear(growth: float) -> LinearModel:
    rng = np.random.default_rng(0)
    spec = PlantSpec((Channel("u"),), (Channel("a"), Channel("b")), 0.5)
    a = rng.normal(size=(3, 3))
    a *= growth / np.abs(np.linalg.eigvals(a)).max()
    return LinearModel(
        spec, a, rng.normal(size=(3, 1)), rng.normal(size=(2, 3)), rng.normal(size=(2, 1)),
        0.1 * rng.normal(size=(3, 2)), rng.normal(size=3), rng.normal(size=2),
    )  # fmt: skip


@pytest.mark.parametrize(("n", "growth"), [(30, 0.7), (1000, 0.999), (1023, 1.0), (700, 1.05)])
def test_fast_free_runs_and_filters_equal_stepping(n, growth):
    model, rng = linear(growth), np.random.default_rng(1)
    u, x = rng.normal(size=(2, n, 1)), rng.normal(size=(2, 3))
    fast, state = model.free_run(x, u), x
    for k in range(n):
        assert fast[:, k] == pytest.approx(model.output(state, u[:, k]), rel=1e-12, abs=1e-11)
        state = model.step(state, u[:, k])
    y, state = rng.normal(size=(n, 2)), x[0]
    states = model.filtered(x[0], u[0], y)
    for k in range(n):
        state = model.correct(state, u[0, k], y[k])
        assert states[k] == pytest.approx(state, rel=1e-12, abs=1e-11)
        state = model.step(state, u[0, k])


def test_feedthrough_is_predicted_with_the_present_input():
    model = LinearModel(
        SPEC, np.zeros((1, 1)), np.zeros((1, 1)), np.zeros((1, 1)), np.full((1, 1), 2.0), np.zeros((1, 1)),
        np.zeros(1), np.zeros(1),
    )  # fmt: skip
    u = np.array([1.0, -1.0, 3.0])
    assert predict(model, record(2 * u, u), 1)[1:, 0].tolist() == [-2.0, 6.0]


def test_the_score_names_its_initial_state_and_is_a_value():
    score = simulation_error(Scalar(1.0), record([1.0, 2.0, 3.0]), initial_samples=2)
    assert "first 2 samples" in score.initial_state
    assert json.dumps(score.rms.tolist())
