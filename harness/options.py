"""Values of options held against the types and bounds that are declared, in words instead of Python's."""

from __future__ import annotations

import inspect
import operator
import sys
import types
import typing
import warnings
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from harness.errors import InputError, nearest

_Factory = typing.TypeVar("_Factory", bound=Callable[..., Any])

_WORDS: dict[Any, str] = {
    float: "a number",
    int: "a whole number",
    bool: "true or false",
    str: "a text",
    type(None): "nothing",
}

_NEVER: tuple[tuple[Any, tuple[Any, ...]], ...] = (
    (bool, (float, int, str, type(None))),
    (str, (float, int, bool, type(None))),
    (int | float, (bool, str, type(None))),
    (list | tuple | dict, (float, int, bool, str, type(None))),
)
"""Plain types that a value certainly is not, by its own; true and false first, which Python calls numbers."""


def as_options(options: Any) -> dict[str, Any]:
    """Return options as a dictionary of one's own.

    Raises
    ------
    InputError
        If they are no mapping.

    Examples
    --------
    >>> as_options({"order": 2}), as_options(None)
    ({'order': 2}, {})
    """
    if options is not None and not isinstance(options, Mapping):
        remedy = 'write {"NAME": value}'
        raise InputError("options", expected="a mapping from their names", got=repr(options), remedy=remedy)
    return dict(options or {})


def meant_options(owner: str, factory: Callable[..., Any], options: Mapping[str, Any]) -> dict[str, Any]:
    """Return options as they are meant, and refuse those of a wrong type where the declaration leaves no doubt.

    A command line has no word for nothing, nor a list of one: ``None`` is nothing where that may be, and a name is a
    list of one where names are listed.

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
    >>> def plant(friction: float | None = 0.0, outputs: Sequence[str] = ()): ...
    >>> meant_options("plant 'arm'", plant, {"friction": "None", "outputs": "theta"})
    {'friction': None, 'outputs': ['theta']}
    >>> try:
    ...     meant_options("plant 'arm'", plant, {"friction": "high"})
    ... except InputError as error:
    ...     print(error)
    friction: option of plant 'arm': expected a number, got 'high'; remedy: give a number
    """
    hints = _hints(factory, options)
    result = dict(options)
    for name, hint in hints.items():
        value = result[name] = _meant(options[name], hint)
        if not _may_be(value, hint):
            wanted = _said(hint)
            raise InputError(
                f"option of {owner}", expected=wanted, got=repr(value), remedy=f"give {wanted}", place=name
            )
    return result


_COMPARED = {">=": operator.ge, ">": operator.gt, "<=": operator.le, "<": operator.lt}


def check_options(made: Any, owner: str, /, **bounds: str) -> None:
    """Refuse fields that are none of the words that their declaration lists (``Literal``), or out of bounds.

    Parameters
    ----------
    made : object
        With a field for each of its parameters, as a dataclass has.
    owner : str
        What it is, for the message.
    **bounds : str
        Of fields that are numbers, or lists of them: ``order=">= 1"``, ``forgetting="> 0, <= 1"``. None is not asked.

    Raises
    ------
    InputError
        If a field is none of its words, or out of its bounds.

    Examples
    --------
    >>> from dataclasses import dataclass
    >>> @dataclass
    ... class Method:
    ...     order: int | None = None
    ...     rule: typing.Literal["bic", "aic"] = "bic"
    >>> check_options(Method(), "method", order=">= 1")
    >>> for wrong in (Method(order=0), Method(rule="cv")):
    ...     try:
    ...         check_options(wrong, "method", order=">= 1")
    ...     except InputError as error:
    ...         print(error)
    order: option of method: expected a number >= 1, got 0; remedy: correct it
    rule: option of method: expected one of bic, aic, got 'cv'; remedy: correct it
    """
    given = {name: getattr(made, name) for name in inspect.signature(type(made)).parameters}
    wanted = {
        name: _said(hint)
        for name, hint in _hints(type(made), given).items()
        if any(typing.get_origin(kind) is typing.Literal for kind in _alternatives(hint))
        and not _may_be(given[name], hint)
    }
    for name, bound in bounds.items():
        limits = [(_COMPARED[sign], float(limit)) for sign, limit in (part.split() for part in bound.split(", "))]
        values = np.ravel([] if given[name] is None else given[name])
        if not all(compared(value, limit) for value in values for compared, limit in limits):
            wanted[name] = f"a number {bound.replace(', ', ' and ')}"
    if wanted:
        name, expected = next(iter(wanted.items()))
        got = repr(given[name])
        raise InputError(f"option of {owner}", expected=expected, got=got, remedy="correct it", place=name)


def _alternatives(hint: Any) -> tuple[Any, ...]:
    """Return the types of which a value may be one."""
    origin, parts = typing.get_origin(hint), typing.get_args(hint)
    if origin is typing.Annotated:
        return _alternatives(parts[0])
    if origin in (typing.Union, types.UnionType):
        return tuple(one for part in parts for one in _alternatives(part))
    return (hint,)


def _meant(value: Any, hint: Any) -> Any:
    """Return a text as nothing, or as a list of one, where it can be nothing else."""
    kinds = _alternatives(hint)
    if isinstance(value, dict):
        within = [parts[1] for kind in kinds if len(parts := typing.get_args(kind)) == 2 and _mapped(kind)]
        return {key: _meant(one, within[0]) for key, one in value.items()} if within else value
    if not isinstance(value, str):
        return value
    if type(None) in kinds and (value == "None" or (value.lower() in ("none", "null") and str not in kinds)):
        literal = [
            text for kind in kinds if typing.get_origin(kind) is typing.Literal for text in typing.get_args(kind)
        ]
        return value if value in literal else None
    names = any(_listed(kind) and _may_be(value, typing.get_args(kind)[0]) for kind in kinds)
    return [value] if names and not any(not _listed(kind) and _may_be(value, kind) for kind in kinds) else value


def _listed(kind: Any) -> bool:
    """Return True for a list of any length of one type."""
    origin, parts = typing.get_origin(kind), typing.get_args(kind)
    return (origin in (list, Sequence, Collection, Iterable) and len(parts) == 1) or (
        origin is tuple and len(parts) == 2 and parts[1] is ...
    )


def _mapped(kind: Any) -> bool:
    """Return True for a table of values by name."""
    origin = typing.get_origin(kind)
    return isinstance(origin, type) and issubclass(origin, Mapping)


def options_of(made: Callable[..., Any], *without: str) -> Callable[[_Factory], _Factory]:
    """Give a factory that takes ``**options`` the signature of what it hands them on to.

    Parameters
    ----------
    made : callable
        What takes the options, and says in its docstring what they mean.
    *without : str
        Parameters of it that the factory itself fills in.

    Examples
    --------
    >>> def plant(kind: str, mass: float = 1.0, sample_time: float = 0.01): ...
    >>> @options_of(plant, "kind")
    ... def heavy(*, mass=5.0, **options): ...
    >>> {one.name: one.default for one in inspect.signature(heavy).parameters.values()}
    {'mass': 5.0, 'sample_time': 0.01}
    """

    def told(factory: _Factory) -> _Factory:
        signature, whole = inspect.signature(factory), inspect.signature(made)
        own = [one for one in signature.parameters.values() if one.kind is not one.VAR_KEYWORD]
        kept = {*without, *(one.name for one in own)}
        more = [one.replace(kind=one.KEYWORD_ONLY) for one in whole.parameters.values() if one.name not in kept]
        back = made if inspect.isclass(made) else whole.return_annotation
        back = vars(sys.modules[made.__module__]).get(back, back) if isinstance(back, str) else back
        vars(factory).update(
            __signature__=whole.replace(parameters=[*own, *more], return_annotation=back), __options_of__=made
        )
        return factory

    return told


def instead(unknown: Sequence[str], known: Iterable[str]) -> str:
    """Return the remedy for unknown options: the known names nearest to them.

    Examples
    --------
    >>> instead(["frction"], ["friction", "mass"]), instead(["colour"], ["mass"])
    ('did you mean friction for frction?', 'remove colour')
    """
    names = list(known)
    meant = [f"did you mean {found} for {name}?" for name in unknown for found in nearest(name, names, 1)]
    table = "parameters" in names and f" (parameters of the model: sysid: -O parameters.{unknown[0]}=...)"
    return " ".join(meant) if meant else f"remove {', '.join(unknown)}{table or ''}"


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
    if hint in next((never for kinds, never in _NEVER if isinstance(value, kinds)), ()):
        return False
    container = isinstance(origin, type) and issubclass(origin, Collection)
    if isinstance(value, bool):
        return True
    if isinstance(value, str):  # a text is a sequence of letters, which nobody means
        return not container
    if isinstance(value, int | float):
        whole = hint is int and isinstance(value, float) and not value.is_integer()
        return not whole and not isinstance(origin, type)
    if isinstance(value, dict):
        within = parts[1] if _mapped(hint) and len(parts) == 2 else Any
        return not _listed(hint) and origin is not tuple and all(_may_be(one, within) for one in value.values())
    if isinstance(value, list | tuple):
        return _list_may_be(value, hint)
    return True


def _list_may_be(values: Sequence[Any], hint: Any) -> bool:
    """Return False if a list certainly is not what a type says."""
    origin, parts = typing.get_origin(hint), typing.get_args(hint)
    if _mapped(hint):
        return False
    if _listed(hint):
        return all(_may_be(one, parts[0]) for one in values)
    if origin is tuple and parts:
        return len(values) == len(parts) and all(map(_may_be, values, parts))
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
    if _mapped(hint):
        within = _said(parts[1]) if len(parts) == 2 and parts[1] in _WORDS else ""
        return "values by name (NAME.KEY=value)" + (f", each {within}" if within else "")
    if _listed(hint) and parts[0] is str:
        return 'a list of names (["a", "b"])'
    if _listed(hint) and typing.get_origin(parts[0]) in (list, tuple, Sequence):
        return "a list of lists ([[...], [...]])"
    if isinstance(origin, type):
        return "a list ([1, 2])"
    return str(getattr(hint, "__name__", hint))


class BoundsWarning(UserWarning):
    """A parameter was given a value outside the bounds that its model or its FMU declares; the run goes on."""


def outside(name: str, value: object, low: float, high: float, unit: str = "1") -> str | None:
    """Return what is to be said of a value outside its bounds; None inside them, or where it is no number.

    Parameters
    ----------
    name : str
        Of the parameter.
    value : number, or a sequence of them
        What it was given, in the unit of the bounds. Of a sequence the value that is farthest outside is named.
    low, high : float
        Bounds, infinite where there is none.
    unit : str
        Of all three.

    Examples
    --------
    >>> outside("J", -1.0, 0.0, 10.0, "kg m^2")
    'J = -1 kg m^2 is outside its bounds, 0 to 10 kg m^2'
    >>> outside("gain", [1.0, 7.0], -np.inf, 5.0), outside("J", 2.0, 0.0, 10.0)
    ('gain = 7 is outside its bounds, at most 5', None)
    """
    try:
        values = np.ravel(np.asarray(value, dtype=float))
    except (TypeError, ValueError):  # a text, or the name of an item
        return None
    beyond = np.maximum(low - values, values - high)
    if not beyond.size or not beyond.max() > 0.0:
        return None
    shown = "" if unit.strip() in ("", "1", "-") else f" {unit}"
    if np.isinf(low):
        bounds = f"at most {high:g}"
    elif np.isinf(high):
        bounds = f"at least {low:g}"
    else:
        bounds = f"{low:g} to {high:g}"
    return f"{name} = {values[int(beyond.argmax())]:g}{shown} is outside its bounds, {bounds}{shown}"


def say_beyond(texts: Iterable[str], note: Callable[[str], None] | None) -> None:
    """Say what :func:`outside` returned: to ``note``, or where there is none as :class:`BoundsWarning`."""
    for text in texts:
        if note is not None:
            note(text)
        else:
            warnings.warn(text, BoundsWarning, stacklevel=4)
