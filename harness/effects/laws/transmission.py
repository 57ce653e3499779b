"""Transmissions: what lies between the motor and the load of a driven coordinate.

Hidden states are the motor's lead over the load, e, and the motor's own rate w (in the load's units): e = 0 and w = v
is rest wherever the load stands.

Two laws refine others, and are tried where those were fitted: a joint that stiffens with its twist, as those of
harmonic drives do, and flanks that push and never pull (Nordin, Galic & Gutman 1997, Int. J. Adapt. Control Signal
Process. 11:49: with a damper between the flanks a dead band in the force pulls them together as they part).
"""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import Any

from harness.effects.effect import EffectParameter, effect, par
from harness.effects.functions import absolute, dead_band, dead_band_slope, sigmoid, sin, softplus, tanh


def _inertia(scale: str, grid: tuple[float, ...] = (1.0,)) -> EffectParameter:
    """Return the inertia of the motor's side."""
    return par("Jm", "F/a", scale=scale, sign="+", minimum=1e-12, nuisance=True, grid=grid,
               meaning="inertia of the motor's side, no longer part of the load's")  # fmt: skip


def _stiffness(scale: str, grid: tuple[float, ...] = (1.0,), *, main: bool) -> EffectParameter:
    """Return the stiffness of the transmission."""
    return par("k", "F/q", scale=scale, sign="+", minimum=1e-12, main=main, nuisance=not main, grid=grid,
               meaning="stiffness of the transmission")  # fmt: skip


def _damping(scale: str) -> EffectParameter:
    """Return the damping of the transmission; what fades within a sample time is as good as rigid."""
    return par("d", "F/v", scale=scale, ceiling="1 F/(a dt)", sign="+", minimum=0.0, nuisance=True,
               meaning="damping in the transmission")  # fmt: skip


_transmission = functools.partial(
    effect,
    "coordinate",
    states={"e": "q", "w": "v"},
    initial={"w": "v"},
    drives=True,
    linearises=False,
)
"""What all transmissions are: hidden states in the way of the drive, of which no first-order test sees anything."""


def _through(passed: Any, f: Any, s: Any, p: Any, v: Any) -> tuple[Any, list[Any]]:
    """Return the force to add for what a transmission passes on in place of f, and the rates of its states."""
    return passed - f, [s.w - v, (f - passed) / p.Jm]


@_transmission(
    [_stiffness("20 F a/v^2", (1.0, 0.1, 10.0), main=True), _inertia("0.4 F/a", (1.0, 0.2)), _damping("0.2 F/v")],
    formula="force on the load = k e + d e' in place of f; e' = w - v, Jm w' = f - k e - d e'",
    family=("backlash", "actuator_lag", "input_delay"),
    limits={"parameter": "for large k: the two inertias add up to the nominal's", "backlash": "for zero gap"},
    experiment="a chirp through the resonance and antiresonance of the two masses, with a sensor on each side",
    told_by=("small reversals",),
)
def elasticity(f: Any, s: Any, p: Any, q: Any, v: Any) -> tuple[Any, list[Any]]:
    """Flexible transmission between a motor mass and the load."""
    passed = p.k * s.e + p.d * (s.w - v)
    return _through(passed, f, s, p, v)


@_transmission(
    [
        _stiffness("20 F a/v^2", (1.0, 0.1, 10.0), main=True),
        par("k3", "F/q^3", scale="2e3 F/q^3", sign="+", grid=(1.0, 30.0, 0.03),
            meaning="cubic stiffness of the transmission"),
        _inertia("0.4 F/a", (1.0, 0.2)),
        _damping("0.2 F/v"),
    ],
    formula="as elasticity, with k e + k3 e^3 + d e' passed on",
    family=("elasticity", "backlash"),
    nests=("elasticity",),
    limits={"elasticity": "for small twists", "backlash": "for a joint that is soft at first: a rounded play"},
    grows="stiffening",
    experiment="chirps of two sizes through the resonance, which moves up with the amplitude",
    told_by=("small reversals",),
)  # fmt: skip
def hardening_elasticity(f: Any, s: Any, p: Any, q: Any, v: Any) -> tuple[Any, list[Any]]:
    """Flexible transmission that stiffens with its twist, as harmonic drives do."""
    passed = p.k * s.e + p.k3 * s.e**3 + p.d * (s.w - v)
    return _through(passed, f, s, p, v)


@effect(
    "coordinate",
    [
        _stiffness("20 F a/v^2", (1.0, 0.1, 10.0), main=True),
        par("J", "F/a", scale="0.4 F/a", sign="+", minimum=1e-12, nuisance=True, grid=(1.0, 0.2),
            meaning="inertia of the load, no longer part of the motor's side"),
        _damping("0.2 F/v"),
    ],
    states={"e": "q", "w": "v"},
    initial={"w": "v"},
    drives=True,
    linearises=False,
    formula="F = -(k e + d e') - g, e' = q' - w, J w' = k e + d e' + g; g the nominal force at rest, which pulls "
    "at the load",
    family=("elasticity", "input_delay", "actuator_lag", "viscous_friction", "coulomb_friction"),
    limits={"parameter": "for large k: the two inertias add up to the nominal's",
            "elasticity": "without damping of either mass, below the antiresonance"},
    # what does not swing is a lag of the drive, or a delay: it has no resonance that would tell a spring
    requires={"the load swings on its spring: d lies below 2 sqrt(k J)": lambda p: p["d"] ** 2 < 4 * p["k"] * p["J"]},
    experiment="a chirp through the antiresonance and resonance of the two masses, with a sensor on each side",
    told_by=("chirp",),
)  # fmt: skip
def elastic_load(f: Any, s: Any, p: Any, q: Any, v: Any, pull: Any) -> tuple[Any, list[Any]]:
    """Load behind a flexible transmission whose motor's side is measured: harmonic drives, belts, shafts."""
    passed = p.k * s.e + p.d * (v - s.w)
    return -passed - pull, [v - s.w, (passed + pull) / p.J]


def _play() -> list[EffectParameter]:
    """Return the parameters of a play."""
    return [
        par("gap", "q", scale="0.1 q", ceiling="2 q", sign="+", minimum=0.0, main=True, grid=(1.0, 2.0, 0.3),
            meaning="half of the play, which the motion must cross"),
        _stiffness("50 F/q", main=False),
        _inertia("0.1 F/a"),
        _damping("3 F/v"),  # gears hardly bounce: damping ratio near 1
        # from a rounded corner a fit sees flanks that it does not touch yet; from a sharp one it ended where it began
        par("c", "1", scale="0.01", sign="+", minimum=0.01, maximum=0.5, nuisance=True, grid=(20.0,),
            meaning="length over which the flanks come into contact, over the gap"),
    ]  # fmt: skip


@_transmission(
    _play(),
    formula="as elasticity, with k dz(e) + d dz'(e) e' passed on: nothing within |e| < gap (corners of c gap)",
    family=("elasticity", "dead_zone", "hysteresis", "coulomb_friction"),
    nests=("elasticity",),
    limits={"elasticity": "for zero gap"},
    experiment="small reversals, and a sensor on the load's side",
    told_by=("small reversals",),
)
def backlash(f: Any, s: Any, p: Any, q: Any, v: Any) -> tuple[Any, list[Any]]:
    """Play between a motor mass and the load, with an elastic contact."""
    smoothing = p.c * p.gap + 1e-12
    passed = p.k * dead_band(s.e, p.gap, smoothing) + p.d * dead_band_slope(s.e, p.gap, smoothing) * (s.w - v)
    return _through(passed, f, s, p, v)


@_transmission(
    # flanks that pull as well lose less in the damper and are stiffer, for the same motion
    [replace(one, refined={"k": (1.0, 0.6), "d": (1.0, 1.3)}.get(one.name, (1.0,))) for one in _play()],
    formula="as backlash, each flank passing on k (|e| - gap) + d |e|' where that pushes, and nothing where it pulls",
    family=("backlash", "elasticity", "dead_zone", "hysteresis", "coulomb_friction"),
    nests=("backlash",),
    limits={"backlash": "for flanks without damping"},
    grows="parting flanks",
    experiment="small fast reversals: flanks part at once",
    told_by=("small reversals",),
)
def unilateral_backlash(f: Any, s: Any, p: Any, q: Any, v: Any) -> tuple[Any, list[Any]]:
    """Play between a motor mass and the load whose flanks push and never pull."""
    smoothing = p.c * p.gap + 1e-12

    def pushes(lead: Any, rate: Any) -> Any:
        touches, force = (lead - p.gap) / smoothing, p.k * (lead - p.gap) + p.d * rate
        return sigmoid(touches) * p.k * smoothing * softplus(force / (p.k * smoothing))

    passed = pushes(s.e, s.w - v) - pushes(-s.e, v - s.w)
    return _through(passed, f, s, p, v)


def _wave(meaning: str) -> list[EffectParameter]:
    """Return wave number and phase of what repeats along the motion.

    k times the travel (2 sqrt(2) rms) reaches pi/2: over less than a quarter of a period nothing repeats.
    """
    return [
        par("k", "rad/q", scale="6", floor="0.56 q^-1", minimum=2.5, maximum=1000.0,
            grid=(1.0, 0.5, 0.6666666666666666, 1.3333333333333333, 2.0, 3.0, 4.0),
            role="wave number", meaning=meaning),
        par("phi", "rad", scale="0.5", nuisance=True, grid=(1.0, 4.0, 7.0, 10.0), role="phase", meaning="phase"),
    ]  # fmt: skip


@effect(
    "coordinate",
    [
        par("c", "1", scale="0.1", sign="+", neutral=0.0, main=True, linear=True,
            meaning="share of the transmitted force that is lost: 1 less the efficiency, the motor driving"),
        # with the scale of the nominal parameters free, any other ratio is a gain of the drive
        par("r", "1", scale="1", sign="+", minimum=0.0, fixed=True,
            meaning="share that is lost while the load drives, over c"),
        par("w", "v", scale="0.02 v", floor="0.0002 v", ceiling="1 v", sign="+", minimum=1e-6, nuisance=True,
            meaning="smoothing width of the sign"),
    ],
    formula="F = -c |f| sgn(v) while the motor drives (f v > 0), -c r |f| sgn(v) while the load does; f the force of "
    "the input, sgn(v) = tanh(v/w); efficiencies 1 - c and 1/(1 + c r)",
    family=("load_dependent_friction", "coulomb_friction", "input_gain", "torque_ripple", "dead_zone",
            "viscous_friction"),
    same_as={"parameter": "while one side drives all the time: a factor on all nominal parameters"},
    limits={
        "coulomb_friction": "under a force of constant size",
        "load_dependent_friction": "where the guide carries no load that changes: its load is then the input's force",
        "input_gain": "while one side drives all the time",
    },
    needs=("drive",),
    experiment="the same motion against a spring or a weight, driven and driving back: the force loop opens with the "
    "torque that the gear passes on, and closes where it passes none",
    told_by=("slow motion", "added mass"),
)  # fmt: skip
def gear_loss(f: Any, s: Any, p: Any, q: Any, v: Any) -> Any:
    """Efficiency of a gear: dry friction in proportion to the torque that it transmits, whoever drives."""
    sign = tanh(v / p.w)
    return -0.5 * p.c * ((1.0 + p.r) * absolute(f) * sign + (1.0 - p.r) * f * sign**2)


@effect(
    "coordinate",
    [
        par("a", "1", scale="0.1", neutral=0.0, main=True, linear=True, meaning="share of the force that ripples"),
        *_wave("periods per turn: pole pairs or commutations times the gear ratio"),
    ],
    formula="F = a sin(k q + phi) f, f the force of the input, k >= 2.5",
    family=("cogging", "gear_loss", "position_dependent_friction", "input_gain"),
    limits={
        "cogging": "under a force of constant size, or one that follows from the angle as at rest",
        "input_gain": "for a motion far shorter than a period",
    },
    requires={"the force keeps its direction": lambda p: abs(p["a"]) < 1.0},
    needs=("drive",),
    experiment="slow turns against several loads: what repeats with the angle grows with the torque, cogging stays",
    told_by=("added mass",),
)  # fmt: skip
def torque_ripple(f: Any, s: Any, p: Any, q: Any, v: Any) -> Any:
    """Ripple of a motor's torque with its angle, in proportion to the torque (commutation, an encoder's angle)."""
    return p.a * sin(p.k * q + p.phi) * f


@effect(
    "coordinate",
    [
        par("A", "F", scale="0.05 F", neutral=0.0, main=True, linear=True, meaning="amplitude"),
        *_wave("periods per turn"),
    ],
    formula="F = A sin(k q + phi), k >= 2.5",
    family=("cubic_spring", "quadratic_spring", "position_dependent_friction", "periodic_disturbance",
            "eccentric_load", "torque_ripple"),
    limits={
        "eccentric_load": "for one period per turn (excluded: k >= 2.5)",
        "quadratic_spring": "if the motion covers less than half a period about a crest",
        "cubic_spring": "if the motion covers less than a period about a zero, with the stiffness free",
    },
    experiment="slow full turns in both directions: the force repeats with the angle whatever the speed",
    told_by=("rest",),
)  # fmt: skip
def cogging(f: Any, s: Any, p: Any, q: Any, v: Any) -> Any:
    """Torque that repeats several times a turn (poles, teeth)."""
    return p.A * sin(p.k * q + p.phi)
