"""check(NAME_OR_FILE): find the part, see what it is, run the list that belongs to it."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from harness import registry
from harness.conformance.grey_boxes import check_effect, check_model
from harness.conformance.identifiers import check_identifier
from harness.conformance.online import check_online_identifier
from harness.conformance.plants import check_plant
from harness.conformance.results import CheckResult
from harness.conformance.scenarios import check_scenario
from harness.conformance.workloads import KINDS, PLANT
from harness.errors import HarnessError, InputError, did_you_mean, refuse_no_file
from harness.protocols import Identifier, OnlineIdentifier, Plant, Scenario
from harness.trust import names_fmu

_TOLD = "pendulum-ode"
CHECKED = ("plants", "identifiers", "scenarios", "effects", "models")


def check(name: str) -> list[CheckResult]:
    """Hold a part to its contract.

    Parameters
    ----------
    name : str
        Id of a registered part (``dmdc``, or ``scenarios/replay`` where two kinds share the id), ``FILE.py:NAME``, or
        ``FILE.fmu``.

    Returns
    -------
    list of CheckResult
        If several kinds have a part of this id, each name starts with its kind.

    Raises
    ------
    InputError
        If there is no such part, or it needs options to be made.

    Examples
    --------
    >>> all(result.passed for result in check("models/oscillator"))
    True
    """
    if names_fmu(name):
        return _check_fmu(name)
    if ".py:" in name or name.endswith(".py"):
        factory = _from_file(name)
        return _check_as(_kind_of(factory, name), factory)
    kind, slash, id = name.partition("/")
    if slash and kind in CHECKED:
        registry.entry(kind, id)
        return _check_registered(kind, id)
    found = [candidate for candidate in CHECKED if name in _ids(candidate)]
    if not found:
        expected = "the id of a plant, identifier, scenario, effect or model, FILE.py:NAME, or FILE.fmu"
        refuse_no_file(name, expected)
        everything = sorted({id for candidate in CHECKED for id in _ids(candidate)})
        raise InputError(
            "no part has this name",
            expected=expected,
            got=repr(name),
            remedy="name what the run must agree with: --reference FILE"
            if Path(name).is_file()
            else did_you_mean(name, everything, "see sysid list"),
        )
    if len(found) == 1:
        return _check_registered(found[0], name)
    results = []
    for candidate in found:
        results += [
            replace(result, name=f"{candidate}: {result.name}") for result in _check_registered(candidate, name)
        ]
    return results


def _ids(kind: str) -> set[str]:
    """Return the ids of a kind; effects may have none registered beside the built-in ones."""
    try:
        return {entry.id for entry in registry.entries(kind)}
    except HarnessError:
        return set()


def _check_registered(kind: str, id: str) -> list[CheckResult]:
    """Run the list of a registered part."""
    if kind == "effects":
        made = registry.load(kind, id)
        return check_effect(lambda: made)
    if kind == "models":
        return check_model(lambda: registry.create(kind, id))
    options: dict[str, Any] = {}
    kinds: tuple[str, ...] = KINDS
    if kind == "identifiers":
        known = registry.named_options(kind, id)
        if "plant" in known:  # one that is told the plant learns from that plant's records only
            options["plant"] = registry.create("plants", _TOLD)
            kinds = (f"{PLANT}{_TOLD}",)
        if "model" in known and known["model"].default is known["model"].empty:
            options["model"] = "pendulum"
    try:
        _close(registry.create(kind, id, **options))
    except InputError as error:
        raise InputError(
            f"{kind[:-1]} {id!r} cannot be made without options",
            expected="a part that can be made as it is",
            got=str(error),
            remedy="write a function that returns it with options, and check FILE.py:FUNCTION",
        ) from error
    return _check_as(kind, lambda: registry.create(kind, id, **options), kinds)


def _close(part: Any) -> None:
    """Close what can be closed."""
    close = getattr(part, "close", None)
    if callable(close):
        close()


def _check_as(kind: str, factory: Callable[[], Any], kinds: tuple[str, ...] = KINDS) -> list[CheckResult]:
    """Run the list, or both lists, of one kind."""
    if kind == "plants":
        return check_plant(factory)
    if kind == "scenarios":
        return check_scenario(factory)
    if kind == "effects":
        return check_effect(factory)
    if kind == "models":
        return check_model(factory)
    made = factory()
    results: list[CheckResult] = []
    if hasattr(made, "fit") or not hasattr(made, "hindsight"):
        results += check_identifier(factory, kinds=kinds)
    if isinstance(made, OnlineIdentifier) or hasattr(made, "hindsight"):
        results += check_online_identifier(factory)
    return results


def _kind_of(factory: Callable[[], Any], name: str) -> str:
    """Return what kind of part a factory makes."""
    made = factory()
    with contextlib.ExitStack() as stack:
        stack.callback(_close, made)
        kinds: list[tuple[str, Any]] = [("plants", Plant), ("scenarios", Scenario), ("identifiers", Identifier)]
        for kind, protocol in [*kinds, ("identifiers", OnlineIdentifier)]:
            if isinstance(made, protocol):
                return kind
        from harness.effects import Effect
        from harness.physics import System

        if isinstance(made, Effect):
            return "effects"
        if isinstance(made, System) or hasattr(made, "system"):
            return "models"
    raise InputError(
        "a part of no known kind",
        expected="a plant, an identifier, a scenario, an effect or a model",
        got=f"a {type(made).__name__}, which has the methods of none",
        remedy="see harness.protocols",
        file=name,
    )


def _from_file(name: str) -> Callable[[], Any]:
    """Return a factory of the part that ``FILE.py:NAME`` names."""
    path_text, _, attribute = name.rpartition(":") if ".py:" in name else (name, "", "")
    if not attribute and Path(path_text).is_file():
        raise InputError(
            "no such part",
            expected="FILE.py:NAME",
            got=f"{name} without a name in it",
            remedy="write the name after a colon",
            file=path_text,
        )
    from harness.physics.models.catalogue import from_file

    return _factory(from_file(Path(path_text), attribute)[0], name)


def _factory(found: Any, name: str) -> Callable[[], Any]:
    """Return a factory of a class, a function or a finished part."""
    from harness.effects import Effect

    if isinstance(found, Effect) or not callable(found):
        return lambda: found

    def make() -> Any:
        try:
            return found()
        except HarnessError:
            raise
        except TypeError as error:
            raise InputError(
                f"{name} cannot be made without options",
                expected="a class or function that can be called without arguments",
                got=str(error),
                remedy="write a function that returns the part with its options",
            ) from error

    return make


def _check_fmu(path: str) -> list[CheckResult]:
    """Run the plant's list on an FMU."""
    if not Path(path).is_file():
        raise InputError("no such FMU", expected="an FMU file", got="no file", remedy="check the path", file=path)
    _close(registry.create("plants", "fmu", path=path))
    return check_plant(lambda: registry.create("plants", "fmu", path=path))
