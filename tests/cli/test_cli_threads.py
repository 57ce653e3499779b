"""A command of its own computes on one thread, unless its user says otherwise."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from harness.supervision.workers import THREAD_VARIABLES

SCRIPT = """
import os, sys
from harness.command import main
sys.argv = ["sysid", "--help"]
try:
    main()
except SystemExit:
    from threadpoolctl import threadpool_info
    import numpy
    print("threads", {library["num_threads"] for library in threadpool_info()})
"""


@pytest.mark.parametrize(("asked", "threads"), [(None, "{1}"), ("2", "{2}")])
def test_linear_algebra_of_a_command_runs_on_one_thread_unless_the_environment_says_more(
    asked: str | None, threads: str
) -> None:
    """Matrices of a diagnosis are small: on two busy cores more threads took a fifth more of CPU to wait."""
    environment = {name: value for name, value in os.environ.items() if name not in THREAD_VARIABLES}
    if asked is not None:
        environment |= dict.fromkeys(THREAD_VARIABLES, asked)
    done = subprocess.run([sys.executable, "-c", SCRIPT], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == f"threads {threads}"
