"""Plants in a child process: the same numbers, and every kind of sudden death becomes a named status, quickly."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from harness.errors import InputError, PlantError
from plants.fmu.mockups import pendulum_fmu
from plants.isolation.isolated import IsolatedPlant, isolated

RNG = np.random.default_rng(0)
MODES = (
    "well segfault aborts exits hangs returns_nan chatters discards terminates fails fatal warns halves crawls pends "
    "fails_start crashes_start hangs_start"
).split()


def waves(n: int) -> np.ndarray:
    """A torque that swings the pendulum."""
    return 0.5 * np.sin(0.05 * np.arange(n)).reshape(-1, 1)


def test_gives_the_numbers_of_the_direct_plant() -> None:
    u = waves(3000)
    with pendulum_fmu() as direct:
        first = direct.reset(rng=RNG, x0={"theta": 1.0})
        expected = np.vstack([first, direct.rollout(u)])
        spec, truth = direct.spec, direct.truth()
    with isolated("pendulum-fmu", timeout=20.0) as plant:
        assert plant.spec == spec
        assert plant.abilities == {"batch", "snapshots", "truth", "batch-truth"}
        first = plant.reset(rng=RNG, x0={"theta": 1.0})
        assert np.array_equal(np.vstack([first, plant.rollout(u)]), expected)
        assert np.array_equal(plant.truth(), truth)
        plant.reset(rng=RNG, x0={"theta": 1.0})
        assert np.array_equal(np.array([plant.step(row) for row in u[:50]]), expected[1:51])
        taken = plant.get_state()
        plant.rollout(u[:100])
        plant.set_state(taken)
        assert np.array_equal(plant.rollout(u[50:100]), expected[51:101])


def test_a_step_that_takes_much_longer_than_those_before_ends_soon(odd_fmu: Callable[..., Path]) -> None:
    options = {"path": str(odd_fmu("hostile")), "sample_time": 0.01, "parameters": {"mode": 4, "when": 9.0}}
    with IsolatedPlant("fmu", options, timeout=60.0) as plant:
        plant.reset(rng=RNG)
        plant.rollout(np.ones((800, 1)))
        began = time.monotonic()
        with pytest.raises(PlantError, match=r"the step from t = 9 s does not end within [2-9].* the option timeout"):
            plant.rollout(np.ones((800, 1)))
        assert time.monotonic() - began < 15.0


@pytest.mark.parametrize(
    ("mode", "status", "words"),
    [
        ("segfault", "crashed", "SIGSEGV"),
        ("aborts", "crashed", "SIGABRT"),
        ("exits", "crashed", "exited with status 0"),
        ("hangs", "timeout", "within 1 s|no answer"),
        ("returns_nan", "diverged", "not finite"),
        ("discards", "crashed", "discarded"),
        ("crawls", "timeout", "does not end|no answer"),
        ("terminates", "terminated", "ends the simulation"),
        ("fatal", "crashed", "fatal"),
    ],
)
def test_hostile_fmus_end_with_a_status(
    mode: str, status: str, words: str, odd_fmu: Callable[..., Path], temporary_folder: Path
) -> None:
    options = {"path": str(odd_fmu("hostile")), "sample_time": 0.01, "parameters": {"mode": MODES.index(mode)}}
    plant = IsolatedPlant("fmu", options, timeout=1.0)
    for many in (True, False):
        plant.reset(rng=RNG)
        started = time.monotonic()
        with pytest.raises(PlantError, match=words) as caught:
            plant.rollout(np.ones((9, 1))) if many else [plant.step(np.ones(1)) for _ in range(9)]
        assert caught.value.status == status
        assert "\n" not in str(caught.value)
        assert time.monotonic() - started < 5.0
    plant.close()
    assert list(temporary_folder.iterdir()) == []


@pytest.mark.parametrize(
    ("mode", "status", "words"),
    [
        ("fails_start", "crashed", "told to fail"),
        ("crashes_start", "crashed", "SIGSEGV"),
        ("hangs_start", "timeout", "1 s"),
    ],
)
def test_hostile_starts(
    mode: str, status: str, words: str, odd_fmu: Callable[..., Path], temporary_folder: Path
) -> None:
    options = {"path": str(odd_fmu("hostile")), "sample_time": 0.01, "parameters": {"mode": MODES.index(mode)}}
    with IsolatedPlant("fmu", options, timeout=1.0) as plant:
        with pytest.raises(PlantError, match=words) as caught:
            plant.reset(rng=RNG)
        assert caught.value.status == status
    assert list(temporary_folder.iterdir()) == []


def test_chatter_on_stdout_disturbs_nobody(odd_fmu: Callable[..., Path], capfd: pytest.CaptureFixture[str]) -> None:
    options = {"path": str(odd_fmu("hostile")), "sample_time": 0.01, "parameters": {"mode": MODES.index("chatters")}}
    with IsolatedPlant("fmu", options) as plant:
        plant.reset(rng=RNG)
        assert plant.rollout(np.ones((5, 1)))[-1] == pytest.approx([0.05])
    assert capfd.readouterr().out == ""


def test_errors_keep_their_kind_and_the_child_lives_on() -> None:
    with isolated("pendulum-fmu") as plant:
        with pytest.raises(InputError, match="did you mean theta"):
            plant.reset(rng=RNG, x0={"thea": 1.0})
        plant.reset(rng=RNG)
        for bad in (np.zeros(2), np.array([np.nan])):
            with pytest.raises(InputError):
                plant.step(bad)
        with pytest.raises(InputError, match=r"\(N, 1\)"):
            plant.rollout(np.zeros((3, 2)))
        plant.step(np.zeros(1))
        old = plant.get_state()
        plant._child.process.kill()  # type: ignore[union-attr]
        with pytest.raises(PlantError, match="SIGKILL"):
            plant.step(np.zeros(1))
        with pytest.raises(InputError, match="without a process"):
            plant.step(np.zeros(1))
        plant.reset(rng=RNG)
        with pytest.raises(InputError, match="another process"):
            plant.set_state(old)
    with pytest.raises(InputError, match="closed"):
        plant.reset(rng=RNG)


def test_bad_orders_are_refused() -> None:
    with pytest.raises(InputError, match="unknown plant"):
        isolated("no-such-plant")
    with pytest.raises(InputError, match="cannot travel"):
        IsolatedPlant(lambda: pendulum_fmu())
    with pytest.raises(InputError, match="timeout"):
        isolated("pendulum-fmu", timeout=0.0)
    with pytest.raises(
        InputError, match=r"options of the plant 'pendulum-fmu'.*sample_time.*got colour='red'; remedy: remove colour"
    ):
        isolated("pendulum-fmu", colour="red")


def test_recycles_its_child() -> None:
    with IsolatedPlant("pendulum-fmu", recycle=1) as plant:
        pids = set()
        for _ in range(2):
            plant.reset(rng=RNG)
            pids.add(plant._child.process.pid)  # type: ignore[union-attr]
        assert len(pids) == 2


TREACHEROUS = """
import os, pickle, socket, struct, sys
import numpy as np
from plants.equations.linear import LinearPlant

class Bomb:
    def __reduce__(self):
        return os.system, ("touch " + os.environ["TREASON"],)

class Traitor(LinearPlant):
    def __init__(self, how):
        super().__init__(A=[[0.5]], B=[[1.0]], C=[[1.0]], D=[[0.0]], sample_time=0.1)
        self.how = how

    def reset(self, *, rng, x0=None):
        pipe = socket.socket(fileno=os.dup(int(sys.argv[1])))
        body = {
            "pickle": pickle.dumps((True, Bomb())),
            "too long": b"",
            "too few": b"\\x81\\xa6values\\xc4\\x00",
            "half": b"",
        }[self.how]
        length = {"too long": 1 << 40, "half": 1000}.get(self.how, len(body))
        pipe.sendall(struct.pack("<Q", length) + body)
        return np.zeros(1)
"""


@pytest.mark.parametrize(
    ("how", "words"),
    [("pickle", "no answer"), ("too long", "SIGKILL|closed|exited"), ("too few", "no answer"), ("half", "within 1 s")],
)
def test_what_a_child_sends_is_never_executed(
    how: str, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "treachery.py").write_text(TREACHEROUS)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("TREASON", str(tmp_path / "done"))
    with IsolatedPlant("treachery:Traitor", {"how": how}, timeout=1.0) as plant:
        with pytest.raises(PlantError, match=words):
            plant.reset(rng=RNG)
        assert plant._child is None
    assert not (tmp_path / "done").exists()


def test_a_child_works_in_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = "import os\nfrom plants.equations.linear import LinearPlant\n\ndef littering(where, path):\n"
    source += "    assert open(path).read() == 'here'\n    open('litter', 'w').close()\n"
    source += "    open(where, 'w').write(os.getcwd())\n"
    source += "    return LinearPlant(A=[[0.5]], B=[[1.0]], C=[[1.0]], D=[[0.0]], sample_time=0.1)\n"
    (tmp_path / "litters.py").write_text(source)
    (tmp_path / "data.txt").write_text("here")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    with IsolatedPlant("litters:littering", {"where": str(tmp_path / "told"), "path": "data.txt"}) as plant:
        plant.reset(rng=RNG)
    assert not (tmp_path / "litter").exists()
    assert not Path((tmp_path / "told").read_text()).exists()


def test_a_hanging_child_does_not_outlive_its_caller(odd_fmu: Callable[..., Path], tmp_path: Path) -> None:
    code = (
        "import numpy as np, os, sys, threading\n"
        "from plants.isolation.isolated import IsolatedPlant\n"
        f"o = dict(path={str(odd_fmu('hostile'))!r}, sample_time=0.01, parameters=dict(mode=4, when=0.0))\n"
        "p = IsolatedPlant('fmu', o)\n"
        "p.reset(rng=np.random.default_rng(0))\n"
        "print(p._child.process.pid, flush=True)\n"
        "threading.Timer(0.5, os._exit, [0]).start()\n"
        "p.step(np.ones(1))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], env={**os.environ, "TMPDIR": str(tmp_path)}, stdout=subprocess.PIPE, check=True
    )
    pid = int(done.stdout)
    for _ in range(100):
        if not _alive(pid):
            break
        time.sleep(0.1)
    assert not _alive(pid)
    assert [p.name for p in tmp_path.iterdir() if p.name.startswith("sysid")] == []


def _alive(pid: int) -> bool:
    """Return True while a process runs (an unreaped one does not)."""
    try:
        return "\nState:\tZ" not in Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return False


HOLDS = """
import ctypes, pickle, socket, sys
from plants.isolation import child, frames
child.HELD = 1.0
child._made = lambda *options: ctypes.PyDLL(None).sleep(60)
caller, pipe = socket.socketpair()
frames.send(caller, pickle.dumps(("make", (pickle.dumps(()),), ())))
sys.argv = ["child", str(pipe.fileno())]
child.serve()
"""


@pytest.mark.skipif(not hasattr(signal, "setitimer"), reason="no alarm on this system")
def test_a_library_that_keeps_the_interpreter_to_itself_ends() -> None:
    """As one that never ends its loading: no thread of the child gets a turn to see that the caller has gone."""
    ended = subprocess.run([sys.executable, "-c", HOLDS], timeout=30, check=False)
    assert ended.returncode == -signal.SIGALRM
