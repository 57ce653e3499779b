"""Work that runs foreign machine code, in a process of its own: a crash or a silence there is one error here.

It keeps accidents away and is no sandbox: what the work returns is believed.
"""

from __future__ import annotations

import ctypes
import os
import signal
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from multiprocessing import parent_process
from multiprocessing.connection import Connection
from typing import Any

from harness.errors import HarnessError, PlantError, PluginError
from harness.supervision.processes import adopt_orphans, end_children
from harness.supervision.workers import fresh_process

SILENCE = 300.0
"""Seconds without a simulation ended or a step of progress after which work counts as hanging: thirty times what the
longest simulation of the project's records takes (1e5 samples of an FMU, 10 s)."""
START = 300.0  # s that a process may take to begin: imports on a machine with too much to do
BEAT = 0.5  # s between signs of life
_DEATH_SIGNAL = 1  # PR_SET_PDEATHSIG of Linux' prctl


class _Line:
    """Where the worker reports to; empty in any other process."""

    connection: Connection | None = None
    last = 0.0
    hurried = False


def alive(within: float | None = None, doing: str = "") -> None:
    """Say that the work goes on; harmless outside of guarded work.

    - ``within``: seconds in which the next sign comes, where less than usual
    - ``doing``: what is to be said if it does not come
    """
    now = time.monotonic()
    if _Line.connection is not None and (now - _Line.last > BEAT or within is not None or _Line.hurried):
        _Line.last, _Line.hurried = now, within is not None
        _Line.connection.send(("alive", within, doing))


def guarded(
    work: Callable[..., Any],
    *arguments: Any,
    what: str,
    progress: Callable[..., None] | None = None,
    silence: float | None = None,
    **options: Any,
) -> Any:
    """Return ``work(*arguments, progress=..., **options)``, done in a process of its own.

    - ``work``: at the top of a module; what it takes and returns travels by pickle
    - ``what``: what is run, for a message
    - ``progress``: called here with what the work calls its ``progress`` with
    - ``silence``: seconds without a call of :func:`alive` or of ``progress`` that end the work; by default
      :data:`SILENCE`

    Raises
    ------
    PlantError
        If the process dies (``crashed``) or falls silent (``timeout``).
    HarnessError
        What the work itself raises.
    """
    limit, doing = START, ""
    folder = tempfile.TemporaryDirectory(prefix="sysid-apart-", ignore_cleanup_errors=True)
    ours, process = fresh_process(_serve, folder.name, work, arguments, options)
    try:
        while True:
            if not ours.poll(limit):
                raise PlantError(doing or f"{what}: no sign of life for {limit:g} s", status="timeout")
            kind, *content = ours.recv()
            limit, doing = SILENCE if silence is None else silence, ""  # it has begun
            if kind == "alive" and content[0] is not None:
                limit, doing = min(limit, content[0]), content[1]
            if kind == "progress" and progress is not None:
                progress(*content)
            elif kind == "done":
                process.join(BEAT)
                return content[0]
            elif kind == "failed":
                raise content[0]
            elif kind == "left":
                raise PluginError(f"{what} {content[0]}")
    except (EOFError, ConnectionResetError):
        process.join(BEAT)
        raise PlantError(f"{what}: the process {_ended(process.exitcode)}", status="crashed") from None
    finally:
        if hasattr(os, "killpg"):
            with suppress(ProcessLookupError, PermissionError):
                os.killpg(process.pid or 0, signal.SIGKILL)  # with all that it started
        process.kill()
        process.join()
        ours.close()
        folder.cleanup()


def _ended(code: int | None) -> str:
    """Return how a process ended."""
    if code is not None and code < 0:
        with suppress(ValueError):
            return f"was killed by {signal.Signals(-code).name}"
    return f"ended itself with exit status {code}"


def _serve(connection: Connection, folder: str, work: Callable[..., Any], arguments: Any, options: Any) -> None:
    """Do the work in its process."""
    if hasattr(os, "setsid"):
        os.setsid()  # an interrupt from the keyboard is the caller's to handle
    os.environ["TMPDIR"] = tempfile.tempdir = folder  # what a crash leaves there goes with it
    adopt_orphans()
    with suppress(OSError, AttributeError, TypeError):
        ctypes.CDLL(None).prctl(_DEATH_SIGNAL, signal.SIGKILL)
    caller = parent_process()

    def watch() -> None:
        if caller is not None:
            caller.join()
        if hasattr(os, "killpg"):
            os.killpg(0, signal.SIGKILL)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
    _Line.connection = connection
    alive()
    try:
        done = work(*arguments, progress=lambda *content: connection.send(("progress", *content)), **options)
        answer = ("done", done)
    except HarnessError as error:
        answer = ("failed", error)
    except MemoryError:
        answer = ("failed", PlantError("out of memory", status="crashed"))
    except Exception as error:
        answer = ("failed", RuntimeError(f"{type(error).__name__}: {error}"))
    except BaseException as error:  # an exit, an interrupt that foreign code raised
        answer = ("left", f"raised {type(error).__name__}: {error}".rstrip(": "))
    _Line.connection = None
    end_children()
    connection.send(answer)
