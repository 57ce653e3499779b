"""Ctrl-C during a closed loop: finished refits stay, no process is left behind, --resume ends as if nothing was."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

DATASET = """
name = "bench"
sample_time = 0.02
signals.u = { role = "input", unit = "N m" }
signals.theta = { role = "output", unit = "rad" }
[nominal]
model = "pendulum"
[[runs]]
file = "estimation.csv"
use = "estimation"
[[runs]]
file = "validation.csv"
use = "validation"
"""
PYTHON = [sys.executable, "-c", "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
          "from harness.command import main; main()"]  # fmt: skip


@pytest.fixture(scope="module")
def folder(foreign_dry_pendulum, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a dry pendulum as CSV files and their description."""
    where = tmp_path_factory.mktemp("interrupted")
    (where / "dataset.toml").write_text(DATASET)
    for use, (u, y) in foreign_dry_pendulum.items():
        rows = "".join(f"{a!r},{b!r}\n" for a, b in zip(u.tolist(), y.tolist(), strict=True))
        (where / f"{use}.csv").write_text("u,theta\n" + rows)
    return where


def call(folder: Path, out: str, *more: str) -> list[str]:
    return [*PYTHON, "close-loop", str(folder / "dataset.toml"), "--out", str(folder / out), *more]


def finished(folder: Path, out: str, *more: str) -> dict:
    """Return the report of a call that ends, without its duration."""
    done = subprocess.run(call(folder, out, *more), capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    report = json.loads((folder / out / "report.json").read_text())
    del report["seconds"]
    return report


def alive(group: int) -> bool:
    """Return True if a process of the group still runs."""
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.mark.slow
def test_interrupted_and_resumed(folder: Path) -> None:
    whole = finished(folder, "whole")
    process = subprocess.Popen(call(folder, "cut"), stderr=subprocess.PIPE, text=True, start_new_session=True)
    held = folder / "cut" / "candidates"
    until = time.monotonic() + 240
    while not (held.is_dir() and any(held.glob("*.json"))):
        assert process.poll() is None, process.stderr.read()  # type: ignore[union-attr]
        assert time.monotonic() < until
        time.sleep(0.02)
    os.killpg(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 130, errors
    assert "Traceback" not in errors
    assert "--resume continues" in errors
    until = time.monotonic() + 20
    while alive(process.pid) and time.monotonic() < until:
        time.sleep(0.05)
    assert not alive(process.pid), "a worker outlived the command"
    assert not (folder / "cut" / "report.json").exists()
    kept = {path.name: path.stat().st_mtime_ns for path in held.glob("*.json")}
    assert kept

    refused = subprocess.run(call(folder, "cut"), capture_output=True, text=True, check=False)
    assert refused.returncode == 2
    assert "--resume" in refused.stderr

    resumed = finished(folder, "cut", "--resume")
    assert resumed == whole, "neither the interruption nor the number of workers changes the report"
    again = {name: (held / name).stat().st_mtime_ns for name in kept}
    assert again == kept, "a finished refit was done again"


def test_a_finished_report_is_kept_without_force(folder: Path) -> None:
    out = folder / "mine"
    out.mkdir()
    (out / "report.json").write_text("{}")
    refused = subprocess.run(call(folder, "mine"), capture_output=True, text=True, check=False)
    assert refused.returncode == 2
    assert "--force" in refused.stderr
    assert (out / "report.json").read_text() == "{}"


@pytest.fixture(scope="module")
def foreign_dry_pendulum() -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return input and angle of J = 0.1, b = 0.05, mgl = 1, Fc = 0.05 by the semi-implicit Euler method, by use."""
    made = {}
    for role, use in enumerate(("estimation", "validation")):
        rng, n, dt = np.random.default_rng([5, role]), 300, 0.02
        t = np.arange(n) * dt
        u = sum(0.1 * np.cos(2 * np.pi * f * t + rng.uniform(0, 6)) for f in np.arange(0.1, 1.5, 0.1))
        q, v, y = 0.1, 0.0, np.empty(n)
        for k in range(n):
            y[k] = q
            for _ in range(20):
                v += dt / 20 * (u[k] - 0.05 * v - np.sin(q) - 0.05 * np.tanh(v / 0.002)) / 0.1
                q += dt / 20 * v
        made[use] = (u, y + 1e-3 * rng.standard_normal(n))
    return made
