"""The effects that a diagnosis tries: built in, of plug-ins, or given; broken plug-ins are named, the others count."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, cast

from harness import registry
from harness.diagnosis.systems import AnySystem
from harness.effects import Dictionary, compose, place_all
from harness.effects.effect import Effect, Placed
from harness.errors import HarnessError, InputError
from harness.physics.models.catalogue import from_file

if TYPE_CHECKING:
    from harness.physics.compiled.system import System


@dataclass(frozen=True)
class Laws:
    """The laws of a run."""

    dictionary: Dictionary
    outside: Mapping[str, registry.Entry] = field(default_factory=dict)
    """The entry points of those that plug-ins brought, by name."""
    faults: tuple[str, ...] = ()
    """One sentence for each plug-in that could not be used: which entry point it is and what failed."""


def with_effects_of(given: Sequence[str | Effect]) -> list[Effect] | None:
    """Return the built-in effects with those of a user; None without any.

    Raises InputError if a file has no effect of that name, or its name is taken.

    - ``given``: each an effect, or ``FILE.py:NAME``
    """
    if not given:
        return None
    own: list[Effect] = []
    for text in given:
        if isinstance(text, Effect):
            own.append(text)
            continue
        path, _, name = text.rpartition(":") if ".py:" in text else (text, "", "")
        made, where = from_file(Path(path), name)
        if not isinstance(made, Effect):
            raise InputError(
                f"{text} is no effect",
                expected="a law made with @effect",
                got=f"a {type(made).__name__}",
                remedy="decorate it, see sysid new effect",
                file=where,
            )
        own.append(made)
    plug_ins = [law for law in laws_of().dictionary if law.name not in {effect.name for effect in own}]
    return [*plug_ins, *own]


def laws_of(dictionary: Sequence[Effect] | None = None) -> Laws:
    """Return the laws of a run: the built-in ones with those of plug-ins, equal among each other, or those given.

    - ``dictionary``: effects to use in place of the built-in ones and those of plug-ins
    """
    if dictionary is not None:
        return Laws(Dictionary(dictionary))
    known = {effect.name: effect for effect in Dictionary.builtin()}
    outside: dict[str, registry.Entry] = {}
    faults: list[str] = []
    try:
        entries = [entry for entry in registry.entries("effects") if entry.id not in known]
    except HarnessError as error:
        return Laws(Dictionary.builtin(), faults=(f"effects of plug-ins could not be looked up: {error}",))
    for entry in entries:
        try:
            made = _loaded(entry)
            if made.name in known:
                owner = outside[made.name].distribution if made.name in outside else "the harness"
                raise TypeError(f"{owner} already has an effect named {made.name!r}")
        except Exception as error:  # a stranger's code may raise anything, and must not stop the diagnosis
            faults.append(_broken(entry, error))
            continue
        known[made.name], outside[made.name] = made, entry
    return Laws(Dictionary(known.values()), outside, tuple(faults))


def placed(
    system: AnySystem,
    laws: Laws,
    *,
    composed: Callable[[Sequence[Placed]], object] | None = None,
) -> tuple[list[Placed], list[str]]:
    """Return every effect at every port of a system that it fits, and what is wrong with plug-ins.

    - ``laws``: a fault of a built-in effect, or of one that was given, is raised
    - ``composed``: builds the system with one effect: a block is called there for the first time, and may fail

    Returns
    -------
    list of Placed
    list of str
        One sentence for each plug-in that could not be used: which entry point it is and what failed.

    Examples
    --------
    >>> from harness.physics.models import pendulum
    >>> effects, faults = placed(pendulum().system(), laws_of())
    >>> [str(effect) for effect in effects if effect.at == "base"], faults
    (['gravity_tilt@base'], [])
    """
    at = cast("System", system)  # effects are placed at ports, and an FMU has ports as well
    build = composed or functools.partial(compose, at)
    candidates: list[Placed] = []
    faults = [*laws.faults]
    for law in laws.dictionary:
        entry = laws.outside.get(law.name)
        if entry is None:
            candidates += place_all(at, [law])
            continue
        try:
            places = place_all(at, [law])
            for candidate in places:
                build([candidate])
        except Exception as error:  # see above
            faults.append(_broken(entry, error))
            continue
        candidates += places
    return candidates, faults


def _broken(entry: registry.Entry, error: Exception) -> str:
    """Return which plug-in cannot be used, and why."""
    where = f"effect plug-in {entry.id!r} of {entry.distribution} ({entry.target})"
    return f"{where} is broken and was not tried: {_words(error)}"


def _loaded(entry: registry.Entry) -> Effect:
    """Return the effect behind an entry point."""
    made = registry.load("effects", entry.id)
    if not isinstance(made, Effect):
        raise TypeError(f"it is a {type(made).__name__}, not an effect made with @effect")
    return made


def _words(error: Exception) -> str:
    """Return what failed, in one line without the remedy's repetition of the entry point."""
    cause = error.__cause__ if isinstance(error, HarnessError) and error.__cause__ is not None else error
    text = " ".join(str(cause).split()) or "no message"
    return text if isinstance(cause, HarnessError) else f"{type(cause).__name__}: {text}"
