"""A TOML file as a msgspec structure; what it may not hold is refused by its place."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import TypeVar

import msgspec

from harness.errors import InputError

Read = TypeVar("Read", bound=msgspec.Struct)


def read_toml(path: Path, kind: type[Read]) -> Read:
    """Read a file.

    Raises InputError if the file is no TOML, a key is unknown or missing, or a value has the wrong type.

    - ``kind``: its structure; tables that forbid unknown keys refuse them
    """
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise InputError("not TOML", expected="a TOML file", got=str(error), remedy="repair it", file=path) from error
    try:
        return msgspec.convert(content, kind)
    except msgspec.ValidationError as error:
        raise _explained(error, kind).located(file=path) from error


def _explained(error: msgspec.ValidationError, kind: type[msgspec.Struct]) -> InputError:
    """Return msgspec's refusal in our words: ``what - at `$.place```."""
    text, _, where = str(error).partition(" - at ")
    where = where.strip("`").removeprefix("$").lstrip(".")
    place = where or None
    if unknown := re.search(r"unknown field `(.*)`", text):
        known, place = f"one of {', '.join(_keys(kind, where))}", f"{where}.{unknown[1]}".lstrip(".")
        return InputError(
            "unknown key", expected=known, got=repr(unknown[1]), remedy="correct or remove it", place=place
        )
    if missing := re.search(r"missing required field `(.*)`", text):
        return InputError("a key is missing", expected=repr(missing[1]), got="none", remedy="add it", place=place)
    expected, _, got = text.partition(", got ")
    expected, got = expected.removeprefix("Expected ").strip("`") or "another value", got.strip("`") or text
    return InputError("wrong value", expected=expected, got=got, remedy="correct it", place=place)


def _keys(kind: type[msgspec.Struct], place: str) -> list[str]:
    """Return the keys of the table at a place such as ``groups[0].plants[1]``."""
    found = msgspec.inspect.type_info(kind)
    for step in filter(None, re.sub(r"\[[^]]*\]", ".[", place).split(".")):
        if isinstance(found, msgspec.inspect.StructType):
            found = next(field.type for field in found.fields if field.encode_name == step)
        elif step == "[":
            found = getattr(found, "item_type", getattr(found, "value_type", found))
        if isinstance(found, msgspec.inspect.UnionType):
            found = next(one for one in found.types if not isinstance(one, msgspec.inspect.NoneType))
    return [field.encode_name for field in found.fields] if isinstance(found, msgspec.inspect.StructType) else []
