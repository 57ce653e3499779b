"""The functions of the motion behind a lumped model, and the test functions of its weak form."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np
import sympy as sp

from harness.physics.arms.vectorised import Vectorised
from harness.physics.symbolic.convert import to_casadi
from harness.physics.symbolic.lumping import Split
from harness.physics.symbolic.mechanism import Mechanism
from harness.signals import FloatArray


def test_function_on(t: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return a test function on a stretch of time, its derivative, and the weights of the trapezoidal rule."""
    width = t[-1] - t[0]
    s = 2 * (t - t[0]) / width - 1
    weight = np.zeros_like(t)
    step = np.diff(t)
    weight[:-1] += step / 2
    weight[1:] += step / 2
    return (1 - s**2) ** 3, -12 * s * (1 - s**2) ** 2 / width, weight


def jumping_mean(
    test_function: FloatArray, sides: tuple[FloatArray, FloatArray], part: slice, t: FloatArray
) -> FloatArray:
    """Return the integral of a test function times something that may jump at the samples, (after, before) given."""
    step = np.diff(t[part])
    after, before = sides[0][part], sides[1][part]
    forward = np.concatenate([step, [0.0]]) * test_function / 2
    backward = np.concatenate([[0.0], step]) * test_function / 2
    return np.tensordot(forward, after, axes=1) + np.tensordot(backward, before, axes=1)


def motion_functions(mechanism: Mechanism, parts: Split) -> dict[str, Vectorised]:
    """Return the functions of the motion behind the three forms, for whole records."""
    return {name: Vectorised(inputs, outputs) for name, (inputs, outputs) in motion_terms(mechanism, parts).items()}


def motion_terms(mechanism: Mechanism, parts: Split) -> dict[str, tuple[list[Any], list[Any]]]:
    """Return the same as CasADi columns, by its differentiation: the symbols (q, v, u, t, a) and what they make."""
    n, nu, k = len(mechanism.q), len(mechanism.u), len(parts.combinations)
    q, v, a = ca.SX.sym("q", n), ca.SX.sym("v", n), ca.SX.sym("a", n)
    u, t = ca.SX.sym("u", nu), ca.SX.sym("t")
    table: dict[Any, Any] = {mechanism.t: t}
    for symbols, column in ((mechanism.q, q), (mechanism.v, v), (mechanism.u, u)):
        table.update({symbol: column[row] for row, symbol in enumerate(symbols)})

    def energy_terms(lagrangian: Any) -> tuple[Any, Any, Any]:
        """Return energy, momentum and dL/dq of a Lagrangian."""
        expression = to_casadi(sp.sympify(lagrangian), table)
        momentum = ca.gradient(expression, v)
        return ca.dot(v, momentum) - expression, momentum, ca.gradient(expression, q)

    def stacked(forces: Sequence[Any]) -> Any:
        return ca.vertcat(*(to_casadi(sp.sympify(force), table) for force in forces))

    def rate(momentum: Any) -> Any:
        return ca.jtimes(momentum, q, v) + ca.jtimes(momentum, v, a) + ca.jtimes(momentum, t, ca.SX(1.0))

    energies, momenta, pulls, pushes, torques = [], [], [], [], []
    for lagrangian, forces in zip(parts.lagrangians, parts.forces, strict=True):
        energy, momentum, pull = energy_terms(lagrangian)
        push = stacked(forces)
        energies.append(energy)
        momenta.append(momentum)
        pulls.append(pull + push)
        pushes.append(push)
        torques.append(rate(momentum) - pull - push)
    known_energy, known_momentum, known_pull = energy_terms(parts.known_lagrangian)
    known_push = stacked(parts.known_forces)
    inputs = [q, v, u, t]

    def rows(columns: list[Any]) -> Any:
        """Return (n, k) as one column, coordinate by coordinate."""
        return ca.vec(ca.horzcat(*columns).T) if k else ca.SX(0, 1)

    return {
        "torque": ([*inputs, a], [rows(torques)]),
        "torque_known": ([*inputs, a], [known_push + known_pull - rate(known_momentum)]),
        "energy": (inputs, [ca.vertcat(*energies) if k else ca.SX(0, 1)]),
        "momentum": (inputs, [rows(momenta)]),
        "force": (inputs, [rows(pulls), known_pull + known_push]),
        "generalized": (inputs, [rows(pushes), known_push]),
        "known": (inputs, [known_energy, known_momentum]),
    }
