"""Models of other distributions: entry points of the group ``sysid_harness.models``, found when a name asks for one.

This room lies below :mod:`harness.registry`, so it reads the same entry points by itself.
"""

from __future__ import annotations

import functools
import importlib.metadata
import os
from collections.abc import Callable
from typing import Any

from harness.errors import HarnessError, PluginError

__all__ = ["model_names", "model_of"]


@functools.cache
def _points() -> dict[str, importlib.metadata.EntryPoint]:
    """Return the entry points of other distributions by name; of two with one name the first distribution's."""
    if os.environ.get("SYSID_HARNESS_NO_PLUGINS", "") not in ("", "0"):
        return {}
    found = [
        (point.dist.name if point.dist is not None else "?", point)
        for point in importlib.metadata.entry_points(group="sysid_harness.models")
    ]
    result: dict[str, importlib.metadata.EntryPoint] = {}
    for _, point in sorted(found, key=lambda pair: pair[0]):
        result.setdefault(point.name, point)
    return result


def model_names() -> tuple[str, ...]:
    """Return the names of all registered models, the built-in ones included.

    Examples
    --------
    >>> "pendulum" in model_names()
    True
    """
    return tuple(sorted(_points()))


def model_of(name: str) -> Callable[..., Any] | None:
    """Return the function that makes a registered model; None if there is none of this name.

    Raises
    ------
    PluginError
        If the plug-in raises while it is imported.
    """
    point = _points().get(name)
    if point is None:
        return None
    try:
        maker: Callable[..., Any] = point.load()
    except HarnessError:
        raise
    except Exception as error:
        raise PluginError(
            f"model {name!r} ({point.value}) does not load: {type(error).__name__}: {error}; "
            "remedy: repair or uninstall its distribution"
        ) from error
    return maker
