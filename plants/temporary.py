"""Temporary folders that are gone even when the process is ended by SIGTERM.

Finalizers run when the interpreter ends by itself; SIGTERM ends it without. Where nobody handles that signal, the first
folder of a process installs a handler that removes the folders and then lets the signal do its work.
"""

from __future__ import annotations

import os
import shutil
import signal
import tempfile
import threading
from pathlib import Path
from types import FrameType

_folders: dict[Path, int] = {}  # folder: the process that owns it (a fork inherits the table, not the folders)


def temporary_folder(prefix: str) -> Path:
    """Return a new folder, removed by :func:`release` or when SIGTERM ends the process.

    Examples
    --------
    >>> folder = temporary_folder("sysid-doctest-")
    >>> folder.is_dir()
    True
    >>> release(folder)
    >>> folder.is_dir()
    False
    """
    _listen()
    folder = Path(tempfile.mkdtemp(prefix=prefix))
    _folders[folder] = os.getpid()
    return folder


def release(folder: Path) -> None:
    """Remove a folder; harmless if it is gone."""
    shutil.rmtree(folder, ignore_errors=True)
    _folders.pop(folder, None)


def _listen() -> None:
    """Install the handler, unless someone else handles the signal or this is not the main thread."""
    if threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGTERM) is signal.SIG_DFL:
        signal.signal(signal.SIGTERM, _end)


def _end(number: int, _frame: FrameType | None) -> None:
    """Remove this process's folders, then end as the signal would have."""
    for folder, owner in list(_folders.items()):
        if owner == os.getpid():
            shutil.rmtree(folder, ignore_errors=True)
    signal.signal(number, signal.SIG_DFL)
    os.kill(os.getpid(), number)
