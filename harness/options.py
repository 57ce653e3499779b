"""Values of options held against the types that a function declares, in words instead of Python's."""

from __future__ import annotations

import difflib
import inspect
import sys
import types
import typing
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from harness.errors import InputError

__all__ = ["check_options", "instead"]

_WORDS: dict[Any, str] = {
    float: "a number",
    int: "a whole number",
    bool: "true or false",
    str: "a text",
    type(None): "nothing",
}


def check_options(owner: str, factory: Callable[..., Any], options: Mapping[str, Any]) -> None:
    """Refuse options of a wrong type where the declaration leaves no doubt.

    Parameters
    ----------
    owner : str
        What has the options, for the message.
    factory : callable
        Its parameters are annotated.
    options : mapping
        Values by name; only plain values (numbers, texts, lists, tables) are looked at.

    Raises
    ------
    InputError
        With the option's name and what is expected.

    Examples
    --------
    >>> def plant(friction: float = 0.0): ...
    >>> try:
    ...     check_options("plant 'arm'", plant, {"friction": "high"})
    ... except InputError as error:
    ...     print(error)
    friction: option of plant 'arm': expected a number, got 'high'; remedy: give a number
    """
    hints = _hints(factory, options)
    for name, value in options.items():
        if name in hints and not _may_be(value, hints[name]):
            wanted = _said(hints[name])
            raise InputError(
                f"option of {owner}", expected=wanted, got=repr(value), remedy=f"give {wanted}", place=name
            )


def instead(unknown: Sequence[str], known: Iterable[str]) -> str:
    """Return what may be meant by options that there are not.

    Examples
    --------
    >>> instead(["frction"], ["friction", "mass"]), instead(["colour"], ["mass"])
    ('did you mean friction for frction?', 'remove colour')
    """
    near = {name: difflib.get_close_matches(name, list(known), n=1) for name in unknown}
    meant = [f"did you mean {found[0]} for {name}?" for name, found in near.items() if found]
    return " ".join(meant) if meant else f"remove {', '.join(unknown)}"


def _hints(factory: Callable[..., Any], options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the declared types of options, as far as they can be worked out."""
    homes = [sys.modules.get(one.__module__) for one in (factory.__mro__ if inspect.isclass(factory) else (factory,))]
    found: dict[str, Any] = {}
    for name, parameter in inspect.signature(factory).parameters.items():
        hint = parameter.annotation
        if name not in options or hint is parameter.empty:
            continue
        if not isinstance(hint, str):
            found[name] = hint
            continue
        for home in homes:
            try:
                found[name] = eval(hint, dict(vars(home)) if home is not None else {})
                break
            except Exception:
                continue  # a name that exists for type checkers only, or in another module of the family
    return found


def _may_be(value: Any, hint: Any) -> bool:
    """Return False if a plain value certainly is not what a type says."""
    origin, parts = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return any(_may_be(value, part) for part in parts)
    if origin is typing.Literal:
        return value in parts or not isinstance(value, str | int | float | bool)
    if origin is typing.Annotated:
        return _may_be(value, parts[0])
    if isinstance(value, bool):
        return hint not in (float, int, str, type(None))
    if isinstance(value, str):
        listed = isinstance(origin, type) and issubclass(origin, list | tuple | dict | Mapping | Sequence)
        if origin is Sequence and parts:  # a text is a sequence of texts, and of nothing else
            listed = not _may_be(value, parts[0])
        return hint not in (float, int, bool, type(None)) and not listed
    if isinstance(value, int | float):
        whole = hint is int and isinstance(value, float) and not value.is_integer()
        return not whole and hint not in (bool, str, type(None)) and not (isinstance(origin, type))
    if isinstance(value, list | tuple):
        if hint in (float, int, bool, str, type(None)):
            return False
        if origin in (list, Sequence) and parts:
            return all(_may_be(one, parts[0]) for one in value)
        return True
    if isinstance(value, dict):
        return hint not in (float, int, bool, str, type(None))
    return True


def _said(hint: Any) -> str:
    """Return a type in words."""
    origin, parts = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return " or ".join(dict.fromkeys(_said(part) for part in parts if part is not type(None)))
    if origin is typing.Literal:
        return "one of " + ", ".join(map(str, parts))
    if hint in _WORDS:
        return _WORDS[hint]
    if isinstance(origin, type) and issubclass(origin, Mapping):
        return "values by name (NAME.KEY=value)"
    if isinstance(origin, type):
        return "a list ([1, 2])"
    return str(getattr(hint, "__name__", hint))
