"""The effects of the dictionary as hardware has them: laws of another formulation than the dictionary's and ours.

==============================  ====================================================================================
effect                          law
==============================  ====================================================================================
Coulomb friction                Dahl 1968: bristles of finite stiffness
other dry frictions             LuGre (Canudas de Wit et al. 1995): the same level carried by bristles with damping
hysteresis                      four slip elements in parallel (Iwan 1966), as in a gear
sub-linear friction             logarithmic (Eyring 1936)
backlash                        flanks that push and never pull
elasticity                      a flexible joint that hardens
end stop                        a contact after Hunt & Crossley 1975
actuator lag                    a motor with inductance, back-EMF and bounded voltage under a current controller
saturation                      a motor with a current limit whose back-EMF takes a little more of it at speed
input delay                     a controller that samples the command with a slower clock and holds it
payload step                    the payload is taken up within 0.1 s
==============================  ====================================================================================
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from sysid_lab.truths.context import Context, Hidden, rms
from sysid_lab.truths.simulation import DT

BRISTLES = (
    "coulomb_friction",
    "stribeck_friction",
    "asymmetric_friction",
    "load_dependent_friction",
    "position_dependent_friction",
)
LAWS = (
    *BRISTLES,
    "hysteresis",
    "sublinear_friction",
    "backlash",
    "elasticity",
    "end_stop",
    "actuator_lag",
    "saturation",
    "input_delay",
    "payload_step",
)
_PRESLIDING = 0.003  # Length at which bristles slip, over the rms of the motion.
_NEVER_EXACT = ("hysteresis", "sublinear_friction", "backlash", "end_stop", "actuator_lag", "input_delay")
"""No parameter of the dictionary's law is exactly one of these: the values only start the oracle's refit."""


def as_hardware(hidden: Hidden, context: Context, size: float) -> Hidden:
    """Return the same effect at the same size in the formulation of hardware; as it is where hardware has no other.

    Parameters
    ----------
    hidden : Hidden
        As the dictionary writes it.
    context : Context
    size : float
        RMS of the effect's force at its place [N, N m].
    """
    name, at = hidden.name, hidden.at
    if name not in LAWS:  # the second of a pair
        return hidden
    values = dict(hidden.truth)
    i = context.coordinate(at)
    if name in BRISTLES:
        stiffness = size / (_PRESLIDING * rms(context.q(at)))
        values[f"bs{i}"] = stiffness
        damping = 0.0
        if name != "coulomb_friction":
            damping = 0.3 * (stiffness * context.inertia(at)) ** 0.5
            values[f"bd{i}"] = damping
        hidden = _of_bristles(hidden, stiffness, damping)
    elif name == "hysteresis":
        values[f"slip{i}"] = 1.0
    elif name == "sublinear_friction":
        speed = 0.3 * rms(context.v(at))
        values[f"rootv{i}"] = speed
        values[f"root{i}"] *= speed**0.5
    elif name == "end_stop":
        values[f"hunt{i}"] = 0.1 * rms(context.q(at))
    elif name == "backlash":
        values["push"] = 1.0
        hidden = replace(hidden, name="unilateral_backlash")
    elif name == "elasticity":
        values["hard"] = _hardening(values, context)
        stiffness = values["kt"] * values["hard"]
        hidden = replace(hidden, name="hardening_elasticity", named={**hidden.named, "k3": stiffness})
    elif name == "payload_step":
        values["ramp"] = 0.1
    else:
        values = _drive(name, values, context)
    return replace(hidden, truth=values, exact=name not in _NEVER_EXACT)


def _of_bristles(hidden: Hidden, stiffness: float, damping: float) -> Hidden:
    """Return a dry friction under the dictionary's name of its law with bristles."""
    known = hidden.named
    named = {**known, "tau": damping / stiffness}
    if "mu" not in known:  # the typical load, over which its bristles slip, is the diagnosis' own
        level = 0.5 * (known["Fp"] + known["Fm"]) if "Fp" in known else known.get("Fs", known["Fc"])
        named["xs"] = level / stiffness
    name = "lugre_friction" if hidden.name == "stribeck_friction" else f"lugre_{hidden.name}"
    return replace(hidden, name=name, named=named)


def _hardening(values: Mapping[str, float], context: Context) -> float:
    """Return what makes a joint a third stiffer at three times the rms of its twist."""
    twist = rms(context.u) / values["kt"]
    return (1 / 3) / (3 * twist) ** 2


def _drive(name: str, values: Mapping[str, float], context: Context) -> dict[str, float]:
    """Return a drive that is late or limited."""
    if name == "input_delay":
        # what is held is late by half a period of the slower clock on average; the rest is its computing time
        period = 2 * DT if values["delay"] >= DT else 0.5 * DT
        return {"hold": period, "delay": max(0.0, values["delay"] - 0.5 * period)}
    fastest = max(1e-9, float(abs(context.v("x" if context.plant == "cart-pole" else "theta")).max()))
    if name == "saturation":
        return {"limit": values["limit"], "volt": 1.05 * values["limit"], "emf": 0.1 * values["limit"] / fastest}
    electrical, peak = 0.015, float(abs(context.u).max())
    return {
        "te": electrical,
        "loop": electrical / values["tau"],
        "emf": 0.15 * peak / fastest,
        "volt": 4 * peak,
    }
