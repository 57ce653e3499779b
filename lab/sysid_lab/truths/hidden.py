"""Hidden effects: the size of each, written by hand, as parameters of the truth and in the words of the dictionary.

The "nominal" size of a force is 6 to 10 % (drawn) of the rms torque at its place: of the command on a driven
coordinate, of gravity on the pole's hinge. "quarter" is a fourth of that. What is no force:

=====================  ============================================  ===========================
effect                 nominal                                       quarter
=====================  ============================================  ===========================
delays, lag            2 to 3 samples                                0.5 to 0.75 samples
gains                  6 to 10 %                                     1.5 to 2.5 %
limits                 6 to 10 % of the signal's rms is cut off      1.5 to 2.5 %
quantisation           step 0.6 to 1 % of the signal's rms           a fourth
elasticity             resonance at 6 Hz, motor a fourth of inertia  12 Hz
backlash               half play 6 to 10 % of the motion's rms       a fourth
end stop               beyond 80 % of the largest excursion          beyond 95 %
rectification          the whole sign                                (has no size)
=====================  ============================================  ===========================
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from harness.errors import InputError
from harness.signals import FloatArray
from sysid_lab.truths import machines
from sysid_lab.truths.context import PRE, Context, Hidden, Sensor, rms
from sysid_lab.truths.simulation import DT, GRAVITY, SUBSTEPS

OUTSIDE = ("even_drag", "cubic_drag", "force_pulse", "magnet", "tiring_drive")
"""Laws that the dictionary does not have."""
_LEVEL = {"nominal": 1.0, "quarter": 0.25}


def hide(name: str, at: str, level: str, context: Context, rng: np.random.Generator) -> Hidden:
    """Return an effect of the dictionary, hidden in the truth at a size that the motion tells.

    Raises
    ------
    InputError
        If no truth has this effect.
    """
    maker = _MAKERS.get(name)
    if maker is None:
        raise InputError(
            "effect without a truth", expected=", ".join(sorted(_MAKERS)), got=name, remedy="choose one of these"
        )
    scale = _LEVEL[level]
    return maker(context, at, scale, scale * float(rng.uniform(0.06, 0.10)), rng)


def force_size(level: str, context: Context, at: str) -> float:
    """Return the middle of the sizes of a force at a place [N, N m]."""
    return 0.08 * _LEVEL[level] * context.torque(at)


def _put(context: Context, at: str, values: Mapping[str, float]) -> dict[str, float]:
    """Return parameters of a coordinate under the names of the truth."""
    return {f"{name}{context.coordinate(at)}": value for name, value in values.items()}


def _simple(truth: str, named: str, shape: Callable[[FloatArray, FloatArray], FloatArray]) -> Any:
    """Return the maker of a force that is one coefficient times a shape of (q, v)."""

    def make(name: str, context: Context, at: str, scale: float, size: float, rng: np.random.Generator) -> Hidden:
        value = size * context.torque(at) / rms(shape(context.q(at), context.v(at)))
        engine = {
            "quadratic_drag": {"c2": value},
            "linear_spring": {f"spring_{at}": value},
        }.get(name, {})
        return Hidden(name, at, _put(context, at, {truth: value}), {named: value}, engine)

    return make


def _coulomb(context: Context, at: str, scale: float, size: float, rng: np.random.Generator) -> Hidden:
    level = size * context.torque(at)
    engine = {"Fc": level, "Fs": level, "joint_friction": level, f"friction_{at}": level, f"F{at}": level}
    return Hidden("coulomb_friction", at, _put(context, at, {"Fp": level, "Fm": level}), {"Fc": level}, engine)


def _stribeck(context: Context, at: str, scale: float, size: float, rng: np.random.Generator) -> Hidden:
    force, vs = size * context.torque(at), 0.25 * rms(context.v(at))
    Fs, Fc = 1.8 * force, 0.8 * force
    truth = _put(context, at, {"Fss": Fs, "Fst": Fc, "vs": vs})
    return Hidden("stribeck_friction", at, truth, {"Fs": Fs, "Fc": Fc, "vs": vs}, {"Fs": Fs, "Fc": Fc, "vs": vs})


def _asymmetric(context: Context, at: str, scale: float, size: float, rng: np.random.Generator) -> Hidden:
    force, more = size * context.torque(at), 0.4 * float(rng.choice([-1.0, 1.0]))
    values = {"Fp": (1 + more) * force, "Fm": (1 - more) * force}
    return Hidden("asymmetric_friction", at, _put(context, at, values), values)


def _hysteresis(context: Context, at: str, scale: float, size: float, rng: np.random.Generator) -> Hidden:
    values = {"Fh": size * context.torque(at), "xs": 0.05 * rms(context.q(at))}
    return Hidden("hysteresis", at, _put(context, at, values), values)


def _sublinear(context: Context, at: str, scale: float, size: float, rng: np.random.Generator) -> Hidden:
    value = size * context.torque(at) / rms(np.sqrt(np.abs(context.v(at))))
    return Hidden("sublinear_friction", at, _put(context, at, {"root": value}), {"Fr": value, "a": 0.5})


def _load(context: Context, at: str, scale: float, size: float, rng: np.random.Generator) -> Hidden:
    values = {"mu": size * context.torque(at) / context.load(at)}
    return Hidden("load_dependent_friction", at, _put(context, at, values), values)


def _position(context: Context, at: str, scale: float, size: float, rng: np.random.Generator) -> Hidden:
    level, swing, phase = size * context.torque(at), 0.6, float(rng.uniform(-math.pi, math.pi))
    truth = _put(context, at, {"Fpos": level, "pa": swing, "pphi": phase})
    return Hidden("position_dependent_friction", at, truth, {"Fc": level, "a": swing, "phi": phase})


def _maxwell(context: Context, at: str, scale: float, size: float, rng: np.random.Generator) -> Hidden:
    v, tau = context.v(at), float(rng.uniform(0.1, 0.5))
    stretch = np.zeros(len(v))
    for row in range(1, len(v)):
        stretch[row] = stretch[row - 1] + DT * (v[row - 1] - stretch[row - 1] / tau)
    stiffness = size * context.torque(at) / rms(stretch)
    truth = _put(context, at, {"km": stiffness, "taum": tau})
    return Hidden("maxwell_element", at, truth, {"k": stiffness, "tau": tau})


def _uneven(context: Context, at: str, scale: float, size: float, rng: np.random.Generator) -> Hidden:
    value = size * context.torque(at) / rms(context.q(at) ** 2 * context.v(at))
    return Hidden("position_dependent_damping", at, _put(context, at, {"vdp": value}), {"c1": 0.0, "c2": value})


def falling_damping(at: str, coordinate: int, more: float, middle: float) -> Hidden:
    """Return a damping that begins above its nominal value by ``more`` and falls through it at an instant [s].

    That is the middle of the record, counted from where the simulation begins, ``PRE`` samples before the record.
    """
    length = 2 * (middle - PRE * DT)
    truth = {f"warm{coordinate}": more, f"warmt{coordinate}": middle}
    return Hidden("drifting_damping", at, truth, {"d": -more * length / middle, "T": length})


def _drifting(context: Context, at: str, scale: float, size: float, rng: np.random.Generator) -> Hidden:
    v = context.v(at)
    middle = (PRE + 0.5 * (len(v) - PRE)) * DT
    fall = 1 - np.arange(len(v)) * DT / middle
    # no damper drives: at the end of a record a fifth of it is left at least, as much as that is
    most = 0.8 * scale * context.values[f"b{context.coordinate(at)}"] * middle / (middle - PRE * DT)
    return falling_damping(at, context.coordinate(at), min(size * context.torque(at) / rms(fall * v), most), middle)


def _bias(context: Context, at: str, scale: float, size: float, rng: np.random.Generator) -> Hidden:
    value = size * context.torque(at) * float(rng.choice([-1.0, 1.0]))
    return Hidden("force_bias", at, _put(context, at, {"F0": value}), {"F0": value})


def _tilt(context: Context, at: str, scale: float, size: float, rng: np.random.Generator) -> Hidden:
    pull = context.gravity * rms(np.cos(context.q("theta")))
    if context.plant == "cart-pole":
        pull = (context.values["mc"] + context.values["mp"]) * GRAVITY
    value = size * rms(context.u) / pull * float(rng.choice([-1.0, 1.0]))
    return Hidden("gravity_tilt", at, {"tilt": value}, {"alpha": value})


def _force_step(context: Context, at: str, scale: float, size: float, rng: np.random.Generator) -> Hidden:
    value = 2.0 * size * context.torque(at) * float(rng.choice([-1.0, 1.0]))
    own, later = _instants(context, at, "stept", rng)
    return Hidden("force_step", at, _put(context, at, {"stepf": value}), {"F": value, "t0": own}, own=later)


def _instants(
    context: Context, at: str, name: str, rng: np.random.Generator
) -> tuple[float, dict[str, dict[str, float]]]:
    """Return an instant in the middle of the estimation record, and the values of the truth for each record."""
    record = (len(context.u) - PRE) * DT
    own = {use: float(rng.uniform(0.3, 0.7)) * record for use in ("estimation", "validation")}
    return own["estimation"], {use: _put(context, at, {name: t0 + PRE * DT}) for use, t0 in own.items()}


def _payload(context: Context, at: str, scale: float, size: float, rng: np.random.Generator) -> Hidden:
    a = np.gradient(context.v(at), DT)
    angle = at == "theta"
    felt = context.inertia(at) * a + (context.gravity * np.sin(context.q(at)) if angle else 0.0)
    part = size * context.torque(at) / rms(felt)
    values = {"dJ": part * context.inertia(at), "dG": part * context.gravity if angle else 0.0}
    own, later = _instants(context, at, "t0", rng)
    return Hidden("payload_step", at, _put(context, at, values), {**values, "t0": own}, own=later)


def _end_stop(context: Context, at: str, scale: float, size: float, rng: np.random.Generator) -> Hidden:
    q, v = context.q(at), context.v(at)
    stop = (0.80 if scale == 1.0 else 0.95) * float(np.abs(q).max())
    k = 20 * context.torque(at) / rms(q)
    d = 0.05 * context.torque(at) / rms(v)
    truth = _put(context, at, {"stop": stop, "ks": k, "ds": d})
    return Hidden("end_stop", at, truth, {"stop": stop, "k": k, "d": d})


def _delay(context: Context, at: str, scale: float, size: float, rng: np.random.Generator) -> Hidden:
    tau = _late(scale, rng)
    return Hidden("input_delay", at, {"delay": tau}, {"tau": tau})


def _late(scale: float, rng: np.random.Generator) -> float:
    """Return a delay of whole fine steps [s]."""
    step = DT / SUBSTEPS
    return round(scale * float(rng.uniform(2.0, 3.0)) * DT / step) * step


def _lag(context: Context, at: str, scale: float, size: float, rng: np.random.Generator) -> Hidden:
    tau = scale * float(rng.uniform(2.0, 3.0)) * DT
    return Hidden("actuator_lag", at, {"tau": tau}, {"tau": tau})


def _dead_zone(context: Context, at: str, scale: float, size: float, rng: np.random.Generator) -> Hidden:
    width = size * rms(context.u)
    return Hidden("dead_zone", at, {"width": width}, {"width": width})


def _saturation(context: Context, at: str, scale: float, size: float, rng: np.random.Generator) -> Hidden:
    limit = _cut(context.u, size)
    return Hidden("saturation", at, {"limit": limit}, {"limit": limit})


def _cut(signal: FloatArray, size: float) -> float:
    """Return the limit that cuts off this share of a signal's rms."""
    low, high = 0.0, float(np.abs(signal).max())
    for _ in range(40):
        middle = 0.5 * (low + high)
        cut = rms(signal - np.clip(signal, -middle, middle)) > size * rms(signal)
        low, high = (middle, high) if cut else (low, middle)
    return high


def _rate_limit(context: Context, at: str, scale: float, size: float, rng: np.random.Generator) -> Hidden:
    u = context.u
    low, high = 0.0, float(np.abs(np.diff(u)).max()) / DT
    for _ in range(25):
        middle = 0.5 * (low + high)
        z, most, error = float(u[0]), middle * DT, 0.0
        for value in u.tolist():
            z += min(max(value - z, -most), most)
            error += (value - z) ** 2
        cut = math.sqrt(error / len(u)) > size * rms(u)
        low, high = (middle, high) if cut else (low, middle)
    return Hidden("rate_limit", at, {"R": high}, {"R": high})


def _gain(context: Context, at: str, scale: float, size: float, rng: np.random.Generator) -> Hidden:
    gain = 1 + size * float(rng.choice([-1.0, 1.0]))
    return Hidden("input_gain", at, {"gain": gain}, {"gain": gain})


def _compression(context: Context, at: str, scale: float, size: float, rng: np.random.Generator) -> Hidden:
    droop = size * rms(context.u) / rms(context.u**2)
    return Hidden("input_compression", at, {"droop": droop}, {"c": droop})


def sagging_gain(at: str, u: FloatArray, size: float) -> Hidden:
    """Return a gain that falls through 1 in the middle of the record, by a share ``size`` of the command's rms."""
    middle = (PRE + 0.5 * (len(u) - PRE)) * DT
    slope = size * rms(u) / rms((np.arange(len(u)) * DT - middle) * u)
    length = 2 * (middle - PRE * DT)
    return Hidden("drifting_gain", at, {"sag": slope, "sagt": middle}, {"g": -slope * length, "T": length})


def _sagging(context: Context, at: str, scale: float, size: float, rng: np.random.Generator) -> Hidden:
    return sagging_gain(at, context.u, size)


def _two_masses(context: Context, share: float, hertz: float, ratio: float) -> dict[str, float]:
    """Return motor inertia, stiffness and damping of a transmission with this resonance."""
    load = context.inertia("x" if context.plant == "cart-pole" else "theta")
    motor = share * load
    reduced, omega = motor * load / (motor + load), 2 * math.pi * hertz
    return {"k": omega**2 * reduced, "Jm": motor, "d": 2 * ratio * omega * reduced}


def _elasticity(context: Context, at: str, scale: float, size: float, rng: np.random.Generator) -> Hidden:
    two_masses = _two_masses(context, 0.25, 6.0 if scale == 1.0 else 12.0, 0.05)
    return Hidden("elasticity", at, {"kt": two_masses["k"], "Jm": two_masses["Jm"], "dt": two_masses["d"]}, two_masses)


def _backlash(context: Context, at: str, scale: float, size: float, rng: np.random.Generator) -> Hidden:
    two_masses = _two_masses(context, 0.15, 15.0, 1.0) | {"gap": size * rms(context.q(at))}
    truth = {"kt": two_masses["k"], "Jm": two_masses["Jm"], "dt": two_masses["d"], "gap": two_masses["gap"]}
    return Hidden("backlash", at, truth, two_masses)


def _cogging(context: Context, at: str, scale: float, size: float, rng: np.random.Generator) -> Hidden:
    teeth = float(rng.integers(4, 9)) / (1.0 if at == "theta" else max(1.0, rms(context.q(at))))
    amplitude, phase = math.sqrt(2) * size * context.torque(at), float(rng.uniform(-math.pi, math.pi))
    teeth = max(teeth, 3.0)
    truth = _put(context, at, {"cog": amplitude, "cogk": teeth, "cogphi": phase})
    return Hidden("cogging", at, truth, {"A": amplitude, "k": teeth, "phi": phase})


def _periodic(context: Context, at: str, scale: float, size: float, rng: np.random.Generator) -> Hidden:
    amplitude, omega = math.sqrt(2) * size * context.torque(at), 2 * math.pi * float(rng.uniform(0.8, 4.0))
    own = {use: float(rng.uniform(-math.pi, math.pi)) for use in ("estimation", "validation")}
    later = {use: _put(context, at, {"perphi": phase - omega * PRE * DT}) for use, phase in own.items()}
    truth = _put(context, at, {"per": amplitude, "perw": omega})
    named = {"A": amplitude, "omega": omega, "phi": own["estimation"]}
    return Hidden("periodic_disturbance", at, truth, named, own=later)


def _sensor_delay(context: Context, at: str, scale: float, size: float, rng: np.random.Generator) -> Hidden:
    tau = _late(scale, rng)
    return Hidden("sensor_delay", at, _put(context, at, {"sdelay": tau}), {"tau": tau})


def _sensor_gain(context: Context, at: str, scale: float, size: float, rng: np.random.Generator) -> Hidden:
    gain = 1 + size * float(rng.choice([-1.0, 1.0]))
    return Hidden("sensor_gain", at, {}, {"gain": gain}, sensor=lambda y: gain * y)


def _cyclic(context: Context, at: str, scale: float, size: float, rng: np.random.Generator) -> Hidden:
    amplitude, k, phi = (
        0.1 * size * rms(context.q(at)),
        float(rng.integers(1, 9)),
        float(rng.uniform(-math.pi, math.pi)),
    )
    named = {"A": amplitude, "k": k, "phi": phi}
    return Hidden("sensor_cyclic_error", at, {}, named, sensor=lambda y: y + amplitude * np.sin(k * y + phi))


def _bent(context: Context, at: str, scale: float, size: float, rng: np.random.Generator) -> Hidden:
    q = context.q(at)
    b = 0.1 * size * rms(q) / rms(q**2) * float(rng.choice([-1.0, 1.0]))
    return Hidden("sensor_nonlinearity", at, {}, {"b": b}, sensor=lambda y: y + b * y**2)


def _sensor_offset(context: Context, at: str, scale: float, size: float, rng: np.random.Generator) -> Hidden:
    value = size * rms(context.q(at)) * float(rng.choice([-1.0, 1.0]))
    if at == "theta":
        value = size * context.torque(at) / (context.gravity * rms(np.cos(context.q(at)))) * float(np.sign(value))
    return Hidden("sensor_offset", at, {}, {"offset": value}, sensor=lambda y: y + value)


def _quantisation(context: Context, at: str, scale: float, size: float, rng: np.random.Generator) -> Hidden:
    step = 0.1 * size * rms(context.q(at))
    sensor: Sensor = lambda y: step * np.round(y / step)  # noqa: E731 - one line, like its neighbours
    return Hidden("sensor_quantisation", at, {}, {"step": step}, sensor=sensor, late=True)


def _rectification(context: Context, at: str, scale: float, size: float, rng: np.random.Generator) -> Hidden:
    return Hidden("sensor_rectification", at, {}, {}, sensor=np.abs)


def _sensor_saturation(context: Context, at: str, scale: float, size: float, rng: np.random.Generator) -> Hidden:
    limit = _cut(context.q(at), size)
    return Hidden("sensor_saturation", at, {}, {"limit": limit}, sensor=lambda y: np.clip(y, -limit, limit))


def _named(name: str, make: Any) -> Any:
    """Return a maker of a simple force with its name bound."""
    return lambda context, at, scale, size, rng: make(name, context, at, scale, size, rng)


_MAKERS: dict[str, Callable[[Context, str, float, float, np.random.Generator], Hidden]] = {
    "coulomb_friction": _coulomb,
    "stribeck_friction": _stribeck,
    "asymmetric_friction": _asymmetric,
    "hysteresis": _hysteresis,
    "sublinear_friction": _sublinear,
    "load_dependent_friction": _load,
    "position_dependent_friction": _position,
    "quadratic_drag": _named("quadratic_drag", _simple("c", "c", lambda q, v: v**2)),
    "linear_spring": _named("linear_spring", _simple("k", "k", lambda q, v: q)),
    "quadratic_spring": _named("quadratic_spring", _simple("k2", "k2", lambda q, v: q**2)),
    "cubic_spring": _named("cubic_spring", _simple("k3", "k3", lambda q, v: q**3)),
    "eccentric_load": _named("eccentric_load", _simple("A", "A", lambda q, v: np.cos(q))),
    "maxwell_element": _maxwell,
    "position_dependent_damping": _uneven,
    "drifting_damping": _drifting,
    "force_bias": _bias,
    "force_step": _force_step,
    "gravity_tilt": _tilt,
    "payload_step": _payload,
    "end_stop": _end_stop,
    "input_delay": _delay,
    "actuator_lag": _lag,
    "dead_zone": _dead_zone,
    "saturation": _saturation,
    "rate_limit": _rate_limit,
    "input_gain": _gain,
    "input_compression": _compression,
    "drifting_gain": _sagging,
    "elasticity": _elasticity,
    "backlash": _backlash,
    "cogging": _cogging,
    "periodic_disturbance": _periodic,
    "sensor_cyclic_error": _cyclic,
    "sensor_delay": _sensor_delay,
    "sensor_gain": _sensor_gain,
    "sensor_nonlinearity": _bent,
    "sensor_offset": _sensor_offset,
    "sensor_quantisation": _quantisation,
    "sensor_rectification": _rectification,
    "sensor_saturation": _sensor_saturation,
    "gear_loss": machines.lossy_gear,
    "torque_ripple": machines.ripple,
    "supply_sag": machines.supply_sag,
    "propeller_thrust": machines.propeller,
    "counterbalance": machines.counterbalanced,
    "wobbling_base": machines.swaying_base,
}


def hide_outside(name: str, at: str, level: str, context: Context, rng: np.random.Generator) -> Hidden:
    """Return a law that is not in the dictionary, at twice the size of an effect (12 to 20 % of the rms torque).

    Raises
    ------
    InputError
        If there is no such law.
    """
    force = 2 * _LEVEL[level] * float(rng.uniform(0.06, 0.10)) * context.torque(at)
    q, v = context.q(at), context.v(at)
    if name == "magnet":  # it pulls to one place, and nowhere else
        place, width = float(rng.uniform(-0.5, 0.5)) * rms(q), 0.2 * rms(q)
        off = (q - place) / width
        values = {"mag": force / rms(off * np.exp(-0.5 * off**2)), "magq": place, "magw": width}
    elif name == "force_pulse":  # it comes and goes
        instants = (PRE + np.array([0.4, 0.6]) * (len(v) - PRE)) * DT
        values = {"stepf": 2 * force, "stept": float(instants[0]), "stepe": float(instants[1])}
    else:
        truth, shape = {
            "even_drag": ("even", v**2),
            "cubic_drag": ("drag3", v**3),
            "tiring_drive": ("tire", context.u * np.abs(v)),
        }.get(name, ("", v))
        if not truth:
            raise InputError("law outside the dictionary", expected=", ".join(OUTSIDE), got=name, remedy="choose one")
        values = {truth: force / rms(shape)}
    return Hidden(name, at, _put(context, at, values))
