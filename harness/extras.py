"""What is imported when it is used: packages that an extra brings, and the public names of a room."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Mapping
from typing import Any

from harness.errors import InputError


def optional(package: str, kind: str, install: str = "'sysid-harness[data]'") -> Any:
    """Return an optional package.

    Raises InputError if it is not installed.

    - ``package``: its module
    - ``kind``: what needs it, for the message
    - ``install``: what pip is to install

    Examples
    --------
    >>> optional("json", "this line").loads("1")
    1
    """
    try:
        return importlib.import_module(package)
    except ImportError as error:
        raise InputError(
            f"{kind} needs the package {package}",
            expected=f"{package} installed",
            got="it is not",
            remedy=f"pip install {install}",
        ) from error


def on_demand(package: str, homes: Mapping[str, str]) -> Callable[[str], Any]:
    """Return the ``__getattr__`` of a package whose public names are loaded when they are asked for; ``dir`` has them.

    - ``package``: its ``__name__``
    - ``homes``: the module below it that has each name (beside it, if it begins with a dot); empty where the name is
      such a module itself

    Examples
    --------
    >>> loaded = on_demand("harness", {"stream": "rng"})
    >>> loaded("stream").__module__
    'harness.rng'
    >>> loaded("river")
    Traceback (most recent call last):
        ...
    AttributeError: module 'harness' has no attribute 'river'
    """

    def load(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        module = importlib.import_module(f".{homes[name] or name}", package)
        value = getattr(module, name) if homes[name] else module
        setattr(sys.modules[package], name, value)
        return value

    shown = vars(sys.modules[package])
    shown.setdefault("__dir__", lambda: sorted({*homes, *({"__version__"} & shown.keys())}))
    return load
