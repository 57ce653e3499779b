"""Actuators and forces around other people's engines: applied from outside in fine steps, by laws in Python.

An engine moves the bodies; what its joints and motors do not have themselves is put on the driven coordinate as a
force held over a fine step, from the position and the rate in the middle of it, as far as the engine foretells them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import numpy as np

from harness.signals import FloatArray
from sysid_lab.truths.simulation import DT, SUBSTEPS

STEP = DT / SUBSTEPS  # Of a fine step [s].
Law = Callable[[float, float, float, float], float]  # Force from position, rate, time and command.
ACTUATOR = (
    "input_delay",
    "actuator_lag",
    "dead_zone",
    "saturation",
    "rate_limit",
    "input_gain",
    "input_compression",
    "drifting_gain",
)
FORCES = (
    "hysteresis",
    "sublinear_friction",
    "quadratic_drag",
    "linear_spring",
    "cubic_spring",
    "quadratic_spring",
    "eccentric_load",
    "gravity_tilt",
    "force_bias",
    "end_stop",
    "cogging",
    "periodic_disturbance",
    "even_drag",
    "position_dependent_damping",
    "force_pulse",
    "force_step",
    "maxwell_element",
    "cubic_drag",
    "drifting_damping",
    "magnet",
    "tiring_drive",
)
"""Effects whose force can be put on a driven coordinate from outside."""


def actuated(values: Mapping[str, float], u: FloatArray) -> FloatArray:
    """Return the force that leaves the actuator (N * SUBSTEPS,) for a command (N,) held over samples.

    Parameters
    ----------
    values : mapping
        ``delay``, ``width``, ``limit``, ``tau``, ``R``, ``gain``, ``droop``, ``sag``, ``sagt``, as the truth has them.

    Examples
    --------
    >>> actuated({"limit": 1.0}, np.array([0.5, 3.0]))[[0, -1]].tolist()
    [0.5, 1.0]
    """
    f = np.repeat(np.asarray(u, dtype=float), SUBSTEPS)
    late = round(values.get("delay", 0.0) / STEP)
    if late:
        f = np.concatenate([np.full(late, f[0]), f[:-late]])
    f = np.sign(f) * np.maximum(np.abs(f) - values.get("width", 0.0), 0.0)
    f = f * (1 - values.get("droop", 0.0) * np.abs(f))
    f = f * (1 - values.get("sag", 0.0) * (np.arange(len(f)) * STEP - values.get("sagt", 0.0)))
    limit = values.get("limit", math.inf)
    f = np.clip(f, -limit, limit)
    if "tau" in values:
        from scipy.signal import lfilter

        pole = math.exp(-STEP / values["tau"])
        z = lfilter([0.0, 1 - pole], [1.0, -pole], f - f[0]) + f[0]
        f = f + (z - f) * (1 - pole) * values["tau"] / STEP  # the mean over a step
    if "R" in values:
        most, z, limited = values["R"] * STEP, float(f[0]), np.empty_like(f)
        for k, wanted in enumerate(f.tolist()):
            step = min(max(wanted - z, -most), most)
            limited[k] = z + 0.5 * step
            z += step
        f = limited
    return np.asarray(values.get("gain", 1.0) * f)


def force_law(values: Mapping[str, float], plant: str) -> Law | None:
    """Return the force on the driven coordinate that a truth's parameters describe; None where there is none.

    Raises
    ------
    KeyError
        Never for the effects :data:`FORCES`; parameters that belong to an actuator or a sensor are left to those.
    """
    own = {name[:-1]: value for name, value in values.items() if name.endswith("0") and name[:-1] in _TERMS}
    terms = [_TERMS[name](own | _companions(values), plant) for name in own]
    if "tilt" in values:
        terms.append(_tilt(values["tilt"], values, plant))
    if not terms:
        return None
    return lambda q, v, t, u: sum(term(q, v, t, u) for term in terms)


def _companions(values: Mapping[str, float]) -> dict[str, float]:
    """Return all parameters of coordinate 0 by their short names."""
    return {name[:-1]: value for name, value in values.items() if name.endswith("0")}


def _tilt(alpha: float, values: Mapping[str, float], plant: str) -> Law:
    if plant == "pendulum":
        mgl = values["mgl"]
        return lambda q, v, t, u: -mgl * (math.sin(q + alpha) - math.sin(q))
    raise KeyError("gravity_tilt of a cart-pole pulls at two coordinates")


def _stop(values: Mapping[str, float], plant: str) -> Law:
    def law(q: float, v: float, t: float, u: float) -> float:
        if abs(q) <= values["stop"]:
            return 0.0
        return -values["ks"] * (q - math.copysign(values["stop"], q)) - values["ds"] * v

    return law


def _pull(off: float) -> float:
    """Return the pull of a magnet to its place, over its size, at a distance over its width."""
    return off * math.exp(-0.5 * off * off)


def _bouc_wen(values: Mapping[str, float], plant: str) -> Law:
    z = 0.0

    def slope(v: float, z: float) -> float:
        return (v - 0.5 * abs(v) * z - 0.5 * v * abs(z)) / values["xs"]

    def law(q: float, v: float, t: float, u: float) -> float:
        nonlocal z
        middle = z + 0.5 * STEP * slope(v, z)
        z += STEP * slope(v, middle)
        return -values["Fh"] * middle

    return law


def _maxwell(values: Mapping[str, float], plant: str) -> Law:
    m = 0.0

    def law(q: float, v: float, t: float, u: float) -> float:
        nonlocal m
        middle = (m + 0.5 * STEP * v) / (1 + 0.5 * STEP / values["taum"])
        m = 2 * middle - m
        return -values["km"] * middle

    return law


_TERMS: dict[str, Callable[[Mapping[str, float], str], Law]] = {
    "F0": lambda values, plant: lambda q, v, t, u: values["F0"],
    "c": lambda values, plant: lambda q, v, t, u: -values["c"] * abs(v) * v,
    "k": lambda values, plant: lambda q, v, t, u: -values["k"] * q,
    "k2": lambda values, plant: lambda q, v, t, u: -values["k2"] * q * q,
    "k3": lambda values, plant: lambda q, v, t, u: -values["k3"] * q**3,
    "A": lambda values, plant: lambda q, v, t, u: -values["A"] * math.cos(q),
    "cog": lambda values, plant: lambda q, v, t, u: values["cog"] * math.sin(values["cogk"] * q + values["cogphi"]),
    "per": lambda values, plant: lambda q, v, t, u: values["per"] * math.sin(values["perw"] * t + values["perphi"]),
    "stop": _stop,
    "Fh": _bouc_wen,
    "km": _maxwell,
    "root": lambda values, plant: lambda q, v, t, u: -values["root"] * math.copysign(math.sqrt(abs(v)), v),
    "even": lambda values, plant: lambda q, v, t, u: -values["even"] * v * v,
    "vdp": lambda values, plant: lambda q, v, t, u: -values["vdp"] * q * q * v,
    "ripple": lambda values, plant: lambda q, v, t, u: values["ripple"] * u * math.cos(5 * q),
    "stepf": lambda values, plant: (
        lambda q, v, t, u: values["stepf"] * (values["stept"] <= t < values.get("stepe", math.inf))
    ),
    "drag3": lambda values, plant: lambda q, v, t, u: -values["drag3"] * v**3,
    "mag": lambda values, plant: lambda q, v, t, u: -values["mag"] * _pull((q - values["magq"]) / values["magw"]),
    "warm": lambda values, plant: lambda q, v, t, u: -values["warm"] * (1 - t / values["warmt"]) * v,
    "tire": lambda values, plant: lambda q, v, t, u: -values["tire"] * u * abs(v),
    "und": lambda values, plant: lambda q, v, t, u: -values["und"] * math.cos(q) * v,
}
