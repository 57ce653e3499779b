"""Dictionaries of effects: every one by name, what nests in it and what it is taken for."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

from harness.effects.effect import Effect, Placed
from harness.effects.laws import (
    actuator,
    bristles,
    drifting,
    external,
    friction,
    mounting,
    process,
    sensor,
    stiffness,
    stops,
    thermal,
    transmission,
)
from harness.errors import InputError, refuse_unknown

_FILES = (
    friction,
    bristles,
    stiffness,
    stops,
    mounting,
    actuator,
    transmission,
    sensor,
    drifting,
    thermal,
    external,
    process,
)


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
    refuse_unknown("unknown effect", name, sorted(effects), remedy="run 'sysid list effects'")
    return effects[name]


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


class Dictionary:
    """The effects of a run, built in or of others alike, and what they say of each other.

    Parameters
    ----------
    effects : iterable of Effect
        Each name once.

    Raises
    ------
    InputError
        If two effects have one name.

    Examples
    --------
    >>> laws = Dictionary.builtin()
    >>> [effect.name for effect in laws.nested(laws["stribeck_friction"])]
    ['coulomb_friction']
    >>> laws.family(laws["gravity_tilt"]).exact["sensor_offset"]
    'on one joint: an encoder offset of the same angle gives the same motion'
    >>> from harness.effects.effect import Placed
    >>> sorted(laws.contained([Placed(laws["stribeck_friction"], "x")]))
    ['coulomb_friction@x', 'stribeck_friction@x']
    """

    def __init__(self, effects: Iterable[Effect]) -> None:
        self._effects: dict[str, Effect] = {}
        for effect in effects:
            if self._effects.setdefault(effect.name, effect) is not effect:
                raise InputError(
                    "names of effects",
                    expected="each name once",
                    got=f"two effects named {effect.name!r}",
                    remedy="give one of them another name (effect(name=...))",
                )

    @classmethod
    @functools.cache
    def builtin(cls) -> Dictionary:
        """Return the effects that the harness brings."""
        return cls(_all())

    def __iter__(self) -> Iterator[Effect]:
        return iter(self._effects.values())

    def __len__(self) -> int:
        return len(self._effects)

    def __contains__(self, name: str) -> bool:
        return name in self._effects

    def __getitem__(self, name: str) -> Effect:
        return find(name, self._effects)

    def nested(self, effect: Effect) -> tuple[Effect, ...]:
        """Return the simpler effects that are special cases of one, simplest last."""
        found: dict[str, Effect] = {}
        waiting = list(effect.nests)
        while waiting:
            name = waiting.pop(0)
            if name in self._effects and name not in found:
                found[name] = self._effects[name]
                waiting.extend(found[name].nests)
        return tuple(sorted(found.values(), key=lambda effect: -len(effect.parameters)))

    def contained(self, effects: Iterable[Placed]) -> set[str]:
        """Return the names, ``effect@place``, of effects and of all that are special cases of them."""
        return {
            f"{name}@{placed.at}"
            for placed in effects
            for name in (placed.effect.name, *map(str, self.nested(placed.effect)))
        }

    def refines(self, rival: Placed, placed: Placed) -> bool:
        """Return True for a law of which another one at the same place is a special case."""
        return rival.at == placed.at and placed.effect.name in {law.name for law in self.nested(rival.effect)}

    def family(self, effect: Effect) -> Confusions:
        """Return the names that an effect is easily confused with, by its own word and by theirs."""
        exact, limit = dict(effect.same_as), dict(effect.limits)
        own = (*effect.family, *effect.nests, *(name for name in exact if name in self._effects), *limit)
        near = dict.fromkeys(own)
        for other in self:
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
