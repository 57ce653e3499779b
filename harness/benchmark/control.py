"""What a fitted model, linear or lifted, is worth for control on the true plant, for a row of the table."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.errors import FitError, InputError
from harness.parts.files import make_plant
from harness.signals import FloatArray, Trajectory

if TYPE_CHECKING:
    from harness.benchmark.parts import Task
    from harness.benchmark.row import Row
    from harness.scoring.control import LinearPlantModel

__all__ = ["score_control"]

AT_REST = 0.02
"""The plant is linearised at the mean of the records if one sample from there moves no state by more than this share of
its spread: a record that swings about an equilibrium has its mean there, another has none."""
STEPS = 400
"""Samples of the run whose control regret is taken: several designs, the data doubling between them."""
NOISE = 0.1
"""Standard deviation of its disturbance, in units of each state's spread over the records."""
CAREFUL = 0.8
"""Share of the optimal gain that an unstable plant begins with: it is held, and not well."""


def score_control(
    model: Any, identifier: Any, task: Task, runs: Sequence[Trajectory], row: Row, rng: np.random.Generator
) -> None:
    """Fill in control score, the facts about the model, and control regret, or why there are none.

    Parameters
    ----------
    model : Model
        Fitted to the records.
    identifier : Identifier
    task : Task
    runs : sequence of Trajectory
        The estimation records with the true states.
    row : Row
        Changed in place.
    rng : numpy.random.Generator
    """
    from harness.scoring import control_score

    design = _for_control(model)
    if design is None:
        row.control_status = f"not for control: {type(model).__name__} is linear in no coordinates that it names"
        return
    plant, spread = _linearised(task, runs)
    if isinstance(plant, str):
        row.control_status = plant
        return
    try:
        score = control_score(design, plant)
    except InputError as error:
        row.control_status = str(error)
        return
    row.control_score = score.ratio if np.isfinite(score.ratio) else None
    row.control_status = score.status
    row.model_order, row.controllable, row.observable = score.order, score.controllable, score.observable
    row.stabilisable, row.detectable = score.stabilisable, score.detectable
    row.control_regret = _regret(identifier, design, plant, spread, rng)


def _for_control(model: Any) -> Any:
    """Return what a regulator can be designed on: a linear model, or a lifted one in its lifted coordinates."""
    from harness.models.lifted import Lifted, deviations
    from harness.scoring.control import LinearPlantModel

    if all(hasattr(model, f"{name}_matrix") for name in "abcd"):
        return model
    if not isinstance(model, Lifted):
        return None
    a, b, c, _ = deviations(model)
    return LinearPlantModel(a, b, c, np.asarray(model.matrices[3], dtype=float))


def _linearised(task: Task, runs: Sequence[Trajectory]) -> tuple[LinearPlantModel | str, FloatArray]:
    """Return the plant at the mean of the records and the sizes of states and inputs; a text where there is none."""
    from harness.scoring import linearise

    none = np.zeros(0)
    states = [one.x for one in runs]
    if any(x is None for x in states):
        return "the plant does not tell its states", none
    x = np.concatenate([part for part in states if part is not None])
    u = np.concatenate([one.u for one in runs])
    centre, hold, spread = x.mean(axis=0), u.mean(axis=0), x.std(axis=0)
    with make_plant(task.plant.id, dict(task.plant.options)) as plant:
        names = [channel.name for channel in plant.spec.states]
        point = dict(zip(names, centre.tolist(), strict=True))
        if "truth" not in plant.abilities:
            return "the plant does not tell its states", none
        try:
            plant.reset(rng=np.random.default_rng(0), x0=point)
            plant.step(hold)
            truthful: Any = plant
            moved = np.abs(np.asarray(truthful.truth()) - centre)
            if np.any(moved > AT_REST * spread):
                return "the records do not move about an equilibrium", none
            found = linearise(plant, x0=point, u0=hold)
        except InputError as error:
            return str(error), none
    size = np.concatenate([spread, u.std(axis=0)])
    return found, np.where(size > 0, size, 1.0)


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
