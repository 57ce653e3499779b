"""What changes along a record: dampings, gains and sensors of a machine that warms up or tires."""

from __future__ import annotations

from typing import Any

from harness.effects.effect import EffectParameter, effect, par
from harness.effects.functions import larger, smaller


def _length() -> EffectParameter:
    """Return the time in which the change happens."""
    return par("T", "s", scale="1 T", sign="+", minimum=1e-9, fixed=True, nuisance=True,
               meaning="time of the change: the longest record")  # fmt: skip


def _part(t: Any, p: Any) -> Any:
    """Return 0 where a record begins, 1 from the end of the change on."""
    return smaller(larger(t / p.T, 0.0), 1.0)


def _drift(t: Any, p: Any) -> Any:
    """Return -1/2 where a record begins, 0 in the middle of the change, 1/2 from its end on."""
    return _part(t, p) - 0.5


@effect(
    "coordinate",
    [
        par("d", "F/v", scale="0.05 F/v", neutral=0.0, main=True, linear=True,
            meaning="change of the damping within the time T; negative where it warms up"),
        _length(),
    ],
    formula="F = -d (t/T - 1/2) v, t the time since the record began, constant beyond T; "
    "the mean damping is the nominal's own",
    family=("viscous_friction", "position_dependent_damping", "drifting_gain"),
    limits={"viscous_friction": "for a record far shorter than the change takes"},
    requires_along={
        # what brakes is told for the beginning of a record; at its end the damping is larger by d
        "with all that brakes the joint, the damping is nowhere negative over the record": lambda p, q, damping: bool(
            damping.min() + min(p["d"], 0.0) >= -0.05 * abs(p["d"])
        )
    },
    experiment="the same excitation for longer, from a cold start and once more when it is warm: the decay differs",
)  # fmt: skip
def drifting_damping(f: Any, s: Any, p: Any, q: Any, v: Any, t: Any) -> Any:
    """Viscous damping that changes along a record: a gear or a bearing that warms up."""
    return -p.d * _drift(t, p) * v


@effect(
    "input",
    [
        par("g", "1", scale="0.05", neutral=0.0, main=True, linear=True,
            meaning="share of the gain that it changes by within the time T; negative where it tires"),
        _length(),
    ],
    formula="u' = [1 + g (t/T - 1/2)] u, t the time since the record began, constant beyond T",
    family=("input_gain", "payload_step", "drifting_damping"),
    limits={"input_gain": "for a record far shorter than the change takes"},
    requires={"the gain keeps its sign": lambda p: abs(p["g"]) < 2.0},
    experiment="the same excitation twice in one record: the second answer is a scaled copy of the first",
)  # fmt: skip
def drifting_gain(u: Any, s: Any, p: Any, q: Any, v: Any, t: Any) -> Any:
    """Gain of a drive that changes along a record: a supply that sags, magnets and windings that warm up."""
    return (1.0 + p.g * _drift(t, p)) * u


@effect(
    "output",
    [
        par("d", "y", scale="0.05 y", neutral=0.0, main=True, linear=True,
            meaning="error that the reading has gained within the time T"),
        _length(),
    ],
    formula="y' = y + d t/T, t the time since the record began, constant beyond T",
    family=("sensor_offset", "drifting_gain", "drifting_damping"),
    limits={"sensor_offset": "for a record far shorter than the drift takes"},
    experiment="bring the plant back to where it began at the end of the record: the reading is another one",
)  # fmt: skip
def sensor_drift(y: Any, s: Any, p: Any, q: Any, v: Any, t: Any) -> Any:
    """Zero of a sensor that wanders along a record: a strain gauge that warms up, a gyro that is integrated."""
    return y + p.d * _part(t, p)
