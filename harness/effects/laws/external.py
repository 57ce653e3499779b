"""Forces and flows from outside that do not depend on the motion."""

from __future__ import annotations

from typing import Any

from harness.effects.effect import effect, par
from harness.effects.functions import sigmoid, sin
from harness.effects.laws.stiffness import CHANGE

LINE = (
    par(
        "omega",
        "rad/s",
        scale="20 1/T",
        sign="+",
        minimum=1e-9,
        floor="12.5664 1/T",  # two periods: what does not come again within a record is a drift
        grid=(1.0, 0.3, 3.0, 10.0),
        role="frequency",
        meaning="frequency",
    ),
    par(
        "phi",
        "rad",
        scale="0.5",
        nuisance=True,
        per_record=True,
        role="phase",
        grid=(1.0, 4.0, 7.0, 10.0),
        meaning="phase at time 0 of a record",
    ),
)
"""Frequency and phase of what repeats in time, at any port."""


@effect(
    ("coordinate", "input", "process"),
    [
        par("A", "F", scale="0.05 F", neutral=0.0, main=True, linear=True, meaning="amplitude"),
        *LINE,
    ],
    formula="F = A sin(omega t + phi) (at an input: u' = u + F; at a process state: x' = r + F)",
    family=("cogging", "sensor_offset"),
    limits={"cogging": "at constant speed"},
    experiment="no excitation at all: the line stays; its phase is refitted on each record",
    told_by=("rest",),
)
def periodic_disturbance(f: Any, s: Any, p: Any, q: Any, v: Any, t: Any) -> Any:
    """Sinusoidal force or flow from outside (unbalance of a neighbour, mains, sun)."""
    return p.A * sin(p.omega * t + p.phi)


@effect(
    ("coordinate", "process"),
    [par("F", "F", scale="0.1 F", neutral=0.0, main=True, linear=True, meaning="force or flow that comes"), *CHANGE],
    formula="F = F step((t - t0)/w) (at a process state: x' = r + F)",
    family=("force_bias", "payload_step", "sensor_drift"),
    same_as={"parameter": "if t0 lies outside the record: a constant force of the nominal"},
    limits={"force_bias": "where it is there from the beginning of every record"},
    experiment="no excitation at all: the rest position jumps at the instant, and never again",
    told_by=("rest",),
)
def force_step(f: Any, s: Any, p: Any, q: Any, v: Any, t: Any) -> Any:
    """Constant force or flow that sets in during a record: a cable that catches, a weight, an open valve."""
    return p.F * sigmoid((t - p.t0) / p.w)
