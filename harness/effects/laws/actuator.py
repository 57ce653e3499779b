"""Actuators: what happens between the command and the force."""

from __future__ import annotations

from typing import Any

from harness.effects.effect import effect, par
from harness.effects.functions import absolute, clip, dead_band, exp, tanh


@effect(
    "input",
    [par("width", "u", scale="0.1 u", sign="+", minimum=0.0, neutral=0.0, main=True, grid=(1.0, 0.3, 3.0),
         meaning="largest command without effect")],
    formula="u' = dz(u): 0 for |u| < width, u - width sgn(u) beyond (corner rounded over width/1000)",
    family=("coulomb_friction", "input_gain", "backlash"),
    limits={"coulomb_friction": "while the motion follows the command"},
    experiment="a slow small triangle of the command at standstill: nothing moves until its width is passed",
    told_by=("small reversals",),
)  # fmt: skip
def dead_zone(u: Any, s: Any, p: Any, q: Any, v: Any) -> Any:
    """Small commands have no effect."""
    return dead_band(u, p.width, 1e-3 * p.width + 1e-12)


@effect(
    "input",
    [par("limit", "u", scale="1.2 u", sign="+", minimum=0.0, main=True, grid=(1.0, 0.7, 1.1, 1.5, 2.0, 2.4),
         meaning="largest command that passes")],  # times 1.1 it clips the peaks of a sine, which lie at 1.41 u
    formula="u' = clip(u, -limit, limit) (corner rounded over limit/1000)",
    family=("rate_limit", "input_gain"),
    limits={"input_gain": "if the command is always beyond the limit"},
    experiment="commands of two amplitudes: invisible at small amplitude",
    told_by=("full swing",),
)  # fmt: skip
def saturation(u: Any, s: Any, p: Any, q: Any, v: Any) -> Any:
    """Large commands are cut off."""
    return clip(u, p.limit, 1e-3 * p.limit + 1e-12)


@effect(
    "input",
    [
        par("R", "u/s", scale="0.2 u/dt", sign="+", minimum=1e-12, main=True, grid=(1.0, 0.2, 0.04, 3.0),
            meaning="largest rate of the actuator"),
        par("tau", "s", scale="1 dt", floor="0.2 dt", sign="+", minimum=1e-9, nuisance=True,
            meaning="time constant below the limit"),
    ],
    states={"z": "u"},
    initial={"z": "signal"},
    formula="u' = z, z' = R tanh((u - z)/(R tau))",
    family=("actuator_lag", "input_delay", "saturation"),
    nests=("actuator_lag",),
    limits={"actuator_lag": "for commands that never ask for more than the rate R"},
    experiment="steps of two sizes: the rise time of a rate limit grows with the size, that of a lag does not",
    told_by=("chirp",),
)  # fmt: skip
def rate_limit(u: Any, s: Any, p: Any, q: Any, v: Any) -> tuple[Any, list[Any]]:
    """Limit on how fast the actuator can change."""
    return s.z, [p.R * tanh((u - s.z) / (p.R * p.tau))]


@effect(
    "input",
    [par("tau", "s", scale="2 dt", sign="+", minimum=0.0, neutral=0.0, main=True, grid=(1.0, 0.5, 3.0, 8.0),
         meaning="delay")],
    formula="u'(t) = u(t - tau); a held input changes within a sample, to a quarter of it",
    family=("actuator_lag", "sensor_delay", "rate_limit"),
    same_as={"sensor_delay": "in open loop, but for the response to the initial state"},
    limits={"actuator_lag": "at frequencies far below 1/tau"},
    sampled="input_delay",
    experiment="a chirp up to 5/tau (2 to 8 Hz for 20 to 100 ms): a delay turns the phase without losing amplitude",
    told_by=("chirp",),
)  # fmt: skip
def input_delay(u: Any, s: Any, p: Any, q: Any, v: Any) -> Any:
    """Delay between command and force."""
    return u


@effect(
    "input",
    # a twelfth of a sample: what is over sooner is refused, and a floor above that keeps a short lag from its place
    [par("tau", "s", scale="2 dt", floor="0.083 dt", sign="+", minimum=1e-9, main=True, grid=(1.0, 0.5, 3.0, 8.0),
         meaning="time constant")],
    states={"z": "u"},
    initial={"z": "signal"},
    formula="u' = z, z' = (u - z)/tau",
    family=("input_delay", "rate_limit", "elasticity", "sensor_delay"),
    limits={"input_delay": "at frequencies far below 1/tau"},
    experiment="a chirp up to 5/tau: a lag loses amplitude, a delay does not",
    told_by=("chirp",),
)  # fmt: skip
def actuator_lag(u: Any, s: Any, p: Any, q: Any, v: Any) -> tuple[Any, list[Any]]:
    """First-order lag of the actuator."""
    return s.z, [(u - s.z) / p.tau]


@effect(
    "input",
    [par("gain", "1", scale="1.05", sign="+", minimum=0.0, neutral=1.0, main=True, linear=True,
         meaning="force per commanded force")],
    formula="u' = gain u",
    family=("sensor_gain", "saturation", "dead_zone"),
    same_as={"parameter": "a common factor on all nominal parameters, where all of them are free"},
    experiment="a known added mass or a measured force: the scale of inertia is known only through the input",
    told_by=("added mass",),
)  # fmt: skip
def input_gain(u: Any, s: Any, p: Any, q: Any, v: Any) -> Any:
    """Constant factor between command and force."""
    return p.gain * u


@effect(
    "input",
    [par("c", "1/u", scale="0.05 u^-1", ceiling="0.15 u^-1", sign="+", neutral=0.0, main=True, linear=True,
         meaning="share of the gain that is lost at a command of 1")],
    formula="u' = u - c u |u| (more command gives more force, up to three times its rms)",
    family=("saturation", "input_gain", "dead_zone", "quadratic_drag"),
    limits={"input_gain": "for commands of one size"},
    experiment="slow swings or static loads at several commands, with a measured force: the gain falls as they grow",
)  # fmt: skip
def input_compression(u: Any, s: Any, p: Any, q: Any, v: Any) -> Any:
    """Gain of a drive that falls with its command (magnetic saturation, a soft supply)."""
    return u - p.c * u * absolute(u)


@effect(
    "input",
    [
        par("c", "1/u", scale="0.1 u^-1", ceiling="0.8 u^-1", sign="+", neutral=0.0, main=True, linear=True,
            meaning="share of the gain that is lost after a long command of 1"),
        # within two samples it sags at once, and what takes half of the record is a drift
        par("tau", "s", scale="0.03 T", floor="2 dt", ceiling="0.5 T", sign="+", minimum=1e-9, grid=(1.0, 0.2, 4.0),
            meaning="time in which the supply sags and recovers"),
        # no supply sags more at its start than a command could make it: a larger one hides the first rows
        par("z0", "u", scale="0.8 u", ceiling="3 u", sign="+", minimum=0.0, nuisance=True, per_record=True,
            meaning="command before the record that it still sags by"),
    ],
    states={"z": "u"},
    formula="u' = [1 - c (z + z0 exp(-t/tau))] u, z' = (|u| - z)/tau: the current that was drawn, as the supply sags",
    family=("input_compression", "drifting_gain", "saturation", "input_gain"),
    limits={
        "input_compression": "for a supply that sags at once",
        "drifting_gain": "for a supply that recovers in no time of the record",
        "input_gain": "for a command whose size does not change",
    },
    experiment="bursts of large and small commands: after a large one the same command gives less for a while",
)  # fmt: skip
def supply_sag(u: Any, s: Any, p: Any, q: Any, v: Any, t: Any) -> tuple[Any, list[Any]]:
    """Supply that sags with the current drawn, and recovers in a while: a battery, a capacitor behind a long line."""
    return (1.0 - p.c * (s.z + p.z0 * exp(-t / p.tau))) * u, [(absolute(u) - s.z) / p.tau]


@effect(
    "input",
    [
        par("s", "1", scale="0.5", sign="+", neutral=0.0, main=True, linear=True,
            meaning="1: the force is quadratic in the command, 0: it is linear"),
        # beside the scale of the nominal parameters another one is a gain
        par("U", "u", scale="1 u", sign="+", minimum=1e-12, fixed=True, nuisance=True,
            meaning="command at which both give the same"),
    ],
    formula="u' = (1 - s) u + s u |u|/U",
    family=("dead_zone", "input_gain", "input_compression"),
    limits={"dead_zone": "for small commands of one size", "input_gain": "for commands of one size"},
    requires={"small commands do not pull backwards (s is 1 at most)": lambda p: p["s"] <= 1.1},
    experiment="commands of several sizes at standstill, with a measured force: twice the command gives four times it",
    told_by=("small reversals",),
)  # fmt: skip
def propeller_thrust(u: Any, s: Any, p: Any, q: Any, v: Any) -> Any:
    """Thrust of a propeller, and its reaction: quadratic in the speed that is commanded."""
    return (1.0 - p.s) * u + p.s * u * absolute(u) / p.U


@effect(
    ("coordinate", "input"),
    [par("F0", "F", scale="0.05 F", neutral=0.0, main=True, linear=True, role="zero", meaning="constant force")],
    formula="F = F0 (at an input: u' = u + F0)",
    family=("sensor_offset", "gravity_tilt", "eccentric_load", "asymmetric_friction", "quadratic_spring"),
    same_as={"parameter": "where the nominal has a constant force of its own"},
    limits={"gravity_tilt": "at small angles", "sensor_offset": "at small angles"},
    experiment="swings beyond 60 deg: gravity makes an angle offset differ from a constant force",
    told_by=("large swing",),
)
def force_bias(f: Any, s: Any, p: Any, q: Any, v: Any) -> Any:
    """Constant force that nobody commanded."""
    return p.F0
