"""What a fitted model, linear or lifted, is worth for control on the true plant, for a row of the table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.algebra import divisor
from harness.errors import FitError, InputError
from harness.parts.files import make_plant
from harness.signals import FloatArray, Trajectory

if TYPE_CHECKING:
    from harness.benchmark.parts import Task
    from harness.benchmark.row import Row
    from harness.scoring.control import LinearPlantModel

AT_REST = 0.02
"""The plant is linearised at the mean of the records if one sample from there moves no state by more than this share of
its spread: a record that swings about an equilibrium has its mean there, another has none."""
NEWTON = 2  # Steps from there to the equilibrium itself: a controller about another point would pay for holding it.
STEPS = 400  # Samples of the run whose control regret is taken: several designs, the data doubling between them.
NOISE = 0.1  # Standard deviation of its disturbance, in units of each state's spread over the records.
CAREFUL = 0.8  # Share of the optimal gain that an unstable plant begins with: it is held, and not well.


@dataclass(frozen=True, eq=False)
class _Point:
    """Where the plant is to be held, and the plant there."""

    around: LinearPlantModel  # The plant linearised there
    centre: dict[str, float]  # States by name
    # (ny,), (nu,): Outputs and inputs
    target: FloatArray
    hold: FloatArray
    spread: FloatArray  # (nx + nu,): Sizes of states and inputs in the records


def score_control(
    model: Any, identifier: Any, task: Task, runs: Sequence[Trajectory], row: Row, rng: np.random.Generator
) -> None:
    """Fill in what the model is worth for control, the facts about it, and control regret, or why there are none.

    Linear models, and lifted ones in their coordinates, get the cost of their LQG regulator; every model of real inputs
    and outputs that of predictive control (:mod:`harness.scoring.model_predictive`).

    - ``model``: fitted to the records
    - ``runs``: the estimation records with the true states
    - ``row``: changed in place
    """
    from harness.scoring import control_score
    from harness.scoring.model_predictive import predictive_score

    point = _point(task, runs)
    if isinstance(point, str):
        row.control_status = point
        return
    try:
        with make_plant(task.plant.id, dict(task.plant.options)) as plant:
            row.predictive_cost = predictive_score(
                model, plant, point.around, centre=point.centre, target=point.target, hold=point.hold,
                size=point.spread[-plant.spec.nu :], rng=rng,
            )  # fmt: skip
    except InputError as error:
        row.control_status = f"not for control: {type(model).__name__}: {error.got}"
        return
    design = for_control(model)
    if design is None:
        failed = "" if row.predictive_cost is not None else ", which does not hold the plant"
        row.control_status = f"{type(model).__name__} is linear in no coordinates: predictive control alone{failed}"
        return
    try:
        score = control_score(design, point.around)
    except InputError as error:
        row.control_status = str(error)
        return
    row.control_score = score.ratio if np.isfinite(score.ratio) else None
    row.control_status = score.status
    row.model_order, row.controllable, row.observable = score.order, score.controllable, score.observable
    row.stabilisable, row.detectable = score.stabilisable, score.detectable
    row.control_regret = _regret(identifier, design, point.around, point.spread, rng)


def for_control(model: Any) -> Any:
    """Return what a regulator can be designed on: a linear model, or a lifted one in its lifted coordinates."""
    from harness.models.lifted import Lifted, deviations
    from harness.scoring.control import LinearPlantModel

    if all(hasattr(model, f"{name}_matrix") for name in "abcd"):
        return model
    if not isinstance(model, Lifted):
        return None
    a, b, c, _ = deviations(model)
    return LinearPlantModel(a, b, c, np.asarray(model.matrices[3], dtype=float))


def _point(task: Task, runs: Sequence[Trajectory]) -> _Point | str:
    """Return the plant at the mean of the records; a text where it cannot be held there or does not tell its states."""
    from harness.scoring import linearise

    states = [one.x for one in runs]
    if any(x is None for x in states):
        return "the plant does not tell its states"
    x = np.concatenate([part for part in states if part is not None])
    u = np.concatenate([one.u for one in runs])
    centre, hold, spread = x.mean(axis=0), u.mean(axis=0), x.std(axis=0)
    size = divisor(np.concatenate([spread, u.std(axis=0)]))
    with make_plant(task.plant.id, dict(task.plant.options)) as plant:
        if "truth" not in plant.abilities:
            return "the plant does not tell its states"
        names = [channel.name for channel in plant.spec.states]
        truthful: Any = plant

        def after(x: FloatArray, u: FloatArray) -> tuple[dict[str, float], FloatArray, FloatArray]:
            by_name = dict(zip(names, x.tolist(), strict=True))
            y = np.asarray(plant.reset(rng=np.random.default_rng(0), x0=by_name), dtype=float)
            plant.step(u)
            return by_name, y, np.asarray(truthful.truth()) - x

        try:
            by_name, target, moved = after(centre, hold)
            if np.any(np.abs(moved) > AT_REST * spread):
                return "the records do not move about an equilibrium"
            found = linearise(plant, x0=by_name, u0=hold)
            for _ in range(NEWTON):  # from the mean of the records to where the plant stays
                drift = np.hstack([found.a_matrix - np.eye(len(centre)), found.b_matrix]) * size
                step = size * np.linalg.lstsq(drift, -moved, rcond=1e-9)[0]
                centre, hold = centre + step[: len(centre)], hold + step[len(centre) :]
                by_name, target, moved = after(centre, hold)
                found = linearise(plant, x0=by_name, u0=hold)
        except InputError as error:
            return str(error)
    return _Point(found, by_name, target, hold, size)


def _regret(
    identifier: Any, model: Any, plant: LinearPlantModel, spread: FloatArray, rng: np.random.Generator
) -> float | None:
    """Return the cost of learning to control, in samples of the optimal cost; None where states are not measured."""
    from harness.models.lqr import lqr_gain, spectral_radius
    from harness.scoring.control import control_regret, in_states

    try:
        in_states(model)
    except FitError:
        return None
    nx = len(plant.a_matrix)
    if np.shape(model.c_matrix)[0] != nx:
        return None
    states, inputs = spread[:nx], spread[nx:]
    a = plant.a_matrix * states / states[:, None]
    b = plant.b_matrix * inputs / states[:, None]
    first = np.zeros((b.shape[1], nx))
    if spectral_radius(a) >= 1.0:
        best = lqr_gain(a, b, np.eye(nx), np.eye(b.shape[1]))
        if best is None:
            return None
        first = CAREFUL * best if spectral_radius(a - CAREFUL * b @ best) < 1.0 else best
    run = control_regret(identifier, (a, b), steps=STEPS, rng=rng, noise=NOISE, first_gain=first)
    total = run.total / run.optimal
    return float(total) if np.isfinite(total) else None
