"""Work in a process of its own: every kind of end is one error, and nothing is left running."""

from __future__ import annotations

import ctypes
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from harness.errors import InputError, PlantError, PluginError
from harness.supervision.guarded import alive, guarded


def work(how: str, note: str = "", *, progress: Callable[..., None]) -> Any:
    """Return, or end in one of many ways."""
    if note:
        child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
        Path(note).write_text(f"{os.getpid()} {child.pid} {os.environ['TMPDIR']}")
    if how == "crash":
        ctypes.string_at(0)
    if how == "hang":
        time.sleep(600)
    if how == "exit":
        os._exit(0)
    if how == "leave":
        raise KeyboardInterrupt
    if how == "daemon" and os.fork() == 0:
        os.setsid()
        if os.fork() == 0:
            Path(note).write_text(f"{os.getpid()} {os.environ['TMPDIR']}")
            time.sleep(600)
        os._exit(0)
    if how == "daemon":
        time.sleep(1.0)
    if how == "refuse":
        raise InputError("data", expected="more", got="less", remedy="record more")
    if how == "fault":
        raise ZeroDivisionError("odd")
    for k in range(4):
        progress(k / 4, "at work")
        alive()
        time.sleep(0.2)
    return {"how": how}


def test_what_is_done_comes_back_with_its_progress() -> None:
    seen: list[Any] = []
    assert guarded(work, "well", what="the FMU x", progress=lambda *given: seen.append(given)) == {"how": "well"}
    assert seen == [(k / 4, "at work") for k in range(4)]


@pytest.mark.parametrize(
    ("how", "error", "words"),
    [
        ("crash", PlantError, "the FMU x: the process was killed by SIGSEGV"),
        ("hang", PlantError, "the FMU x: no sign of life for 3 s"),
        ("exit", PlantError, "ended itself with exit status 0"),
        ("refuse", InputError, "data: expected more, got less"),
        ("leave", PluginError, "the FMU x raised KeyboardInterrupt$"),
        ("fault", RuntimeError, "ZeroDivisionError: odd"),
    ],
)
def test_every_end_is_one_error_and_leaves_nothing(
    how: str, error: type[Exception], words: str, tmp_path: Path
) -> None:
    with pytest.raises(error, match=words) as caught:
        guarded(work, how, str(tmp_path / "note"), what="the FMU x", silence=3.0)
    assert getattr(caught.value, "status", "") == {"crash": "crashed", "hang": "timeout", "exit": "crashed",
                                                   "refuse": "refused", "leave": "crashed"}.get(how, "")  # fmt: skip
    *processes, folder = (tmp_path / "note").read_text().split()
    deadline = time.monotonic() + 10
    while any(_runs(int(one)) for one in processes):
        assert time.monotonic() < deadline, processes
        time.sleep(0.05)
    assert not Path(folder).exists()


def test_a_daemon_ends_with_the_work(tmp_path: Path) -> None:
    assert guarded(work, "daemon", str(tmp_path / "note"), what="x") == {"how": "daemon"}
    daemon, folder = (tmp_path / "note").read_text().split()
    assert not _runs(int(daemon))
    assert not Path(folder).exists()


def _runs(process: int) -> bool:
    """Return True if a process runs (one that nobody has waited for yet is dead)."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False
