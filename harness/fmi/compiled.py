"""Where compiled things are kept: a content-hashed cache folder of the user, safe for several processes at once."""

from __future__ import annotations

import atexit
import functools
import hashlib
import os
import platform
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path


def cache_folder() -> Path:
    """Return the folder for compiled files: ``$SYSID_HARNESS_CACHE``, else the user's cache folder.

    It exists; where it cannot be written (a read-only home) a temporary folder of this process takes its place.

    Examples
    --------
    >>> cache_folder().is_absolute()
    True
    """
    given = os.environ.get("SYSID_HARNESS_CACHE")
    if given:
        folder = Path(given).resolve()
    else:
        import platformdirs

        folder = Path(platformdirs.user_cache_dir("sysid-harness")).absolute()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return _own_folder()
    return folder if os.access(folder, os.W_OK) else _own_folder()


def build_once(key: str, name: str, make: Callable[[Path], None]) -> Path:
    """Return a cached file, made at the first call.

    - ``key``: hash of everything that the file depends on
    - ``name``: file name
    - ``make``: ``make(target)`` writes the file. It is renamed into place when it is complete, so other processes see
      all of it or nothing; two that build at once both succeed.
    - returns its path in :func:`cache_folder`
    """
    folder = cache_folder() / "fmu" / key
    final = folder / name
    if final.is_file():
        return final
    folder.mkdir(parents=True, exist_ok=True)
    handle, part = tempfile.mkstemp(dir=folder, suffix=".part")
    os.close(handle)
    scratch = Path(part)
    try:
        make(scratch)
        scratch.chmod(0o755)
        scratch.replace(final)
    finally:
        scratch.unlink(missing_ok=True)
    return final


def library_of(source: Path, *options: str, program: tuple[str, ...] | None = None) -> Path:
    """Return the shared library of one C source, compiled at the first call and whenever source or compiler change.

    - ``*options, program``: as of :func:`harness.fmi.build.compile_library`, which raises what keeps it from being
      built
    """
    from harness.fmi import build

    key = source.read_bytes() + repr((platform.machine(), platform.system(), build.FLAGS, options, program)).encode()
    return build_once(
        hashlib.sha256(key).hexdigest()[:24],
        f"{source.stem}{build.library_suffix()}",
        lambda target: build.compile_library([source], target, *options, program=program),
    )


@functools.cache
def _own_folder() -> Path:
    """Return a temporary folder that is removed when the process ends."""
    folder = tempfile.mkdtemp(prefix="sysid-cache-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return Path(folder)
