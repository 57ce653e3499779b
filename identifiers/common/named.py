"""Parts by their id and options, for analyses that are told which to use; options that make no sense."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import entry_points
from typing import Any, Literal

from harness.errors import FitError, InputError
from harness.options import meant_options


def named(kind: Literal["identifiers", "scenarios", "plants"], name: str, options: Mapping[str, Any]) -> Any:
    """Return a registered part with its options.

    Raises InputError if there is no such part, or it has no such option.

    - ``kind`` {"identifiers", "scenarios", "plants"}
    - ``name``: its id

    Examples
    --------
    >>> named("identifiers", "arx", {"order": 2}).order
    2
    """
    found = list(entry_points(group=f"sysid_harness.{kind}", name=name))
    if not found:
        raise InputError(
            f"{kind[:-1]} by its id",
            expected=f"a registered one (sysid list {kind})",
            got=repr(name),
            remedy="correct it",
        )
    maker = found[0].load()
    meant = meant_options(f"{kind[:-1]} {name!r}", maker, options)
    try:
        return maker(**meant)
    except TypeError as error:
        raise InputError(
            f"options of {name}", expected="those of its reference page", got=str(error), remedy="correct them"
        ) from error


def wrong_options(identifier: Any, what: str, expected: str, names: str) -> FitError:
    """Return the refusal of an identifier whose options of these names are not what is expected of them."""
    got = ", ".join(f"{name}={getattr(identifier, name)}" for name in names.split())
    return FitError(f"{what}: options", expected=expected, got=got, remedy="correct the options")
