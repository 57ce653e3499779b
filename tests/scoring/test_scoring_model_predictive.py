"""Predictive control on a model is the least-squares plan of its horizon, and its score the cost of a simulation."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from harness.errors import InputError
from harness.scoring.control import linearise, pulse_sizes
from harness.scoring.model_predictive import HORIZON, ModelPredictive, _Informed, predictive_score
from harness.signals import Channel, FloatArray, PlantSpec
from identifiers.linear.least_squares import LinearModel
from plants.equations.linear import LinearPlant

A, B = np.array([[0.9, 0.3], [-0.2, 0.8]]), np.array([[0.1], [0.5]])
TARGET, HOLD = np.array([1.0, -2.0]), np.array([0.7])
Q, R = np.array([[2.0, 0.3], [0.3, 1.0]]), np.array([[0.5]])
HELD = 3


class Seen:
    """``x+ = A x + b u`` about a point, with a gain that bends where ``bend`` is not 0; the outputs are the states."""

    def __init__(self, a: FloatArray = A, b: FloatArray = B, low: float = -np.inf, high: float = np.inf) -> None:
        self.a, self.b, self.bend = a, b, 0.0
        inputs, outputs = (Channel("u", minimum=low, maximum=high),), (Channel("p"), Channel("v"))
        self.spec = PlantSpec(inputs, outputs, 0.1)
        self.started: Any = None

    def initial_state(self, data: Any) -> FloatArray:
        self.started = data
        return data.y[0]

    def correct(self, x: FloatArray, u: FloatArray, y: FloatArray) -> FloatArray:
        return y

    def step(self, x: FloatArray, u: FloatArray) -> FloatArray:
        away, pushed = x - TARGET, u - HOLD
        return TARGET + away @ self.a.T + (pushed - self.bend * pushed**3) @ self.b.T

    def output(self, x: FloatArray, u: FloatArray) -> FloatArray:
        return x


def rows(model: Any, y: FloatArray, plan: FloatArray) -> FloatArray:
    """Return the weighted deviations of a plan of held inputs, sample by sample."""
    roots = np.linalg.cholesky(Q), np.linalg.cholesky(R)
    found, x = [], y
    for k in range(HORIZON):
        u = plan[k // HELD : k // HELD + 1]
        x = model.step(x, u)
        found += [roots[0].T @ (x - TARGET), roots[1].T @ (u - HOLD)]
    return np.concatenate(found)


def best_plan(model: Any, y: FloatArray) -> FloatArray:
    """Return the least-squares plan of a linear model: superposition of what each input does."""
    still = rows(model, y, np.full(HORIZON // HELD, HOLD[0]))
    moved = [rows(model, y, HOLD[0] + one) - still for one in np.eye(HORIZON // HELD)]
    return np.asarray(HOLD[0] + np.linalg.lstsq(np.array(moved).T, -still)[0])


def test_on_a_linear_model_every_move_is_that_of_the_least_squares_plan() -> None:
    model: Any = Seen()
    controller = ModelPredictive(model, TARGET, HOLD, Q, R, np.ones(1))
    for y in np.random.default_rng(0).normal(size=(5, 2)):
        assert controller.act(y) == pytest.approx(best_plan(model, y)[:1], abs=1e-9)
    assert controller.responds
    assert np.diff(model.started.t) == pytest.approx(np.full(59, model.spec.sample_time))  # it knows what rest is
    assert (model.started.y == TARGET).all()
    assert (model.started.u == HOLD).all()


def test_a_move_keeps_to_the_range_of_the_input_and_an_input_without_effect_is_told() -> None:
    for low, high in ((0.6, 0.8), (0.69, 5.0), (-5.0, 0.71)):
        model: Any = Seen(low=low, high=high)
        controller = ModelPredictive(model, TARGET, HOLD, Q, R, np.ones(1))
        for away in (np.array([4.0, 4.0]), np.array([-4.0, -4.0])):
            wanted = best_plan(model, TARGET + away)[0]
            found = controller.act(TARGET + away)[0]
            assert found == pytest.approx(np.clip(wanted, low, high), abs=0.005) or low < found < high
            assert low <= found <= high
    dead: Any = Seen(b=0 * B)
    controller = ModelPredictive(dead, TARGET, HOLD, Q, R, np.ones(1))
    assert controller.act(TARGET + 1.0) == pytest.approx(HOLD)
    assert not controller.responds


@pytest.mark.parametrize("size", [1.0, 3.0])
def test_a_plan_goes_on_where_the_one_before_left_off_and_never_does_worse(size: float) -> None:
    """One Gauss-Newton step a sample from the plan of the sample before, a third of a move later (``HELD`` samples)."""
    model: Any = Seen()
    model.bend = 0.3
    controller = ModelPredictive(model, TARGET, HOLD, Q, R, np.array([size]))
    moves, nudge, y = HORIZON // HELD, 0.05 * size, TARGET + np.array([1.0, -0.5])
    plan = np.full(moves, HOLD[0])
    for _ in range(6):
        now = rows(model, y, plan)
        slopes = np.array([(rows(model, y, plan + nudge * one) - now) / nudge for one in np.eye(moves)]).T
        step = np.linalg.lstsq(slopes, -now)[0]
        tried = [plan + share * step for share in (1.0, 0.3, 0.1, 0.0)]
        plan = min(tried, key=lambda one: float(np.sum(rows(model, y, one) ** 2)))
        u = controller.act(y)
        assert u == pytest.approx(plan[:1], abs=1e-9)
        plan = plan + (np.append(plan[1:], plan[-1]) - plan) / HELD
        y = model.step(y, u)


def test_a_model_is_told_the_input_that_acts_at_the_sample_that_it_sees() -> None:
    told = list[FloatArray]()

    class Watches(Seen):
        def correct(self, x: FloatArray, u: FloatArray, y: FloatArray) -> FloatArray:
            told.append(u.copy())
            return y

    model: Any = Watches()
    controller = ModelPredictive(model, TARGET, HOLD, Q, R, np.ones(1))
    plan, y = np.full(HORIZON // HELD, HOLD[0]), TARGET + 1.0
    for _ in range(3):
        controller.act(y)
        assert told[-1] == pytest.approx(plan[:1])
        plan = best_plan(model, y)
        plan = plan + (np.append(plan[1:], plan[-1]) - plan) / HELD


def held(plant: LinearPlant, b: FloatArray, size: float, seed: int) -> float:
    """Return the cost of predictive control with another ``b`` on a plant, step by step."""
    sizes = pulse_sizes(linearise(plant))
    q, r = np.diag(sizes**-2.0), np.eye(1)
    powers = [np.linalg.matrix_power(A, k) @ b for k in range(HORIZON)]
    hold = np.repeat(np.eye(HORIZON // HELD), HELD, axis=0)
    seen = np.vstack([np.hstack([powers[k - j] if j <= k else 0 * b for j in range(HORIZON)]) @ hold
                      for k in range(HORIZON)])  # fmt: skip
    free = np.vstack([np.linalg.matrix_power(A, k + 1) for k in range(HORIZON)])
    weight = np.kron(np.eye(HORIZON), q)
    law = -np.linalg.solve(seen.T @ weight @ seen + hold.T @ hold, seen.T @ weight @ free)[0]
    column = np.asarray(plant.B)[:, 0]
    x, cost = np.zeros(2), 0.0
    for push in 0.1 * size * np.random.default_rng(seed).normal(size=240):
        u = float(law @ x)
        cost += float(x @ q @ x + r[0, 0] * u * u)
        x = A @ x + column * (u + push)
    return cost


def test_the_score_is_the_cost_with_the_model_over_that_with_the_plant() -> None:
    share = 1.6
    with LinearPlant(A=A, B=B, C=np.eye(2), sample_time=0.1) as plant:
        model: Any = Seen(b=share * B)
        rest = np.linalg.solve(np.eye(2) - A, B @ HOLD)
        model.step = lambda x, u: rest + (x - rest) @ A.T + (u - HOLD) @ model.b.T
        around, steps, step = linearise(plant), list[float](), plant.step
        watched: Any = plant
        watched.step = lambda u: steps.append(float(u[0])) or step(u)
        found = predictive_score(
            model, plant, around, centre={"x1": rest[0], "x2": rest[1]}, target=rest, hold=HOLD,
            size=np.array([2.0]), rng=np.random.default_rng(3),
        )  # fmt: skip
        expected = held(plant, share * B, 2.0, 3) / held(plant, B, 2.0, 3)
    assert len(steps) == 480
    push = 0.1 * 2.0 * np.random.default_rng(3).normal()  # at rest a controller does nothing of its own
    assert [steps[-480], steps[-240]] == pytest.approx([HOLD[0] + push] * 2)
    assert found == pytest.approx(expected, rel=1e-6)


def test_what_a_model_says_of_an_output_that_no_input_moves_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("harness.scoring.model_predictive.STEPS", 40)
    scores = []
    for outputs in (2, 3):
        c = np.eye(3)[:outputs, :2]
        with LinearPlant(A=A, B=B, C=c, sample_time=0.1) as plant:
            seen = c + np.array([[0.0, 0.0], [0.0, 0.0], [0.8, -0.6]])[:outputs]
            watch, still = np.hstack([0.5 * A, np.zeros((2, 1))])[:, :outputs], np.zeros(2)
            model = LinearModel(
                plant.spec, A, 1.5 * B, seen, np.zeros((outputs, 1)), watch, still, np.zeros(outputs)
            )  # fmt: skip
            scores.append(predictive_score(
                model, plant, linearise(plant), centre={"x1": 0.0, "x2": 0.0}, target=np.zeros(outputs),
                hold=np.zeros(1), size=np.ones(1), rng=np.random.default_rng(0),
            ))  # fmt: skip
    assert scores[0] is not None
    assert scores[0] > 1.0
    assert scores[1] == pytest.approx(scores[0], rel=1e-6)


def test_a_model_that_loses_the_plant_has_no_score_and_one_that_cannot_act_is_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("harness.scoring.model_predictive.STEPS", 40)
    unstable = np.array([[1.6, 0.0], [0.0, 0.5]])
    with LinearPlant(A=unstable, B=np.ones((2, 1)), C=np.eye(2), sample_time=0.1) as plant:
        around = linearise(plant)

        def scored(model: Any) -> float | None:
            return predictive_score(
                model, plant, around, centre={"x1": 0.0, "x2": 0.0}, target=np.zeros(2), hold=np.zeros(1),
                size=np.ones(1), rng=np.random.default_rng(0),
            )  # fmt: skip

        backwards: Any = Seen(unstable, -np.ones((2, 1)))
        backwards.step = lambda x, u: x @ unstable.T - u @ np.ones((1, 2))
        assert scored(backwards) is None
        dead: Any = Seen(0.5 * np.eye(2), 0 * B)
        with pytest.raises(InputError, match="no input moves it"):
            scored(dead)
        words = (Channel("w", kind="category", minimum=0, maximum=1),)
        for spec, why in (
            (PlantSpec((), (Channel("p"),), 0.1), "no input"),
            (PlantSpec(words, (Channel("p"),), 0.1), "categories"),
            (PlantSpec((Channel("u"),), words, 0.1), "categories"),
        ):
            with pytest.raises(InputError, match=why):
                scored(SimpleNamespace(spec=spec))


def test_whoever_knows_the_plant_foretells_it_about_the_point() -> None:
    through = np.array([[0.5], [-2.0]])
    with LinearPlant(A=A, B=B, C=[[1.0, 2.0], [0.0, 3.0]], D=through, sample_time=0.1) as plant:
        rest = np.linalg.solve(np.eye(2) - A, B @ HOLD)
        told = plant.C @ rest + through @ HOLD
        informed = _Informed(plant, linearise(plant), rest, told, HOLD)
        x, u = np.random.default_rng(0).normal(size=(3, 2)), np.random.default_rng(1).normal(size=(3, 4, 1))
        found = informed.free_run(x, u)
        for start, inputs, outputs in zip(x, u, found, strict=True):
            for now, y in zip(inputs, outputs, strict=True):
                assert y == pytest.approx(plant.C @ start + through @ now)
                start = A @ start + B @ now
        plant.reset(rng=np.random.default_rng(0), x0={"x1": 0.3, "x2": -0.4})
        assert informed.correct(x[0], u[0, 0], found[0, 0]).tolist() == [0.3, -0.4]
