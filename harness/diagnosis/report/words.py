"""How figures are said: what an error did, and an estimate with its interval in digits that mean something."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from harness.diagnosis.policy import POLICY
from harness.signals import Dataset
from harness.units import behind, own_unit, told

SAID = 3
"""Rivals that a sentence names; a list below it names all."""
NOTHING = 1e-11
"""A value on a bound below this is 0: what is fitted through its logarithm cannot be."""
SIZES = ("rms", "value", "low", "high", "r", "s", "w")
"""Keys of figures that have the unit of their entry."""


def change_text(factor: float | None) -> str:
    """Return in words what an error did whose value before is this many times the value after.

    Examples
    --------
    >>> change_text(1357.2), change_text(0.5), change_text(1.0)
    ('1360 times smaller', '2 times larger', 'hardly changed')
    """
    if factor is None or 1 / POLICY.changed < factor < POLICY.changed:
        return "hardly changed"
    times = factor if factor > 1 else 1 / factor
    return f"{digits(times, 3)} times {'smaller' if factor > 1 else 'larger'}"


def digits(value: float, count: int = 4) -> str:
    """Return a number in that many digits that count, without a power of ten below ten millions.

    Examples
    --------
    >>> digits(1357.2, 3), digits(12345.6), digits(0.00102), digits(3e9)
    ('1360', '12350', '0.00102', '3e+09')
    """
    return f"{float(f'{value:.{count}g}'):.0f}" if 10.0**count <= abs(value) < 1e7 else f"{value:.{count}g}"


def brief(value: float | None) -> str:
    """Return a number in three digits."""
    return "unknown" if value is None else f"{value:.3g}"


def grown(before: Mapping[str, Any], after: Mapping[str, Any]) -> str:
    """Return in words by how much errors grew, if none of them fell; else nothing."""
    both = {name: (before[name]["rms"], after[name]["rms"]) for name in before if name in after}
    factors = {name: a / b for name, (a, b) in both.items() if a is not None and b}
    if not factors or max(factors.values()) >= POLICY.changed or min(factors.values()) > 1 / POLICY.changed:
        return ""
    return ", ".join(
        f"{name} {brief(both[name][0])} -> {brief(both[name][1])}{behind(before[name]['unit'])}, {change_text(times)}"
        for name, times in factors.items()
    )


def named(effects: Sequence[Mapping[str, Any]], ties: Sequence[Sequence[Mapping[str, Any]]] = ()) -> str:
    """Return the effects of a report and their places in words; many of them, of an arm say, law by law.

    An effect that the data do not tell from others is named with them: ``ties`` holds what is tied with each, itself
    first.

    Examples
    --------
    >>> named([{"name": "quadratic_drag", "at": "x"}, {"name": "cogging", "at": "theta"}])
    'quadratic drag at x and cogging at theta'
    >>> named([{"name": name, "at": at} for at in ("q1", "q2") for name in ("coulomb_friction", "viscous_friction")])
    'coulomb friction at q1, q2; viscous friction at q1, q2'
    >>> drag, lag = {"name": "quadratic_drag", "at": "x"}, {"name": "actuator_lag", "at": "u"}
    >>> named([drag, lag], [[drag], [lag, {"name": "input_delay", "at": "u"}]])
    'quadratic drag at x and actuator lag or input delay at u (these data cannot tell which)'
    """
    places: dict[str, list[str]] = {}
    for effect in effects:
        places.setdefault(_plain(effect), []).append(effect["at"])
    if len(effects) > POLICY.most:  # of an arm: every joint may have some
        more = " (some tied with others, see below)" if any(len(tie) > 1 for tie in ties) else ""
        return "; ".join(f"{name} at {', '.join(at)}" for name, at in places.items()) + more
    sets = [tie if len(tie) > 1 else [effect] for effect, tie in zip(effects, ties or [()] * len(effects), strict=True)]
    return " and ".join(map(_either, sets))


def _plain(effect: Mapping[str, Any]) -> str:
    """Return the name of an effect in words."""
    return str(effect["name"]).replace("_", " ")


def _either(tie: Sequence[Mapping[str, Any]]) -> str:
    """Return what is as likely as each other, the first few of many, with what that means."""
    told, more = tie[:SAID], len(tie) - SAID
    one_place = len({member["at"] for member in told}) == 1
    names = [_plain(member) if one_place else f"{_plain(member)} at {member['at']}" for member in told]
    names += [f"{more} other{'s' if more > 1 else ''} (see below)"] if more > 0 else []
    text = " or ".join(names) + (f" at {told[0]['at']}" if one_place and more <= 0 else "")
    return f"{text} (these data cannot tell which)" if len(tie) > 1 else text


def standing_in(data: Mapping[str, Any], model: str) -> str:
    """Return which effects of a report stand in for something unknown, why, and which may be parts of it.

    Examples
    --------
    >>> spring, drag = ({"name": name, "at": "x", "may_be_part_of": part, "rounds": False}
    ...                 for name, part in (("cubic_spring", ""), ("quadratic_drag", "a force at x over u")))
    >>> reason = "what is left can still be predicted"
    >>> data = {"effects": [spring, drag], "tie_sets": [[spring], [drag]], "stand_in": {"reasons": [reason]}}
    >>> standing_in(data, "cart")[-61:]
    'predicted; quadratic drag at x may be a part of what is left)'
    """
    pairs = [
        (effect, tie)
        for effect, tie in zip(data["effects"], data["tie_sets"], strict=True)
        if not effect["rounds"]  # it stands in for nothing
    ]
    sure, parts = ([pair for pair in pairs if bool(pair[0]["may_be_part_of"]) is part] for part in (False, True))
    reason = data["stand_in"]["reasons"][0]
    if parts:
        reason += f"; {_named_pairs(parts)} may be {'a part' if len(parts) == 1 else 'parts'} of what is left"
    return (
        f"{_named_pairs(sure)} {'stands' if len(sure) == 1 else 'stand'} in for something that {model} lacks and the "
        f"dictionary does not have ({reason})"
    )


def _named_pairs(pairs: Sequence[tuple[Mapping[str, Any], Sequence[Mapping[str, Any]]]]) -> str:
    """Return effects with what is tied with each, in words."""
    return named([effect for effect, _ in pairs], [tie for _, tie in pairs])


def shown(entry: Mapping[str, Any]) -> dict[str, str]:
    """Return value, interval, and the two together of an estimate of ``report.json``, as a reader needs them.

    Two digits of the half width count: the value and both ends have their decimals. Where there is no interval the
    words say why.

    Examples
    --------
    >>> shown({"value": 50.0012, "low": 49.9971, "high": 50.0053, "state": "determined"})["interval"]
    '49.9971 … 50.0053'
    >>> shown({"value": 1623.4, "low": 1370.0, "high": 1877.0, "state": "determined"})["value"]
    '1620'
    >>> shown({"value": 7.5e-07, "low": 7.1e-07, "high": 7.9e-07, "state": "determined"})["interval"]
    '7.10e-07 … 7.90e-07'
    >>> shown({"value": 0.018, "low": None, "high": None, "state": "not_determined"})["interval"]
    'not determined'
    """
    value, low, high = entry["value"], entry["low"], entry["high"]
    if value is None:
        return {"value": "\N{EN DASH}", "interval": "\N{EN DASH}"}
    if low is None or high is None:
        if entry.get("state") == "on_bound" and abs(value) < NOTHING:
            value = 0.0  # a logarithm never comes to 0
        known = "{:.4g}" if entry.get("state") != "not_determined" else "{:.2g}"
        return {"value": known.format(value), "interval": entry.get("state", "not_determined").replace("_", " ")}
    ends = (value, low, high)
    half = min(high - value, value - low) if low < value < high else (high - low) / 2
    if half <= 0:
        return {"value": f"{value:.4g}", "interval": f"{low:.4g} … {high:.4g}"}
    size = max(map(abs, ends))
    power = math.floor(math.log10(size)) if not 1e-4 <= size < 1e6 else 0
    decimals = power + 1 - math.floor(math.log10(half) + 1e-9)
    texts = [_fixed(number, power, decimals) for number in ends]
    return {"value": texts[0], "interval": f"{texts[1]} … {texts[2]}"}


def recorded_units(data: Dataset) -> dict[str, dict[str, str]]:
    """Return by channel its unit and that in which it was recorded, where this is another."""
    channels = (*data.spec.inputs, *data.spec.outputs)
    units = {channel.name: (channel.unit, own_unit(channel, data.recorded)) for channel in channels}
    return {name: {"unit": unit, "recorded": own} for name, (unit, own) in units.items() if own != unit}


def shown_in(unit: str, channel: str, recorded: Mapping[str, Mapping[str, str]]) -> str:
    """Return the unit in which a size at a channel is shown: as recorded if it is in the channel's unit, or its rate's.

    Examples
    --------
    >>> recorded = {"x": {"unit": "m", "recorded": "mm"}}
    >>> shown_in("m", "x", recorded), shown_in("m/s", "x", recorded), shown_in("N", "x", recorded)
    ('mm', 'mm/s', 'N')
    """
    known = recorded.get(channel, {"unit": unit, "recorded": unit})
    rate = unit.removeprefix(known["unit"])
    return known["recorded"] + rate if unit.startswith(known["unit"]) and rate in ("", "/s") else unit


def as_recorded(entry: Mapping[str, Any], channel: str, data: Mapping[str, Any]) -> dict[str, Any]:
    """Return sizes in the unit of a channel, or of its rate, in the one in which it was recorded; others as they are.

    An estimate stays as it is where the recorded unit has another zero: a limit is a reading, an offset a difference.

    Examples
    --------
    >>> data = {"recorded": {"x": {"unit": "m", "recorded": "mm"}}}
    >>> as_recorded({"rms": 0.002, "nrmse": 0.1, "unit": "m"}, "x", data)
    {'rms': 2.0, 'nrmse': 0.1, 'unit': 'mm'}
    >>> as_recorded({"r": 0.002, "unit": "m/s"}, "x", data)
    {'r': 2.0, 'unit': 'mm/s'}
    """
    unit = entry["unit"]
    own = shown_in(unit, channel, data.get("recorded", {}))  # reports of earlier versions have none
    if own == unit or ("state" in entry and told(0.0, unit, own, reading=True)[0]):
        return dict(entry)
    sizes = {key: told(float(entry[key]), unit, own)[0] for key in SIZES if entry.get(key) is not None}
    return {**entry, **sizes, "unit": own}


def _fixed(number: float, power: int, decimals: int) -> str:
    """Return a number with some decimals, in units of a power of ten."""
    scaled = round(number / 10.0**power, decimals) + 0.0  # no minus before 0
    return f"{scaled:.{max(decimals, 0)}f}" + (f"e{power:+03d}" if power else "")
