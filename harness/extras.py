"""Packages that an extra brings: imported where they are used, or refused with the words that install them."""

from __future__ import annotations

import importlib
from typing import Any

from harness.errors import InputError

__all__ = ["optional"]


def optional(package: str, kind: str, install: str = "'sysid-harness[data]'") -> Any:
    """Return an optional package.

    Parameters
    ----------
    package : str
        Its module.
    kind : str
        What needs it, for the message.
    install : str
        What pip is to install.

    Raises
    ------
    InputError
        If it is not installed.

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
