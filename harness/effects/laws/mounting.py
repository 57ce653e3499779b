"""What a machine stands on: the frame, table or floor that gives way under it."""

from __future__ import annotations

from typing import Any

from harness.effects.effect import effect, par
from harness.effects.functions import cos, sin


@effect(
    "coordinate",
    [
        par("mu", "F/a", scale="0.05 F/a", sign="+", neutral=0.0, main=True, linear=True,
            meaning="(m l)^2/M of the link's first moment m l and the mass M of all that wobbles, link included"),
        par("omega", "rad/s", scale="4 v/q", floor="0.5 v/q", ceiling="2 1/dt", sign="+", minimum=1e-9,
            grid=(1.0, 0.4, 2.5), meaning="natural frequency of the base"),
        par("zeta", "1", scale="0.1", sign="+", minimum=1e-3, maximum=1.0, nuisance=True, meaning="its damping ratio"),
    ],
    states={"z": "F s^2", "y": "F s"},
    formula="F = -cos(q) z'', z = m l x of the base's shift x: z'' = -omega^2 z - 2 zeta omega z' - mu (cos(q) q')'; "
    "y = z' + mu cos(q) q' needs no acceleration",
    family=("elasticity", "linear_spring", "maxwell_element", "actuator_lag", "payload_step"),
    limits={
        "parameter": "for a base that moves little within the motion: an inertia that falls with the angle",
    },
    needs=("gravity", "alone"),
    angles=True,
    experiment="a chirp through the resonance of the base, and a second sensor on the base; clamp the base and repeat",
    told_by=("chirp",),
)  # fmt: skip
def wobbling_base(f: Any, s: Any, p: Any, q: Any, v: Any, a: Any) -> tuple[Any, list[Any]]:
    """Wobble of a base that sways on a spring under a hanging link, whose sensor goes along with it."""
    rate = s.y - p.mu * cos(q) * v
    sway = -(p.omega**2) * s.z - 2.0 * p.zeta * p.omega * rate
    return -cos(q) * (sway - p.mu * (cos(q) * a - sin(q) * v**2)), [rate, sway]
