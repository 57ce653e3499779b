"""Nominal models of small aircraft in a vertical plane: quadrotor and perching glider."""

from __future__ import annotations

from typing import Any

import sympy as sp

from harness.physics.definition.parameters import Parameter
from harness.physics.symbolic.mechanism import Mechanism
from harness.physics.symbolic.ode import Ode

STILL = 1e-12  # Keeps the root of a squared speed smooth at rest [m^2/s^2].


def planar_quadrotor() -> Mechanism:
    """Planar quadrotor: the thrusts u1 and u2 of two propellers at distance r from the centre of mass.

    The motion shows m and I / r only; r is measured with a ruler (fixed). Values of the chapter's example
    (Tedrake 2024, *Underactuated Robotics*, ch. 3).

    Examples
    --------
    >>> print(planar_quadrotor().system())
    planar-quadrotor: u1 [N], u2 [N] -> x [m], y [m], theta [rad]
    """
    m = Mechanism("planar-quadrotor", q="x y theta", u="u1 u2", p="m I r", units={"u1": "N", "u2": "N"})
    (x, y, theta), (u1, u2), (mass, inertia, r) = m.q, m.u, m.p
    m.body(mass, (x, y), inertia, theta)
    m.Q = [-(u1 + u2) * sp.sin(theta), (u1 + u2) * sp.cos(theta), r * (u1 - u2)]
    m.parameters(m=("kg", 0.486), I=("kg m^2", 0.00383), r=Parameter("r", "m", 0.25, 0.0, fixed=True))
    return m


def perching_glider() -> Ode:
    """Perching glider: two flat plates (wing with fuselage, elevator) in still air, driven by the elevator's rate.

    Each plate feels a force along its normal, ``F = -rho S |v| (n . v)`` with the velocity v of its centre: the flat
    plate of lift ``2 sin(a) cos(a)`` and drag ``2 sin(a)^2``. Pitch theta and elevator phi count positive nose down, as
    a turn about the axis y with x forward and z up does. Mass and lengths are measured (fixed), the aerodynamic areas
    and the inertia are fitted.

    Notes
    -----
    J. W. Roberts, R. Cory, R. Tedrake, "On the controllability of fixed-wing perching", American Control Conference
    2009, section II; parameters of the glider in Drake's examples (there pitch counts positive nose up).

    Examples
    --------
    >>> print(perching_glider().system())
    perching-glider: phidot [rad/s] -> x [m], z [m], theta [rad], phi [rad]
    """
    units = {
        "x": "m",
        "z": "m",
        "theta": "rad",
        "phi": "rad",
        "xdot": "m/s",
        "zdot": "m/s",
        "thetadot": "rad/s",
        "phidot": "rad/s",
    }
    fitted = {"I": ("kg m^2", 0.0015), "S_w": ("m^2", 0.0885), "S_e": ("m^2", 0.0147)}
    known = {
        "m": ("kg", 0.08),
        "l_w": ("m", 0.0),
        "l_h": ("m", 0.27),
        "l_e": ("m", 0.022),
        "rho": ("kg/m^3", 1.204),
        "g": ("m/s^2", 9.81),
    }
    given: dict[str, Any] = {name: Parameter(name, unit, value, 0.0) for name, (unit, value) in fitted.items()}
    given |= {name: Parameter(name, unit, value, fixed=True) for name, (unit, value) in known.items()}
    model = Ode(
        "perching-glider",
        x="x z theta phi xdot zdot thetadot",
        u="phidot",
        p="m I S_w S_e l_w l_h l_e rho g",
        units=units,
        parameters=given,
    )
    x, z, theta, phi, vx, vz, rate = model.x
    (turn,) = model.u
    m, inertia, s_w, s_e, l_w, l_h, l_e, rho, g = model.p
    tail = theta + phi

    def force(area: Any, angle: Any, px: Any, pz: Any) -> Any:
        """Return the force along the normal (sin, cos) of a plate whose centre moves with (px, pz)."""
        return -rho * area * sp.sqrt(px**2 + pz**2 + STILL) * (sp.sin(angle) * px + sp.cos(angle) * pz)

    wing = force(s_w, theta, vx - l_w * rate * sp.sin(theta), vz - l_w * rate * sp.cos(theta))
    swing = l_e * (rate + turn)
    elevator = force(
        s_e,
        tail,
        vx + l_h * rate * sp.sin(theta) + swing * sp.sin(tail),
        vz + l_h * rate * sp.cos(theta) + swing * sp.cos(tail),
    )
    model.rhs = [
        vx,
        vz,
        rate,
        turn,
        (wing * sp.sin(theta) + elevator * sp.sin(tail)) / m,
        (wing * sp.cos(theta) + elevator * sp.cos(tail)) / m - g,
        (elevator * (l_h * sp.cos(phi) + l_e) - wing * l_w) / inertia,
    ]
    model.outputs = {"x": x, "z": z, "theta": theta, "phi": phi}
    return model
