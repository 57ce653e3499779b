"""Models and their parts as JSON-ready descriptions, and back, by the fields of their dataclasses."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import MISSING, Field, fields, is_dataclass
from types import UnionType
from typing import Any, ClassVar, Literal, Self, Union, cast, get_args, get_origin, get_type_hints

import numpy as np

from harness.errors import as_described
from harness.signals import PlantSpec
from harness.specs import spec_from_dict, spec_to_dict


class Described:
    """A dataclass that is written and read field by field: arrays as lists, signals and parts as their descriptions.

    ``kind`` stands first where a class has one. What may be None or is empty by default may be missing in what is read.

    Examples
    --------
    >>> from dataclasses import dataclass
    >>> @dataclass(frozen=True)
    ... class Gain(Described):
    ...     value: float
    ...     lags: tuple[int, ...] = ()
    ...     kind = "gain"
    >>> Gain(2.0, (1, 3)).to_dict()
    {'kind': 'gain', 'value': 2.0, 'lags': [1, 3]}
    >>> Gain.from_dict({"value": 2, "lags": [1, 3]})
    Gain(value=2.0, lags=(1, 3))
    """

    kind: ClassVar[str] = ""

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready description."""
        return ({"kind": self.kind} if self.kind else {}) | _parts(self)

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> Self:
        """Return what a description describes."""
        return cls.read(content)

    @classmethod
    def read(cls, content: Mapping[str, Any], **own: Any) -> Self:
        """Return what a description describes, with fields that the caller has read himself.

        Raises InputError if it is none.
        """
        with as_described(f"a model of kind {cls.kind}" if cls.kind else f"a {cls.__name__}"):
            return cast(Self, _made(cls, content, **own))


def _parts(value: Any) -> dict[str, Any]:
    return {one.name: _plain(getattr(value, one.name)) for one in fields(value)}


def _plain(value: Any) -> Any:
    """Return a value as JSON knows it."""
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, PlantSpec):
        return spec_to_dict(value)
    if hasattr(value, "to_dict"):
        return value.to_dict()
    if is_dataclass(value):
        return _parts(value)
    if isinstance(value, Mapping):
        return {name: _plain(one) for name, one in value.items()}
    return [_plain(one) for one in value] if isinstance(value, list | tuple) else value


@functools.cache
def _fields(cls: Any) -> tuple[tuple[Field[Any], Any], ...]:
    """Return the fields of a dataclass with their types."""
    hints = get_type_hints(cls)
    return tuple((one, hints[one.name]) for one in fields(cls))


def _made(cls: Any, content: Mapping[str, Any], **own: Any) -> Any:
    """Return a dataclass of a description."""
    for one, hint in _fields(cls):
        if one.name in own or (one.name not in content and one.default_factory is not MISSING):
            continue
        spared = type(None) in get_args(hint)
        own[one.name] = _read(hint, content.get(one.name) if spared else content[one.name])
    return cls(**own)


def _read(hint: Any, value: Any) -> Any:
    """Return a value of a type from what JSON knows."""
    origin, args = get_origin(hint), get_args(hint)
    if hint is Any or origin is Literal:
        return value
    if origin in (Union, UnionType):
        return None if value is None else _read(args[0], value)
    if origin is np.ndarray:
        return np.array(value, dtype=get_args(args[1])[0])
    if origin is tuple:
        kinds = [args[0]] * len(value) if args[-1] is Ellipsis else args
        return tuple(_read(kind, one) for kind, one in zip(kinds, value, strict=True))
    if origin is dict:
        return {str(name): _read(args[1], one) for name, one in value.items()}
    if hint is PlantSpec:
        return spec_from_dict(value)
    if hasattr(hint, "from_dict"):
        return hint.from_dict(value)
    return _made(hint, value) if is_dataclass(hint) else hint(value)
