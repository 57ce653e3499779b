"""What the command loads: packages that a plain diagnosis does without cost a user half a second each time."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from sysid_lab.folder import write_record
from sysid_lab.plan import Task
from sysid_lab.records import make_records

pytestmark = pytest.mark.slow  # whole loops

ASK = """
import sys
from harness.command import main
try:
    main(sys.argv[1:])
except SystemExit as end:
    print("status", end.code)
print("loaded", *(name for name in ("pandas", "control", "cvxpy", "torch") if name in sys.modules))
"""


@pytest.mark.slow
def test_a_diagnosis_loads_what_it_needs(tmp_path: Path) -> None:
    task = Task("none", "pendulum", "laws", (), "", "high", 0.0, 0, 0)
    write_record(tmp_path / "record", "record", task, make_records(task, samples=1000))
    words = ["close-loop", str(tmp_path / "record" / "dataset.toml"), "--out", str(tmp_path / "out")]
    done = subprocess.run([sys.executable, "-c", ASK, *words], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-2:] == ["status 0", "loaded"], done.stdout + done.stderr
