"""Compiled loops of identifiers: a C source beside its module, built once into the user's cache."""

from __future__ import annotations

import ctypes
import functools
import hashlib
import logging
import platform
from pathlib import Path

__all__ = ["native_library"]

log = logging.getLogger(__name__)


@functools.cache
def native_library(source: Path) -> ctypes.CDLL | None:
    """Return the library of a C source, or None where there is no C compiler.

    Parameters
    ----------
    source : Path
        A single C file.
    """
    from harness.compiled import build_once
    from harness.fmi import build

    try:
        key = source.read_bytes() + repr((platform.machine(), platform.system(), build.FLAGS)).encode()
        path = build_once(
            hashlib.sha256(key).hexdigest()[:24],
            f"{source.stem}{build.library_suffix()}",
            lambda target: build.compile_library([source], target, "-O3"),
        )
        return ctypes.CDLL(str(path))
    except (build.BuildError, OSError) as error:
        log.info("%s runs in numpy: %s", source.stem, error)
        return None
