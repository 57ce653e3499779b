"""What a measured temperature does: laws that are tried where an input of the model has the unit K or degC.

A machine that nobody measured the temperature of has the laws of :mod:`harness.effects.laws.drifting`.
"""

from __future__ import annotations

from typing import Any

from harness.effects.effect import EffectParameter, effect, par
from harness.effects.functions import tanh


def _reference() -> EffectParameter:
    """Return the temperature at which nominal parameters are what they are called: another one only renames them."""
    return par("T0", "K", scale="293.15", minimum=0.0, fixed=True, nuisance=True,
               meaning="temperature at which the nominal parameters hold")  # fmt: skip


@effect(
    "coordinate",
    [
        par("d", "F/(v K)", scale="0.005 F/v", neutral=0.0, main=True, linear=True,
            meaning="change of the damping by a kelvin; negative for grease and oil"),
        _reference(),
    ],
    formula="F = -d (T - T0) v, T the measured temperature",
    family=("viscous_friction", "drifting_damping", "thermal_friction", "thermal_gain"),
    limits={
        "viscous_friction": "at one temperature",
        "drifting_damping": "for a temperature that rises steadily through every record",
    },
    experiment="the same excitation cold and warm, in either order",
)  # fmt: skip
def thermal_damping(f: Any, s: Any, p: Any, q: Any, v: Any, temperature: Any) -> Any:
    """Viscous damping that changes with the measured temperature: grease, oil."""
    return -p.d * (temperature - p.T0) * v


@effect(
    "coordinate",
    [
        par("Fc", "F", scale="0.05 F", sign="+", neutral=0.0, main=True, linear=True, meaning="Coulomb level at T0"),
        par("e", "F/K", scale="-0.001 F", neutral=0.0, linear=True,
            meaning="change of the level by a kelvin; negative where it loosens"),
        _reference(),
        par("w", "v", scale="0.02 v", floor="0.0002 v", ceiling="1 v", sign="+", minimum=1e-6, nuisance=True,
            meaning="smoothing width of the sign"),
    ],
    formula="F = -[Fc + e (T - T0)] sgn(v), sgn(v) = tanh(v/w), T the measured temperature",
    family=("coulomb_friction", "thermal_damping", "stribeck_friction", "load_dependent_friction"),
    nests=("coulomb_friction",),
    limits={"coulomb_friction": "at one temperature"},
    experiment="slow triangles through zero speed, cold and warm: the height of the force loop changes",
    whole="dry friction",
)  # fmt: skip
def thermal_friction(f: Any, s: Any, p: Any, q: Any, v: Any, temperature: Any) -> Any:
    """Dry friction whose level changes with the measured temperature: preloaded bearings, seals, gears."""
    return -(p.Fc + p.e * (temperature - p.T0)) * tanh(v / p.w)


@effect(
    "input",
    [
        par("g", "1/K", scale="0.005", neutral=0.0, main=True, linear=True,
            meaning="share of the gain that a kelvin brings; negative for magnets (-0.0002 to -0.002) and windings"),
        _reference(),
    ],
    formula="u' = [1 + g (T - T0)] u, T the measured temperature",
    family=("input_gain", "drifting_gain", "thermal_damping"),
    limits={
        "input_gain": "at one temperature",
        "drifting_gain": "for a temperature that rises steadily through every record",
    },
    requires={"within 50 K the gain keeps its sign": lambda p: abs(p["g"]) < 0.02},
    experiment="the same command, at standstill, cold and warm, with a measured force",
)  # fmt: skip
def thermal_gain(u: Any, s: Any, p: Any, q: Any, v: Any, temperature: Any) -> Any:
    """Gain of a drive that changes with the measured temperature: magnets, windings under voltage."""
    return (1.0 + p.g * (temperature - p.T0)) * u
