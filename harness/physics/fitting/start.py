"""Where a fit starts: values given, values of the model, and an equation-error fit on smoothed measurements."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal

import casadi as ca
import numpy as np
import numpy.typing as npt

from harness.errors import HarnessError
from harness.models.damped import Damping, damped_descent
from harness.physics.arms.vectorised import OnRecords
from harness.physics.compiled.windows import data_states
from harness.physics.fitting.levenberg import log_scaled
from harness.signals import FloatArray, Trajectory

if TYPE_CHECKING:
    from harness.physics.compiled.system import System

# Enough samples to start from; the fit itself uses all.
_SAMPLES = 6000
_STARTS = 6


def first_values(
    system: System,
    records: Sequence[Trajectory],
    values: dict[str, float],
    free: npt.NDArray[np.bool_],
    given: set[str],
    intersample: Literal["zoh", "foh", "smooth"],
) -> list[FloatArray]:
    """Return parameter vectors worth starting from, the plain one first.

    - ``values``: a value for every parameter
    - ``free`` array of bool (np,): which parameters are fitted
    - ``given``: those whose value the caller chose; they stay
    - ``intersample`` {"zoh", "foh", "smooth"}
    - returns one or two vectors (np,): only the first if nothing is left open, or the records do not tell all states
    """
    plain = np.array([values[name] for name in system.parameter_names], dtype=float)
    open_parameters = np.array(
        [bool(is_free) and name not in given for name, is_free in zip(system.parameter_names, free, strict=True)]
    )
    if not open_parameters.any():
        return [plain]
    if system.starts is not None:
        try:
            values_found = system.starts(records)
        except (HarnessError, np.linalg.LinAlgError, ValueError):
            return [plain]
        proposed = plain.copy()
        for row, name in enumerate(system.parameter_names):
            if open_parameters[row] and np.isfinite(values_found.get(name, np.nan)):
                proposed[row] = values_found[name]
        return [plain, proposed]
    if system.nx == 0:
        return [plain]
    if system.nominal is not None:
        # Effects start small: where the nominal model alone would start is a good place for the common parameters.
        base = system.nominal
        rows = [system.parameter_names.index(name) for name in base.parameter_names]
        found = (
            _matched(base, records, plain[rows], open_parameters[rows], intersample)
            if open_parameters[rows].any()
            else None
        )
        if found is None:
            return [plain]
        proposed = plain.copy()
        proposed[rows] = found
        return [plain, proposed]
    found = _matched(system, records, plain, open_parameters, intersample)
    return [plain] if found is None else [plain, found]


def _matched(
    system: System, records: Sequence[Trajectory], plain: FloatArray, free: npt.NDArray[np.bool_], intersample: str
) -> FloatArray | None:
    """Return the parameters that match the derivatives of smoothed states, in the weak form.

    Both sides of x' = f are averaged with a smooth test function, the derivative moved onto it by parts: less noise
    than differentiating (Messenger & Bortz 2021, *Weak SINDy*, without their library).
    """
    dt = records[0].spec.sample_time
    simulator = system.simulator(dt, intersample="zoh", substeps=1, backend="casadi")
    first = len(system.coordinates)
    symbols, rates = [system.x, system.u, system.p, system.t], system.f[first:]
    function = OnRecords(ca.Function("f", symbols, [rates]))
    parameter_jacobian = OnRecords(ca.Function("fp", symbols, [ca.jacobian(rates, system.p)]))
    parts: list[tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]] = []
    budget = _SAMPLES
    for record in records:
        use = record[: min(len(record), budget)]
        if len(use) < 30:
            continue
        x, known = data_states(simulator, use, plain)
        if not all(known):
            return None
        u = use.u
        if intersample == "zoh" and u.shape[1]:
            # A held input acts on average half a sample late at the instants of the states.
            u = 0.5 * (u + np.vstack([u[:1], u[:-1]]))
        test_function, derivative, hop = _test_function(use, dt)
        target = -np.column_stack([np.convolve(x[:, c], derivative, "valid")[::hop] for c in range(first, system.nx)])
        parts.append((x, u, use.t, test_function, target))
        budget -= len(use)
        if budget < 30:
            break
    if not parts:
        return None
    size = np.sqrt(np.mean(np.vstack([part[4] for part in parts]) ** 2, axis=0)) + 1e-300
    hops = [max(1, part[3].shape[0] // 4) for part in parts]

    def residual(p: FloatArray, jacobian: bool) -> tuple[FloatArray, FloatArray]:
        rows, columns = [], []
        for (x, u, t, test_function, target), hop in zip(parts, hops, strict=True):
            f = function(x, u, p, t[:, None])[0]
            rows.append(((target - _averaged(f, test_function, hop)) / size).ravel())
            if jacobian:
                by_p = parameter_jacobian(x, u, p, t[:, None])[0]  # column by column
                averaged = _averaged(by_p, test_function, hop)
                averaged = averaged.reshape(-1, p.shape[0], f.shape[1]).transpose(0, 2, 1)
                columns.append((averaged / size[:, None]).reshape(-1, p.shape[0]))
        return np.concatenate(rows), np.vstack(columns) if jacobian else np.zeros((0, 0))

    rng = np.random.default_rng(0)
    logarithmic = log_scaled(system)
    best: tuple[float, FloatArray] | None = None
    for number in range(_STARTS):
        p = plain.copy()
        if number:
            p = np.where(free & logarithmic, p * np.exp(1.5 * rng.normal(size=p.shape)), p)
        p, cost = _small_fit(system, residual, p, free, logarithmic)
        if np.isfinite(cost) and (best is None or cost < best[0]):
            same = best is not None and cost > 0.999 * best[0]
            best = (cost, p)
            if same:
                break
        elif best is not None and np.isfinite(cost) and cost < 1.001 * best[0]:
            break
    return None if best is None else best[1]


def _test_function(record: Trajectory, dt: float) -> tuple[FloatArray, FloatArray, int]:
    """Return a test function of unit sum, its derivative as np.convolve wants it, and the hop between two of them."""
    from harness.physics.fitting.smoothing import smooth

    width = smooth(record.y[:, 0], dt, period=record.spec.outputs[0].period).width
    half = int(np.clip(width, 5, max(5, len(record) // 10)))
    s = np.arange(-half, half + 1) / (half + 1)
    test_function = (1 - s**2) ** 2
    area = test_function.sum()
    derivative = -4 * s * (1 - s**2) / ((half + 1) * dt)
    # np.convolve mirrors its second argument: the odd derivative changes its sign, the even test function does not.
    return test_function / area, -derivative / area, max(1, test_function.shape[0] // 4)


def _averaged(signal: FloatArray, test_function: FloatArray, hop: int) -> FloatArray:
    """Return each column averaged under the test function, which is even, at every hop-th sample."""
    return np.asarray(
        np.lib.stride_tricks.sliding_window_view(signal, len(test_function), axis=0)[::hop] @ test_function
    )


def _small_fit(
    system: System, residual: Any, p: FloatArray, free: npt.NDArray[np.bool_], logarithmic: npt.NDArray[np.bool_]
) -> tuple[FloatArray, float]:
    """Return the parameters of least squared residual, and that sum."""
    low = np.array([parameter.minimum for parameter in system.parameters])
    high = np.array([parameter.maximum for parameter in system.parameters])
    sound = True

    def cost(p: FloatArray) -> float:
        r, _ = residual(p, False)
        total = float(r @ r)
        return total if np.isfinite(total) else np.inf

    def linearised(p: FloatArray) -> tuple[FloatArray, FloatArray] | None:
        r, j = residual(p, True)
        nonlocal sound
        sound = bool(np.isfinite(r).all() and np.isfinite(j).all())
        if not sound:
            return None
        scaled = (j * np.where(logarithmic, p, 1.0))[:, free]
        return scaled.T @ scaled, scaled.T @ r

    def moved(p: FloatArray, system: tuple[FloatArray, FloatArray], damping: float) -> FloatArray:
        gram, right = system
        size = np.sqrt(np.maximum(np.diag(gram), 1e-14 * np.diag(gram).max(initial=0.0) + 1e-200))
        matrix = gram / np.outer(size, size) + (damping + 1e-12) * np.eye(len(right))
        step = np.zeros_like(p)
        step[free] = np.linalg.solve(matrix, right / size) / size
        longest = np.abs(step[logarithmic]).max(initial=0.0)
        step *= min(1.0, 2.0 / longest) if longest > 0 else 1.0
        trial = np.clip(np.where(logarithmic, p * np.exp(np.clip(step, -2.0, 2.0)), p + step), low, high)
        return np.where(logarithmic, np.maximum(trial, 1e-12), trial)

    rule = Damping(growth=6.0, fall=1 / 8, least=0.0, enough=1e-5, rounds=40)
    found = damped_descent(np.where(logarithmic, np.maximum(p, 1e-12), p), cost, linearised, moved, rule)
    return found, cost(found) if sound else np.inf
