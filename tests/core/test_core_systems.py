"""What systems differ in: no POSIX calls, no compiler; the package works, and says what it costs."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path

import pytest

from harness.fmi import build

ELSEWHERE = """
import builtins, ctypes, os, signal, socket, sys, types

OURS = ("harness", "plants", "identifiers", "scenarios")
MODULES = "resource fcntl pwd grp termios tty pty syslog posix readline curses crypt".split()
LACKING = {
    os: "fork forkpty killpg setsid getsid setpgid getpgid getpgrp setpgrp getuid geteuid getgid getegid getgroups "
    "nice wait wait3 wait4 waitid WNOHANG uname getloadavg sched_getaffinity sched_setaffinity sched_yield sysconf "
    "mkfifo chown lchown statvfs pread pwrite sendfile O_NONBLOCK O_CLOEXEC O_DIRECTORY O_NOFOLLOW pipe2 openpty "
    "fchdir posix_spawn memfd_create register_at_fork",
    signal: "SIGKILL SIGALRM SIGHUP SIGUSR1 SIGUSR2 SIGSTOP SIGCONT SIGCHLD SIGPIPE SIGQUIT SIGTSTP setitimer alarm "
    "ITIMER_REAL pause pthread_kill pthread_sigmask sigwait siginterrupt",
    socket: "AF_UNIX",
}


def foreign(name):
    return str(name).partition(".")[0] not in OURS


class Windows(types.ModuleType):
    def __getattribute__(self, name):
        if not foreign(sys._getframe(1).f_globals.get("__name__", "")):
            if name in HIDDEN[object.__getattribute__(self, "__name__")]:
                raise AttributeError(f"Windows has no {name}")
            if name == "name" and object.__getattribute__(self, "__name__") == "os":
                return "nt"
        return object.__getattribute__(self, name)


HIDDEN = {module.__name__: set(names.split()) for module, names in LACKING.items()}
for module in LACKING:
    module.__class__ = Windows
imported, library = builtins.__import__, ctypes.CDLL.__init__


def imports(name, globals=None, *others, **more):
    if name in MODULES and not foreign((globals or {}).get("__name__", "")):
        raise ModuleNotFoundError(name)
    return imported(name, globals, *others, **more)


def loads(self, name, *others, **more):
    if name is None and not foreign(sys._getframe(1).f_globals.get("__name__", "")):
        raise TypeError("Windows has no library without a name")
    library(self, name, *others, **more)


builtins.__import__, ctypes.CDLL.__init__ = imports, loads
"""
"""As Windows looks to our own modules, in each process; others go on asking the system that is there."""


def python(folder: Path, environment: Mapping[str, str], *words: str) -> subprocess.CompletedProcess[str]:
    """Run Python in a folder; it has to succeed."""
    done = subprocess.run(
        [sys.executable, *words], capture_output=True, text=True, check=False, timeout=300, cwd=folder, env=environment
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return done


@pytest.fixture
def elsewhere(tmp_path: Path) -> Callable[..., str]:
    """Run Python where our modules see Windows; returns what it writes."""
    (tmp_path / "sitecustomize.py").write_text(ELSEWHERE, encoding="utf-8")
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join((str(tmp_path), str(Path(__file__).parents[2])))}

    return lambda *words: python(tmp_path, environment, *words).stdout


MODULES = """
import importlib, pkgutil, re
import harness, identifiers, plants, scenarios
from pathlib import Path
names = re.compile("resource|fcntl|killpg|setpgid|getpgid|setsid|sched_|getuid|SIGKILL|SIGALRM|fork|os\\.name|platform")
for package in (harness, identifiers, plants, scenarios):
    for found in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
        file = Path(found.module_finder.path, found.name.rpartition(".")[2] + ".py")
        if file.is_file() and names.search(file.read_text(encoding="utf-8")):
            importlib.import_module(found.name)
from harness.jobs import make_engine
assert make_engine("local", None).workers >= 1
"""
EVERYDAY = [
    "simulate pendulum-ode --scenario multisine --scenario-option duration=6 -o run.csv",
    "identify run.csv --input u --output theta -o model.json",
    "check-data run.csv --json",
    "close-loop run.csv --model pendulum --out report",
    "export report -o repaired.fmu",
    "check repaired.fmu",
    "simulate repaired.fmu --stop 1 -o fmu.csv",
    "bench smoke --workers 2 --out table",
]


def test_the_package_works_where_posix_calls_are_missing(elsewhere: Callable[..., str]) -> None:
    elsewhere("-c", MODULES)


@pytest.mark.slow  # a closed loop and a table with two workers
def test_the_everyday_commands_run_where_posix_calls_are_missing(elsewhere: Callable[..., str], tmp_path: Path) -> None:
    for words in EVERYDAY:
        elsewhere("-m", "harness", *words.split())
    report = json.loads((tmp_path / "report" / "report.json").read_text(encoding="utf-8"))
    assert report["verdict"] == "nothing_missing"
    rows = json.loads(elsewhere("-m", "harness", "query", "table", "select status from results", "--json"))
    assert {row["status"] for row in rows} == {"ok"}


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
    done = python(tmp_path, {**os.environ, "SYSID_HARNESS_NO_COMPILER": "1"}, "-c", code)
    assert done.stderr.count("no C compiler was found") == 1
    assert "sysid-harness[compiler]" in done.stderr
