"""Sensors: what happens between an output and its record."""

from __future__ import annotations

from typing import Any

from harness.effects.effect import effect, par
from harness.effects.functions import absolute, clip, sin
from harness.effects.laws.external import LINE


@effect(
    "output",
    [par("offset", "y", scale="0.05 y", neutral=0.0, main=True, linear=True, role="zero", meaning="reading at zero")],
    formula="y' = y + offset",
    family=("gravity_tilt", "force_bias", "eccentric_load"),
    same_as={"gravity_tilt": "an angle on one joint", "eccentric_load": "an angle on one joint, gravity free"},
    limits={"force_bias": "at small angles"},
    experiment="turn the base (tells from tilt); swing beyond 60 deg (tells from a bias)",
    told_by=("turned base", "large swing"),
)
def sensor_offset(y: Any, s: Any, p: Any, q: Any, v: Any) -> Any:
    """Error of a sensor at zero."""
    return y + p.offset


@effect(
    "output",
    # further off is another unit, which the check of columns tells
    [par("gain", "1", scale="1.05", sign="+", minimum=0.1, maximum=10.0, neutral=1.0, main=True, linear=True,
         meaning="reading per true value")],
    formula="y' = gain y",
    family=("input_gain", "sensor_saturation", "linear_spring"),
    same_as={"input_gain": "where the nominal is linear"},
    experiment="angles beyond 90 deg: gravity knows the true angle; or a reference sensor",
    told_by=("full swing",),
)  # fmt: skip
def sensor_gain(y: Any, s: Any, p: Any, q: Any, v: Any) -> Any:
    """Wrong scale of a sensor."""
    return p.gain * y


@effect(
    "output",
    [
        par("A", "y", scale="0.01 y", neutral=0.0, main=True, linear=True, meaning="amplitude"),
        # k times the travel (2 sqrt(2) rms) reaches pi/4: over less than an eighth of a period a sine is a parabola
        par("k", "rad/y", scale="2", floor="0.28 y^-1", minimum=0.7, maximum=1000.0,
            grid=(1.0, 0.5, 1.5, 2.0, 3.0, 4.0), role="wave number", meaning="periods per turn"),
        par("phi", "rad", scale="0.5", nuisance=True, grid=(1.0, 4.0, 7.0, 10.0), role="phase", meaning="phase"),
    ],
    formula="y' = y + A sin(k y + phi), k >= 0.7",
    family=("sensor_gain", "sensor_offset", "cogging", "eccentric_load"),
    limits={
        "sensor_gain": "if the motion covers less than half a period about a zero",
        "sensor_offset": "if the motion covers less than half a period about a crest",
    },
    angles=True,
    experiment="fast turns: an error of the angle accelerates with them, a torque does not; or a second encoder",
)  # fmt: skip
def sensor_cyclic_error(y: Any, s: Any, p: Any, q: Any, v: Any) -> Any:
    """Error of an angle that repeats with it: eccentric scale (once a turn), resolver (twice), lines (k times)."""
    return y + p.A * sin(p.k * y + p.phi)


@effect(
    "output",
    [par("A", "y", scale="0.01 y", neutral=0.0, main=True, linear=True, meaning="amplitude"), *LINE],
    formula="y' = y + A sin(omega t + phi)",
    family=("periodic_disturbance", "sensor_drift", "sensor_cyclic_error"),
    same_as={"periodic_disturbance": "where the nominal is linear and one thing is measured"},
    limits={"sensor_cyclic_error": "at constant speed"},
    experiment="hold the plant still by a brake: the line stays in the reading",
    told_by=("rest",),
)
def sensor_hum(y: Any, s: Any, p: Any, q: Any, v: Any, t: Any) -> Any:
    """Line in a reading that the plant has no part in: mains or a vibration, also as sampling folds it down."""
    return y + p.A * sin(p.omega * t + p.phi)


@effect(
    "output",
    [par("b", "1/y", scale="0.01 y^-1", neutral=0.0, main=True, linear=True, meaning="curvature of the scale")],
    formula="y' = y + b y^2",
    family=("sensor_gain", "sensor_offset", "sensor_cyclic_error", "quadratic_spring"),
    limits={"sensor_cyclic_error": "if the motion covers less than half a period about a crest"},
    experiment="a calibration at rest: known positions on both sides of zero; or a second sensor",
)
def sensor_nonlinearity(y: Any, s: Any, p: Any, q: Any, v: Any) -> Any:
    """Bent scale of a sensor: an error that grows with the square of the reading."""
    return y + p.b * y * y


@effect(
    "output",
    [par("tau", "s", scale="2 dt", sign="+", minimum=0.0, neutral=0.0, main=True, grid=(1.0, 0.5, 3.0, 8.0),
         meaning="delay")],
    formula="y'(t) = y(t - tau), interpolated; before a record the reading is held (plants) or continued (fits)",
    family=("input_delay", "actuator_lag"),
    same_as={"input_delay": "in open loop, but for the response to the initial state"},
    sampled="output_delay",
    experiment="closed loop or a free swing with a second, fast sensor",
    told_by=("chirp",),
    whole="late reading",
)  # fmt: skip
def sensor_delay(y: Any, s: Any, p: Any, q: Any, v: Any) -> Any:
    """Delay of a reading."""
    return y


@effect(
    "output",
    [par("tau", "s", scale="2 dt", floor="0.083 dt", sign="+", minimum=1e-9, main=True, grid=(1.0, 0.5, 3.0, 8.0),
         meaning="time constant")],
    states={"z": "y"},
    initial={"z": "signal"},
    formula="y' = z, z' = (y - z)/tau",
    family=("sensor_delay", "actuator_lag", "input_delay"),
    same_as={"actuator_lag": "where the nominal is linear, but for the response to the initial state"},
    limits={"sensor_delay": "at frequencies far below 1/tau"},
    experiment="a free swing with a second, fast sensor",
    told_by=("chirp",),
    whole="late reading",
)  # fmt: skip
def sensor_lag(y: Any, s: Any, p: Any, q: Any, v: Any) -> tuple[Any, list[Any]]:
    """Filter of first order behind a sensor."""
    return s.z, [(y - s.z) / p.tau]


@effect(
    "output",
    [
        par("tau", "s", scale="2 dt", floor="0.083 dt", sign="+", minimum=1e-9, main=True, grid=(1.0, 0.5, 3.0, 8.0),
            meaning="delay of slow motion"),
        # 1/4: two equal lags, 1/2: as flat as possible (Butterworth); a mean over m rows is near 1/3
        par("c", "1", scale="0.25", sign="+", minimum=0.02, maximum=2.0, grid=(1.0, 2.0), nuisance=True,
            meaning="1/(4 d^2), of the damping ratio d"),
    ],
    states={"z": "y", "r": "y"},
    initial={"z": "signal"},
    formula="y' = z, tau z' = r, c tau r' = y - z - r",
    family=("sensor_lag", "sensor_delay", "actuator_lag", "input_delay"),
    nests=("sensor_lag", "sensor_delay"),
    limits={"sensor_lag": "for c = 0", "sensor_delay": "at frequencies far below 1/tau"},
    grows="a second pole",
    experiment="a free swing with a second, fast sensor",
    told_by=("chirp",),
    whole="late reading",
)  # fmt: skip
def sensor_filter(y: Any, s: Any, p: Any, q: Any, v: Any) -> tuple[Any, list[Any]]:
    """Filter of second order behind a sensor, or a mean over the last readings."""
    return s.z, [s.r / p.tau, (y - s.z - s.r) / (p.c * p.tau)]


@effect(
    "output",
    formula="y' = |y|",
    family=("sensor_saturation", "sensor_offset"),
    experiment="reverse the motion: the reading does not change its sign",
    cuts=True,
)
def sensor_rectification(y: Any, s: Any, p: Any, q: Any, v: Any) -> Any:
    """Loss of the sign in a sensor (pulse counter, tachometer without direction)."""
    return absolute(y)


@effect(
    "output",
    [par("limit", "y", scale="1.2 y", sign="+", minimum=0.0, main=True, grid=(1.0, 0.7, 1.5),
         meaning="largest reading")],
    formula="y' = clip(y, -limit, limit) (corner rounded over limit/2000)",
    family=("end_stop", "level_saturation", "sensor_gain"),
    limits={"level_saturation": "while the level stays at the limit"},
    experiment="a histogram of the readings: they pile up at one value while the input goes on",
    cuts=True,
)  # fmt: skip
def sensor_saturation(y: Any, s: Any, p: Any, q: Any, v: Any) -> Any:
    """Largest value that a sensor can read."""
    return clip(y, p.limit, 5e-4 * p.limit + 1e-12)


@effect(
    "output",
    [
        par(
            "step",
            "y",
            scale="0.01 y",
            sign="+",
            minimum=0.0,
            neutral=0.0,
            main=True,
            role="step",
            meaning="size of one step",
        )
    ],
    formula="y' = step round(y/step); no derivative: found by the grid on which the readings lie, not by a fit",
    family=("sensor_saturation",),
    sampled="quantise",
    experiment="a slow ramp: the readings climb stairs of one height",
)
def sensor_quantisation(y: Any, s: Any, p: Any, q: Any, v: Any) -> Any:
    """Quantisation of a reading in steps of one size."""
    return y
