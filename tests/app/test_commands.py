"""What is chosen on the page is a command line, and that command line runs."""

from __future__ import annotations

import shlex
import shutil
from pathlib import Path
from typing import Any

import pytest

from harness.app.commands import Choice, LogColumn, matched, ports_told, read_choice, spoken, words
from harness.app.reach import SessionFiles
from harness.cli.app import run
from harness.errors import InputError
from harness.supervision.interrupts import Interrupts
from plants.mockups import mockup


def columns(*given: tuple[str, ...]) -> list[LogColumn]:
    return [LogColumn(title, *rest) for title, *rest in given]  # type: ignore[arg-type]


def chosen(task: Any = "identify", log: str = "log.csv", **more: Any) -> Choice:
    more.setdefault("columns", columns(("time [s]", "time"), ("u [V]", "input"), ("y [m]", "output")))
    return Choice(task, log, **more)


def said(choice: Choice, reach: SessionFiles, monkeypatch: pytest.MonkeyPatch) -> str:
    assert reach.opened is not None
    monkeypatch.chdir(reach.opened)
    return spoken(words(choice, reach, shown=True))


def test_columns_are_named_and_the_command_runs_as_it_is_copied(
    reach: SessionFiles, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    line = said(chosen(options=["order=1"]), reach, monkeypatch)
    assert line == "sysid identify log.csv --input 'u [V]' --output 'y [m]' --option order=1"
    assert run(shlex.split(line)[1:], Interrupts()) == 0
    assert "NRMSE" in capsys.readouterr().out


def test_without_an_input_nothing_drives_the_output(reach: SessionFiles, monkeypatch: pytest.MonkeyPatch) -> None:
    line = said(chosen(columns=columns(("y [m]", "output"))), reach, monkeypatch)
    assert line == "sysid identify log.csv --output 'y [m]' --input none"


def test_without_an_output_there_is_nothing_to_run(reach: SessionFiles) -> None:
    with pytest.raises(InputError, match="which columns are outputs"):
        words(chosen(columns=columns(("u [V]", "input"))), reach)


def test_a_loop_without_a_model_starts_from_a_linear_one(reach: SessionFiles, monkeypatch: pytest.MonkeyPatch) -> None:
    assert "--model linear" in said(chosen("close-loop"), reach, monkeypatch)
    assert "--model" not in said(chosen("identify"), reach, monkeypatch)


def pendulum_log(folder: Path, header: str) -> str:
    (folder / "swing.csv").write_text(
        header + "\n" + "".join(f"{0.01 * k},{k % 7 - 3},{0.1 * (k % 11)}\n" for k in range(60))
    )
    return "swing.csv"


def test_columns_with_the_names_of_ports_go_without_saying(
    reach: SessionFiles, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = pendulum_log(folder, "time [s],u [N m],theta [rad]")
    assert matched(folder / log, "pendulum") == {"u [N m]": ("input", "u"), "theta [rad]": ("output", "theta")}
    own = columns(("u [N m]", "input", "u"), ("theta [rad]", "output", "theta"))
    choice = chosen("close-loop", log, model="pendulum", columns=own)
    assert said(choice, reach, monkeypatch) == "sysid close-loop swing.csv --model pendulum"


def test_other_columns_are_put_on_ports_with_units_and_the_clock(
    reach: SessionFiles, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    log = pendulum_log(folder, "Zeitpunkt,Moment [N m],Winkel")
    own = columns(
        ("Zeitpunkt", "time", "chosen", "ms"), ("Moment [N m]", "input", "u"), ("Winkel", "output", "theta", "deg")
    )
    line = said(chosen("check-data", log, model="pendulum", columns=own), reach, monkeypatch)
    assert line == (
        "sysid check-data swing.csv --model pendulum --column 'u=Moment [N m]' "
        "--column theta=Winkel --unit theta=deg --column time=Zeitpunkt --unit time=ms"
    )
    assert run(shlex.split(line)[1:], Interrupts()) == 0
    assert "Traceback" not in capsys.readouterr().err


def test_a_column_that_is_a_port_by_name_may_stay_unused(
    reach: SessionFiles, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    log = pendulum_log(folder, "u [N m],torque [N m],theta [rad]")
    own = columns(("torque [N m]", "input", "u"), ("theta [rad]", "output", "theta"))
    line = said(chosen("check-data", log, model="pendulum", columns=own, sample_time=0.01), reach, monkeypatch)
    assert line == (
        "sysid check-data swing.csv --model pendulum --input u --column 'u=torque [N m]' --output theta "
        "--column 'theta=theta [rad]' --sample-time 0.01"
    )
    assert run(shlex.split(line)[1:], Interrupts()) == 0
    assert "Traceback" not in capsys.readouterr().err


def test_what_begins_like_an_option_is_no_option(
    reach: SessionFiles, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (folder / "-x.csv").write_text("time [s],--out,y\n0,1,2\n")
    own = columns(("--out", "input"), ("y", "output"))
    line = said(chosen("identify", "-x.csv", columns=own), reach, monkeypatch)
    assert line == "sysid identify ./-x.csv --input=--out --output y"


def test_a_file_out_of_reach_is_in_no_command(reach: SessionFiles) -> None:
    for more in (
        {"log": "../secret.csv"},
        {"validation": "../secret.csv"},
        {"model": "../evil.fmu"},
        {"model": "evil.py:m"},
    ):
        with pytest.raises(InputError, match=r"outside of what was opened|no such file"):
            words(chosen("close-loop", **more), reach)


def test_an_fmu_runs_only_when_it_is_trusted(reach: SessionFiles, folder: Path) -> None:
    shutil.copyfile(mockup("pendulum", 2), folder / "theirs.fmu")
    log = pendulum_log(folder, "time [s],u [N m],theta [rad]")
    ports = ports_told("theirs.fmu", reach)["ports"]
    assert {"u", "theta"} <= {port["name"] for port in ports}
    own = columns(("u [N m]", "input", "u"), ("theta [rad]", "output", "theta"))
    with pytest.raises(InputError, match="an FMU is machine code"):
        words(chosen("close-loop", log, model="theirs.fmu", columns=own), reach)
    found = words(chosen("close-loop", log, model="theirs.fmu", columns=own, trusted=True), reach)
    assert found[-2:] == ["--trust", str(folder / "theirs.fmu")]


@pytest.mark.parametrize(
    "text", [b"", b"{}", b'{"task":"new","log":"a"}', b'{"task":"identify","log":"a","shell":"rm"}']
)
def test_what_the_page_does_not_send_is_refused(text: bytes) -> None:
    with pytest.raises(InputError, match="what was chosen"):
        read_choice(text)


@pytest.mark.parametrize("option", ["model=evil.py:m", "model=../evil.fmu", "weights=/etc/passwd"])
def test_an_option_that_names_code_or_a_file_elsewhere_is_refused(
    reach: SessionFiles, folder: Path, option: str
) -> None:
    with pytest.raises(InputError, match=r"runs code|reaches out"):
        words(chosen(options=[option]), reach)
