"""The record of an identified state-space model in what does not depend on its coordinates: poles and static gains."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from harness.models.estimate import Estimate, RankDecision
from identifiers.common.linear_model import LinearModel
from identifiers.common.one_step_estimate import LARGEST, quotient

__all__ = ["state_space_estimate"]

INTEGRATES = 1e-6
"""Distance of a pole from 1 below which a static gain would be that of an integrator."""


def state_space_estimate(model: LinearModel, singular_values: Sequence[float], rule: str) -> Estimate | None:
    """Return poles (modulus, angle) and static gains of a model, and its order as the rank that was decided.

    No intervals: what a subspace method leaves uncertain is known for many samples only, and depends on its window and
    on the order, which was chosen from the same data (Bauer 2005, Automatica 41:359).

    Parameters
    ----------
    model : LinearModel
    singular_values : sequence of float
        That the order was read from, largest first.
    rule : str
        What decided the order.

    Returns
    -------
    Estimate or None
        None beyond 200 parameters.

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
    spec, a = model.spec, np.asarray(model.a_matrix)
    n = len(a)
    poles = np.linalg.eigvals(a) if n else np.zeros(0, dtype=complex)
    poles = poles[poles.imag >= 0]
    poles = poles[np.lexsort((poles.imag, -np.abs(poles)))]
    names, units, values = [], [], []
    for number, pole in enumerate(poles, 1):
        names += [f"pole {number}, modulus", f"pole {number}, angle"]
        units += ["1", "rad"]
        values += [abs(pole), abs(np.angle(pole))]
    if not n or np.abs(np.linalg.eigvals(a) - 1.0).min() > INTEGRATES:
        gain = np.asarray(model.c_matrix) @ np.linalg.solve(np.eye(n) - a, np.asarray(model.b_matrix)) + model.d_matrix
        for row, output in enumerate(spec.outputs):
            for column, given in enumerate(spec.inputs):
                names.append(f"{output.name} per {given.name}, static")
                units.append(quotient(output.unit, given.unit))
                values.append(gain[row, column])
    if len(values) > LARGEST:
        return None
    seen = [value for value in singular_values if value > 0]
    return Estimate(
        tuple(names),
        tuple(units),
        np.array(values, dtype=float),
        method="no interval: the covariance of a subspace method is known for many samples only",
        rank=RankDecision(n, max(len(singular_values), n), rule=rule),
        condition=float(seen[0] / seen[min(n, len(seen)) - 1]) if seen and n else float("nan"),
    )
