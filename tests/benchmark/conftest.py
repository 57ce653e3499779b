"""A distribution of plug-ins that behave well, badly and terribly, installed for one test session in a folder."""

from __future__ import annotations

import contextlib
import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path

import pytest

from harness import registry
from harness.benchmark import BenchResult, bench

sys.path.insert(0, str(Path(__file__).parent))  # made rows are a module beside the tests

MODULE = '''
"""Plug-ins for the tests of the benchmark: ordinary ones, and one for each way to break."""

import ctypes
import errno
import os
import signal
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from harness.errors import FitError, PlantError
from harness.protocols import Hindsight
from harness.signals import Channel, PlantSpec

SPEC = PlantSpec((Channel("u", "V", -2.0, 2.0),), (Channel("y", "m"),), 0.1)


class Lag:
    """First-order lag."""

    spec = SPEC
    abilities = frozenset()
    made = 0

    def __init__(self, pole: float = 0.8, fail: str = ""):
        self.pole, self.fail, self.count = pole, fail, 0
        type(self).made += 1

    def __enter__(self):
        return self

    def __exit__(self, *exc):
        self.close()

    def close(self):
        pass

    def reset(self, *, rng, x0=None):
        self.x = 0.0
        return np.array([self.x])

    def step(self, u):
        self.count += 1
        if self.count > 20:
            misbehave(self.fail)
        self.x = self.pole * self.x + (1 - self.pole) * float(u[0])
        return np.array([self.x])


def misbehave(how):
    if how == "raise":
        raise ZeroDivisionError("by intent")
    if how == "diverge":
        raise PlantError("an output is not finite at t = 2 s", status="diverged")
    if how == "hang":
        time.sleep(1000)
    if how == "hang-in-c":
        ctypes.PyDLL(None).sleep(1000)  # holds the interpreter's lock: only a C thread or a kill can end it
    if how == "segfault":
        ctypes.string_at(0)
    if how == "kill":
        os.kill(os.getpid(), signal.SIGKILL)
    if how == "exit":
        os._exit(7)
    if how == "exit-well":
        os._exit(0)
    if how == "descriptors":
        os.closerange(3, 200)
    if how == "standard-lines":
        os.closerange(0, 3)
    if how == "surroundings":
        os.chdir("/")
        os.environ.clear()
        sys.path.clear()
    if how == "fork" and os.fork() == 0:
        time.sleep(600)
        os._exit(0)
    if how == "fork-back":
        os.fork()
    if how == "daemon" and os.fork() == 0:
        os.setsid()
        if os.fork() == 0:
            time.sleep(600)
        os._exit(0)
    if how == "interrupt":
        raise KeyboardInterrupt
    if how == "untold":
        class Untold(BaseException):
            def __str__(self):
                raise ValueError("no text")
            def __reduce__(self):
                raise TypeError("no pickle")
        raise Untold
    if how.startswith("full-disk ") and Path(how.partition(" ")[2]).exists():
        try:
            raise OSError(errno.ENOSPC, "No space left on device", "/scratch/x")
        except OSError as error:
            raise RuntimeError("the compiler failed") from error
    if how == "sys-exit":
        sys.exit("leaving")
    if how == "unfit":
        raise FitError("too little", expected="more", got="less", remedy="record more")


@dataclass(frozen=True)
class Model:
    spec: PlantSpec
    a: float
    b: float
    burn_in: int = 1

    def initial_state(self, data):
        return data.y[0].copy()

    def output(self, x, u):
        return x

    def step(self, x, u):
        return self.a * x + self.b * u

    def correct(self, x, u, y):
        return y

    def to_dict(self):
        return {"kind": "test-model", "a": self.a, "b": self.b}


@dataclass(frozen=True)
class Fit:
    """Least squares for the first-order lag; breaks on request."""

    fail: str = ""
    nap: float = 0.0

    def fit(self, trajectories, *, rng):
        assert all(trajectory.x is None for trajectory in trajectories)
        time.sleep(self.nap)
        misbehave(self.fail)
        rows = np.vstack([np.column_stack([r.y[:-1], r.u[:-1]]) for r in trajectories])
        goal = np.concatenate([r.y[1:, 0] for r in trajectories])
        a, b = np.linalg.lstsq(rows, goal, rcond=None)[0]
        if self.fail == "unstable":
            a = 1e3
        return Model(trajectories[0].spec, float(a), float(b))


@dataclass(frozen=True)
class Online:
    """Predicts the last output; hindsight is the best constant gain on it."""

    def init(self, spec, *, rng):
        return np.zeros(spec.ny)

    def start(self, state, y):
        return y.copy()

    def predict(self, state, u):
        return state

    def update(self, state, u, y):
        return y.copy()

    def hindsight(self, trajectories):
        before = np.concatenate([r.y[:-1] for r in trajectories])
        after = np.concatenate([r.y[1:] for r in trajectories])
        gain = float((before * after).sum() / (before**2).sum())
        return Hindsight(((after - gain * before) ** 2).sum(axis=1), True)


class Nothing:
    """Neither fits nor learns online."""
'''

ENTRY_POINTS = """
[sysid_harness.plants]
test-lag = bench_plugins:Lag
[sysid_harness.identifiers]
test-fit = bench_plugins:Fit
test-online = bench_plugins:Online
test-nothing = bench_plugins:Nothing
"""


@pytest.fixture(scope="session")
def plugin_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write the distribution."""
    folder = tmp_path_factory.mktemp("bench-plugins")
    (folder / "bench_plugins.py").write_text(textwrap.dedent(MODULE))
    info = folder / "bench_plugins-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: bench-plugins\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(ENTRY_POINTS)
    return folder


@contextlib.contextmanager
def found(folder: Path) -> Iterator[Path]:
    """Let the registry find the plug-ins, here and in the workers (which take over sys.path)."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(folder))
        registry._all.cache_clear()
        try:
            yield folder
        finally:
            registry._all.cache_clear()
            sys.modules.pop("bench_plugins", None)


@pytest.fixture
def plugins(plugin_folder: Path) -> Iterator[Path]:
    """Let the registry find the plug-ins in a test."""
    with found(plugin_folder) as folder:
        yield folder


GOOD = """
name = "trial"
seeds = [0, 1]
[[groups]]
plants = [{id = "test-lag"}, {id = "test-lag", label = "slow lag", options = {pole = 0.98}}]
scenarios = [{id = "prbs", options = {samples = 200, noise = 0.01}}]
identifiers = [{id = "test-fit"}, {id = "test-online"}]
"""


@pytest.fixture(scope="session")
def good(plugin_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> BenchResult:
    """Return a benchmark of ordinary plug-ins, run once by two workers; its suite lies above its folder."""
    folder = tmp_path_factory.mktemp("good")
    (folder / "trial.toml").write_text(GOOD)
    with found(plugin_folder):
        return bench(folder / "trial.toml", out=folder / "out", workers=2)
