"""Two runs on one folder: the second is one line, and what the first had done when it was killed is not done again."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytestmark = [
    pytest.mark.slow,  # whole commands
    pytest.mark.skipif(os.name != "posix", reason="signals of POSIX"),
]

MAIN = [sys.executable, "-c", "from harness.command import main; main()"]
SUITE = """
name = "at-once"
seeds = [0, 1, 2, 3, 4, 5, 6, 7]
[[groups]]
plants = [{ id = "linear-ode" }]
scenarios = [{ id = "prbs", options = { samples = 4000, amplitude = 1.0 } }]
identifiers = [{ id = "arx" }, { id = "hold" }]
"""


def sysid(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([*MAIN, *words], cwd=folder, capture_output=True, text=True, check=False, timeout=300)


def test_a_second_run_is_refused_and_a_killed_one_is_resumed_to_the_same_table(tmp_path: Path) -> None:
    (tmp_path / "suite.toml").write_text(SUITE)
    command = ["bench", "suite.toml", "--workers", "1", "--out"]
    with subprocess.Popen(
        [*MAIN, *command, "out"], cwd=tmp_path, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        start_new_session=True,
    ) as first:  # fmt: skip
        shards = tmp_path / "out" / "shards"
        end = time.monotonic() + 120.0
        while not (shards.is_dir() and any(shards.glob("*.json"))):
            assert first.poll() is None, "it ended before it was killed"
            assert time.monotonic() < end
            time.sleep(0.02)
        os.killpg(first.pid, signal.SIGSTOP)  # it holds the folder for as long as the second one takes
        try:
            second = sysid(tmp_path, *command, "out", "--resume")
        finally:
            os.killpg(first.pid, signal.SIGKILL)
    assert second.returncode == 2, second.stderr
    (line,) = second.stderr.strip().splitlines()
    assert "another run writes into the folder" in line
    again = sysid(tmp_path, *command, "out", "--resume")
    assert again.returncode == 0, again.stderr
    assert sysid(tmp_path, *command, "whole").returncode == 0
    tables = [(tmp_path / name / "results.parquet").read_bytes() for name in ("out", "whole")]
    assert tables[0] == tables[1]
