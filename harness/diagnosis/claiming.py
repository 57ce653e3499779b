"""The balance of forces with effects that have no equation form: their force is simulated along the measured motion."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from harness.diagnosis.equation import Equations, Form, bump_rows
from harness.diagnosis.motion import Motion
from harness.effects import Signals
from harness.effects.claimed import ClaimedForce
from harness.signals import FloatArray

__all__ = ["Claiming"]

STEP = 1e-3
"""Of a finite difference, as a part of the parameter or of its usual size."""


@dataclass(frozen=True, eq=False)
class Claiming(Equations):
    """Equations less the forces that effects claim; see :class:`harness.diagnosis.equation.Equations`.

    ``system`` has all parameters, for their names and bounds; its own functions are never asked.

    Attributes
    ----------
    inner : Equations
        Of the model without these effects; its residual may be filtered.
    claims : tuple of ClaimedForce
        Several are added up: each is small beside the motion that is measured.
    average : callable
        Brings columns (N, n, k) of forces along a motion to the rows of the residual.
    """

    inner: Any = None
    claims: tuple[ClaimedForce, ...] = ()
    average: Callable[[FloatArray, Motion], FloatArray] = lambda columns, motion: columns

    def residual(
        self, motion: Motion, p: FloatArray, form: Form = "weak", columns: Sequence[int] | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Return the residual (rows, n) and its derivative (rows, n, k); claims are differenced."""
        p, names, within = np.asarray(p, dtype=float), self.system.parameter_names, self.inner.system.parameter_names
        wanted = list(range(p.size)) if columns is None else list(columns)
        own = [k for k in wanted if names[k] in within]
        r, j = self.inner.residual(motion, self._inside(p), form, [within.index(names[k]) for k in own])
        signals = motion.signals()
        force = self._claimed(signals, p)
        sides = [force]
        for k in wanted:
            step = self._step(k, p)
            moved = p.copy()
            moved[k] += step
            sides.append((self._claimed(signals, moved) - force) / step)
        rows = self.average(np.stack(sides, axis=2), motion)
        slopes = -rows[:, :, 1:]
        slopes[:, :, [wanted.index(k) for k in own]] += j
        return r - rows[:, :, 0], slopes

    def balance(self, motion: Motion, p: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the residual of the weak form and the change of momentum in it, both (rows, n), never filtered."""
        p = np.asarray(p, dtype=float)
        left, change = self.inner.balance(motion, self._inside(p))
        return left - bump_rows(self._claimed(motion.signals(), p), motion), change

    def force_of(self, motion: Motion, u: FloatArray, p: FloatArray) -> FloatArray:
        """Return the force (N, n) of inputs u (N, nu) along a motion, after what claims take from it."""
        p = np.asarray(p, dtype=float)
        inputs = {channel.name for channel in self.system.inputs}
        here = [one for one in self.claims if one.placed.at in inputs]
        signals = motion.signals(u)
        return np.asarray(self.inner.force_of(motion, u, self._inside(p)) + self._claimed(signals, p, here))

    def _inside(self, p: FloatArray) -> FloatArray:
        """Return the parameters of the model without the claims."""
        known = dict(zip(self.system.parameter_names, p, strict=True))
        return np.array([known[name] for name in self.inner.system.parameter_names])

    def _claimed(self, signals: Signals, p: FloatArray, claims: Sequence[ClaimedForce] | None = None) -> FloatArray:
        """Return the force (N, n) that claims add along a motion."""
        known = dict(zip(self.system.parameter_names, map(float, p), strict=True))
        nominal = {name: known[name] for name in self.inner.system.parameter_names}
        total = np.zeros_like(signals.q)
        for one in self.claims if claims is None else claims:
            own = {short.name: known[one.placed.name(short.name)] for short in one.placed.effect.parameters}
            total += one(signals, own, nominal)
        return total

    def _step(self, k: int, p: FloatArray) -> float:
        """Return the step of a finite difference, away from the nearer bound."""
        parameter = self.system.parameters[k]
        usual = abs(self.system.values()[parameter.name])
        step = STEP * (max(abs(float(p[k])), usual) or 1.0)
        return step if p[k] + step <= parameter.maximum else -step
