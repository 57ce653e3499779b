"""Files that are there whole or not at all; what the disk or the folder refuses is said with the path."""

from __future__ import annotations

import contextlib
import errno
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from harness.errors import InputError

REMEDIES = {
    errno.ENOSPC: "make room on that disk, or write elsewhere",
    errno.EDQUOT: "make room in your quota, or write elsewhere",
    errno.EFBIG: "write elsewhere, or less",
    errno.EACCES: "choose a folder that you may write to, or change its permissions",
    errno.EPERM: "choose a folder that you may write to, or change its permissions",
    errno.EROFS: "choose a folder that is not read-only",
    errno.ENOENT: "make the folder first, or correct the path",
    errno.ENOTDIR: "correct the path: a part of it is a file",
    errno.EISDIR: "give the name of a file, not of a folder",
    errno.EEXIST: "choose another name",
    errno.ENOTEMPTY: "choose another name",
    errno.ENAMETOOLONG: "choose a shorter name",
    errno.EMFILE: "close other programs, or raise the limit of open files (ulimit -n)",
    errno.ELOOP: "correct the links in the path",
}


def refused_by_system(error: OSError, path: str | Path | None = None) -> InputError | None:
    """Return an error of the operating system with its remedy, where a user can act on it; else None.

    Examples
    --------
    >>> print(refused_by_system(OSError(errno.ENOSPC, "No space left on device"), "/data/run.csv"))
    /data/run.csv: the system refuses: expected a file that can be read or written, got no space left on device;
    remedy: make room on that disk, or write elsewhere
    """
    remedy = REMEDIES.get(error.errno or 0)
    if remedy is None:
        return None
    reason = error.strerror or "no reason"
    return InputError(
        "the system refuses",
        expected="a file that can be read or written",
        got=reason[:1].lower() + reason[1:],
        remedy=remedy,
        file=path if path is not None else error.filename,
    )


@contextlib.contextmanager
def whole_file(path: str | Path) -> Iterator[Path]:
    """Give a scratch file beside a path; it takes the place of the path at the end, and is removed if that fails.

    Raises InputError if the disk is full or the folder cannot be written to, with the path.
    """
    path = Path(path)
    scratch = path.with_name(path.name + ".part")
    try:
        yield scratch
        scratch.replace(path)
    except OSError as error:
        refused = refused_by_system(error, path)
        if refused is None:
            raise
        raise refused from error
    finally:
        with contextlib.suppress(OSError):
            scratch.unlink(missing_ok=True)


def write_text(path: str | Path, text: str) -> None:
    """Write a text whole or not at all; see :func:`whole_file`."""
    with whole_file(path) as scratch:
        scratch.write_text(text, encoding="utf-8")


def write_json(path: str | Path, content: Any) -> None:
    """Write JSON whole or not at all, which holds no NaN; see :func:`whole_file`."""
    write_text(path, json.dumps(content, indent=1, allow_nan=False) + "\n")
