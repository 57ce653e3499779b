"""A disk without room is a state of the run, not of a job: nothing is stored for it, and the run ends with one line.

What was finished stays, and the run is continued where there is room.
"""

from __future__ import annotations

import errno
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

from harness.errors import InputError

FULL = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS})
"""What a system answers to a write that it has no room for."""
LEAST = 1 << 20
"""Free bytes below which a disk counts as full: a row and its reports are some ten kilobytes, and a compiler or a
library that met a full disk says so in words of its own."""


def full_disk(error: BaseException) -> OSError | None:
    """Return the refusal of a full disk that an exception is, or that led to it; None if there was none.

    Examples
    --------
    >>> full_disk(ValueError("x")) is None
    True
    >>> full_disk(OSError(errno.ENOSPC, "No space left on device")).errno == errno.ENOSPC
    True
    """
    return next((one for one in _chain(error) if isinstance(one, OSError) and one.errno in FULL), None)


def _chain(error: BaseException | None) -> Iterator[BaseException]:
    """Yield an exception and those that led to it."""
    seen: set[int] = set()
    while error is not None and id(error) not in seen:
        seen.add(id(error))
        yield error
        error = error.__cause__ or error.__context__


def stop_if_full(error: BaseException) -> None:
    """End a run whose worker met a full disk.

    Raises InputError with what to do.
    """
    found = full_disk(error)
    if found is not None:
        reason = found.strerror or "no room"
        raise InputError(
            "the disk takes nothing more",
            expected="room for results",
            got=reason[:1].lower() + reason[1:],
            remedy="make room and continue with --resume: what was finished is kept",
            file=found.filename,
        ) from error


def require_room(folder: str | Path) -> None:
    """Refuse a disk on which nothing more can be written.

    Raises OSError of the kind that a write would raise, with the folder.
    """
    found = shutil.disk_usage(folder)
    if found.total and found.free < LEAST:  # some network file systems tell no sizes
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(folder))


def raise_if_full(error: BaseException) -> None:
    """Raise the full disk behind a failure, or that there is now: then the failure says nothing about the job.

    Raises OSError if a write was refused, or nothing more can be written where scratch files lie.
    """
    found = full_disk(error)
    if found is not None:
        raise OSError(found.errno, found.strerror, found.filename) from error
    require_room(tempfile.gettempdir())
