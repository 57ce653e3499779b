"""Every ``sysid`` command of README.md and docs/*.md is understood, and those that take seconds run, each alone."""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable
from pathlib import Path

import pytest
from typer.core import TyperGroup
from typer.main import get_command

from harness.cli import app
from harness.command import main
from plants.mockups import mockup

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
PAGES += sorted((ROOT / "examples").glob("*/README.md"))
FENCE = re.compile(r"^```(?:sh)?\n(.*?)^```\s*$", re.MULTILINE | re.DOTALL)


def commands() -> list[tuple[str, str]]:
    """Return the page and the line of every command, continuation lines joined."""
    found = []
    for page in PAGES:
        for block in FENCE.findall(page.read_text(encoding="utf-8")):
            for line in block.replace("\\\n", " ").splitlines():
                if line.startswith("sysid "):
                    found.append((page.name, line))
    return found


COMMANDS = commands()


def words(line: str) -> list[str]:
    """Return the arguments of a command as a shell passes them."""
    return shlex.split(line, comments=True)[1:]


def test_there_are_commands() -> None:
    assert len(COMMANDS) > 25


@pytest.mark.parametrize(("page", "line"), COMMANDS)
def test_a_command_is_understood(page: str, line: str) -> None:
    group = get_command(app)
    assert isinstance(group, TyperGroup)
    name, *rest = words(line)
    command = group.commands[name]
    command.make_context(name, rest)  # raises for an unknown option, a missing or a superfluous argument


def record(folder: Path) -> None:
    """Leave what the commands of the pages expect to find: an FMU, a record, a data set with two models."""
    for name in ("FILE.fmu", "model.fmu", "theirs.fmu", "pendulum.fmu"):
        (folder / name).write_bytes(mockup("pendulum").read_bytes())
    runs = ("run.csv", "estimation.csv", "validation.csv")
    for role, name in zip(("estimation/0", "estimation/1", "validation/0"), runs, strict=True):
        sysid(f"sysid simulate pendulum-fmu --scenario multisine -S duration=20 -S noise=1e-3 --role {role} -o {name}")
    (folder / "dataset.toml").write_text(
        'name = "swing"\nsignals.u = { role = "input" }\nsignals.theta = { role = "output" }\n'
        'nominal.model = "pendulum"\n'
        '[[runs]]\nfile = "run.csv"\n[[runs]]\nfile = "validation.csv"\nuse = "validation"\n'
    )
    for name, identifier in (("other.json", "arx"), ("MODEL.json", "arx"), ("OTHER.json", "dmdc -O delays=4")):
        sysid(f"sysid identify dataset.toml --identifier {identifier} -o {name}")


def sysid(line: str) -> None:
    """Run a command as typed."""
    with pytest.raises(SystemExit) as ended:
        main(words(line))
    assert ended.value.code == 0, line


SECONDS: dict[str, Callable[[str], bool]] = {
    "list": lambda line: "soft_friction" not in line and "identifiers" not in line,
    "simulate": lambda line: "repaired" not in line,
    "spectrum": lambda line: True,
    "order": lambda line: True,
    "identify": lambda line: "dataset.toml" in line,
    "compare": lambda line: "arx.json" not in line,
    "new": lambda line: True,
    "isolability": lambda line: True,
}
"""Commands that take seconds and need nothing but a record; the others need an earlier one's result, or minutes."""
QUICK = [(page, line) for page, line in COMMANDS if SECONDS.get(words(line)[0], lambda _: False)(line)]


@pytest.mark.slow
@pytest.mark.parametrize(("page", "line"), QUICK)
def test_a_quick_command_runs(page: str, line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    record(tmp_path)
    if words(line)[0] == "simulate":
        (tmp_path / "run.csv").unlink()
    sysid(line)
