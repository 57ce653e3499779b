"""Friction and drag: forces against the motion of a coordinate.

The sign of a velocity is ``tanh(v / w)``. The width w is a free nuisance parameter: fixed too wide, it turns Coulomb
friction into Stribeck friction. Steps in which the speed comes near zero are divided: a narrow width costs no accuracy.
"""

from __future__ import annotations

from typing import Any

from harness.effects.effect import EffectParameter, effect, par
from harness.effects.functions import absolute, cos, exp, no_sooner, power, tanh


def _width() -> EffectParameter:
    """Return the smoothing width of a sign, which turns over within the motion: wider ones are viscous friction.

    What sticks creeps at a part of it, so its floor is far below the speeds of the motion: over seconds the angle shows
    the creep, and with a floor of 0.003 of the speed a friction of the same law was called another's stand-in.
    """
    return par("w", "v", scale="0.02 v", floor="0.0002 v", ceiling="1 v", sign="+", minimum=1e-6, nuisance=True,
               meaning="smoothing width of the sign")  # fmt: skip


def _level(name: str, scale: str, *, main: bool, meaning: str) -> EffectParameter:
    """Return a force level that should be positive."""
    return par(name, "F", scale=scale, sign="+", neutral=0.0, main=main, linear=True, meaning=meaning)


@effect(
    "coordinate",
    [par("b", "F/v", scale="0.05 F/v", sign="+", neutral=0.0, main=True, linear=True, meaning="viscous coefficient")],
    formula="F = -b v",
    family=("quadratic_drag", "coulomb_friction"),
    same_as={"parameter": "where the nominal has a viscous term of its own on this coordinate"},
    limits={"quadratic_drag": "at one constant speed"},
    experiment="swings of several amplitudes: the decay per cycle of viscous friction does not depend on amplitude",
    told_by=("slow motion", "fast swing"),
)
def viscous_friction(f: Any, s: Any, p: Any, q: Any, v: Any) -> Any:
    """Friction proportional to speed."""
    return -p.b * v


@effect(
    "coordinate",
    [_level("Fc", "0.05 F", main=True, meaning="Coulomb level"), _width()],
    formula="F = -Fc sgn(v), sgn(v) = tanh(v/w)",
    family=("stribeck_friction", "asymmetric_friction", "viscous_friction", "hysteresis", "load_dependent_friction",
            "position_dependent_friction", "sublinear_friction", "yield_friction", "gear_loss"),
    limits={"stribeck_friction": "at speeds far above the Stribeck speed"},
    experiment="slow triangles through zero speed at several amplitudes: the force loop keeps its height",
    whole="dry friction",
    told_by=("slow motion", "fast swing"),
)  # fmt: skip
def coulomb_friction(f: Any, s: Any, p: Any, q: Any, v: Any) -> Any:
    """Dry friction: constant against the motion."""
    return -p.Fc * tanh(v / p.w)


@effect(
    "coordinate",
    [
        par("Fs", "F", scale="0.08 F", sign="+", neutral=0.0, main=True, linear=True, meaning="level near standstill"),
        par("Fc", "F", scale="0.04 F", sign="+", neutral=0.0, linear=True, meaning="Coulomb level at speed"),
        par(
            "vs",
            "v",
            scale="0.2 v",
            floor="0.015 v",  # slower than that, what sticks creeps: a level of its own there is the sign's
            sign="+",
            minimum=1e-6,
            grid=(1.0, 0.3, 3.0),
            meaning="Stribeck speed",
        ),
        _width(),
    ],
    formula="F = -[Fc + (Fs - Fc) exp(-(v/vs)^2)] sgn(v), sgn(v) = tanh(v/w)",
    family=("coulomb_friction", "asymmetric_friction", "viscous_friction", "hysteresis"),
    nests=("coulomb_friction",),
    requires={
        "the level near standstill Fs lies above the level at speed Fc": lambda p: p["Fs"] > p["Fc"],
        # the sign has turned to 99 % at 2.65 w: less of a rise than three quarters of it there is a sharper sign
        "the Stribeck speed vs lies far above the smoothing width w": lambda p: p["vs"] > 5 * p["w"],
    },
    limits={"coulomb_friction": "at speeds far above the Stribeck speed vs"},
    experiment="a slow triangle through zero speed: the force must fall as the speed rises",
    whole="dry friction",
    told_by=("slow motion",),
)
def stribeck_friction(f: Any, s: Any, p: Any, q: Any, v: Any) -> Any:
    """Dry friction that is higher near standstill."""
    return -(p.Fc + (p.Fs - p.Fc) * exp(-((v / p.vs) ** 2))) * tanh(v / p.w)


@effect(
    "coordinate",
    [
        _level("Fp", "0.06 F", main=True, meaning="level at positive speed"),
        _level("Fm", "0.04 F", main=False, meaning="level at negative speed"),
        _width(),
    ],
    formula="F = -(Fp + Fm)/2 sgn(v) - (Fp - Fm)/2, sgn(v) = tanh(v/w): -Fp forwards, +Fm backwards",
    family=("coulomb_friction", "force_bias", "stribeck_friction"),
    nests=("coulomb_friction", "force_bias"),
    same_as={"coulomb_friction + force_bias": "always: level (Fp + Fm)/2 and bias -(Fp - Fm)/2"},
    experiment="none on one joint tells it from Coulomb friction plus a bias; turning the joint round shows which",
    whole="dry friction",
    told_by=("slow motion",),
)
def asymmetric_friction(f: Any, s: Any, p: Any, q: Any, v: Any) -> Any:
    """Dry friction with another level in each direction."""
    return -0.5 * (p.Fp + p.Fm) * tanh(v / p.w) - 0.5 * (p.Fp - p.Fm)


@effect(
    "coordinate",
    [
        par("Fr", "F", scale="0.05 F", sign="+", neutral=0.0, main=True, linear=True,
            meaning="force at a speed of 1 (rad/s or m/s)"),
        par("a", "1", scale="0.5", minimum=0.05, maximum=0.95, grid=(1.0, 0.5, 1.5), meaning="exponent of the speed"),
        _width(),
    ],
    formula="F = -Fr |v|^a sgn(v) with v in rad/s or m/s, 0 < a < 1; |v| rounded over w",
    family=("coulomb_friction", "viscous_friction", "stribeck_friction", "quadratic_drag"),
    nests=("coulomb_friction",),
    limits={"coulomb_friction": "for a small exponent", "viscous_friction": "for an exponent near 1"},
    experiment="slow and fast triangles: the force grows with the speed, less than in proportion",
    whole="dry friction",
    told_by=("slow motion",),
)  # fmt: skip
def sublinear_friction(f: Any, s: Any, p: Any, q: Any, v: Any) -> Any:
    """Degressive friction of grease and seals: a power of the speed, which grows less than in proportion."""
    return -p.Fr * v * power(v * v + p.w * p.w, 0.5 * (p.a - 1.0))


@effect(
    "coordinate",
    [
        par("Fr", "F", scale="0.05 F", sign="+", neutral=0.0, main=True, linear=True,
            meaning="force at a speed of 1 (rad/s or m/s), beyond the level"),
        par("a", "1", scale="0.5", minimum=0.05, maximum=0.95, grid=(1.0, 0.5, 1.5), meaning="exponent of the speed"),
        _level("Fc", "0.03 F", main=False, meaning="Coulomb level"),
        _width(),
    ],
    formula="F = -(Fc + Fr |v|^a) sgn(v) with v in rad/s or m/s, 0 < a < 1; sgn(v) = tanh(v/w), |v| rounded over w",
    family=("stribeck_friction", "viscous_friction", "asymmetric_friction"),
    nests=("sublinear_friction", "coulomb_friction"),
    limits={"coulomb_friction": "for a small exponent"},
    experiment="slow and fast triangles: the force starts from a level, and grows with the speed, less and less",
    whole="dry friction",
    told_by=("slow motion",),
)  # fmt: skip
def yield_friction(f: Any, s: Any, p: Any, q: Any, v: Any) -> Any:
    """Dry friction and, beyond its level, a force that grows with the speed less than in proportion: stiff grease."""
    return -p.Fc * tanh(v / p.w) - p.Fr * v * power(v * v + p.w * p.w, 0.5 * (p.a - 1.0))


@effect(
    "coordinate",
    [
        _level("Fc", "0.05 F", main=True, meaning="level at high speed; Fc/vs is viscous, near standstill"),
        # at lower speeds it is told from the sign of dry friction by its corner alone, which nobody knows
        par("vs", "v", scale="0.3 v", floor="0.05 v", ceiling="5 v", sign="+", minimum=1e-6, grid=(1.0, 0.3, 3.0),
            meaning="speed at which half of the level is reached"),
    ],
    formula="F = -Fc v/(vs + |v|), which is -c v/(1 + |v|/vs) with c = Fc/vs",
    family=("coulomb_friction", "sublinear_friction", "viscous_friction", "yield_friction"),
    nests=("coulomb_friction",),
    limits={
        "coulomb_friction": "at speeds far above vs",
        "viscous_friction": "at speeds far below vs",
        "sublinear_friction": "within a few times one speed, where any such law is a power",
    },
    grows="degression",
    experiment="slow and fast triangles: near standstill the force grows with the speed, at speed it comes to a level",
    whole="dry friction",
    told_by=("slow motion",),
)  # fmt: skip
def degressive_friction(f: Any, s: Any, p: Any, q: Any, v: Any) -> Any:
    """Degressive viscous friction, which grows with the speed up to a level: shear-thinning grease, wet seals."""
    return -p.Fc * v / (p.vs + absolute(v))


@effect(
    "coordinate",
    [par("c", "F/v", scale="0.05 F/v", neutral=0.0, main=True, linear=True,
         meaning="half of what the damping forwards is above that backwards")],
    formula="F = -c |v|: forwards the damping is c larger, backwards c smaller",
    family=("viscous_friction", "asymmetric_friction", "quadratic_drag", "quadratic_spring"),
    requires_along={
        "with all that brakes the joint, the damping is nowhere negative over the motion": lambda p, q, damping: bool(
            damping.min() >= -0.05 * abs(p["c"])
        )
    },
    experiment="the same speed forwards and backwards, at several speeds: the forces differ in proportion to it",
    told_by=("fast swing",),
)  # fmt: skip
def asymmetric_damping(f: Any, s: Any, p: Any, q: Any, v: Any) -> Any:
    """Damping with another coefficient in each direction (rebound and compression of a suspension's damper)."""
    return -p.c * absolute(v)


@effect(
    "coordinate",
    [par("c", "F/v^2", scale="0.05 F/v^2", sign="+", neutral=0.0, main=True, linear=True, meaning="drag coefficient")],
    formula="F = -c |v| v",
    family=("viscous_friction", "coulomb_friction"),
    limits={"viscous_friction": "at one constant speed"},
    experiment="large swings: the decay per cycle grows with amplitude; needs a high peak speed",
    told_by=("fast swing",),
)
def quadratic_drag(f: Any, s: Any, p: Any, q: Any, v: Any) -> Any:
    """Drag of a fluid at speed."""
    return -p.c * absolute(v) * v


@effect(
    "coordinate",
    [par("mu", "1", scale="0.05", sign="+", neutral=0.0, main=True, linear=True, meaning="friction coefficient"),
     _width()],
    formula="F = -mu |load| sgn(v), sgn(v) = tanh(v/w); load = what the guide carries, else the input's force",
    family=("coulomb_friction", "position_dependent_friction", "hysteresis", "input_gain"),
    limits={"coulomb_friction": "under a load of constant size"},
    experiment="the same motion with and without a payload: Coulomb friction stays, this one grows",
    told_by=("slow motion",),
)  # fmt: skip
def load_dependent_friction(f: Any, s: Any, p: Any, q: Any, v: Any, load: Any) -> Any:
    """Dry friction in proportion to the force that the joint carries."""
    return -p.mu * absolute(load) * tanh(v / p.w)


def _gears() -> list[EffectParameter]:
    """Return the parameters of dry friction that grows with the torque in a gear.

    Driven through a motor's resistance the damping is mostly the motor's, and so on the drive's side of the teeth. How
    much of the load's pull counts is a matter of the gear: as much as the drive's, or hardly any (models M3 and M5 of
    Duclusaud et al. 2024, arXiv:2410.08650, section III).
    """
    return [
        _level("Fc", "0.03 F", main=False, meaning="level without a torque in the gear"),
        par("mu", "1", scale="0.05", sign="+", neutral=0.0, main=True, linear=True,
            meaning="friction over the torque in the gear"),
        par("r", "1", scale="1", minimum=0.0, maximum=4.0, nuisance=True,
            meaning="weight of what the load pulls with, over what the drive does"),
        _width(),
    ]  # fmt: skip


@effect(
    "coordinate",
    _gears(),
    formula="F = -(Fc + mu |f + d - r g|) sgn(v), sgn(v) = tanh(v/w); f the force of the input, d the nominal damping, "
    "g the nominal force at rest",
    family=("coulomb_friction", "load_dependent_friction", "gear_loss", "position_dependent_friction"),
    nests=("coulomb_friction",),
    limits={"coulomb_friction": "under a torque of constant size"},
    needs=("drive",),
    experiment="the same motion with and without a payload: a level of its own stays, the rest grows",
    whole="dry friction",
    told_by=("slow motion", "added mass"),
)
def gear_friction(f: Any, s: Any, p: Any, q: Any, v: Any, damping: Any, pull: Any) -> Any:
    """Dry friction of a gear: a level, and a part in proportion to the torque that its teeth pass on."""
    return -(p.Fc + p.mu * absolute(f + damping - p.r * pull)) * tanh(v / p.w)


@effect(
    "coordinate",
    [
        *_gears(),
        par("b", "1", scale="0.5", minimum=0.0, maximum=1.0, meaning="share of the friction that is left at speed"),
        par("vs", "v", scale="0.3 v", floor="0.015 v", sign="+", minimum=1e-6, grid=(1.0, 0.3, 3.0),
            meaning="Stribeck speed"),
    ],
    formula="F = -(Fc + mu |f + d - r g|) [b + (1 - b) exp(-(v/vs)^2)] sgn(v), otherwise as gear_friction",
    family=("gear_friction", "stribeck_friction"),
    nests=("gear_friction", "coulomb_friction"),
    limits={"gear_friction": "at speeds far above the Stribeck speed vs"},
    grows="Stribeck speed",
    needs=("drive",),
    experiment="slow triangles with and without a payload: the force must fall as the speed rises",
    whole="dry friction",
    told_by=("slow motion", "added mass"),
)  # fmt: skip
def gear_stribeck_friction(f: Any, s: Any, p: Any, q: Any, v: Any, damping: Any, pull: Any) -> Any:
    """Dry friction of a gear that is higher near standstill."""
    level = p.b + (1.0 - p.b) * exp(-((v / p.vs) ** 2))
    return -(p.Fc + p.mu * absolute(f + damping - p.r * pull)) * level * tanh(v / p.w)


@effect(
    "coordinate",
    [
        par("Fc", "F", scale="0.05 F", sign="+", neutral=0.0, main=True, linear=True, meaning="mean Coulomb level"),
        par("a", "1", scale="0.5", minimum=-2.0, maximum=2.0, meaning="relative swing of the level"),
        par("phi", "rad", scale="0.5", nuisance=True, grid=(1.0, 4.0, 7.0, 10.0), meaning="phase of the level"),
        _width(),
    ],
    formula="F = -[1 + a cos(q + phi)] Fc sgn(v), sgn(v) = tanh(v/w)",
    family=("coulomb_friction", "load_dependent_friction", "cogging"),
    nests=("coulomb_friction",),
    requires={"the level 1 + a cos(q + phi) is nowhere negative": lambda p: abs(p["a"]) <= 1.0},
    angles=True,
    experiment="slow full turns in both directions: the height of the force loop depends on the angle",
    whole="dry friction",
    told_by=("slow motion",),
)
def position_dependent_friction(f: Any, s: Any, p: Any, q: Any, v: Any) -> Any:
    """Dry friction whose level depends on the angle."""
    return -(1.0 + p.a * cos(q + p.phi)) * p.Fc * tanh(v / p.w)


@effect(
    "coordinate",
    [
        par("c1", "F/(q v)", scale="0.02 F/(q v)", neutral=0.0, linear=True,
            meaning="rise of the damping along the way"),
        par("c2", "F/(q^2 v)", scale="0.05 F/(q^2 v)", neutral=0.0, main=True, linear=True,
            meaning="curvature of the damping along the way"),
    ],
    formula="F = -(c1 q + c2 q^2) v",
    family=("viscous_friction", "position_dependent_friction", "load_dependent_friction", "quadratic_drag"),
    limits={"viscous_friction": "for a motion that stays at one place"},
    requires_along={
        # a twentieth of its largest is no drive: the estimate at the ends of the way is not better known
        "with all that brakes the joint, the damping is nowhere negative over the motion": lambda p, q, damping: bool(
            damping.min() >= -0.05 * abs(p["c1"] * q + p["c2"] * q**2).max()
        )
    },
    experiment="small fast swings about several places: the decay differs from place to place",
    needs=("place",),
)  # fmt: skip
def position_dependent_damping(f: Any, s: Any, p: Any, q: Any, v: Any) -> Any:
    """Viscous damping that changes with the position (worn guides, gaps of a damper)."""
    return -(p.c1 * q + p.c2 * q**2) * v


def _slips() -> list[EffectParameter]:
    """Return the parameters of hysteresis."""
    return [
        _level("Fh", "0.05 F", main=True, meaning="largest hysteretic force"),
        par("xs", "q", scale="0.05 q", floor="0.001 q", sign="+", minimum=1e-9, grid=(1.0, 0.2, 5.0),
            meaning="presliding length"),
        # a smaller one gives energy, and runs away (Erlicher & Point 2004, C. R. Mecanique 332:51)
        par("beta", "1", scale="0.75", minimum=0.5, maximum=1.0, nuisance=True,
            meaning="1: Dahl; 1/2: elastic unloading"),
    ]  # fmt: skip


def _settles() -> EffectParameter:
    """Return the time within which a hysteretic force follows the speed at once."""
    return par("T", "s", scale="0.2 dt", sign="+", minimum=0.0, fixed=True, nuisance=True,
               meaning="shortest time in which the force settles")  # fmt: skip


def _slip_rate(z: Any, length: Any, p: Any, v: Any) -> Any:
    """Return the rate of a hysteretic force, over its largest."""
    speed = absolute(v) / length
    return no_sooner(v / length - p.beta * speed * z - (1.0 - p.beta) * v / length * absolute(z), speed, p.T)


@effect(
    "coordinate",
    [*_slips(), _settles()],
    states={"z": "1"},
    formula="F = -Fh z, z' = [v - beta |v| z - (1 - beta) v |z|]/xs (Bouc-Wen of order 1, with k A = Fh/xs)",
    family=("coulomb_friction", "linear_spring", "stribeck_friction", "backlash", "maxwell_element"),
    limits={
        "coulomb_friction": "for a presliding length far below the motion",
        "linear_spring": "for motions far below the presliding length",
    },
    experiment="reversals of several small amplitudes: minor loops appear where Coulomb friction has none",
    whole="dry friction",
    told_by=("slow motion", "small reversals"),
)
def hysteresis(f: Any, s: Any, p: Any, q: Any, v: Any) -> tuple[Any, list[Any]]:
    """Bouc-Wen hysteresis: friction that builds up over a presliding length."""
    return -p.Fh * s.z, [_slip_rate(s.z, p.xs, p, v)]


@effect(
    "coordinate",
    [
        *_slips(),
        par("share", "1", scale="0.3", sign="+", minimum=0.0, maximum=1.0, grid=(1.0, 0.3),
            meaning="share of the force that the shorter element carries"),
        par("ratio", "1", scale="0.3", sign="+", minimum=0.01, maximum=1.0, grid=(1.0, 0.1),
            meaning="presliding length of the shorter element over that of the longer"),
        _settles(),
    ],
    states={"z": "1", "zs": "1"},
    formula="F = -Fh [(1 - share) z + share zs], both as in hysteresis, zs with the length ratio xs",
    family=("hysteresis", "lugre_coulomb_friction", "coulomb_friction", "linear_spring", "maxwell_element"),
    nests=("hysteresis",),
    limits={"hysteresis": "for a share of 0, or equal lengths"},
    grows="slip elements",
    experiment="reversals of several small amplitudes: elements slip one after the other, the shortest first",
    whole="dry friction",
    told_by=("slow motion",),
)  # fmt: skip
def parallel_hysteresis(f: Any, s: Any, p: Any, q: Any, v: Any) -> tuple[Any, list[Any]]:
    """Hysteresis of two elements in parallel that slip one after the other (Iwan 1966), as gears and bearings have."""
    rates = [_slip_rate(s.z, p.xs, p, v), _slip_rate(s.zs, p.ratio * p.xs, p, v)]
    return -p.Fh * ((1.0 - p.share) * s.z + p.share * s.zs), rates
