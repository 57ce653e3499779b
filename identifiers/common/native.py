"""C sources beside this file, compiled once and kept in the user's cache."""

from __future__ import annotations

import ctypes
import functools
import logging
from pathlib import Path
from typing import Any

log = logging.getLogger(__name__)


@functools.cache
def library(name: str) -> Any:
    """Return the compiled library of ``identifiers/NAME.c``, or None where there is no C compiler.

    Examples
    --------
    >>> library("hmm_loop") is library("hmm_loop")
    True
    """
    from harness.fmi import build
    from harness.fmi.compiled import library_of

    try:
        program = build.compiler() or build.small_compiler()
        return ctypes.CDLL(str(library_of(Path(__file__).with_name(f"{name}.c"), "-O3", program=program)))
    except (build.BuildError, OSError) as error:
        log.info("%s runs in numpy: %s", name, error)
        return None


def declared(name: str, **calls: tuple[Any, list[Any]]) -> Any:
    """Return the library of :func:`library`, with the type of the result and of the arguments of its functions."""
    compiled = library(name)
    if compiled is not None:
        for call, (result, arguments) in calls.items():
            function = getattr(compiled, call)
            function.restype, function.argtypes = result, arguments
    return compiled


def pointers(*arrays: Any) -> list[int]:
    """Return the addresses of arrays for a call into C."""
    return [array.ctypes.data for array in arrays]
