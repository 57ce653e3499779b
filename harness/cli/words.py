"""Words of the command line read as values: pairs, seeds, ranges, effects, names that a shell completes."""

from __future__ import annotations

import sys
import tomllib
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from harness.errors import UNREADABLE, InputError

if TYPE_CHECKING:
    pass


def completed(kind: str) -> Callable[[str], list[str]]:
    """Return the function that completes the id of a part in a shell (``sysid --install-completion``)."""

    def begun(incomplete: str) -> list[str]:
        from harness import registry

        return [entry.id for entry in registry.entries(kind) if entry.id.startswith(incomplete)]

    return begun


def option_value(text: str) -> Any:
    """Read an option's value as TOML (3, 0.5, true, [1, 2]); anything else is text."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except UNREADABLE:
        return text


def text_pairs(texts: Sequence[str] | None, flag: str) -> dict[str, str]:
    """Read ``k=v`` pairs as they stand."""
    pairs = [text.partition("=") for text in texts or ()]
    for key, equals, value in pairs:
        if not (key and equals):
            raise InputError(
                "pair",
                expected="NAME=VALUE",
                got=repr(key + equals + value),
                place=flag,
                remedy=f"write the name of a signal before it: {flag} NAME={key or value}",
            )
    return {key.strip(): value.strip() for key, _, value in pairs}


def option_pairs(texts: Sequence[str] | None, flag: str) -> dict[str, Any]:
    """Read ``k=v`` pairs; ``k.NAME=v`` is an entry of the table ``k``, and NAME may hold dots itself."""
    result: dict[str, Any] = {}
    for text in texts or ():
        key, equals, value = text.partition("=")
        if not equals or not key:
            raise InputError("option", expected="k=v", got=repr(text), remedy=f"write {flag} name=value", place=flag)
        head, dot, name = key.strip().partition(".")
        head = head.replace("-", "_")
        table = result.setdefault(head, {}) if dot else None
        if dot and not (name and isinstance(table, dict)):
            raise InputError("option", expected=f"{head}.NAME=v", got=repr(text), remedy="correct it", place=flag)
        if table is None:
            result[head] = option_value(value.strip())
        else:
            table[name] = option_value(value.strip())
    return result


def hidden_effect(text: str) -> tuple[str, str, dict[str, float]]:
    """Read ``effect@port:k=v,k=v``."""
    head, _, tail = text.partition(":")
    name, at, port = head.partition("@")
    if not (name and at and port):
        raise InputError(
            "hidden effect",
            expected="EFFECT@PORT:k=v,...",
            got=repr(text),
            remedy="write e.g. --hide coulomb_friction@theta:Fc=0.05",
            place="--hide",
        )
    pairs = option_pairs([part for part in tail.split(",") if part], "--hide")
    for key, value in pairs.items():
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise InputError(
                "hidden effect", expected=f"a number for {key}", got=repr(value), remedy="correct it", place="--hide"
            )
    return name, port, {key: float(value) for key, value in pairs.items()}


def seed_range(text: str | None) -> tuple[int, int] | None:
    """Read ``A..B``; None where nothing is asked for."""
    if text is None:
        return None
    first, last = whole_range(text, "--seeds")
    if ".." not in text and first:
        print(f"seed {first} alone; --seeds 0..{first - 1} are {first} seeds", file=sys.stderr)
    return first, last


def whole_range(text: str, flag: str) -> tuple[int, int]:
    """Read ``A..B``, or one number.

    Raises InputError if it is no range of whole numbers from 0 on.
    """
    first, dots, last = text.partition("..")
    try:
        pair = (int(first), int(last if dots else first))
    except ValueError:
        pair = (1, 0)
    if pair[0] > pair[1] or pair[0] < 0:
        raise InputError(
            flag[2:], expected="A..B with 0 <= A <= B", got=repr(text), remedy=f"write e.g. {flag} 1..4", place=flag
        )
    return pair
