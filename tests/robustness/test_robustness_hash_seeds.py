"""The order of sets and the seed of hashes decide nothing; a folder that may not be written to is one line."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from plants.mockups import mockup

pytestmark = pytest.mark.slow  # whole commands

MAIN = [sys.executable, "-c", "from harness.command import main; main()"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with two records of a pendulum with dry friction, 300 rows at 50 Hz."""
    where = tmp_path_factory.mktemp("seeds")
    for role, name in enumerate(("estimation", "validation")):
        rng, dt = np.random.default_rng([7, role]), 0.02
        t = np.arange(300) * dt
        u = sum(0.1 * np.cos(2 * np.pi * f * t + rng.uniform(0, 6)) for f in np.arange(0.1, 1.5, 0.1))
        q, v, rows = 0.1, 0.0, []
        for k in range(len(t)):
            rows.append(f"{t[k]:.2f},{u[k]!r},{q + 1e-3 * rng.standard_normal()!r}\n".replace("np.float64", ""))
            for _ in range(20):
                v += dt / 20 * (u[k] - 0.05 * v - np.sin(q) - 0.05 * np.tanh(v / 0.002)) / 0.1
                q += dt / 20 * v
        text = "".join(rows).replace("(", "").replace(")", "")
        (where / f"{name}.csv").write_text("t [s],u [N m],theta [rad]\n" + text)
    return where


def test_a_report_is_the_same_under_another_hash_seed(folder: Path) -> None:
    reports = []
    for seed in ("0", "12345"):
        out = folder / f"out-{seed}"
        call = [*MAIN, "close-loop", "estimation.csv", "--validation", "validation.csv", "--model", "pendulum",
                "--input", "u", "--output", "theta", "--out", str(out)]  # fmt: skip
        done = subprocess.run(
            call, cwd=folder, env={**os.environ, "PYTHONHASHSEED": seed}, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        report = json.loads((out / "report.json").read_text())
        del report["seconds"]
        reports.append(report)
    assert reports[0] == reports[1]


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_that_may_not_be_written_to_is_one_line(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    try:
        call = [*MAIN, "simulate", str(mockup("pendulum")), "--stop", "0.1", "-o", str(tmp_path / "run.csv")]
        done = subprocess.run(call, capture_output=True, text=True, check=False)
    finally:
        tmp_path.chmod(0o700)
    assert done.returncode == 2
    assert len(done.stderr.strip().splitlines()) <= 2
    assert "Traceback" not in done.stderr
