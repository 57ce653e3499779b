"""What a diagnosis costs a user: the command in a process of its own, with imports, compilers and report."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from harness.errors import InputError, PlantError
from sysid_lab.folder import write_record
from sysid_lab.plan import Task
from sysid_lab.records import Records

_COMMAND = "from harness.command import main; main()"
LIMIT = 600.0  # Seconds after which the command is abandoned.


def timed_command(task: Task, records: Records) -> dict[str, Any]:
    """Run ``sysid close-loop`` twice, with nothing compiled yet and again; return both CPU times and the answer.

    Counted is the whole tree of processes: the interpreter with its imports, compilers, workers and the report.

    Raises
    ------
    PlantError
        If the command fails or takes too long.
    """
    import json

    row: dict[str, Any] = {}
    with tempfile.TemporaryDirectory(prefix="sysid-cost-") as scratch:
        folder = Path(scratch)
        write_record(folder / "record", "record", task, records)
        environment = dict(os.environ, SYSID_HARNESS_CACHE=str(folder / "cache"))
        environment.pop("PYTHONDONTWRITEBYTECODE", None)  # what an installation has compiled, a user does not compile
        for column in ("cpu_cold_s", "cpu_s"):
            out = folder / column
            words = ["close-loop", str(folder / "record" / "dataset.toml"), "--out", str(out)]
            before, began = _cpu_of_children(), time.monotonic()
            try:
                done = subprocess.run(
                    [sys.executable, "-c", _COMMAND, *words],
                    env=environment, capture_output=True, text=True, timeout=LIMIT, check=False,
                )  # fmt: skip
            except subprocess.TimeoutExpired as error:
                raise PlantError(f"close-loop took longer than {LIMIT:g} s", status="timeout") from error
            if done.returncode:
                raise PlantError(f"close-loop failed: {done.stderr[-200:]}", status="crashed")
            row[column] = f"{_cpu_of_children() - before:.2f}"
            row["wall_s"] = f"{time.monotonic() - began:.2f}"
        report = json.loads((out / "report.json").read_text(encoding="utf-8"))
    row["verdict"] = report["verdict"]
    row["report"] = report
    return row


def _cpu_of_children() -> float:
    """Return the CPU seconds of all processes that this one, or one of them, has waited for.

    Raises
    ------
    InputError
        Where the system does not count them (Windows).
    """
    try:
        import resource
    except ImportError as error:
        raise InputError(
            "the cost of a diagnosis",
            expected="a system that counts the CPU time of child processes",
            got=sys.platform,
            remedy="run this part of the study on Linux or macOS",
        ) from error
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime
