"""The equation form: put the measured motion into the equations of motion and see which force is left over.

Two forms of one residual. The strong form M a - Q needs the acceleration; it is low-passed and decimated together
with its regressors (the published method for the EMPS benchmark). The weak form multiplies with test functions and
integrates the momentum by parts, so that no acceleration is needed (momentum form of a mechanical model).
Effects with hidden states or on samples cannot be judged here; see :func:`expressible`.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from harness.diagnosis.records.motion import SmoothedMotion
from harness.effects.effect import Placed
from harness.physics.compiled.system import System
from harness.signals import FloatArray


@dataclass(frozen=True, eq=False)
class MotionEquations:
    """Residual force of a system on measured motion."""

    system: System
    strong: Any  # (q, v, a, u, p, t) -> M a - Q (n,)
    weak: Any  # (q, v, u, p, t) -> momentum M v, force Q + M' v, and their Jacobians
    drive: Any  # (q, v, u, p, t) -> force of the inputs (n,)

    def _values(self, name: str, *arguments: FloatArray) -> list[FloatArray]:
        """Return the outputs of a function along a record (N, size), matrices column by column."""
        from harness.physics.arms.vectorised import OnRecords

        known: dict[str, OnRecords] = self.__dict__.setdefault("_on_records", {})
        if name not in known:
            known[name] = OnRecords(getattr(self, name))
        return known[name](*arguments)

    def force_of(self, motion: SmoothedMotion, p: FloatArray) -> FloatArray:
        """Return the force (N, n) of the inputs along a motion."""
        return self._values("drive", motion.q, motion.v, motion.u, np.asarray(p, dtype=float), motion.t[:, None])[0]

    def residual(self, motion: SmoothedMotion, p: FloatArray) -> FloatArray:
        """Return the residual force (rows, n) [force units] of one record, decimated."""
        p, t = np.asarray(p, dtype=float), motion.t[:, None]
        return decimated(self._values("strong", motion.q, motion.v, motion.a, motion.u, p, t)[0], motion)

    def weak_residual(
        self, motion: SmoothedMotion, p: FloatArray, columns: Sequence[int]
    ) -> tuple[FloatArray, FloatArray]:
        """Return the mean residual force (rows, n) over half overlapping test functions, and its derivatives.

        - ``p`` (np,): parameters in the order of the system's
        - ``columns``: parameters whose derivatives (rows, n, k) are wanted
        """
        n, npar, rows, k = motion.q.shape[1], p.size, motion.q.shape[0], len(columns)
        p, t = np.asarray(p, dtype=float), motion.t[:, None]
        momentum, force, dm, df = self._values("weak", motion.q, motion.v, motion.u, p, t)
        jm, jf = (
            one.reshape(rows, npar, n).transpose(0, 2, 1)[:, :, list(columns)].reshape(rows, n * k) for one in (dm, df)
        )
        r = weak_rows(momentum, motion, derivative=True) - weak_rows(force, motion)
        j = weak_rows(jm, motion, derivative=True) - weak_rows(jf, motion)
        return r, j.reshape(-1, n, k)


def expressible(placed: Placed) -> bool:
    """Return True if an effect acts on the forces without a state of its own, so that it has an equation form."""
    effect = placed.effect
    if effect.name == "input_gain":  # a common factor on all forces: the equation alone cannot know it
        return False
    return not effect.states and not effect.sampled and bool({"coordinate", "input", "base"} & set(effect.kinds))


def equations_of(system: System) -> MotionEquations:
    """Return the equation form of a system.

    - ``system``: with coordinates and without hidden states
    """
    import casadi as ca

    n = len(system.coordinates)
    q, v, a = ca.SX.sym("q", n), ca.SX.sym("v", n), ca.SX.sym("a", n)
    t = ca.SX.sym("t")
    swap = [ca.vertcat(system.x, system.gravity, system.t), ca.vertcat(q, v, ca.DM([0.0, -1.0]), t)]
    matrix = ca.substitute(system.mass_matrix, *swap)
    force = ca.substitute(system.generalized_forces, *swap)
    u, p = system.u, system.p
    momentum = matrix @ v
    drift = force + ca.jtimes(momentum, q, v)  # Q + M'(q) v, so that d(M v)/dt equals it
    left_over = matrix @ a - force
    strong = ca.Function("strong", [q, v, a, u, p, t], [left_over])
    weak = ca.Function("weak", [q, v, u, p, t], [momentum, drift, ca.jacobian(momentum, p), ca.jacobian(drift, p)])
    driving = ca.substitute(system.input_forces, *swap)
    return MotionEquations(system, strong, weak, ca.Function("drive", [q, v, u, p, t], [driving]))


@functools.cache
def _low_pass(factor: int) -> FloatArray:
    """Return the filter of a decimation, as second-order sections."""
    from scipy import signal

    return np.asarray(signal.cheby1(8, 0.05, 0.8 / factor, output="sos"))


def decimated(rows: FloatArray, motion: SmoothedMotion) -> FloatArray:
    """Return rows (N, n * k), low-passed without delay, decimated, the touched ends cut off.

    Rows that do not count are 0 in what is measured and in what a model says: a filter carries nothing of them into
    their neighbours.
    """
    from scipy import signal

    factor = motion.factor
    if motion.counts is not None:
        rows = rows * np.repeat(motion.counts, rows.shape[1] // motion.counts.shape[1], axis=1)
    if factor == 1:
        return rows[motion.inside]
    sos = _low_pass(factor)
    inner = rows[motion.inside]
    smooth = signal.sosfiltfilt(sos, inner, axis=0, padlen=min(6 * factor, inner.shape[0] - 1))
    result = smooth[::factor]
    cut = 10 if result.shape[0] > 200 else 2
    return np.asarray(result[cut:-cut])


def weak_rows(rows: FloatArray, motion: SmoothedMotion, *, derivative: bool = False) -> FloatArray:
    """Return means of rows (N, k) over half overlapping test functions, or minus those over their derivatives.

    A test function is (1 - s^2)^2 on s in (-1, 1), so both it and its derivative vanish at its ends; it is as wide as
    five decimated samples. With ``derivative`` the result is the mean of the derivative of the rows, by parts.
    """
    dt = motion.sample_time
    width = max(5 * motion.factor, 8)
    rows = rows[motion.inside]
    width = min(width, rows.shape[0] // 4)
    s = (np.arange(width) + 0.5) / width * 2 - 1
    test = (1 - s**2) ** 2
    norm = test.sum()
    weights = 4 * s * (1 - s**2) * (2 / (width * dt)) if derivative else test
    starts = np.arange(0, rows.shape[0] - width + 1, max(width // 2, 1))
    windows = np.lib.stride_tricks.sliding_window_view(rows, width, axis=0)[starts]
    return np.asarray(windows @ (weights / norm))
