"""Predictive control on any model, and what it costs on the true plant: a score for models linear in no coordinates.

At every sample the inputs of the next :data:`HORIZON` samples, held for some samples each, are improved by one
Gauss-Newton step on the model's own free runs from its corrected state, and the first is applied (real-time iteration,
Diehl, Bock & Schloder 2005, *SIAM J. Control Optim.* 43:1714).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from harness.errors import InputError, PlantError
from harness.protocols import Model
from harness.scoring.control import LinearPlantModel, pulse_sizes
from harness.scoring.prediction import free_runs
from harness.scoring.regulation import GONE
from harness.signals import FloatArray, Trajectory

HORIZON, HELD = 30, 3  # Samples that are looked ahead, and samples for which an input of the plan is held.
STEPS = 240  # Samples of the run on the true plant: eight horizons.
PUSHED = 0.1
"""Deviation of the disturbance at each input, in that of the records' inputs: so small that the plant stays where its
linearisation holds."""
REST = 60  # Samples at rest before, by which the model knows its state.
NUDGE = 0.05
"""Change of an input, in deviations of the records' inputs, from which slopes are taken: trees have none at a point."""
SHARES = np.array([1.0, 0.3, 0.1, 0.0])  # Shares of a step that are tried; the last keeps the plan.


class ModelPredictive:
    """Receding-horizon control of the outputs of a model about a point.

    - ``model``: of real inputs and outputs
    - ``target, hold`` (ny,), (nu,): outputs to be held, and inputs that hold them
    - ``q, r`` (ny, ny), (nu, nu): weights of deviations from both
    - ``size`` (nu,): of the inputs that the model was fitted to

    Notes
    -----
    It begins at rest at the point; ``act`` is called once a sample.
    """

    def __init__(
        self, model: Model, target: FloatArray, hold: FloatArray, q: FloatArray, r: FloatArray, size: FloatArray
    ) -> None:
        self.model, self.target, self.hold = model, target, hold
        self.roots = np.linalg.cholesky(q).T, np.linalg.cholesky(r).T
        self.low = np.array([channel.minimum for channel in model.spec.inputs])
        self.high = np.array([channel.maximum for channel in model.spec.inputs])
        self.nudge = np.tile(NUDGE * size, HORIZON // HELD)
        self.responds = False
        self._plan = np.tile(hold, (HORIZON // HELD, 1))
        u, y = (np.tile(part, (REST, 1)) for part in (hold, target))
        record = Trajectory(model.spec.sample_time * np.arange(float(REST)), u, y, model.spec)
        self._x = np.asarray(model.initial_state(record), dtype=float)

    def act(self, y: FloatArray) -> FloatArray:
        """Return the input (nu,) for the output (ny,) of this sample."""
        self._x = self.model.correct(self._x, self._plan[0], y)
        plan, nudge = self._plan.ravel(), self.nudge
        missed = self._missed(np.vstack([plan, plan + np.diag(nudge)]))
        slopes = (missed[1:] - missed[0]).T / nudge
        self.responds |= bool(np.any(slopes[: HORIZON * len(self.target)]))
        if np.isfinite(slopes).all():
            step = np.linalg.lstsq(slopes, -missed[0])[0]
            tried = np.clip(plan + SHARES[:, None] * step, np.tile(self.low, HORIZON // HELD), self._most)
            costs = np.sum(self._missed(tried) ** 2, axis=1)
            plan = tried[int(np.argmin(np.where(np.isfinite(costs), costs, np.inf)))]
        self._plan = plan.reshape(self._plan.shape)
        u: FloatArray = self._plan[0].copy()
        self._x = self.model.step(self._x, u)
        # a sample later a HELD-th of every held input is over: the next one comes in by as much
        later = np.vstack([self._plan[1:], self._plan[-1:]])
        self._plan = self._plan + (later - self._plan) / HELD
        return u

    @property
    def _most(self) -> FloatArray:
        return np.tile(self.high, HORIZON // HELD)

    def _missed(self, plans: FloatArray) -> FloatArray:
        """Return the weighted deviations (M, rows) under plans (M, moves nu)."""
        moves = plans.reshape(len(plans), -1, len(self.hold))
        u = np.repeat(moves, HELD, axis=1)
        states = np.broadcast_to(self._x, (len(plans), *self._x.shape))
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            y = free_runs(self.model, states, np.concatenate([u, u[:, -1:]], axis=1))[:, 1:]
            away = (y - self.target) @ self.roots[0].T
            pushed = (u - self.hold) @ self.roots[1].T
        return np.concatenate([away.reshape(len(plans), -1), pushed.reshape(len(plans), -1)], axis=1)


class _Informed:
    """The plant's linearisation as a model whose state is the true one."""

    def __init__(self, plant: Any, around: LinearPlantModel, x: FloatArray, y: FloatArray, u: FloatArray) -> None:
        self.plant, self.spec, self.around, self.point = plant, plant.spec, around, (x, y, u)

    def initial_state(self, data: Trajectory) -> FloatArray:
        """Return the state (nx,) at rest at the point."""
        return self.point[0]

    def correct(self, x: FloatArray, u: FloatArray, y: FloatArray) -> FloatArray:
        """Return the true state (nx,)."""
        return np.asarray(self.plant.truth(), dtype=float)

    def step(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return any state: the next :meth:`correct` knows better."""
        return x

    def free_run(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the outputs (M, N, ny) from states (M, nx) under inputs (M, N, nu)."""
        a, b, c, d = (getattr(self.around, f"{name}_matrix") for name in "abcd")
        away, pushed, y = x - self.point[0], u - self.point[2], np.empty((*u.shape[:2], len(c)))
        for k in range(u.shape[1]):
            y[:, k] = self.point[1] + away @ c.T + pushed[:, k] @ d.T
            away = away @ a.T + pushed[:, k] @ b.T
        return y


def predictive_score(
    model: Model,
    plant: Any,
    around: LinearPlantModel,
    *,
    centre: Mapping[str, float],
    target: FloatArray,
    hold: FloatArray,
    size: FloatArray,
    rng: np.random.Generator,
) -> float | None:
    """Return what predictive control on a model costs over the same with the plant itself; None where it fails.

    Both run on the true plant from rest at the point, :data:`STEPS` samples under the same white disturbance of the
    inputs, without noise; the one is the plant linearised at the point and given the true states, the model sees
    outputs. Weights as in :func:`harness.scoring.control.control_score`. Raises InputError if the model is none that
    acts on a plant.

    - ``plant``: with the ability ``"truth"``
    - ``around``: the plant linearised at the point
    - ``centre``: the point, by state name
    - ``target, hold`` (ny,), (nu,): outputs and inputs there
    - ``size`` (nu,): of the inputs that the model was fitted to
    - ``rng``: of the disturbance
    """
    spec = model.spec
    if spec.nu == 0 or any(channel.kind == "category" for channel in (*spec.inputs, *spec.outputs)):
        got = "no input" if spec.nu == 0 else "categories"
        raise InputError("a model for control", expected="real inputs and outputs", got=got, remedy="none is needed")
    sizes = pulse_sizes(around)
    q = np.diag(np.where(sizes > 0, 1.0 / np.where(sizes > 0, sizes, 1.0) ** 2, 1e-9))
    r = np.eye(spec.nu)
    point = np.array([centre[channel.name] for channel in plant.spec.states])
    pushes = PUSHED * size * rng.normal(size=(STEPS, spec.nu))
    size = np.where(size > 0, size, 1.0)
    informed: Any = _Informed(plant, around, point, target, hold)
    given, controller = (ModelPredictive(one, target, hold, q, r, size) for one in (informed, model))

    def cost(act: Callable[[FloatArray], FloatArray]) -> float:
        y, total = np.asarray(plant.reset(rng=np.random.default_rng(0), x0=dict(centre)), dtype=float), 0.0
        for push in pushes:
            u = act(y)
            away, moved = y - target, u - hold
            total += float(away @ q @ away + moved @ r @ moved)
            try:
                y = np.asarray(plant.step(u + push), dtype=float)
            except PlantError:
                return np.inf
            if not np.all(np.abs(y) < GONE):
                return np.inf
        return total

    best, found = cost(given.act), cost(controller.act)
    if not controller.responds:
        raise InputError(
            "a model for control", expected="one that inputs move", got="no input moves it", remedy="fit another"
        )
    return found / best if np.isfinite(found) else None
