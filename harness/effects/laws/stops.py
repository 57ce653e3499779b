"""Where a travel ends: stops at both sides; a wall, a buffer, a floor or a taut cable at one."""

from __future__ import annotations

from typing import Any

from harness.effects.effect import effect, par
from harness.effects.functions import absolute, dead_band, dead_band_slope, sigmoid, sign, softplus

GIVES = (
    # what gives way as far as the plant usually moves under the usual force ends no travel
    par("k", "F/q", scale="10 F/q", floor="1 F/q", sign="+", minimum=0.0, neutral=0.0, linear=True,
        meaning="its stiffness"),
    par("d", "F/v", scale="0.1 F/v", sign="+", minimum=0.0, neutral=0.0, linear=True, nuisance=True,
        meaning="damping of the stop"),
)  # fmt: skip
"""How a stop gives way."""


@effect(
    "coordinate",
    [
        par("stop", "q", scale="1.2 q", sign="+", minimum=0.0, main=True, grid=(1.0, 0.8, 1.3),
            meaning="half of the free travel"),
        *GIVES,
        par("centre", "q", scale="0", fixed=True, meaning="middle of the free travel"),
    ],
    formula="F = -k dz(q) - d dz'(q) v, dz: how far |q - centre| lies beyond the stop (corner rounded over stop/5000)",
    family=("cubic_spring", "sensor_saturation"),
    limits={"cubic_spring": "if only the rounded edge of the stop is touched"},
    experiment="drive slowly against both ends",
    told_by=("full swing",),
    needs=("place",),
    corners=lambda p, q: (absolute(q - p.centre) - p.stop,),
)  # fmt: skip
def end_stop(f: Any, s: Any, p: Any, q: Any, v: Any) -> Any:
    """Elastic limit of the travel."""
    x, smoothing = q - p.centre, 2e-4 * p.stop + 1e-9
    return -p.k * dead_band(x, p.stop, smoothing) - p.d * dead_band_slope(x, p.stop, smoothing) * v


@effect(
    "coordinate",
    [
        par("stop", "q", scale="1.2 q", main=True, grid=(1.0, -1.0, 0.8, -0.8, 1.3, -1.3),
            meaning="where the travel ends: above if positive, below if negative"),
        *GIVES,
    ],
    formula="F = -s k max(s (q - stop), 0) - d v where s (q - stop) > 0, s = sign(stop) (corner rounded over stop/5e3)",
    family=("end_stop", "quadratic_spring", "cubic_spring"),
    limits={"end_stop": "where only one of its ends is reached"},
    experiment="drive slowly against both ends",
    told_by=("full swing",),
    needs=("place",),
    corners=lambda p, q: (q - p.stop,),
)  # fmt: skip
def one_sided_stop(f: Any, s: Any, p: Any, q: Any, v: Any) -> Any:
    """Elastic limit of the travel at one end."""
    side = sign(p.stop)
    beyond, smoothing = side * (q - p.stop), 2e-4 * side * p.stop + 1e-9
    return -side * p.k * smoothing * softplus(beyond / smoothing) - p.d * sigmoid(beyond / smoothing) * v
