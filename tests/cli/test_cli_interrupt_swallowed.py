"""Ctrl-C that a library swallows is heard all the same."""

from __future__ import annotations

import os
import signal
import sys
import time

import pytest

from harness.cli import app as cli
from harness.cli.terminal import progress_bar
from harness.supervision.interrupts import INTERRUPTED, Interrupts


def swallowed() -> None:
    """Meet Ctrl-C as a library does that catches everything."""
    try:
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(1.0)
    except KeyboardInterrupt:
        return
    raise AssertionError("nothing was heard")


@pytest.fixture(autouse=True)
def usual_handler() -> object:
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize("terminal", [False, True])
def test_long_work_stops_at_the_next_step_of_its_progress(terminal: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: terminal, raising=False)
    with progress_bar("working") as bar:
        task = bar.add_task("one", total=1.0)
        with Interrupts():
            bar.update(task, completed=0.1)
            swallowed()
            with pytest.raises(KeyboardInterrupt):
                bar.update(task, completed=0.2)
        bar.update(task, completed=0.3)


def test_a_command_that_came_to_its_end_says_that_it_was_interrupted(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with Interrupts() as interrupts:
        assert cli.run(["--version"], interrupts) == 0
        swallowed()
        assert cli.run(["--version"], interrupts) == INTERRUPTED
    assert "interrupted" in capsys.readouterr().err
