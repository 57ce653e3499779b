"""What foreign code leaves behind in a worker: folder, environment, descriptors, processes. Checked and put right."""

from __future__ import annotations

import ctypes
import os
import signal
import stat
import sys
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

_SUBREAPER = 36  # PR_SET_CHILD_SUBREAPER of Linux' prctl
PROC = Path("/proc")
APART = os.name == "posix"
"""Whether a plant can have a process of its own, which inherits a socket; elsewhere it runs in the caller's."""


def adopt_orphans() -> None:
    """Become the parent of every process whose own parent ends, so that none is lost from sight (Linux)."""
    with suppress(OSError, AttributeError, TypeError):  # no prctl, or no library without a name (Windows)
        ctypes.CDLL(None).prctl(_SUBREAPER, 1, 0, 0, 0)


def children() -> dict[int, bytes]:
    """Return the processes of this one, and of those, with their command lines."""
    parents: dict[int, list[int]] = {}
    for entry in PROC.glob("[0-9]*/stat") if PROC.is_dir() else ():
        with suppress(OSError, ValueError, IndexError):
            parents.setdefault(int(entry.read_text().rpartition(")")[2].split()[1]), []).append(int(entry.parent.name))
    found: dict[int, bytes] = {}
    waiting = parents.get(os.getpid(), [])
    while waiting:
        one = waiting.pop()
        with suppress(OSError):
            found[one] = (PROC / str(one) / "cmdline").read_bytes()
        waiting += parents.get(one, [])
    return found


def end_children(keep: Iterable[int] = (), *, copies: bool = False) -> None:
    """End the processes that were started here.

    - ``keep``: processes that stay
    - ``copies``: only copies of this process (``fork``): what was started by name may be a compiler at work
    """
    me = (PROC / "self" / "cmdline").read_bytes() if copies and PROC.is_dir() else b""
    for one, line in children().items():
        if one not in set(keep) and (not copies or line == me):
            with suppress(ProcessLookupError, PermissionError):
                os.kill(one, signal.SIGKILL)
            with suppress(ChildProcessError):
                os.waitpid(one, 0)


def ended(process: int) -> bool:
    """Return True if a process is no more, or is dead and waits to be collected."""
    if not PROC.is_dir():
        return False
    try:
        return (PROC / str(process) / "stat").read_text().rpartition(")")[2].split()[0] in "ZX"
    except (OSError, IndexError):
        return True


class Surroundings:
    """Folder, environment, import path, descriptors and processes as they are now, to be found so again."""

    def __init__(self) -> None:
        self._process = os.getpid()
        self._folder, self._environment, self._path = os.getcwd(), dict(os.environ), list(sys.path)
        self._lines = {number: mark for number in _numbers() if (mark := _mark(number)) is not None}
        self._children = set(children())

    def restore(self) -> str:
        """Put right what can be put right; returns what cannot, empty if nothing.

        In a copy that ``fork`` made of the process the end has come: nothing of the work is its own.
        """
        if os.getpid() != self._process:
            os._exit(0)
        os.chdir(self._folder)
        if dict(os.environ) != self._environment:
            os.environ.clear()
            os.environ.update(self._environment)
        if sys.path != self._path:
            sys.path[:] = self._path
        end_children(self._children, copies=True)
        lost = [number for number, mark in self._lines.items() if _mark(number) != mark]
        for number in [one for one in lost if one < 3]:  # they lead nowhere in a worker
            nowhere = os.open(os.devnull, os.O_RDWR)
            if nowhere != number:
                os.dup2(nowhere, number)
                os.close(nowhere)
        broken = [number for number in lost if number > 2]
        return f"closed {len(broken)} descriptors that are not its own" if broken else ""


def _numbers() -> list[int]:
    """Return the open descriptors."""
    try:
        return [int(name) for name in os.listdir("/proc/self/fd")]
    except OSError:
        return [0, 1, 2]


def _mark(number: int) -> tuple[int, int] | None:
    """Return what a descriptor leads to: of lines to other processes and of the first three; None of any other.

    Files are opened and closed by everybody.
    """
    try:
        found = os.fstat(number)
    except OSError:
        return None
    line = stat.S_ISFIFO(found.st_mode) or stat.S_ISSOCK(found.st_mode)
    return (found.st_dev, found.st_ino) if line or number < 3 else None
