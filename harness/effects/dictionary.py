"""The built-in dictionary: every effect by name, what nests in it and what it is taken for."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from harness.effects import actuator, bristles, drifting, external, friction, process, sensor, stiffness, transmission
from harness.effects.effect import Effect, Placed
from harness.errors import InputError

__all__ = ["Confusions", "builtin", "contained", "family", "find", "nested"]

_FILES = (friction, bristles, stiffness, actuator, transmission, sensor, drifting, external, process)


@functools.cache
def _all() -> tuple[Effect, ...]:
    """Return the built-in effects, file by file, in the order they are listed there."""
    return tuple(
        member
        for module in _FILES
        for member in (getattr(module, name) for name in dir(module))
        if isinstance(member, Effect)
    )


def builtin() -> dict[str, Effect]:
    """Return the built-in effects by name.

    Examples
    --------
    >>> builtin()["dead_zone"].main.unit
    'u'
    """
    return {effect.name: effect for effect in _all()}


def find(name: str | Effect, known: Mapping[str, Effect] | None = None) -> Effect:
    """Return an effect by name; an effect is returned as it is.

    Parameters
    ----------
    name : str or Effect
    known : mapping, optional
        Effects by name, the built-in ones if not given.

    Raises
    ------
    InputError
        If the name is unknown.
    """
    if isinstance(name, Effect):
        return name
    effects = builtin() if known is None else known
    if name not in effects:
        import difflib

        near = difflib.get_close_matches(name, effects, n=3)
        raise InputError(
            "unknown effect",
            expected=f"one of {', '.join(sorted(effects))}",
            got=repr(name),
            remedy=f"did you mean {' or '.join(near)}?" if near else "run 'sysid list effects'",
        )
    return effects[name]


def nested(effect: Effect, known: Mapping[str, Effect] | None = None) -> tuple[Effect, ...]:
    """Return the simpler effects that are special cases of one, simplest last.

    Examples
    --------
    >>> [effect.name for effect in nested(builtin()["stribeck_friction"])]
    ['coulomb_friction']
    """
    effects = builtin() if known is None else known
    found: dict[str, Effect] = {}
    waiting = list(effect.nests)
    while waiting:
        name = waiting.pop(0)
        if name in effects and name not in found:
            found[name] = effects[name]
            waiting.extend(effects[name].nests)
    return tuple(sorted(found.values(), key=lambda effect: -len(effect.parameters)))


def contained(effects: Iterable[Placed]) -> set[str]:
    """Return the names, ``effect@place``, of effects and of all that are special cases of them.

    Examples
    --------
    >>> from harness.effects.effect import Placed
    >>> sorted(contained([Placed(find("stribeck_friction"), "x")]))
    ['coulomb_friction@x', 'stribeck_friction@x']
    """
    return {
        f"{name}@{placed.at}" for placed in effects for name in (placed.effect.name, *map(str, nested(placed.effect)))
    }


@dataclass(frozen=True)
class Confusions:
    """What an effect is taken for.

    Attributes
    ----------
    near : tuple of str
        Its family: names to compare it with.
    exact : dict
        Names (``"parameter"`` for a nominal parameter, ``"a + b"`` for a pair) that no data of this kind can tell
        from it, with the circumstance.
    limit : dict
        Names that it approaches, with the limit in which it does.
    """

    near: tuple[str, ...]
    exact: dict[str, str]
    limit: dict[str, str]


def family(effect: Effect, known: Mapping[str, Effect] | None = None) -> Confusions:
    """Return what an effect is taken for, what others say of it included.

    Examples
    --------
    >>> family(builtin()["gravity_tilt"]).exact["sensor_offset"]
    'on one joint: an encoder offset of the same angle gives the same motion'
    """
    effects = builtin() if known is None else known
    exact, limit = dict(effect.same_as), dict(effect.limits)
    near = dict.fromkeys([*effect.family, *effect.nests, *(name for name in exact if name in effects), *limit])
    for other in effects.values():
        if effect.name in other.family or effect.name in other.nests:
            near.setdefault(other.name)
        if effect.name in other.same_as:
            exact.setdefault(other.name, other.same_as[effect.name])
            near.setdefault(other.name)
        if effect.name in other.limits:
            limit.setdefault(other.name, other.limits[effect.name])
            near.setdefault(other.name)
    near.pop("parameter", None)
    near.pop(effect.name, None)
    return Confusions(tuple(near), exact, limit)
