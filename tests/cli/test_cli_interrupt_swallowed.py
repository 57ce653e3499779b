"""Ctrl-C that a library swallows is heard all the same."""

from __future__ import annotations

import os
import signal

import pytest

from harness import cli
from harness.interrupts import INTERRUPTED, Interrupts, stop_if_asked


def swallowed() -> None:
    """Meet Ctrl-C as a library does that catches everything."""
    try:
        os.kill(os.getpid(), signal.SIGINT)
        signal.sigtimedwait([], 1.0)
    except KeyboardInterrupt:
        return
    raise AssertionError("nothing was heard")


@pytest.fixture(autouse=True)
def usual_handler() -> object:
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_long_work_stops_at_its_next_step() -> None:
    with Interrupts():
        stop_if_asked()
        swallowed()
        with pytest.raises(KeyboardInterrupt):
            stop_if_asked()
    stop_if_asked()


def test_a_command_that_came_to_its_end_says_that_it_was_interrupted(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with Interrupts() as interrupts:
        assert cli.run(["--version"], interrupts) == 0
        swallowed()
        assert cli.run(["--version"], interrupts) == INTERRUPTED
    assert "interrupted" in capsys.readouterr().err
