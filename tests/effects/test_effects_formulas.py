"""Every law computes what its formula says: force, reading or rate, and the rates of what is hidden."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from harness.effects import builtin

SHARP = 1e-9
"""Width of a sign or corner that is none."""


def bristles(level: float, steady: float, s: Any, p: Any, v: float) -> tuple[float, ...]:
    rate = v - level / p.xs * abs(v) * s.z / steady
    return -level / p.xs * (s.z + p.tau * rate), rate


def slips(z: float, length: float, p: Any, v: float) -> float:
    return (v - p.beta * abs(v) * z - (1 - p.beta) * v * abs(z)) / length


def through(passed: float, f: float, s: Any, p: Any, v: float) -> tuple[float, ...]:
    return passed - f, s.w - v, (f - passed) / p.Jm


def beyond(x: float, width: float) -> float:
    return np.sign(x) * max(abs(x) - width, 0.0)


def dry(level: Callable[[Any], float]) -> Callable[[Any, Any, Any], float]:
    return lambda p, s, at: -level(SimpleNamespace(**{**vars(at), **vars(p)})) * np.sign(at.v)


LAWS: dict[str, Callable[[Any, Any, Any], Any]] = {
    # friction
    "viscous_friction": lambda p, s, at: -p.b * at.v,
    "coulomb_friction": dry(lambda x: x.Fc),
    "stribeck_friction": dry(lambda x: x.Fc + (x.Fs - x.Fc) * np.exp(-((x.v / x.vs) ** 2))),
    "asymmetric_friction": lambda p, s, at: -p.Fp if at.v > 0 else p.Fm,
    "sublinear_friction": dry(lambda x: x.Fr * abs(x.v) ** x.a),
    "yield_friction": dry(lambda x: x.Fc + x.Fr * abs(x.v) ** x.a),
    "degressive_friction": lambda p, s, at: -p.Fc * at.v / (p.vs + abs(at.v)),
    "asymmetric_damping": lambda p, s, at: -p.c * abs(at.v),
    "quadratic_drag": dry(lambda x: x.c * x.v**2),
    "load_dependent_friction": dry(lambda x: x.mu * abs(x.load)),
    "gear_friction": dry(lambda x: x.Fc + x.mu * abs(x.f + x.damping - x.r * x.pull)),
    "gear_stribeck_friction": dry(
        lambda x: (x.Fc + x.mu * abs(x.f + x.damping - x.r * x.pull))
        * (x.b + (1 - x.b) * np.exp(-((x.v / x.vs) ** 2)))
    ),
    "position_dependent_friction": dry(lambda x: (1 + x.a * np.cos(x.q + x.phi)) * x.Fc),
    "position_dependent_damping": lambda p, s, at: -(p.c1 * at.q + p.c2 * at.q**2) * at.v,
    "hysteresis": lambda p, s, at: (-p.Fh * s.z, slips(s.z, p.xs, p, at.v)),
    "parallel_hysteresis": lambda p, s, at: (
        -p.Fh * ((1 - p.share) * s.z + p.share * s.zs), slips(s.z, p.xs, p, at.v), slips(s.zs, p.ratio * p.xs, p, at.v),
    ),
    "thermal_friction": dry(lambda x: x.Fc + x.e * (x.temperature - x.T0)),
    "thermal_damping": lambda p, s, at: -p.d * (at.temperature - p.T0) * at.v,
    "drifting_damping": lambda p, s, at: -p.d * (min(at.t / p.T, 1.0) - 0.5) * at.v,
    # bristles
    "lugre_coulomb_friction": lambda p, s, at: bristles(p.Fc, p.Fc, s, p, at.v),
    "lugre_friction": lambda p, s, at: bristles(
        p.Fs, p.Fc + (p.Fs - p.Fc) * np.exp(-((at.v / p.vs) ** 2)), s, p, at.v
    ),
    "lugre_asymmetric_friction": lambda p, s, at: bristles(
        (p.Fp + p.Fm) / 2, p.Fp if at.v > 0 else p.Fm, s, p, at.v
    ),
    "lugre_load_dependent_friction": lambda p, s, at: bristles(p.mu * p.L, p.mu * abs(at.load), s, p, at.v),
    "lugre_position_dependent_friction": lambda p, s, at: bristles(
        p.Fc, (1 + p.a * np.cos(at.q + p.phi)) * p.Fc, s, p, at.v
    ),
    "lugre_sublinear_friction": lambda p, s, at: bristles(p.Fr, p.Fr * abs(at.v) ** p.a, s, p, at.v),
    "lugre_yield_friction": lambda p, s, at: bristles(p.Fc + p.Fr, p.Fc + p.Fr * abs(at.v) ** p.a, s, p, at.v),
    # springs, weights, stops
    "linear_spring": lambda p, s, at: -p.k * at.q,
    "maxwell_element": lambda p, s, at: (-p.k * s.z, at.v - s.z / p.tau),
    "quadratic_spring": lambda p, s, at: -p.k2 * at.q**2,
    "cubic_spring": lambda p, s, at: -p.k3 * at.q**3,
    "eccentric_load": lambda p, s, at: -p.A * np.cos(at.q + p.phi),
    "unbalanced_load": lambda p, s, at: -p.A * np.sin(at.q + p.phi),
    "payload_step": lambda p, s, at: -(p.dJ * at.a + p.dG * np.sin(at.q)) / (1 + np.exp(-(at.t - p.t0) / p.w)),
    "mass_step": lambda p, s, at: at.f + p.dm / (1 + np.exp(-(at.t - p.t0) / p.w)),
    "end_stop": lambda p, s, at: (
        -p.k * beyond(at.q - p.centre, p.stop) - p.d * (abs(at.q - p.centre) > p.stop) * at.v
    ),
    "one_sided_stop": lambda p, s, at: (
        -np.sign(p.stop) * p.k * max(np.sign(p.stop) * (at.q - p.stop), 0.0)
        - p.d * (np.sign(p.stop) * (at.q - p.stop) > 0) * at.v
    ),
    # from outside, actuators
    "force_bias": lambda p, s, at: p.F0,
    "force_step": lambda p, s, at: p.F / (1 + np.exp(-(at.t - p.t0) / p.w)),
    "periodic_disturbance": lambda p, s, at: p.A * np.sin(p.omega * at.t + p.phi),
    "dead_zone": lambda p, s, at: beyond(at.f, p.width),
    "saturation": lambda p, s, at: np.clip(at.f, -p.limit, p.limit),
    "rate_limit": lambda p, s, at: (s.z, p.R * np.tanh((at.f - s.z) / (p.R * p.tau))),
    "actuator_lag": lambda p, s, at: (s.z, (at.f - s.z) / p.tau),
    "input_gain": lambda p, s, at: p.gain * at.f,
    "drifting_gain": lambda p, s, at: (1 + p.g * (min(at.t / p.T, 1.0) - 0.5)) * at.f,
    "thermal_gain": lambda p, s, at: (1 + p.g * (at.temperature - p.T0)) * at.f,
    "input_compression": lambda p, s, at: at.f - p.c * at.f * abs(at.f),
    "supply_sag": lambda p, s, at: (
        (1 - p.c * (s.z + p.z0 * np.exp(-at.t / p.tau))) * at.f, (abs(at.f) - s.z) / p.tau,
    ),
    "propeller_thrust": lambda p, s, at: (1 - p.s) * at.f + p.s * at.f * abs(at.f) / p.U,
    # transmissions
    "elasticity": lambda p, s, at: through(p.k * s.e + p.d * (s.w - at.v), at.f, s, p, at.v),
    "hardening_elasticity": lambda p, s, at: through(
        p.k * s.e + p.k3 * s.e**3 + p.d * (s.w - at.v), at.f, s, p, at.v
    ),
    "elastic_load": lambda p, s, at: (
        -(p.k * s.e + p.d * (at.v - s.w)) - at.pull, at.v - s.w, (p.k * s.e + p.d * (at.v - s.w) + at.pull) / p.J,
    ),
    "backlash": lambda p, s, at: through(
        p.k * beyond(s.e, p.gap) + p.d * (abs(s.e) > p.gap) * (s.w - at.v), at.f, s, p, at.v
    ),
    "torque_ripple": lambda p, s, at: p.a * np.sin(p.k * at.q + p.phi) * at.f,
    "cogging": lambda p, s, at: p.A * np.sin(p.k * at.q + p.phi),
    # sensors
    "sensor_offset": lambda p, s, at: at.f + p.offset,
    "sensor_gain": lambda p, s, at: p.gain * at.f,
    "sensor_cyclic_error": lambda p, s, at: at.f + p.A * np.sin(p.k * at.f + p.phi),
    "sensor_hum": lambda p, s, at: at.f + p.A * np.sin(p.omega * at.t + p.phi),
    "sensor_nonlinearity": lambda p, s, at: at.f + p.b * at.f**2,
    "sensor_lag": lambda p, s, at: (s.z, (at.f - s.z) / p.tau),
    "sensor_filter": lambda p, s, at: (s.z, s.r / p.tau, (at.f - s.z - s.r) / (p.c * p.tau)),
    "sensor_rectification": lambda p, s, at: abs(at.f),
    "sensor_saturation": lambda p, s, at: np.clip(at.f, -p.limit, p.limit),
    "sensor_drift": lambda p, s, at: at.f + p.d * min(at.t / p.T, 1.0),
    # processes
    "overflow": lambda p, s, at: (
        -(spilled := max(at.f, 0.0) / (1 + np.exp(-(at.q - p.h) / p.w))), p.share * spilled,
    ),
    "level_saturation": lambda p, s, at: -max(at.f, 0.0) / (1 + np.exp(-(at.q - p.limit) / p.w)),
    "leak": lambda p, s, at: -p.c * at.q,
    "radiation": lambda p, s, at: -p.h * p.T0 * ((1 + at.q / p.T0) ** 4 - 1) / 4,
}  # fmt: skip
GRADUAL = ("payload_step", "mass_step", "force_step", "overflow", "level_saturation")
"""Laws whose width is one of a step that takes its time."""


@pytest.mark.parametrize("name", sorted(LAWS))
def test_a_law_is_what_its_formula_says(name: str) -> None:
    law, rng = builtin()[name], np.random.default_rng(0)
    for _ in range(12):
        values = {one.name: float(rng.uniform(0.3, 0.9)) for one in law.parameters}
        corner = "c" if name == "backlash" else "w"
        values |= {corner: SHARP} if corner in values and name not in GRADUAL else {}
        values |= {"T": 0.0} if "hysteresis" in name or "lugre" in name else {}
        states = rng.uniform(-0.9, 0.9, len(law.states)).tolist()
        at = SimpleNamespace(t=rng.uniform(0, 1.5), temperature=rng.uniform(280, 320))
        for one in ("f", "q", "v", "a", "load", "damping", "pull"):
            setattr(at, one, rng.uniform(-2, 2))
        more = {one: getattr(at, one) for one in law.extras}
        found, rates = law.evaluate(at.f, states, values, at.q, at.v, **more)
        s, p = SimpleNamespace(**dict(zip(law.states, states, strict=True))), SimpleNamespace(**values)
        wanted = np.atleast_1d(LAWS[name](p, s, at))
        assert np.array([*np.atleast_1d(found), *rates], dtype=float) == pytest.approx(wanted, rel=2e-3, abs=2e-3)
