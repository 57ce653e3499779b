"""Springs, gravity and payload: forces that depend on where a coordinate stands.

Angles are 0 hanging down, so a load at right angles to the nominal's own pulls with the cosine of the angle.
"""

from __future__ import annotations

from typing import Any

from harness.effects.effect import effect, par
from harness.effects.functions import cos, sigmoid, sin, sqrt

CHANGE = (
    par(
        "t0",
        "s",
        scale="0.5 T",
        minimum=0.0,
        per_record=True,
        role="instant",
        grid=(1.0, 0.2, 0.4, 0.6, 0.8, 1.2, 1.4, 1.6, 1.8),
        meaning="instant of the change",
    ),
    par("w", "s", scale="0.5 dt", minimum=1e-6, nuisance=True, fixed=True, meaning="duration of the change"),
)
"""Parameters of a step between two values: its instant, one for each record, and how long it takes."""


@effect(
    "coordinate",
    [par("k", "F/q", scale="0.05 F/q", sign="+", neutral=0.0, main=True, linear=True, meaning="stiffness")],
    formula="F = -k q",
    family=("cubic_spring", "quadratic_spring", "eccentric_load", "force_bias", "hysteresis"),
    same_as={"parameter": "where the nominal has a linear spring of its own; at small angles also its gravity"},
    limits={"cubic_spring": "at small amplitude"},
    experiment="angles beyond 90 deg: gravity turns back, a spring does not",
    told_by=("full swing",),
)
def linear_spring(f: Any, s: Any, p: Any, q: Any, v: Any) -> Any:
    """Force proportional to the coordinate."""
    return -p.k * q


@effect(
    "coordinate",
    [
        par("k", "F/q", scale="0.05 F/q", sign="+", neutral=0.0, main=True, linear=True, meaning="stiffness"),
        par("tau", "s", scale="1 q/v", floor="0.02 q/v", sign="+", minimum=1e-9, grid=(1.0, 0.3, 3.0),
            meaning="relaxation time: damping over stiffness"),
    ],
    states={"z": "q"},
    formula="F = -k z, z' = v - z/tau",
    family=("hysteresis", "viscous_friction", "elasticity"),
    nests=("linear_spring",),
    limits={
        "linear_spring": "for a relaxation time far above a period of the motion",
        "viscous_friction": "for a relaxation time far below a period of the motion",
    },
    experiment="a step of the position, held: the force relaxes; sines of several frequencies at one amplitude",
)  # fmt: skip
def maxwell_element(f: Any, s: Any, p: Any, q: Any, v: Any) -> tuple[Any, list[Any]]:
    """Spring and damper in series, beside the coordinate: rubber, belts, creep."""
    return -p.k * s.z, [v - s.z / p.tau]


@effect(
    "coordinate",
    [par("k2", "F/q^2", scale="0.05 F/q^2", neutral=0.0, main=True, linear=True, meaning="quadratic stiffness")],
    formula="F = -k2 q^2",
    family=("cubic_spring", "linear_spring", "force_bias"),
    experiment="a static offset: the resonance shifts with its sign",
    told_by=("full swing",),
    needs=("place",),
)
def quadratic_spring(f: Any, s: Any, p: Any, q: Any, v: Any) -> Any:
    """Force proportional to the square of the coordinate: unequal stiffness to the two sides."""
    return -p.k2 * q**2


@effect(
    "coordinate",
    [par("k3", "F/q^3", scale="0.05 F/q^3", neutral=0.0, main=True, linear=True, meaning="cubic stiffness")],
    formula="F = -k3 q^3",
    family=("linear_spring", "quadratic_spring", "end_stop"),
    limits={"linear_spring": "at small amplitude"},
    experiment="sweeps of two amplitudes: the resonance shifts with amplitude",
    told_by=("full swing",),
    needs=("place",),
)
def cubic_spring(f: Any, s: Any, p: Any, q: Any, v: Any) -> Any:
    """Force proportional to the cube of the coordinate: hardening (k3 > 0) or softening."""
    return -p.k3 * q**3


@effect(
    "base",
    [par("alpha", "rad", scale="0.05", minimum=-1.6, maximum=1.6, neutral=0.0, main=True, meaning="tilt of the base")],
    formula="gravity turned by alpha: a joint that hangs at q = 0 now hangs at q = -alpha",
    family=("sensor_offset", "eccentric_load", "force_bias"),
    same_as={
        "sensor_offset": "on one joint: an encoder offset of the same angle gives the same motion",
        "eccentric_load": "on one joint: gravity amplitude and tilt against two components of the load",
    },
    limits={"force_bias": "at small angles"},
    experiment="turn the base: tilt turns with it, an encoder offset does not",
    told_by=("turned base", "large swing"),
)
def gravity_tilt(g: Any, s: Any, p: Any, q: Any, v: Any) -> Any:
    """Tilt of the base."""
    gx, gy = g
    return gx * cos(p.alpha) + gy * sin(p.alpha), gy * cos(p.alpha) - gx * sin(p.alpha)


@effect(
    "coordinate",
    [
        par("A", "F", scale="0.05 F", neutral=0.0, main=True, linear=True, meaning="torque of the load at q = 0"),
        par("phi", "rad", scale="0", nuisance=True, fixed=True, meaning="angle of the load from a right angle"),
    ],
    formula="F = -A cos(q + phi); phi is kept at 0 because the sine part adds to the nominal's own gravity",
    family=("gravity_tilt", "sensor_offset", "force_bias", "linear_spring", "cogging"),
    same_as={
        "gravity_tilt": "on one joint, with its gravity amplitude free",
        "sensor_offset": "on one joint, with its gravity amplitude free",
    },
    limits={"force_bias": "at small angles"},
    angles=True,
    experiment="turn the base by a known angle: the load's torque stays with the body, the tilt does not",
    told_by=("turned base", "large swing"),
)
def eccentric_load(f: Any, s: Any, p: Any, q: Any, v: Any) -> Any:
    """Centre of mass beside the nominal's line."""
    return -p.A * cos(q + p.phi)


@effect(
    "coordinate",
    [
        par("A", "F", scale="0.05 F", sign="+", neutral=0.0, main=True, linear=True,
            meaning="weight of the load over its arm"),
        par("phi", "rad", scale="0.2", grid=(1.0, 8.854, 16.708, 24.562), role="phase",
            meaning="minus the angle at which the load hangs"),
    ],
    formula="F = -A sin(q + phi), on a coordinate that nothing in the model holds anywhere",
    family=("eccentric_load", "linear_spring", "cubic_spring", "payload_step", "cogging"),
    nests=("eccentric_load",),
    limits={"linear_spring": "at small angles about where it hangs", "force_bias": "at small angles elsewhere"},
    angles=True,
    needs=("astatic", "place"),
    experiment="hold the joint at angles over the whole turn: its torque comes once a turn",
    told_by=("full swing",),
)  # fmt: skip
def unbalanced_load(f: Any, s: Any, p: Any, q: Any, v: Any) -> Any:
    """Weight beside the axis of what the model takes to be balanced."""
    return -p.A * sin(q + p.phi)


@effect(
    "coordinate",
    [
        par("A", "F", scale="0.05 F", sign="+", neutral=0.0, main=True, linear=True,
            meaning="k L0 a b rho / (4 sqrt(a^2 + b^2)): what the free length adds twice a turn"),
        par("alpha", "rad", scale="0.2", grid=(1.0, 4.927, 8.854, 12.781),
            meaning="angle at which arm and anchor stand in line"),
        par("rho", "1", scale="0.5", minimum=-0.98, maximum=0.98, nuisance=True,
            meaning="2 a b / (a^2 + b^2), of the arm a and the distance b of the anchor; negative: on the other side"),
        par("E", "F", scale="0", neutral=0.0, linear=True,
            meaning="its pull at q = 0, where the anchor stands beside the vertical"),
    ],
    formula="F = 2 A sin(2 (q - alpha)) / (s (1 + s)) + E cos(q), s = sqrt(1 - rho cos(q - alpha)): the torque "
    "-k (1 - L0/L) a b sin(q - alpha) of a spring of length L = s sqrt(a^2 + b^2), less what gravity takes up",
    family=("cubic_spring", "quadratic_spring", "linear_spring", "eccentric_load", "gravity_tilt", "cogging",
            "sensor_nonlinearity", "sensor_cyclic_error"),
    nests=("eccentric_load",),
    same_as={"parameter": "for a spring without a free length: gravity, with its amplitude free"},
    limits={
        "cubic_spring": "at small angles from an anchor in line with the arm, with gravity's amplitude free",
        "quadratic_spring": "at small angles, from an anchor at half a right angle to the arm",
    },
    angles=True,
    needs=("gravity",),
    experiment="hold the joint at angles over the whole turn: beside gravity, its torque comes twice a turn",
    told_by=("full swing",),
)  # fmt: skip
def counterbalance(f: Any, s: Any, p: Any, q: Any, v: Any) -> Any:
    """Spring over a lever arm that carries a load, and whose length changes: more than a share of gravity."""
    angle = q - p.alpha
    length = sqrt(1.0 - p.rho * cos(angle))
    return 2.0 * p.A * sin(2.0 * angle) / (length * (1.0 + length)) + p.E * cos(q)


@effect(
    "coordinate",
    [
        par("dJ", "F/a", scale="0.1 F/a", sign="+", neutral=0.0, main=True, linear=True, meaning="added inertia"),
        par("dG", "F", scale="0.05 F", neutral=0.0, linear=True, angle_only=True, meaning="added gravity amplitude"),
        *CHANGE,
    ],
    formula="F = -(dJ q'' + dG sin q) step((t - t0)/w)",
    family=("eccentric_load", "force_bias", "input_gain"),
    same_as={"parameter": "if t0 lies outside the record: an error of the nominal inertia and gravity"},
    experiment="repeat the same excitation before and after the change",
    told_by=("added mass",),
)
def payload_step(f: Any, s: Any, p: Any, q: Any, v: Any, t: Any, a: Any) -> Any:
    """Load that is picked up during the record."""
    return -(p.dJ * a + p.dG * sin(q)) * sigmoid((t - p.t0) / p.w)


@effect(
    "mass",
    [
        par("dm", "M", scale="0.2 M", neutral=0.0, main=True, linear=True, meaning="mass that comes; negative: goes"),
        *CHANGE,
    ],
    formula="m' = m + dm step((t - t0)/w), m a mass that moves with several coordinates",
    family=("payload_step", "drifting_damping"),
    same_as={"parameter": "if t0 lies outside the record: an error of the nominal mass"},
    experiment="repeat the same excitation before and after the change",
    told_by=("added mass",),
)
def mass_step(m: Any, s: Any, p: Any, q: Any, v: Any, t: Any) -> Any:
    """Load that is picked up, or dropped, by a body that several coordinates move."""
    return m + p.dm * sigmoid((t - p.t0) / p.w)
