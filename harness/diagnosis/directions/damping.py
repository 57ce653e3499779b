"""How much brakes a coordinate, place by place: what a law of damping must keep from turning into a drive."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from harness.signals import FloatArray

if TYPE_CHECKING:
    from harness.physics.compiled.system import System

PLACES = 41
"""Places along the motion."""


def damping_along(
    system: System, values: Mapping[str, float], at: str, q: FloatArray, v: FloatArray
) -> tuple[FloatArray, FloatArray] | None:
    """Return places between the ends of a motion (K,), and the damping of all that brakes the coordinate there (K,).

    It is the part of the force that turns with the direction, at the usual speed, over that speed: viscous and dry
    friction count, springs, weight and centrifugal forces do not.

    - ``system``: with its effects; None is returned for one whose forces are no expressions
    - ``values``: of all parameters
    - ``at``: name of the coordinate
    - ``q, v`` (N,): the coordinate and its rate along the records

    Examples
    --------
    >>> from harness.physics.models import pendulum
    >>> system = pendulum().system()
    >>> places, damping = damping_along(system, system.values({"b": 0.3}), "theta", np.array([-1.0, 1.0]), np.ones(2))
    >>> bool(np.allclose(damping, 0.3)), len(places)
    (True, 41)
    """
    import casadi as ca

    forces, speed = getattr(system, "generalized_forces", None), float(np.sqrt(np.mean(v**2)))
    if not isinstance(forces, ca.SX) or not speed > 0:
        return None
    row = system.coordinate(at)
    function = ca.Function("Q", [system.x, system.u, system.p, system.t], [system.upright(forces[row.force])])
    places = np.linspace(float(q.min()), float(q.max()), PLACES)
    sides = []
    for sign in (1.0, -1.0):
        x = np.zeros((system.nx, PLACES))
        x[row.q], x[row.v] = places, sign * speed
        still = np.zeros((system.nu, PLACES)), np.tile(system.vector(values)[:, None], PLACES), np.zeros((1, PLACES))
        sides.append(function.map(PLACES)(x, *still).full()[0])
    return places, -(sides[0] - sides[1]) / (2 * speed)
