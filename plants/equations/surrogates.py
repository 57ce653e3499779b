"""Surrogates of two flow experiments: the perching glider, and the hydrodynamic cart-pole in a water tunnel.

Both are ordinary differential equations of a few states in place of a flow with infinitely many.
"""

from __future__ import annotations

from typing import Any

from plants.equations.ode import named
from plants.equations.ode_plant import OdePlant

# Keeps the root of a squared speed smooth at rest [m^2/s^2].
STILL = 1e-12


def glider_ode(**options: Any) -> OdePlant:
    """Perching glider: two flat plates (wing with fuselage, elevator) in still air, driven by the elevator's rate.

    The model ``perching-glider``. The stops of the elevator (-0.4463, 0.9473 rad) are left out.

    Parameters
    ----------
    **options
        Of :class:`plants.equations.ode.OdePlant`. Parameters: m [kg], I [kg m^2], S_w, S_e [m^2] areas of wing and
        elevator,
        l_w, l_h, l_e [m] from the centre of mass to the wing, to the hinge, from the hinge to the elevator's centre,
        rho [kg/m^3], g [m/s^2].

    Notes
    -----
    It starts 3.5 m before the perch at 7 m/s.

    Examples
    --------
    >>> print(glider_ode().spec)
    phidot [rad/s] -> x [m], z [m], theta [rad], phi [rad] every 0.01 s
    """
    start = {"x": -3.5, "z": 0.1, "xdot": 7.0}
    defaults = {"model": "perching-glider", "u_limit": 13.0, "initial": start, "sample_time": 0.01}
    return named("glider-ode", defaults, options)


def hydro_cart_pole_ode(**options: Any) -> OdePlant:
    """Hydrodynamic cart-pole: a wing hinged to a cart across a water stream, which takes the part of gravity.

    theta = 0 trails downstream (stable), theta = pi points into the stream (unstable). On the wing act the force of a
    flat plate along its normal, ``-rho S |w| (n . w)`` with the velocity w against the water, the mass of water that it
    pushes along its normal, and a periodic force of shed vortices from a wake oscillator of van der Pol that is driven
    by the wing's normal acceleration.

    Parameters
    ----------
    **options
        Of :class:`plants.equations.ode.OdePlant`. Parameters: mc, mw [kg] cart and wing, chord, span [m], U [m/s]
        stream,
        rho [kg/m^3], bx, btheta friction of rail and hinge, Omega [rad/s] shedding, Cw force coefficient of the wake
        (0: no wake), eps and A of the wake oscillator.

    Notes
    -----
    A surrogate of our own for the experiment of J. W. Roberts (hydrodynamic cart-pole, MIT). Sources of its parts:
    added mass ``rho pi (c/2)^2`` and added inertia ``rho pi (c/2)^4 / 8`` for each unit of span of a plate of chord c,
    J. N. Newman, *Marine Hydrodynamics*, table 4.3; wake oscillator with acceleration coupling, A = 12, eps = 0.3:
    M. L. Facchinetti, E. de Langre, F. Biolley, Journal of Fluids and Structures 19 (2004) 123-140. The velocity
    terms of the added mass leave the stream out, because the plate force stands for all steady forces.

    Examples
    --------
    >>> print(hydro_cart_pole_ode().spec)
    u [N] -> x [m], theta [rad] every 0.02 s
    """
    defaults = {"model": _hydro_cart_pole(), "u_limit": 1.0, "initial": {"wake": 2.0}, "sample_time": 0.02}
    return named("hydro-cart-pole-ode", defaults, options)


def _hydro_cart_pole() -> Any:
    """Return the equations of motion of the hydrodynamic cart-pole."""
    import sympy as sp

    from harness.physics import Ode

    units = {"x": "m", "theta": "rad", "xdot": "m/s", "thetadot": "rad/s", "wakedot": "1/s", "u": "N"}
    given = {
        "mc": ("kg", 1.0),
        "mw": ("kg", 0.2),
        "chord": ("m", 0.1),
        "span": ("m", 0.2),
        "U": ("m/s", 0.22),
        "rho": ("kg/m^3", 1000.0),
        "bx": ("N s/m", 0.5),
        "btheta": ("N m s/rad", 1e-4),
        "Omega": ("rad/s", 2.1),
        "Cw": ("1", 0.1),
        "eps": ("1", 0.3),
        "A": ("1", 12.0),
    }
    model = Ode(
        "hydro-cart-pole",
        x="x theta xdot thetadot wake wakedot",
        u="u",
        p=" ".join(given),
        units=units,
        parameters=given,
    )
    x, theta, v, rate, wake, waker = model.x
    (u,) = model.u
    mc, mw, chord, span, stream, rho, bx, btheta, omega, cw, eps, a = model.p
    sine, cosine, arm = sp.sin(theta), sp.cos(theta), chord / 2
    pushed = rho * sp.pi.evalf(17) * arm**2 * span
    inertia = mw * chord**2 / 12 + pushed * arm**2 / 8
    # velocity of the wing's middle against the water, along x, along the stream, along the normal (cos, sin)
    across, along = v + arm * rate * cosine, arm * rate * sine + stream
    normal = across * cosine + along * sine
    area = chord * span
    force = -rho * area * sp.sqrt(across**2 + along**2 + STILL) * normal + cw * rho * area * stream**2 / 2 * wake
    m11, m12 = mc + mw + pushed * cosine**2, (mw + pushed) * arm * cosine
    m22 = inertia + (mw + pushed) * arm**2
    q1 = u - bx * v + force * cosine + 2 * pushed * cosine * sine * rate * v + (mw + pushed) * arm * sine * rate**2
    q2 = arm * force - btheta * rate - pushed * cosine * sine * v**2
    det = m11 * m22 - m12**2
    cart, turn = (m22 * q1 - m12 * q2) / det, (m11 * q2 - m12 * q1) / det
    pull = cart * cosine + arm * turn - v * sine * rate
    model.rhs = [v, rate, cart, turn, waker, a / chord * pull - eps * omega * (wake**2 - 1) * waker - omega**2 * wake]
    model.outputs = {"x": x, "theta": theta}
    return model
