"""Axes: one option of a group's parts takes several values, so that a table becomes a curve (error against noise)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import msgspec

from harness.benchmark.parts import Group, Part

__all__ = ["KINDS", "expanded", "problem"]

KINDS = ("plants", "scenarios", "identifiers")


def problem(axes: Mapping[str, Sequence[float]]) -> str:
    """Return the first fault of the axes of a group in words; empty where there is none.

    Examples
    --------
    >>> problem({"scenarios.noise": [0.0, 0.1]})
    ''
    >>> problem({"noise": [0.0, 0.1]})
    "axis 'noise' names no kind: write plants.OPTION, scenarios.OPTION or identifiers.OPTION"
    """
    for name, values in axes.items():
        kind, dot, option = name.partition(".")
        if kind not in KINDS or not dot or not option:
            return f"axis {name!r} names no kind: write plants.OPTION, scenarios.OPTION or identifiers.OPTION"
        if not values or len(set(values)) != len(values):
            return f"axis {name!r} needs different values, at least one"
    return ""


def expanded(group: Group) -> Group:
    """Return the group with every part once for each combination of values along its axes.

    The label tells the values. The random streams of a part stay those of its name without them, so that the points of
    an axis are paired: the same excitation and the same noise, scaled.
    """
    if not group.axes:
        return group
    parts = {kind: tuple(getattr(group, kind)) for kind in KINDS}
    for name, values in group.axes.items():
        kind, _, option = name.partition(".")
        parts[kind] = tuple(_at(part, name, option, value) for part in parts[kind] for value in values)
    return msgspec.structs.replace(group, **parts, axes={})


def _at(part: Part, name: str, option: str, value: float) -> Part:
    """Return a part at one point of an axis."""
    text = f"{value:g}" if isinstance(value, float) else str(value)
    base, bracket, inside = part.name.partition(" [")
    inside = f"{inside.removesuffix(']')}, " if bracket else ""
    return msgspec.structs.replace(
        part,
        options={**part.options, option: value},
        label=f"{base} [{inside}{option} {text}]",
        streams=part.streams or part.name,
        at={**part.at, name: float(value)},
    )
