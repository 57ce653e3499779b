"""Pools of workers leave the calling process as it is, while they live and afterwards."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from harness.supervision.workers import worker_pool

SCRIPT = """
import os, sys
print("ran", flush=True)
from harness.supervision.workers import worker_pool

before = dict(os.environ)
with worker_pool(2) as pool:
    first = pool.schedule(eval, args=["__import__('os').environ['OMP_NUM_THREADS']"])
    assert first.result() == "1", first.result()
    assert __file__.endswith("script.py")
    main = sys.modules["__main__"]
    assert main.__file__ == __file__ and hasattr(main, "__spec__"), vars(main)
    assert dict(os.environ) == before
    assert pool.schedule(eval, args=["hasattr(__import__('__main__'), 'defined')"]).result() is False
print("done")
"""


def test_a_script_without_a_guard_runs_once_and_keeps_its_name(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    environment = {name: value for name, value in os.environ.items() if "THREADS" not in name}
    done = subprocess.run(
        [sys.executable, str(script)], capture_output=True, text=True, check=False, timeout=120, env=environment
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["ran", "done"]


OWN_POOL = """
import multiprocessing
from harness.supervision.workers import worker_pool

def double(x):
    return 2 * x

if __name__ == "__main__":
    with worker_pool(1) as pool:
        pool.schedule(eval, args=["1"]).result()
        with multiprocessing.get_context("spawn").Pool(1) as own:
            print(own.map(double, [21]))
"""


def test_a_pool_of_the_callers_own_still_finds_its_script(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(OWN_POOL)
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, check=False, timeout=120)
    assert done.stdout == "[42]\n", done.stderr


def test_threads_chosen_by_the_caller_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    with worker_pool(1) as pool:
        assert pool.schedule(eval, args=["__import__('os').environ['OMP_NUM_THREADS']"]).result() == "3"
    assert os.environ["OMP_NUM_THREADS"] == "3"
