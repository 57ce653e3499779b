"""Nominal parameters that leave the inertia of a motor out of the plant that it drives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import casadi as ca
import numpy as np

from harness.diagnosis.directions.changed import LOOKED_AT
from harness.diagnosis.directions.directions import signals_of
from harness.diagnosis.directions.trace import Trace
from harness.physics.compiled.system import System

_FARTHEST = 5.0
"""Times a parameter, or part of it: a step of first order reaches no farther."""


def lightened(
    traces: Sequence[Trace], nominal: System, values: Mapping[str, float], free: Sequence[str], at: str, inertia: float
) -> dict[str, float]:
    """Return values of free parameters with which a plant is lighter by an inertia and moves alike otherwise.

    A nominal fit holds the inertia of whatever turns along. Along the smoothed motion what the parameters change in
    ``M a - F`` is brought as near to ``-inertia a`` at the coordinate as they allow, by least squares.

    - ``traces``: smoothed records
    - ``nominal``: given by its equations of motion
    - ``values``: of all nominal parameters
    - ``free``: nominal parameters that may move
    - ``at``: the coordinate
    - returns new values of ``free``
    """
    place = [coordinate.name for coordinate in nominal.coordinates].index(at)
    columns = [nominal.parameter_names.index(name) for name in free]
    a = ca.SX.sym("a", len(nominal.coordinates))
    left = nominal.upright(ca.mtimes(nominal.mass_matrix, a) - nominal.generalized_forces)
    by_p = ca.densify(ca.jacobian(left, nominal.p)[:, columns])
    function = ca.Function("by_p", [nominal.x, nominal.u, nominal.p, nominal.t, a], [by_p])
    now = np.array([values[name] for name in free])
    p = nominal.vector({name: values[name] for name in nominal.parameter_names})
    rows, wanted = [], []
    for trace in traces:
        every = slice(None, None, max(1, len(trace.record) // LOOKED_AT))
        moved = signals_of(trace, nominal).a[every]
        n = len(moved)
        derivative = function.map(n)(
            trace.x[every, : nominal.nx].T, trace.record.u[every].T, np.tile(p[:, None], n), trace.record.t[every],
            moved.T,
        ).full()  # fmt: skip
        rows.append(derivative.reshape(len(a.nz), n, len(free)).transpose(1, 0, 2) * now)
        force = np.zeros_like(moved)
        force[:, place] = -inertia * moved[:, place]
        wanted.append(force)
    matrix, target = np.concatenate(rows), np.concatenate(wanted)
    size = np.sqrt((matrix**2).sum(axis=2).mean(axis=0))  # coordinates have units of their own
    size[size == 0] = 1.0
    step = np.linalg.lstsq((matrix / size[:, None]).reshape(-1, len(free)), (target / size).reshape(-1), rcond=1e-9)[0]
    return dict(zip(free, (now * np.clip(1.0 + step, 1.0 / _FARTHEST, _FARTHEST)).tolist(), strict=True))
