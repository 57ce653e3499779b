"""Process plants: tanks that overflow, levels that cannot rise, leaks, walls that radiate."""

from __future__ import annotations

from typing import Any

from harness.effects.effect import EffectParameter, effect, par
from harness.effects.functions import larger, sigmoid


def _height(name: str, meaning: str) -> EffectParameter:
    """Return a height that a level can reach."""
    return par(name, "x", scale="1.5 x", sign="+", minimum=0.0, main=True, grid=(1.0, 0.8, 1.2, 1.4), meaning=meaning)


def _edge() -> EffectParameter:
    """Return the height over which the rim begins to spill."""
    return par(
        "w", "x", scale="0.02 x", sign="+", minimum=1e-6, nuisance=True, fixed=True, meaning="softness of the rim"
    )


def _spilled(rate: Any, level: Any, height: Any, width: Any) -> Any:
    """Return what cannot stay: a rising level stands still at the rim, a falling one is free."""
    return larger(rate, 0.0) * sigmoid((level - height) / width)


@effect(
    "process",
    [
        _height("h", "height of the rim"),
        par("share", "1", scale="0.5", sign="+", neutral=None, linear=True, grid=(1.0, 0.4, 2.0),
            meaning="part of the spilled flow that the next tank receives"),
        _edge(),
    ],
    formula="x' = r - r+ s, next tank + share r+ s, s = sigmoid((x - h)/w), r+ = max(r, 0), r the nominal net rate",
    family=("level_saturation", "leak", "saturation"),
    nests=("level_saturation",),
    limits={"level_saturation": "if nothing of the spilled flow reaches the next tank (share 0)"},
    downstream=True,
    experiment="fill until it spills, then cut the inflow: the next tank jumps while it spills",
)  # fmt: skip
def overflow(rate: Any, s: Any, p: Any, q: Any, v: Any) -> tuple[Any, Any]:
    """Spill of a full tank into the next one."""
    spilled = _spilled(rate, q, p.h, p.w)
    return -spilled, p.share * spilled


@effect(
    "process",
    [_height("limit", "highest possible level"), _edge()],
    formula="x' = r - r+ s, s = sigmoid((x - limit)/w), r+ = max(r, 0), r the nominal net rate",
    family=("overflow", "sensor_saturation"),
    limits={"sensor_saturation": "while the level stays at its limit"},
    experiment="fill beyond the limit and cut the inflow: the level falls at once; behind a saturated sensor it waits",
)
def level_saturation(rate: Any, s: Any, p: Any, q: Any, v: Any) -> Any:
    """Upper limit of a level; what is too much is lost."""
    return -_spilled(rate, q, p.limit, p.w)


@effect(
    "process",
    [par("c", "1/s", scale="0.05 1/T", sign="+", neutral=0.0, main=True, linear=True, meaning="leak rate")],
    formula="x' = r - c x (seepage; an orifice would only add to the nominal outlet)",
    family=("overflow", "force_bias"),
    same_as={"parameter": "where the nominal outlet is linear in the level"},
    experiment="close the inflow and watch the level from full to empty",
)
def leak(rate: Any, s: Any, p: Any, q: Any, v: Any) -> Any:
    """Loss in proportion to the level."""
    return -p.c * q


@effect(
    "process",
    [
        par("h", "1/s", scale="0.05 1/T", sign="+", neutral=0.0, main=True, linear=True,
            meaning="4 eps sigma A T0^3 over the heat capacity: what it loses at small x, in proportion to x"),
        par("T0", "K", scale="293", minimum=200.0, maximum=600.0, nuisance=True, fixed=True,
            meaning="absolute temperature where x = 0"),
    ],
    formula="x' = r - h T0 ((1 + x/T0)^4 - 1) / 4 (law of Stefan and Boltzmann)",
    family=("leak", "sensor_nonlinearity", "supply_sag", "input_compression"),
    limits={"leak": "while x is small beside T0"},
    needs=("temperature",),
    experiment="hold several powers until nothing changes: the loss grows faster than the temperature",
)  # fmt: skip
def radiation(rate: Any, s: Any, p: Any, q: Any, v: Any) -> Any:
    """Heat that a hot body radiates."""
    return -0.25 * p.h * p.T0 * ((1.0 + q / p.T0) ** 4 - 1.0)
