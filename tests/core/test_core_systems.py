"""What systems differ in: no POSIX calls, no compiler; the package works, and says what it costs."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from harness.fmi import build

WITHOUT = """
import multiprocessing, os, signal, subprocess, sys, tempfile
import platformdirs  # theirs: it asks the system itself
for name in ("resource", "fcntl", "pwd", "grp", "termios", "tty", "pty", "posix_ipc"):
    sys.modules[name] = None
for name in ("killpg", "fork", "forkpty", "setsid", "getuid", "geteuid", "sched_getaffinity", "getpgid", "setpgid"):
    if hasattr(os, name):
        delattr(os, name)
for name in ("SIGALRM", "setitimer", "alarm", "SIGHUP", "SIGUSR1", "pthread_sigmask"):
    if hasattr(signal, name):
        delattr(signal, name)
"""

MODULES = """
import importlib, pkgutil, re
import harness, identifiers, plants, scenarios
from pathlib import Path
names = re.compile("resource|fcntl|killpg|sched_getaffinity|getuid|setsid|SIGKILL|SIGALRM|fork|os\\\\.name|platform")
for package in (harness, identifiers, plants, scenarios):
    for found in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
        file = Path(found.module_finder.path, found.name.rpartition(".")[2] + ".py")
        if file.is_file() and names.search(file.read_text(encoding="utf-8")):
            importlib.import_module(found.name)
from harness import api
from harness.jobs import make_engine
assert make_engine("local", None).workers >= 1
record = api.simulate("linear-ode", scenario="prbs", scenario_options={"duration": 10.0})
print(api.identify(record).equation_error["validation"][0].nrmse)
from plants.isolation.isolated import isolated
isolated("linear-ode").close()
"""


@pytest.mark.skipif(os.name != "posix", reason="the calls are missing here anyway")
def test_the_package_works_where_posix_calls_are_missing(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT + MODULES],
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
        cwd=tmp_path,
    )
    assert done.returncode == 0, done.stderr[-2000:]


def test_a_compiler_is_looked_for_under_all_its_names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("SYSID_HARNESS_NO_COMPILER", raising=False)
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(build.importlib.util, "find_spec", lambda name: None)
    assert build.compiler() is None
    monkeypatch.setattr(build.importlib.util, "find_spec", lambda name: name == "ziglang" or None)
    assert build.compiler() == (sys.executable, "-m", "ziglang", "cc", "-fno-sanitize=undefined")
    for name in ("clang", "cc", "gcc"):
        program = tmp_path / name
        program.write_text("#!/bin/sh\n", encoding="utf-8")
        program.chmod(0o755)
        assert build.compiler() == (str(program),)
    monkeypatch.setenv("CC", "clang -m64")
    assert build.compiler() == (str(tmp_path / "clang"), "-m64")
    monkeypatch.setenv("SYSID_HARNESS_NO_COMPILER", "1")
    assert build.compiler() is None


def test_what_a_missing_compiler_costs_is_said_once(tmp_path: Path) -> None:
    code = (
        "import numpy as np\nfrom harness.physics import load_model\n"
        "for name in ('pendulum', 'drive'):\n    load_model(name).simulator(0.01).prepare()\n"
    )
    environment = {**os.environ, "SYSID_HARNESS_NO_COMPILER": "1"}
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
        timeout=120,
        cwd=tmp_path,
        env=environment,
    )
    assert done.stderr.count("no C compiler was found") == 1
    assert "sysid-harness[compiler]" in done.stderr
