"""The command line as a person meets it: Ctrl-C, full disks, mistyped options, lists, completion, narrow windows."""

from __future__ import annotations

import errno
import importlib.metadata
import importlib.util
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from harness import api, registry
from harness.command import main
from harness.errors import InputError

COMMAND = [  # Ctrl-C is heard also where the tests were started in the background, which ignores it
    sys.executable,
    "-c",
    "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); from harness.command import main; main()",
]


def sysid(*arguments: object, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [*COMMAND, *map(str, arguments)],
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
        env={**os.environ, **environment},
    )


def test_the_package_runs_as_the_command() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "harness", "list", "effects"], capture_output=True, text=True, check=False, timeout=120
    )
    assert done.returncode == 0, done.stderr
    assert "drifting_damping" in done.stdout


def ended(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> tuple[int, str]:
    """Return the status and the one line on standard error."""
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    error = capsys.readouterr().err
    assert len(error.strip().splitlines()) == 1, error
    assert isinstance(caught.value.code, int)
    return caught.value.code, error


@pytest.mark.parametrize("disguise", [RuntimeError, ImportError, InputError, KeyboardInterrupt, SystemError])
def test_ctrl_c_is_no_fault_whatever_a_library_makes_of_it(
    disguise: type[BaseException], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def hit(*_: object, **__: object) -> None:
        try:
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(5.0)
        except KeyboardInterrupt as error:
            if disguise is InputError:
                raise InputError("a", expected="b", got="c", remedy="d") from error
            raise disguise("from a callback") from error

    monkeypatch.setattr(api, "list_parts", hit)
    inherited = signal.signal(signal.SIGINT, signal.default_int_handler)  # started in the background it is ignored
    try:
        status, line = ended(["list"], capsys)
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, inherited)
    assert status == 130
    assert "interrupted" in line


def test_ctrl_c_during_the_first_imports(tmp_path: Path) -> None:
    (tmp_path / "typer.py").write_text("import os, signal, time\nos.kill(os.getpid(), signal.SIGINT)\ntime.sleep(9)\n")
    paths = os.pathsep.join([str(tmp_path), *filter(None, [os.environ.get("PYTHONPATH")])])
    done = sysid("list", PYTHONPATH=paths)
    assert (done.returncode, done.stderr) == (130, "sysid: interrupted\n")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no /dev/full")
def test_a_full_disk_is_the_users_and_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    out = tmp_path / "run.csv"
    (tmp_path / "run.csv.part").symlink_to("/dev/full")
    short = ["simulate", "pendulum-ode", "--scenario", "multisine", "-S", "duration=2.0", "-o"]
    status, line = ended([*short, str(out)], capsys)
    assert status == 2
    assert f"{out}: the system refuses" in line
    assert "no space left on device; remedy: make room" in line
    assert list(tmp_path.iterdir()) == []

    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("pyarrow.parquet.write_table", full)
    status, line = ended([*short, str(tmp_path / "run.parquet")], capsys)
    assert status == 2
    assert "run.parquet" in line
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_cannot_be_written_to_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    (tmp_path / "file").write_text("")
    status, line = ended(["bench", "smoke", "--out", str(tmp_path / "file" / "x")], capsys)
    assert status == 2
    assert str(tmp_path / "file") in line

    def refused(self: Path, *_: object, **__: object) -> None:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(self))

    monkeypatch.setattr(Path, "write_text", refused)
    status, line = ended(
        ["simulate", "pendulum-ode", "--scenario", "multisine", "-S", "duration=1.0", "-o", str(tmp_path / "a.csv")],
        capsys,
    )
    assert status == 2
    assert "permission denied; remedy: choose a folder that you may write to" in line


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--option", "joint_frction=0.1"], "did you mean joint_friction for joint_frction?"),
        (
            ["--option", "joint_friction=high"],
            "joint_friction: option of one_joint_arm: expected a number or a list ([1, 2]), got 'high'",
        ),
        (["--option", "mass=heavy"], "mass: option of plant 'arm-bullet': expected a number, got 'heavy'"),
        (["-S", "duraton=3.0"], "did you mean duration for duraton?"),
        (["-S", "duration=long"], "duration: option of scenario 'multisine': expected a number"),
        (["-S", "duration=true"], "expected a number"),
    ],
)
def test_options_are_refused_in_words(arguments: list[str], words: str, capsys: pytest.CaptureFixture[str]) -> None:
    status, line = ended(["simulate", "arm-bullet", "--scenario", "multisine", *arguments], capsys)
    assert status == 2
    assert words in line
    assert "Error" not in line


@pytest.mark.parametrize("kind", ["plants", "identifiers", "scenarios"])
def test_no_option_of_any_part_answers_with_words_of_python(kind: str) -> None:
    for entry in registry.entries(kind):
        for name in registry.named_options(kind, entry.id):
            for value in ("nonsense", [["x"]], {"a": "b"}, True):
                needed = {
                    other: "pendulum-ode"
                    for other, one in registry.named_options(kind, entry.id).items()
                    if one.default is one.empty and other != name
                }
                said = ""
                try:
                    getattr(registry.create(kind, entry.id, **needed, **{name: value}), "close", lambda: None)()
                except InputError as error:
                    said = str(error)
                assert "Error" not in said, (entry.id, name, value, said)


def test_lists_show_text() -> None:
    for rows in api.list_parts().values():
        for row in rows:
            assert "``" not in row["summary"]
            assert ":class:" not in row["summary"]
            assert row["summary"]


def test_a_plant_whose_engine_is_not_there_is_marked(
    monkeypatch: pytest.MonkeyPatch, sysid: Callable[..., Any]
) -> None:
    """As PyBullet has no wheels for Python 3.12 and later."""
    found = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *more: None if name == "pybullet" else found(name, *more)
    )
    needed = {row["id"]: row["needs"] for row in api.list_parts("plants")["plants"]}
    marked = {name for name, package in needed.items() if package}
    assert {name for name in needed if name.endswith("-bullet")} <= marked
    assert not marked & {"arm-mujoco", "cart-pole-pymunk", "pendulum-fmu", "pendulum-ode"}
    assert "(needs pybullet, which is not installed)" in " ".join(sysid("list", "plants").out.split())


@pytest.mark.parametrize("place", ["__init__.py", "part.py"])
def test_a_plug_in_says_itself_what_it_needs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, place: str) -> None:
    """Whatever it is called, and without being imported."""
    folder = tmp_path / "somebodys_own"
    folder.mkdir()
    (folder / "__init__.py").write_text("")
    (folder / "part.py").write_text("import no_such_engine\n")
    with (folder / place).open("a") as file:
        file.write('NEEDS = ("json", "no_such_engine")\n')
    monkeypatch.syspath_prepend(tmp_path)
    point = importlib.metadata.EntryPoint("odd", "somebodys_own.part:Plant", "sysid_harness.plants")
    monkeypatch.setattr(registry, "entries", lambda kind: (registry.Entry(kind, "odd", point.value, "theirs", point),))
    assert [row["needs"] for row in api.list_parts("plants")["plants"]] == ["no_such_engine"]


def test_a_unit_in_brackets_is_no_markup(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = "".join(f"{0.01 * k},{(-1) ** (k // 7)},{0.001 * k * (60 - k)}\n" for k in range(60))
    (tmp_path / "run.csv").write_text("time [s],u [N m],theta [rad]\n" + rows)
    with pytest.raises(SystemExit) as caught:
        main(["identify", str(tmp_path / "run.csv"), "--model", "pendulum", "--identifier", "hold"])
    assert caught.value.code == 0
    assert "rad)" in capsys.readouterr().out


def test_linear_fits_print_coefficients_intervals_rank_and_order(tmp_path: Path, sysid: Callable[..., Any]) -> None:
    rng = np.random.default_rng(0)
    u, y = rng.normal(size=300), np.zeros(300)
    for k in range(299):
        y[k + 1] = 0.8 * y[k] + u[k] + 0.05 * rng.normal()
    np.savetxt(
        tmp_path / "run.csv", np.column_stack([np.arange(300) * 0.1, u, y]), "%.9f", ",", header="t,u,y", comments=""
    )
    (tmp_path / "dataset.toml").write_text(
        'name = "a lag"\nsample_time = 0.1\n[time]\ncolumn = "t"\n[signals.u]\nrole = "input"\nunit = "V"\n'
        '[signals.y]\nrole = "output"\nunit = "m"\n[[runs]]\nfile = "run.csv"\n'
    )
    said = {}
    for name in ("arx", "ho-kalman", "stlsq"):
        said[name] = sysid("identify", tmp_path / "dataset.toml", "--identifier", name).out
    assert re.search(r"y on u = 1\.\d+ m/V \[0\.9\d+, 1\.0\d+\]", said["arx"])
    assert "rank 3 of 3" in said["arx"]
    assert "condition number" in said["arx"]
    assert "1 state, spectral radius 0.8" in said["arx"]
    assert "Hankel singular values" in said["ho-kalman"]
    assert "hankel noise " in said["ho-kalman"]
    assert re.search(r"order \d", said["ho-kalman"])
    assert re.search(r"\n  Order error: 1 0\.\d+, 2 \d", said["stlsq"])
    assert "y' = " in said["stlsq"]


def test_a_narrow_terminal_still_shows_every_word(monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    from rich.console import Console

    from harness.cli import results

    monkeypatch.setattr(results, "wide_console", lambda: Console(width=40, markup=False, highlight=False))
    results.print_parts(api.list_parts("effects"))
    shown = capsys.readouterr().out
    assert max(map(len, shown.splitlines())) <= 40
    flat = " ".join(shown.split())
    for row in api.list_parts("effects")["effects"]:
        assert row["id"] in flat
        assert " ".join(row["summary"].split()) in flat or len(row["summary"]) > 36


@pytest.mark.parametrize("width", [20, 40, 60, 100])
def test_no_number_of_a_table_is_cut(width: int, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    from rich.console import Console

    import harness.cli.terminal as terminal

    monkeypatch.setattr(terminal, "wide_console", lambda: Console(width=width, markup=False, highlight=False))
    row = {"identifier": "ho-kalman", "order": 12, "nrmse": 1.2345e-05, "free_run": None, "sound": True}
    terminal.print_rows([{**row, "note": "the input does not excite all lags, so that nothing can be said of it"}])
    shown = capsys.readouterr().out
    assert max(map(len, shown.splitlines())) <= width
    assert all(word in shown for word in ("ho-kalman", "12", "1.234e-05", "yes"))
    assert "None" not in shown
    assert "so that nothing can be said of it" in " ".join(shown.split())


def test_a_shell_completes_ids() -> None:
    done = sysid(_SYSID_COMPLETE="complete_bash", COMP_WORDS="sysid identify x --identifier lum", COMP_CWORD="4")
    assert "lumped-momentum" in done.stdout, done.stderr
    assert "arx" not in done.stdout


def test_every_command_that_prints_a_result_prints_it_for_a_program(capsys: pytest.CaptureFixture[str]) -> None:
    from typer.main import get_command

    from harness.cli.app import app

    commands = get_command(app).commands  # type: ignore[attr-defined]
    silent = {"open", "study"}  # a page in the browser, and a sign-post
    for name, command in commands.items():
        options = {word for parameter in command.params for word in parameter.opts}
        assert ("--json" in options) is (name not in silent), name
    with pytest.raises(SystemExit):
        main(["equations", "pendulum", "--as", "python", "--json"])
    found = json.loads(capsys.readouterr().out)
    assert (found["model"], found["as"], found["wrote"]) == ("pendulum", "python", None)
    assert "def derivative" in found["text"]


def test_a_command_that_is_asked_for_is_built_alone_and_reads_the_same(capsys: pytest.CaptureFixture[str]) -> None:
    from harness.cli.app import _asked, app

    assert [one.callback.__name__ for one in _asked(app, ["close-loop", "x"]).registered_commands] == ["close_loop"]
    for words in ([], ["--help"], ["nothing"]):
        assert _asked(app, words) is app
    with pytest.raises(SystemExit):
        main(["simulat"])
    assert "Did you mean 'simulate'?" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["simulate", "--help"])
    assert "Usage: sysid simulate" in capsys.readouterr().out
