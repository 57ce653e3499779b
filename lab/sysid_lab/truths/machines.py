"""Laws of drives, springs and bases as machines have them: each by its own parts, in the words of ``truth.c``.

The dictionary's parameters that a name comes with (``named``) follow from the parts where both mean the same; a gear of
one efficiency loses a little more while the load drives, which the dictionary's law has only with its ratio freed.
"""

from __future__ import annotations

import math

import numpy as np

from harness.signals import FloatArray
from sysid_lab.truths.context import Context, Hidden, rms
from sysid_lab.truths.simulation import DT, GRAVITY


def lossy_gear(context: Context, at: str, scale: float, size: float, rng: np.random.Generator) -> Hidden:
    """Return a gear that loses this share of what it transmits."""
    return Hidden("gear_loss", at, {"eta": 1.0 - size}, {"c": size}, exact=False)


def ripple(context: Context, at: str, scale: float, size: float, rng: np.random.Generator) -> Hidden:
    """Return a commutation that repeats three to eight times a turn, or times the way."""
    k = max(3.0, float(rng.integers(3, 9)) / (1.0 if at == "theta" else max(1.0, rms(context.q(at)))))
    a, phi = math.sqrt(2) * size, float(rng.uniform(-math.pi, math.pi))
    return Hidden("torque_ripple", at, {"rip": a, "ripk": k, "ripphi": phi}, {"a": a, "k": k, "phi": phi})


def supply_sag(context: Context, at: str, scale: float, size: float, rng: np.random.Generator) -> Hidden:
    """Return a supply that sags within 0.3 to 1.5 s: what it takes of the force changes by this share of the rms."""
    u, tau = context.u, math.exp(rng.uniform(math.log(0.3), math.log(1.5)))
    z = _lagged(np.abs(u), tau)
    c = size * rms(u) / rms((z - z.mean()) * u)
    return Hidden("supply_sag", at, {"sagc": c, "sagtau": tau}, {"c": c, "tau": tau})


def _lagged(signal: FloatArray, tau: float) -> FloatArray:
    """Return a signal (N,) behind a lag of the first order that begins at 0."""
    from scipy.signal import lfilter

    pole = math.exp(-DT / tau)
    return np.asarray(lfilter([1.0 - pole], [1.0, -pole], signal))


def propeller(context: Context, at: str, scale: float, size: float, rng: np.random.Generator) -> Hidden:
    """Return a thrust that is quadratic in the command; it has no smaller size."""
    u = rms(context.u)
    return Hidden("propeller_thrust", at, {"square": u}, {"s": 1.0, "U": u})


def counterbalanced(context: Context, at: str, scale: float, size: float, rng: np.random.Generator) -> Hidden:
    """Return a spring from the arm's end to an anchor above the axis, whose second harmonic has this size."""
    arm, anchor = 0.05, 0.05 * float(rng.uniform(1.5, 3.0))
    far = math.hypot(arm, anchor)
    rho, free = 2 * arm * anchor / far**2, float(rng.uniform(0.5, 0.8)) * (anchor - arm)
    place = math.pi + float(rng.uniform(-0.1, 0.1))
    q = context.q("theta") - place
    s = np.sqrt(1 - rho * np.cos(q))
    second = size * context.torque(at) / rms(2 * np.sin(2 * q) / (s * (1 + s)))
    stiffness = second * 4 * far / (rho * free * arm * anchor)
    truth = {"arm": arm, "anchor": anchor, "kc": stiffness, "free": free, "place": place}
    return Hidden("counterbalance", at, truth, {"A": second, "alpha": place - math.pi, "rho": -rho}, exact=False)


def swaying_base(context: Context, at: str, scale: float, size: float, rng: np.random.Generator) -> Hidden:
    """Return a base that takes this share of the link's inertia, at 3 to 6 Hz."""
    moment = context.values["mgl"] / GRAVITY
    mass, omega = moment**2 / (size * context.inertia(at)), 2 * math.pi * float(rng.uniform(3.0, 6.0))
    truth = {"bm": mass, "bk": mass * omega**2, "bc": 2 * 0.05 * omega * mass}
    named = {"mu": moment**2 / mass, "omega": omega, "zeta": 0.05}
    return Hidden("wobbling_base", at, truth, named)
