"""Ctrl-C that a library swallows is heard all the same."""

from __future__ import annotations

import os
import signal
import sys
import time

import pytest

from harness.app.jobs import PROGRESS as READ
from harness.cli import app as cli
from harness.cli.terminal import PROGRESS, jobs_bar, progress_bar, share_bar
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


def test_lines_of_progress_are_shares_or_counts(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The page of ``sysid open`` reads the shares."""
    monkeypatch.setenv(PROGRESS, "0")
    with share_bar("closing the loop", "run") as share:
        share(0.42, "backlash@theta")
    with jobs_bar("records", "fleet") as count:
        count(2, 6, "2 ok")
    with progress_bar("simulating") as bar:
        bar.update(bar.add_task("plant"), completed=50, total=200)
    first, second, third = capsys.readouterr().err.splitlines()
    assert first == "closing the loop: 42 %, backlash@theta"
    read = READ.fullmatch(first)
    assert read is not None
    assert read.groups() == ("42", "backlash@theta")
    assert (second, third) == ("records: 2 of 6, 2 ok", "simulating: 25 %")


def test_a_command_that_came_to_its_end_says_that_it_was_interrupted(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with Interrupts() as interrupts:
        assert cli.run(["--version"], interrupts) == 0
        swallowed()
        assert cli.run(["--version"], interrupts) == INTERRUPTED
    assert "interrupted" in capsys.readouterr().err
