"""Lumped parameters of an arm too large to be written out: base parameters, and compiled functions of the motion."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property

import numpy as np
import sympy as sp

from harness.physics.arms.arm import REST
from harness.physics.arms.mechanism import ArmMechanism
from harness.physics.arms.regressor import ArmRegressor, Form
from harness.physics.lumps.identifiability import identifiability
from harness.physics.symbolic.lumping import Split, known_symbols
from harness.signals import FloatArray

MOTIONS = 400
"""Random instants on which dependent columns are found; the gap of an iiwa is above 1e10 on a tenth of them."""
TOLERANCE = 1e-8  # A column that is new by less than this, relative to its length, is a sum of the others.
EXACT = 1e-10  # Shares below this, or this near to a whole number, are rounding.

Function = Callable[..., list[FloatArray]]


class ArmLumps:
    """Base parameters of an arm (Gautier 1991) and what they are multiplied by.

    Parameters
    ----------
    mechanism : ArmMechanism
    known : mapping
        Parameters whose value is known.

    Attributes
    ----------
    split : Split
        The combinations; the functions of the motion are those of :attr:`functions`.
    names : tuple of str
        The combinations as text; a long one by its first parameter.
    functions : mapping
        By the names that :class:`harness.physics.LumpedModel` uses, each of (q, v, u, t[, a]).
    """

    def __init__(self, mechanism: ArmMechanism, known: Mapping[str, float]) -> None:
        self.mechanism = mechanism
        symbols = [str(symbol) for symbol in mechanism.p]
        values = {str(symbol): float(value) for symbol, value in known_symbols(mechanism, known).items()}
        self.free = [row for row, name in enumerate(symbols) if name not in values]
        self.value = np.array([values.get(name, 0.0) for name in symbols])
        self.n, self.count = mechanism.arm.n, 10 * len(mechanism.arm.arm.joints)
        self._by_form: dict[str, ArmRegressor] = {"torque": mechanism.arm.arm.compiled_regressor}
        rng = np.random.default_rng(0)
        q, v, a = rng.uniform(-2, 2, size=(3, MOTIONS, self.n))
        found = identifiability(
            self.wide("torque", q, v, a)[..., self.free].reshape(MOTIONS * self.n, -1),
            [symbols[row] for row in self.free],
            tolerance=TOLERANCE,
        )
        self.kept = [self.free[row] for row in found.kept]
        shares = np.where(np.abs(found.shares) < EXACT, 0.0, found.shares)
        whole = np.round(shares)
        shares = np.where(np.abs(shares - whole) < EXACT, whole, shares)
        combinations, names = [], []
        for row, own in zip(shares, self.kept, strict=True):
            others = [(value, mechanism.p[self.free[d]]) for value, d in zip(row, found.dropped, strict=True) if value]
            total = mechanism.p[own] + sum(_number(value) * symbol for value, symbol in others)
            combinations.append(total)
            text = str(total)
            names.append(text if len(others) <= 2 else f"{mechanism.p[own]} + {len(others)} more")
        self.split = Split(tuple(combinations), (), (), sp.Integer(0), ())
        self.names = tuple(names)

    @cached_property
    def functions(self) -> dict[str, Function]:
        """The functions of the motion; each form is compiled when it is first used."""
        return {
            "torque": self._torque,
            "torque_known": self._torque_known,
            "energy": self._energy,
            "momentum": self._momentum,
            "force": self._force,
            "generalized": self._generalized,
            "known": self._known,
        }

    def wide(self, form: Form, q: FloatArray, v: FloatArray, a: FloatArray) -> FloatArray:
        """Return the regressor (N, rows, np) of all parameters of the mechanism in a form."""
        if form not in self._by_form:
            self._by_form[form] = ArmRegressor(self.mechanism.arm.arm.joints, form)
        gravity = (0.0, 0.0, -self.mechanism.g)
        rigid = self._by_form[form](q, v, a, gravity).reshape(len(q), -1, self.count)
        joints = np.zeros((len(q), rigid.shape[1], 2 * self.n))
        if form in ("torque", "pull"):
            sign = 1.0 if form == "torque" else -1.0
            for row in range(self.n):
                joints[:, row, row] = sign * v[:, row]
                joints[:, row, self.n + row] = sign * np.tanh(v[:, row] / REST)
        return np.concatenate([rigid, joints], axis=2)

    # ---- the functions of a lumped model -------------------------------------------------------------------------

    def _driven(self, u: FloatArray) -> FloatArray:
        """Return the forces (N, n) of the inputs."""
        names = [str(symbol) for symbol in self.mechanism.u]
        push = np.zeros((len(u), self.n))
        for row, channel in enumerate(self.mechanism.arm.inputs):
            if channel.name in names:
                push[:, row] = u[:, names.index(channel.name)]
        return push

    def _flat(self, wide: FloatArray) -> FloatArray:
        return wide[..., self.kept].reshape(len(wide), -1)

    def _torque(self, q: FloatArray, v: FloatArray, u: FloatArray, t: FloatArray, a: FloatArray) -> list[FloatArray]:
        return [self._flat(self.wide("torque", q, v, a))]

    def _torque_known(
        self, q: FloatArray, v: FloatArray, u: FloatArray, t: FloatArray, a: FloatArray
    ) -> list[FloatArray]:
        return [self._driven(u) - self.wide("torque", q, v, a) @ self.value]

    def _energy(self, q: FloatArray, v: FloatArray, u: FloatArray, t: FloatArray) -> list[FloatArray]:
        return [self._flat(self.wide("energy", q, v, np.zeros_like(q)))]

    def _momentum(self, q: FloatArray, v: FloatArray, u: FloatArray, t: FloatArray) -> list[FloatArray]:
        return [self._flat(self.wide("momentum", q, v, np.zeros_like(q)))]

    def _force(self, q: FloatArray, v: FloatArray, u: FloatArray, t: FloatArray) -> list[FloatArray]:
        wide = self.wide("pull", q, v, np.zeros_like(q))
        return [self._flat(wide), self._driven(u) + wide @ self.value]

    def _generalized(self, q: FloatArray, v: FloatArray, u: FloatArray, t: FloatArray) -> list[FloatArray]:
        only = np.zeros((len(q), self.n, self.count + 2 * self.n))
        for row in range(self.n):
            only[:, row, self.count + row] = -v[:, row]
            only[:, row, self.count + self.n + row] = -np.tanh(v[:, row] / REST)
        return [self._flat(only), self._driven(u) + only @ self.value]

    def _known(self, q: FloatArray, v: FloatArray, u: FloatArray, t: FloatArray) -> list[FloatArray]:
        no_acceleration = np.zeros_like(q)
        energy = self.wide("energy", q, v, no_acceleration) @ self.value
        return [energy, self.wide("momentum", q, v, no_acceleration) @ self.value]


def _number(value: float) -> sp.Number:
    return sp.Integer(round(value)) if value == round(value) else sp.Float(value)
