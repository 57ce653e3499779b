"""What belongs to a record and not to the plant: initial states, phases, instants of change.

They are fitted on every use of the data alike, parameters held; ``form`` is the simulation form that asks.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from harness.diagnosis.runs.fitted import Fitted
from harness.diagnosis.runs.windowed import WindowedForm
from harness.diagnosis.systems import AnySystem
from harness.effects.along import Signals, hidden_states
from harness.physics.compiled.simulator import Simulator
from harness.physics.compiled.system import System
from harness.physics.compiled.windows import Windows
from harness.physics.fitting.levenberg import minimise
from harness.signals import FloatArray, Trajectory


def on_validation(
    form: WindowedForm, system: AnySystem, record: Mapping[str, Any], own: Mapping[str, float]
) -> dict[str, Any]:
    """Return the initial states of the validation windows, and what belongs to the record refitted there.

    ``own`` is where the likelihood has that: a free run has other maxima beside it, and a grid ended in one (an
    instant three seconds too early, with everything else right to four digits).
    """
    records = form.records["validation"]
    if not records:
        return {"x0_validation": [], "refitted": {}}
    p = system.vector({**record["values"], **own})
    windows = form.windows(system, p, "validation")
    x0 = windows.starts_from([form.from_data(windows.simulator, run, p)[0] for run in records])
    x0 = settled_states(form, system, p, "validation", windows, x0)
    if own:
        free = np.array([name in own for name in system.parameter_names], dtype=bool)
        solution = minimise(windows, p, x0, free, 25, decrease=form.decrease)
        if np.isfinite(solution.evaluation.cost):
            p, x0 = solution.p, solution.x0
    refitted = {name: float(p[system.parameter_names.index(name)]) for name in sorted(own)}
    return {"x0_validation": x0.tolist(), "refitted": refitted}


def settled_states(
    form: WindowedForm, system: AnySystem, p: FloatArray, use: str, windows: Windows, x0: FloatArray
) -> FloatArray:
    """Return fitted initial states (W, nx), found over short windows first where the windows are long."""
    records = list(form.records[use])
    longest = max(last - first for _, first, last in windows.places) * form.sample_time
    short = max(longest / 8, 50 * form.sample_time)
    if short < 0.6 * longest:
        first = form.cut(windows.simulator, records, short)
        states = [form.from_data(windows.simulator, run, p)[0] for run in records]
        settled = form.fit_states(first, p, first.starts_from(states), 8)
        kept = first.together(first.evaluate(p, settled, keep=True).states)
        better = windows.starts_from(kept)
        x0 = np.where(np.isfinite(better), better, x0)
    return form.fit_states(windows, p, x0, 25)


def carried_states(
    form: WindowedForm, system: AnySystem, p: FloatArray, windows: Windows, x0: FloatArray
) -> FloatArray:
    """Return initial states (W, nx) of validation windows with the hidden ones handed on from window to window.

    They start where their effects say, and are carried over the seams by how far they are from there (a twist, a bent
    bristle); the other states are fitted to each window. So hidden states are what the motion made them.
    """
    result, first = x0.copy(), system.nx - system.hidden_count
    simulator, records = windows.simulator, form.records["validation"]
    away, before = np.zeros(system.hidden_count), -1
    for row, (number, place, last) in enumerate(windows.places):
        record = records[number][place:last]
        alone = Windows(simulator, [record], None, form.weights)
        away = away if number == before else np.zeros(system.hidden_count)
        before = number
        for _ in range(3):  # Gauss-Newton over the states of the nominal model
            result[row, first:] = simulator.hidden_start(result[row], record.u[0], p) + away
            residual = alone.evaluate(p, result[row : row + 1], keep=True).residuals[0]
            _, _, sensitivity = simulator.sensitivities(p, result[row], record.u, t0=float(record.t[0]))
            known = (sensitivity[..., :first] / form.weights[:, None]).reshape(
                sensitivity.shape[0] * sensitivity.shape[1], first
            )
            wanted = (residual / form.weights).reshape(-1)
            if not (np.isfinite(known).all() and np.isfinite(wanted).all()):
                break
            result[row, :first] += np.linalg.lstsq(known, wanted, rcond=1e-10)[0]
        result[row, first:] = simulator.hidden_start(result[row], record.u[0], p) + away
        end = alone.evaluate(p, result[row : row + 1], keep=True).states[0][-1]
        if np.isfinite(end).all():
            away = end[first:] - simulator.hidden_start(end, record.u[-1], p)
    return result


def led_states(simulator: Simulator, record: Trajectory, p: FloatArray, x: FloatArray) -> FloatArray:
    """Return states (N, nx) read off a record, the hidden ones of effects where the motion from its first sample led.

    In the middle of a motion bristles are bent: at their declared start the friction would be missing for a while.
    """
    system = simulator.system
    n = len(system.coordinates)
    if not (isinstance(system, System) and system.hidden_count and system.nx - system.hidden_count == 2 * n):
        return x  # an FMU, or states that nothing tells
    u = simulator.sampled.inputs(record.u[None], p[None], False)[0][0]
    q, v = x[:, :n], x[:, n : 2 * n]
    motion = Signals(record.t, u, q, v, 0.0 * v, ramps=simulator.intersample != "zoh")
    hidden = hidden_states(system, motion, p, substeps=simulator.substeps)
    return x if hidden is None or not np.isfinite(hidden).all() else np.hstack([q, v, hidden])


def state_bases(form: WindowedForm, base: Fitted, use: str) -> tuple[list[FloatArray], list[tuple[int, int, int]]]:
    """Return for each window an orthonormal basis of what its initial state can do, and the windows; found once."""
    cache: dict[str, Any] = base.__dict__.setdefault("_state_bases", {})
    if use not in cache:
        system = base.system
        p = system.vector({**base.values, **(base.refitted if use != "estimation" else {})})
        windows = form.windows(system, p, use)
        key = "x0" if use == "estimation" else "x0_validation"
        x0 = np.array(base.record[key], dtype=float).reshape(len(windows), system.nx)
        lefts = []
        for row, (number, first, last) in enumerate(windows.places):
            record = form.records[use][number]
            _, _, sensitivity = windows.simulator.sensitivities(p, x0[row], record.u[first:last], t0=record.t[first])
            flat = (sensitivity / form.weights[:, None]).reshape(sensitivity.shape[0] * sensitivity.shape[1], system.nx)
            left, sizes, _ = np.linalg.svd(flat, full_matrices=False)
            lefts.append(left[:, sizes > 1e-10 * max(sizes.max(initial=0.0), 1e-300)])
        cache[use] = (lefts, windows.places)
    bases: tuple[list[FloatArray], list[tuple[int, int, int]]] = cache[use]
    return bases
