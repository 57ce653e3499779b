"""Dry friction that bristles carry (LuGre): every law of a level, with the stretch in which the force builds up.

Canudas de Wit, Olsson, Astrom & Lischinsky 1995, IEEE Trans. Autom. Control 40:419, eqs. (1) to (3): with the mean
deflection z of bristles of stiffness s0 and damping s1 and the level g of the friction in steady motion,
``z' = v - s0 |v| z / g``, ``F = -s0 z - s1 z'``. Here ``s0 = level / xs``, with the length xs at which they slip, and
``s1 = s0 tau``. At speed z follows the level at once; that it does so no faster than within a time T, far below what
samples show, changes nothing of the force near standstill, and spares steps of the solver within T: the rate of z is
divided by the fourth root of 1 + (r T)^4, r its eigenvalue, which is 1 as long as it is slow.

Such a law grows from the law of its level: it is tried where that one was fitted.
"""

from __future__ import annotations

from typing import Any

from harness.effects.effect import EffectParameter, effect, par
from harness.effects.functions import absolute, cos, exp, no_sooner, power, sign, sqrt

_UNLOADED = 1e-3
"""Share of the typical load that a guide carries at least: a level of nothing divides by nothing."""

_STILL = 1e-6
"""Speed below which a level that grows with the speed no longer changes [rad/s or m/s]."""

_NOTHING = 1e-30
"""Added to levels that are divided by each other, for the case that there are none."""


def _level(name: str, scale: str, *, main: bool = False, meaning: str) -> EffectParameter:
    """Return a force level that should be positive."""
    return par(name, "F", scale=scale, sign="+", neutral=0.0, main=main, meaning=meaning)


def _bristles() -> list[EffectParameter]:
    """Return the parameters of the bristles."""
    return [
        # no sample sees less than the way from rest within one
        par("xs", "q", scale="0.003 q", floor="0.5 a dt^2", sign="+", minimum=1e-9, grid=(1.0, 0.3, 3.0),
            meaning="presliding length"),
        par("tau", "s", scale="4 dt", sign="+", minimum=0.0, nuisance=True,
            meaning="damping of the bristles over their stiffness"),
        par("T", "s", scale="0.2 dt", sign="+", minimum=0.0, fixed=True, nuisance=True,
            meaning="shortest time in which the bristles settle"),
    ]  # fmt: skip


def _power(v: Any, a: Any) -> Any:
    """Return the power of a speed."""
    return power(v * v + _STILL**2, 0.5 * a)


def _carried(level: Any, steady: Any, s: Any, p: Any, v: Any) -> tuple[Any, list[Any]]:
    """Return the force of bristles and the rate of z, from the level at deflection xs and that of steady motion."""
    settles = absolute(v) / p.xs * (level + _NOTHING) / (steady + _NOTHING)
    rate = no_sooner(v - settles * s.z, settles, p.T)
    return -level / p.xs * (s.z + p.tau * rate), [rate]


@effect(
    "coordinate",
    [_level("Fc", "0.05 F", main=True, meaning="Coulomb level"), *_bristles()],
    states={"z": "q"},
    formula="F = -(Fc/xs) (z + tau z'), z' = v - |v| z/xs",
    family=("coulomb_friction", "hysteresis"),
    nests=("coulomb_friction",),
    limits={
        "coulomb_friction": "for a presliding length xs far below the motion",
        "hysteresis": "for bristles without damping, where beta is 1 (Dahl 1968)",
    },
    grows="bristles",
    experiment="reversals of several small amplitudes: within the presliding length the joint springs back",
    whole="dry friction",
    told_by=("slow motion",),
)
def lugre_coulomb_friction(f: Any, s: Any, p: Any, q: Any, v: Any) -> tuple[Any, list[Any]]:
    """Dry friction of bristles with one level (Dahl's, with damping)."""
    return _carried(p.Fc, p.Fc, s, p, v)


@effect(
    "coordinate",
    [
        _level("Fs", "0.08 F", main=True, meaning="level near standstill"),
        _level("Fc", "0.04 F", meaning="Coulomb level at speed"),
        par("vs", "v", scale="0.2 v", floor="0.005 v", sign="+", minimum=1e-6, grid=(1.0, 0.3, 3.0),
            meaning="Stribeck speed"),
        *_bristles(),
    ],
    states={"z": "q"},
    formula="F = -(Fs/xs) (z + tau z'), z' = v - (Fs/xs) |v| z/g, g = Fc + (Fs - Fc) exp(-(v/vs)^2)",
    family=("stribeck_friction", "lugre_coulomb_friction"),
    nests=("stribeck_friction", "coulomb_friction", "lugre_coulomb_friction"),
    requires={"the level near standstill Fs lies above the level at speed Fc": lambda p: p["Fs"] > p["Fc"]},
    limits={"stribeck_friction": "for a presliding length xs far below the motion"},
    grows="bristles",
    experiment="slow triangles through zero speed, and reversals within the presliding length: small loops appear",
    whole="dry friction",
    told_by=("slow motion",),
)  # fmt: skip
def lugre_friction(f: Any, s: Any, p: Any, q: Any, v: Any) -> tuple[Any, list[Any]]:
    """Dry friction of bristles that is higher near standstill (LuGre)."""
    return _carried(p.Fs, p.Fc + (p.Fs - p.Fc) * exp(-((v / p.vs) ** 2)), s, p, v)


@effect(
    "coordinate",
    [
        _level("Fp", "0.06 F", main=True, meaning="level at positive speed"),
        _level("Fm", "0.04 F", meaning="level at negative speed"),
        *_bristles(),
    ],
    states={"z": "q"},
    formula="F = -(Fp + Fm)/(2 xs) (z + tau z'), z' = v - (Fp + Fm)/(2 xs) |v| z/g, g = Fp forwards, Fm backwards",
    family=("asymmetric_friction", "lugre_coulomb_friction", "force_bias"),
    nests=("asymmetric_friction", "coulomb_friction", "lugre_coulomb_friction"),
    limits={"asymmetric_friction": "for a presliding length xs far below the motion"},
    grows="bristles",
    experiment="none on one joint tells its levels from one level and a bias; turning the joint round shows which",
    whole="dry friction",
    told_by=("slow motion",),
)
def lugre_asymmetric_friction(f: Any, s: Any, p: Any, q: Any, v: Any) -> tuple[Any, list[Any]]:
    """Dry friction of bristles with another level in each direction."""
    return _carried(0.5 * (p.Fp + p.Fm), 0.5 * (p.Fp + p.Fm) + 0.5 * (p.Fp - p.Fm) * sign(v), s, p, v)


@effect(
    "coordinate",
    [
        par("mu", "1", scale="0.05", sign="+", neutral=0.0, main=True, meaning="friction coefficient"),
        *_bristles(),
        par("L", "F", scale="1 L", sign="+", minimum=0.0, fixed=True, nuisance=True, meaning="typical load"),
    ],
    states={"z": "q"},
    formula="F = -(mu L/xs) (z + tau z'), z' = v - (mu L/xs) |v| z/g, g = mu |load|",
    family=("load_dependent_friction", "lugre_coulomb_friction"),
    nests=("load_dependent_friction",),
    limits={"load_dependent_friction": "for a presliding length xs far below the motion"},
    grows="bristles",
    experiment="the same motion with and without a payload: a level of its own stays, this one grows",
    whole="dry friction",
    told_by=("slow motion",),
)
def lugre_load_dependent_friction(f: Any, s: Any, p: Any, q: Any, v: Any, load: Any) -> tuple[Any, list[Any]]:
    """Dry friction of bristles in proportion to the force that the joint carries."""
    carries = sqrt(load * load + (_UNLOADED * p.L) ** 2)
    return _carried(p.mu * p.L, p.mu * carries, s, p, v)


@effect(
    "coordinate",
    [
        _level("Fc", "0.05 F", main=True, meaning="mean Coulomb level"),
        par("a", "1", scale="0.5", minimum=-2.0, maximum=2.0, meaning="relative swing of the level"),
        par("phi", "rad", scale="0.5", nuisance=True, grid=(1.0, 4.0, 7.0, 10.0), meaning="phase of the level"),
        *_bristles(),
    ],
    states={"z": "q"},
    formula="F = -(Fc/xs) (z + tau z'), z' = v - (Fc/xs) |v| z/g, g = [1 + a cos(q + phi)] Fc",
    family=("position_dependent_friction", "lugre_coulomb_friction"),
    nests=("position_dependent_friction", "coulomb_friction", "lugre_coulomb_friction"),
    requires={"the level 1 + a cos(q + phi) is nowhere negative": lambda p: abs(p["a"]) <= 1.0},
    limits={"position_dependent_friction": "for a presliding length xs far below the motion"},
    angles=True,
    grows="bristles",
    experiment="slow full turns in both directions: the height of the force loop depends on the angle",
    whole="dry friction",
    told_by=("slow motion",),
)
def lugre_position_dependent_friction(f: Any, s: Any, p: Any, q: Any, v: Any) -> tuple[Any, list[Any]]:
    """Dry friction of bristles whose level depends on the angle."""
    return _carried(p.Fc, (1.0 + p.a * cos(q + p.phi)) * p.Fc, s, p, v)


@effect(
    "coordinate",
    [
        par(
            "Fr", "F", scale="0.05 F", sign="+", neutral=0.0, main=True, meaning="force at a speed of 1 (rad/s or m/s)"
        ),
        par("a", "1", scale="0.5", minimum=0.05, maximum=0.95, grid=(1.0, 0.5, 1.5), meaning="exponent of the speed"),
        *_bristles(),
    ],
    states={"z": "q"},
    formula="F = -(Fr/xs) (z + tau z'), z' = v - (Fr/xs) |v| z/g, g = Fr |v|^a with v in rad/s or m/s, 0 < a < 1",
    family=("sublinear_friction", "lugre_coulomb_friction"),
    nests=("sublinear_friction", "coulomb_friction", "lugre_coulomb_friction"),
    limits={"sublinear_friction": "for a presliding length xs far below the motion"},
    grows="bristles",
    experiment="slow and fast triangles: the force grows with the speed, less than in proportion",
    whole="dry friction",
    told_by=("slow motion",),
)
def lugre_sublinear_friction(f: Any, s: Any, p: Any, q: Any, v: Any) -> tuple[Any, list[Any]]:
    """Friction of bristles whose level grows with the speed less than in proportion: grease and seals."""
    return _carried(p.Fr, p.Fr * _power(v, p.a), s, p, v)


@effect(
    "coordinate",
    [
        par("Fr", "F", scale="0.05 F", sign="+", neutral=0.0, main=True,
            meaning="force at a speed of 1 (rad/s or m/s), beyond the level"),
        par("a", "1", scale="0.5", minimum=0.05, maximum=0.95, grid=(1.0, 0.5, 1.5), meaning="exponent of the speed"),
        _level("Fc", "0.03 F", meaning="Coulomb level"),
        *_bristles(),
    ],
    states={"z": "q"},
    formula="F = -s0 (z + tau z'), z' = v - s0 |v| z/g, s0 = (Fc + Fr)/xs, g = Fc + Fr |v|^a with v in rad/s or m/s",
    family=("yield_friction", "lugre_sublinear_friction"),
    nests=("yield_friction", "coulomb_friction", "lugre_sublinear_friction", "lugre_coulomb_friction"),
    limits={"yield_friction": "for a presliding length xs far below the motion"},
    grows="bristles",
    experiment="slow and fast triangles: the force starts from a level, and grows with the speed, less and less",
    whole="dry friction",
    told_by=("slow motion",),
)  # fmt: skip
def lugre_yield_friction(f: Any, s: Any, p: Any, q: Any, v: Any) -> tuple[Any, list[Any]]:
    """Dry friction of bristles whose level grows with the speed less than in proportion: stiff grease."""
    return _carried(p.Fc + p.Fr, p.Fc + p.Fr * _power(v, p.a), s, p, v)
