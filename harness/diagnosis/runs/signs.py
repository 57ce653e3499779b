"""States of a record whose sensor hides the sign: the model without that sensor tells the signs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from harness.diagnosis.records.tracked_signs import LONGEST
from harness.diagnosis.records.unfold import HIDING, followed
from harness.diagnosis.runs.windowed import WindowedForm
from harness.physics.compiled.simulator import Simulator
from harness.physics.compiled.windows import Windows, data_states
from harness.signals import FloatArray, Trajectory


def signs_by_model(form: WindowedForm, simulator: Simulator, record: Trajectory, p: FloatArray) -> FloatArray | None:
    """Return states (N, nx) of a record whose sensor hides the sign; None if the system has no such sensor.

    Where the output could be followed through its zeros its signs are known but for the first. Elsewhere there are some
    choices: paths through the zeros, and what the model without the sensor says from several states. Its signs unfold
    the output, its initial state follows from the unfolded output, and so on until the signs stay. The model decides
    about all choices.
    """
    system = simulator.system
    effects = tuple(system.effects)
    hiding = [placed for placed in effects if placed.effect.name in HIDING]
    if len(hiding) != 1:
        return None
    others = [placed for placed in effects if placed.effect.name not in HIDING]
    plain = form.system(others)
    values = dict(zip(system.parameter_names, p, strict=True))
    q = plain.vector({name: values[name] for name in plain.parameter_names})
    column = [channel.name for channel in plain.outputs].index(hiding[0].at)
    runner = form.simulator(plain, q)
    paths = followed(np.asarray(record.y[:, column], dtype=float)) if len(record) <= LONGEST else ()
    choices = [sense * path.signs for path in paths for sense in (1.0, -1.0)]
    if len(paths) != 1:
        choices += _simulated_signs(form, runner, record, column, q)
    return _likeliest_states(form, runner, record, column, choices, q)


def _simulated_signs(
    form: WindowedForm, runner: Simulator, record: Trajectory, column: int, q: FloatArray
) -> list[FloatArray]:
    """Return signs (N,) that a model without the sensor gives the output, from several initial states."""
    guess = data_states(runner, record, q)[0]
    tries = [guess, np.zeros_like(guess)]
    tries.append(data_states(runner, _signed(record, column, -np.ones(len(record))), q)[0])
    found: list[FloatArray] = []
    for x in tries:
        windows = Windows(runner, [record], None, form.weights)
        x0 = windows.starts_from([x])
        signs = np.zeros(len(record))
        for _ in range(6):
            result = windows.evaluate(q, x0, keep=True)
            if not np.isfinite(result.cost):
                break
            simulated = windows.trajectories[0].y - result.residuals[0]
            now = np.where(simulated[:, column] >= 0, 1.0, -1.0)
            if np.array_equal(now, signs):
                break
            signs = now
            windows = Windows(runner, [_signed(record, column, signs, fold=True)], None, form.weights)
            x0 = form.fit_states(windows, q, x0, 25)
        if signs.any() and not any(np.array_equal(signs, other) for other in found):
            found.append(signs)
    return found


def _likeliest_states(
    form: WindowedForm, runner: Simulator, record: Trajectory, column: int, choices: Sequence[FloatArray], q: FloatArray
) -> FloatArray | None:
    """Return the states (N, nx) by a model without the sensor, of the signs that it explains best."""
    best: tuple[float, FloatArray] | None = None
    for signs in choices:
        unfolded = _signed(record, column, signs)
        windows = Windows(runner, [unfolded], form.horizon, form.weights)
        with np.errstate(all="ignore"):  # the wrong sign may diverge
            x0 = form.fit_states(windows, q, windows.starts_from([data_states(runner, unfolded, q)[0]]), 25)
            result = windows.evaluate(q, x0, keep=True)
        if np.isfinite(result.cost) and (best is None or result.cost < best[0]):
            best = (float(result.cost), windows.together(result.states)[0])
    return None if best is None else best[1]


def _signed(run: Trajectory, column: int, signs: FloatArray, *, fold: bool = False) -> Trajectory:
    """Return a run with signs put to one output."""
    y = np.array(run.y, dtype=float)
    y[:, column] = (np.abs(y[:, column]) if fold else y[:, column]) * signs
    return replace(run, y=y)
