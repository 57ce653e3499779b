"""Two thousand broken inputs of every format: each is refused in one line or read as a sound record, never a fault."""

from __future__ import annotations

import random
from pathlib import Path

import mutations
import pytest

from harness.command import main

SEED = 1
BY_CALL, BY_COMMAND = 1800, 200


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # numbers near the largest ones overflow in scores
def test_broken_inputs_are_refused_or_sound(tmp_path: Path) -> None:
    counts, faults = mutations.run(BY_CALL, SEED, tmp_path)
    assert faults == []
    assert sum(counts.values()) == BY_CALL
    refused = sum(count for name, count in counts.items() if name.endswith("refused"))
    assert refused > 0.7 * BY_CALL  # the mutations do break what they touch


COMMANDS = {
    "a.csv": ["identify", "a.csv", "--model", "pendulum", "--identifier", "arx", "-O", "order=1"],
    "dataset.toml": ["identify", "dataset.toml", "--identifier", "arx", "-O", "order=1"],
    "suite.toml": ["bench", "suite.toml", "--dry-run"],
    "model.json": ["compare", "model.json", "dataset.toml"],
    "a.fmu": ["list", "a.fmu"],
    "coupling.toml": ["simulate", "coupling.toml", "--scenario", "multisine", "-S", "duration=0.2", "-o", "out.csv"],
}


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_broken_inputs_on_the_command_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    module = mutations
    module.write_inputs(tmp_path)
    monkeypatch.chdir(tmp_path)
    chance = random.Random(SEED)
    statuses = []
    for number in range(BY_COMMAND):
        name = list(COMMANDS)[number % len(COMMANDS)]
        sound = (tmp_path / name).read_bytes()
        way, content = module.mutated(sound, chance)
        (tmp_path / name).write_bytes(content)
        (tmp_path / "out.csv").unlink(missing_ok=True)
        capsys.readouterr()
        with pytest.raises(SystemExit) as ended:
            main(COMMANDS[name])
        (tmp_path / name).write_bytes(sound)
        said = capsys.readouterr()
        assert ended.value.code in (0, 2), (number, name, way, said.err)
        assert "Traceback" not in said.err
        if ended.value.code == 2:
            refusals = [line for line in said.err.splitlines() if line.startswith("sysid: ") and "remedy" in line]
            assert len(refusals) == 1, (number, name, way, said.err)
            assert not (tmp_path / "out.csv").exists()
        statuses.append(ended.value.code)
    assert 0.5 * BY_COMMAND < statuses.count(2) < BY_COMMAND
