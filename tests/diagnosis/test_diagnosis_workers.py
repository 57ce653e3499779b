"""Refits in worker processes: the same answers as in this one, whatever is defined where, and whoever dies."""

from __future__ import annotations

import multiprocessing
import os
import subprocess
import sys
import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

import harness.workers
from harness.diagnosis.output_form import OutputForm
from harness.diagnosis.prepare import sizes_of
from harness.diagnosis.refit import Task
from harness.diagnosis.refit_workers import RefitWorkers
from harness.diagnosis.refitter import Refitter
from harness.diagnosis.store import Store
from harness.effects import builtin, effect, par
from harness.effects.effect import Effect, Placed
from harness.physics import load_model
from harness.workers import worker_pool

from .conftest import pendulum_dataset


def cubic_drag() -> Effect:
    """Return an effect that no other process can import: it is defined in a function."""

    @effect("coordinate", [par("c", "F/v^3", scale="0.05 F/v^3", sign="+", main=True)], experiment="swing fast")
    def cubic_drag(f, s, p, q, v):
        """Drag that grows with the third power of the speed."""
        return -p.c * v**3

    return cubic_drag


def stored(number: int) -> Placed:
    """Return one of many effects by number: a toy form does not look at them."""
    return Placed(builtin()[sorted(builtin())[number]], "theta")


def tasks(count: int) -> list[Task]:
    return [Task((stored(k),), ({"k": float(k)},)) for k in range(count)]


def toy(what: Any) -> Any:
    """Return a form that answers a task with ``what(k)``; its class, too, is defined in a function."""

    class Toy:
        def solve(self, effects: Any, starts: Any, *, seed: int, bar: Any) -> dict[str, Any]:
            return {"answer": what(int(starts[0]["k"])), "by": os.getpid(), "seed": seed}

    return Toy()


def solve(form: Any, count: int, workers: int = 2) -> list[dict[str, Any]]:
    """Return the records of numbered tasks of a toy form; no process may be left behind."""
    before = set(multiprocessing.active_children())
    with RefitWorkers(workers) as helpers:
        found = Refitter(form, Store(None, ""), 5, helpers).solve(tasks(count))
    assert set(multiprocessing.active_children()) <= before
    return found


# ---- pools -----------------------------------------------------------------------------------------------------------


def test_a_worker_is_no_copy_of_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(harness.workers, "only_here", True, raising=False)
    main = dict(vars(sys.modules["__main__"]))
    with worker_pool(1) as pool:
        pid, copied = pool.schedule(
            eval, args=["__import__('os').getpid(), hasattr(__import__('harness.workers').workers, 'only_here')"]
        ).result()
    assert pid != os.getpid()
    assert not copied
    assert {name: vars(sys.modules["__main__"]).get(name) for name in main} == main


def test_an_exception_ends_the_workers_at_once() -> None:
    before = set(multiprocessing.active_children())

    def interrupted() -> None:
        with worker_pool(2) as pool:
            for _ in range(2):
                pool.schedule(eval, args=["__import__('time').sleep(600)"])
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert set(multiprocessing.active_children()) <= before


# ---- refits ----------------------------------------------------------------------------------------------------------


def test_workers_answer_as_this_process_does() -> None:
    """Of a real model, with an effect that nobody can import, and one that cannot be refitted."""
    dataset = pendulum_dataset(3, lambda q, v, u, t: -0.05 * v**3, n=800)
    system = load_model("pendulum")
    values = system.values()
    form = OutputForm(
        system, dataset, sizes=sizes_of(system, values, dataset), horizon=2.0, weights=[1e-3], floors=[1e-3]
    )
    drag, dry = Placed(cubic_drag(), "theta"), Placed(builtin()["coulomb_friction"], "theta")
    starts = [{**values, "cubic_drag@theta.c": 0.01}, {**values, "coulomb_friction@theta.Fc": 0.01}]
    wanted = [Task((one,), (start,)) for one, start in zip((drag, dry), starts, strict=True)]
    alone = Refitter(form, Store(None, ""), 1).solve(wanted)
    with RefitWorkers(2) as helpers:
        together = Refitter(form, Store(None, ""), 1, helpers).solve(wanted)
    assert [one["cost"] for one in together] == [one["cost"] for one in alone]
    assert together == alone
    assert alone[0]["values"]["cubic_drag@theta.c"] == pytest.approx(0.05, rel=0.3)


def test_each_task_has_its_own_seed_whoever_solves_it() -> None:
    alone, together = solve(toy(lambda k: k), 5, workers=1), solve(toy(lambda k: k), 5)
    assert [one["answer"] for one in together] == [0, 1, 2, 3, 4]
    assert [one["seed"] for one in together] == [one["seed"] for one in alone]
    assert len({one["seed"] for one in together}) == 5
    assert {one["by"] for one in alone} == {os.getpid()}
    assert os.getpid() not in {one["by"] for one in together}


def test_one_task_stays_here() -> None:
    assert solve(toy(lambda k: k), 1)[0]["by"] == os.getpid()


def test_what_cannot_travel_is_solved_here() -> None:
    lock = threading.Lock()

    def locked(k: int) -> int:
        with lock:
            return k

    found = solve(toy(locked), 3)
    assert [one["answer"] for one in found] == [0, 1, 2]
    assert {one["by"] for one in found} == {os.getpid()}


def test_what_does_not_arrive_is_solved_here() -> None:
    here = os.getpid()

    def rebuilt() -> SimpleNamespace:
        if os.getpid() != here:
            raise ImportError("not on this path")
        return SimpleNamespace()

    class Fragile:
        def __reduce__(self) -> Any:
            return rebuilt, ()

    fragile = Fragile()
    found = solve(toy(lambda k: (fragile, k)[1]), 3)
    assert [one["answer"] for one in found] == [0, 1, 2]
    assert {one["by"] for one in found} == {os.getpid()}


def test_a_lost_worker_costs_its_own_task_only(tmp_path: Path) -> None:
    here = os.getpid()

    def dies(k: int) -> int:
        if k == 1 and os.getpid() != here:
            os._exit(9)
        if k == 2 and os.getpid() != here and not (tmp_path / "once").exists():
            (tmp_path / "once").touch()
            os._exit(9)
        return k

    found = solve(toy(dies), 4)
    assert [one.get("answer") for one in found] == [0, None, 2, 3]
    assert found[1]["failed"].endswith("the worker ended itself with exit status 9, twice")
    assert str(tasks(2)[1].effects[0]) in found[1]["failed"]


def test_a_lost_refit_is_tried_again_when_resumed(tmp_path: Path) -> None:
    """A machine that ran out of memory once says nothing of the effect; a refit that cannot be made is not repeated."""
    here, wanted = os.getpid(), tasks(3)

    def answer(k: int, first: bool) -> int:
        if k == 1 and first and os.getpid() != here:
            os._exit(9)
        if k == 2 and first:
            raise ArithmeticError("no such number")
        return k

    with RefitWorkers(2) as helpers:
        found = Refitter(toy(lambda k: answer(k, True)), Store(tmp_path, "x"), 5, helpers).solve(wanted)
    assert ["failed" in one for one in found] == [False, True, True]
    store = Store(tmp_path, "x")
    again = Refitter(toy(lambda k: answer(k, False)), store, 5).solve(wanted)
    assert [one.get("answer") for one in again] == [0, 1, None]
    assert store.reused == 2


def test_an_interruption_keeps_what_was_finished() -> None:
    store, before = Store(None, ""), set(multiprocessing.active_children())

    def interrupt(name: str) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), RefitWorkers(2) as helpers:
        Refitter(toy(lambda k: k), store, 5, helpers, interrupt).solve(tasks(6))
    assert any(store.get(one.key) for one in tasks(6))
    assert set(multiprocessing.active_children()) <= before


SCRIPT = '''
from tests.diagnosis.conftest import pendulum_dataset
from harness.diagnosis import close_loop
from harness.effects import builtin, effect, par

@effect("coordinate", [par("c", "F/v^3", scale="0.05 F/v^3", sign="+", main=True)], experiment="swing fast")
def cubic_drag(f, s, p, q, v):
    """Drag that grows with the third power of the speed."""
    return -p.c * v**3

data = pendulum_dataset(3, lambda q, v, u, t: -0.05 * v**3, n=1000)
some = [cubic_drag, *(builtin()[name] for name in ("coulomb_friction", "linear_spring", "input_delay"))]
report = close_loop(data, "pendulum", dictionary=some, workers=2)  # at the top level of a script, without a guard
print("found", [one["name"] for one in report.data["effects"]])
'''


def test_a_script_without_a_guard_may_bring_its_own_effect(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    root = Path(__file__).resolve().parents[2]
    done = subprocess.run(
        [sys.executable, str(script)], capture_output=True, text=True, check=False, timeout=300,
        env={**os.environ, "PYTHONPATH": str(root)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "found ['cubic_drag']"
