"""The record of an identified state-space model in what does not depend on its coordinates: poles and static gains."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from harness.models.estimate import Estimate, RankDecision
from harness.models.spread import Matrices, covariance_of, matched_poles, quantile
from harness.signals import FloatArray
from harness.units import quotient
from identifiers.common.linear_model import LinearModel
from identifiers.common.one_step_estimate import LARGEST, LEVEL

INTEGRATES = 1e-6  # Distance of a pole from 1 below which a static gain would be that of an integrator.


def state_space_estimate(model: LinearModel, singular_values: Sequence[float], rule: str) -> Estimate | None:
    """Return poles (modulus, angle) and static gains of a model, and its order as the rank that was decided.

    Intervals follow from the model's spread, the fits without one stretch of the records each, to first order; that the
    order was chosen from the same data is not in them.

    - ``singular_values``: that the order was read from, largest first
    - ``rule``: what decided the order
    - returns None beyond 200 parameters

    Examples
    --------
    >>> from harness.signals import Channel, PlantSpec
    >>> spec = PlantSpec((Channel("u", "V"),), (Channel("y", "m"),), 0.1)
    >>> zero = np.zeros((1, 1))
    >>> made = LinearModel(spec, np.array([[0.5]]), np.ones((1, 1)), np.ones((1, 1)), zero, zero, zero[0], zero[0])
    >>> found = state_space_estimate(made, [2.0, 0.1], "given")
    >>> [f"{name} = {value:g} {unit}" for name, value, unit in zip(found.names, found.values, found.units)]
    ['pole 1, modulus = 0.5 1', 'pole 1, angle = 0 rad', 'y per u, static = 2 m/V']
    >>> print(found.rank)
    rank 1 of 2 (given)
    """
    spec, n = model.spec, len(model.a_matrix)
    poles = np.linalg.eigvals(model.a_matrix).astype(np.complex128)
    upper = poles[poles.imag >= 0]
    upper = upper[np.lexsort((upper.imag, -np.abs(upper)))]
    names, units = [], []
    for number in range(1, len(upper) + 1):
        names += [f"pole {number}, modulus", f"pole {number}, angle"]
        units += ["1", "rad"]
    settles = not n or bool(np.abs(poles - 1.0).min() > INTEGRATES)
    for output in spec.outputs if settles else ():
        for given in spec.inputs:
            names.append(f"{output.name} per {given.name}, static")
            units.append(quotient(output.unit, given.unit))

    def values_of(matrices: Matrices) -> FloatArray:
        found = matched_poles(upper, matrices[0]) if n else upper
        told = np.column_stack([np.abs(found), np.abs(np.angle(found))]).ravel()
        return np.concatenate([told, _static(matrices)]) if settles else told

    values = values_of(model.matrices)
    if len(values) > LARGEST:
        return None
    seen = [value for value in singular_values if value > 0]
    covariance = intervals = None
    method = "no interval: too few rows to leave stretches out, or the model was moved"
    if model.spread is not None:
        covariance = covariance_of(model, values_of)
        half = quantile(model.spread, LEVEL) * np.sqrt(np.diag(covariance))
        method = model.spread.method
        if model.spread.warning:
            method = f"no interval: {model.spread.warning}"
        elif np.isfinite(half).all():
            intervals = np.column_stack([values - half, values + half])
    return Estimate(
        tuple(names),
        tuple(units),
        values,
        covariance,
        intervals,
        LEVEL,
        method,
        RankDecision(n, max(len(singular_values), n), rule=rule),
        float(seen[0] / seen[min(n, len(seen)) - 1]) if seen and n else float("nan"),
    )


def _static(matrices: Matrices) -> FloatArray:
    """Return the static gains, output by output."""
    a, b, c, d = matrices
    found: FloatArray = (c @ np.linalg.solve(np.eye(len(a)) - a, b) + d).ravel()
    return found
