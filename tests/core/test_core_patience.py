"""How long foreign code is waited for: steps that take much longer than those before are left behind."""

from __future__ import annotations

import time
import weakref
from collections.abc import Callable
from typing import Any

import pytest

from harness.errors import InputError, PlantError
from harness.supervision.guarded import alive, guarded
from harness.supervision.patience import LEAST, LONGEST, Aside, Patience, waiting


def test_steps_that_were_done_tell_how_long_the_next_may_take() -> None:
    patience = Patience()
    assert patience.limit() == LONGEST
    patience.took(100, 0.1)
    assert LEAST < patience.limit() < LEAST + 0.2
    patience.took(100, 0.01)  # quicker ones say nothing of the slow one
    assert patience.limit(10) > patience.limit()
    patience.took(1, 60.0)
    assert patience.limit() == LONGEST
    with waiting(0.5):
        assert Patience().limit() == 0.5
    assert Patience(3.0).limit() == 3.0


def test_a_call_that_does_not_end_is_left_behind_and_the_next_one_is_done() -> None:
    aside = Aside("x.fmu", 0.5)
    began = time.monotonic()
    with pytest.raises(PlantError, match=r"^x.fmu: the step from t = 2 s does not end within 0.5 s .*--step-limit"):
        aside.call(lambda: time.sleep(30), lambda: 0, lambda: "the step from t = 2 s", loads=False)
    assert time.monotonic() - began < 3.0
    assert aside.call(lambda: 7, lambda: 0, lambda: "", loads=True) == 7


def test_steps_that_go_on_may_take_as_long_as_they_like_together() -> None:
    done: list[int] = []

    def work() -> str:
        for k in range(6):
            time.sleep(0.3)
            done.append(k)
        return "done"

    assert Aside("x.fmu", 1.0).call(work, lambda: len(done), lambda: "", loads=False) == "done"


def test_what_is_raised_aside_is_raised_here() -> None:
    def refuse() -> None:
        raise InputError("data", expected="more", got="less", remedy="record more")

    with pytest.raises(InputError, match="record more"):
        Aside("x.fmu").call(refuse, lambda: 0, lambda: "", loads=False)


def silent(*, progress: Callable[..., None]) -> Any:
    """Promise a sign of life and give none."""
    alive(0.7, "x.fmu: is not loaded within 0.7 s")
    time.sleep(60)


def test_a_promise_of_a_sign_of_life_that_is_not_kept_ends_the_work() -> None:
    with pytest.raises(PlantError, match=r"^x.fmu: is not loaded within 0.7 s$") as caught:
        guarded(silent, what="the FMU x")
    assert caught.value.status == "timeout"


def test_the_thread_keeps_nothing_of_what_it_worked_on_and_ends() -> None:
    class Unit:
        def run(self) -> int:
            return 3

    unit, aside = [Unit()], Aside("x.fmu")
    gone = weakref.ref(unit[0])
    assert aside.call(unit[0].run, lambda: 0, lambda: "", loads=False) == 3
    thread = aside._thread
    unit.clear()
    assert gone() is None
    del aside
    assert thread is not None
    thread.join(5.0)
    assert not thread.is_alive()
