"""The effects that a diagnosis tries: built in, of plug-ins, or given; broken plug-ins are named, the others count."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, cast

from harness import registry
from harness.diagnosis.systems import AnySystem
from harness.effects import builtin, compose, place_all
from harness.effects.effect import Effect, Placed
from harness.errors import HarnessError

if TYPE_CHECKING:
    from harness.physics.system import System

__all__ = ["placed"]


def placed(
    system: AnySystem,
    dictionary: Sequence[Effect] | None = None,
    *,
    composed: Callable[[Sequence[Placed]], object] | None = None,
) -> tuple[list[Placed], list[str]]:
    """Return every effect at every port of a system that it fits, and what is wrong with plug-ins.

    Parameters
    ----------
    system : AnySystem
    dictionary : sequence of Effect, optional
        Effects to use in place of the built-in ones and those of plug-ins; a fault of one of these is raised.

    composed : callable
        Builds the system with one effect: a block is called there for the first time, and may fail.

    Returns
    -------
    list of Placed
    list of str
        One sentence for each plug-in that could not be used: which entry point it is and what failed.

    Examples
    --------
    >>> from harness.physics.models import pendulum
    >>> effects, faults = placed(pendulum().system())
    >>> [str(effect) for effect in effects if effect.at == "base"], faults
    (['gravity_tilt@base'], [])
    """
    at = cast("System", system)  # effects are placed at ports, and an FMU has ports as well
    build = composed or functools.partial(compose, at)
    if dictionary is not None:
        return place_all(at, dictionary), []
    known = builtin()
    candidates = place_all(at, known.values())
    faults: list[str] = []
    names = {name: "the harness" for name in known}
    for entry in _outside(known, faults):
        where = f"effect plug-in {entry.id!r} of {entry.distribution} ({entry.target})"
        try:
            made = _loaded(entry)
            if made.name in names:
                raise TypeError(f"{names[made.name]} already has an effect named {made.name!r}")
            places = place_all(at, [made])
            for candidate in places:
                build([candidate])
        except Exception as error:  # a stranger's code may raise anything, and must not stop the diagnosis
            faults.append(f"{where} is broken and was not tried: {_words(error)}")
            continue
        names[made.name] = entry.distribution
        candidates += places
    return candidates, faults


def _outside(known: dict[str, Effect], faults: list[str]) -> list[registry.Entry]:
    """Return the entry points of plug-ins."""
    try:
        return [entry for entry in registry.entries("effects") if entry.id not in known]
    except HarnessError as error:
        faults.append(f"effects of plug-ins could not be looked up: {error}")
        return []


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
