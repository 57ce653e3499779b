"""Stored models and reports in which a value is another, or gone: refused in one line, or read; never a fault."""

from __future__ import annotations

import copy
import json
import random
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from harness import api
from harness.command import main
from harness.comparison.reports import FORMAT, compare_reports
from harness.errors import InputError
from harness.models.determined import KEY
from harness.parts.stored import read_model

OTHER = [None, True, 0, -1, 1e308, "", "x", "nan", [], {}, [[]], [1, 2], {"a": 1}, float("nan"), 10**30, "9^9^9"]
COUNT = 150


def changed(value: Any, chance: random.Random, depth: int = 0) -> Any:
    """Return JSON in which a value at some depth is another, missing, doubled, or under another name."""
    if not isinstance(value, dict | list) or not value or (depth and chance.random() < 0.15):
        return chance.choice(OTHER)
    made, way = copy.copy(value), chance.random()
    key = chance.choice(list(made)) if isinstance(made, dict) else chance.randrange(len(made))
    if way < 0.12:
        del made[key]
    elif way < 0.2 and isinstance(made, list):
        made.append(made[key])
    elif way < 0.25 and isinstance(made, dict):
        made[chance.choice(["x", "kind", "model", ""])] = made[key]
    else:
        made[key] = changed(made[key], chance, depth + 1)
    return made


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("stored")
    rng = np.random.default_rng(0)
    t = np.arange(120) * 0.05
    u = rng.normal(size=120)
    y = np.zeros(120)
    for k in range(119):
        y[k + 1] = 0.9 * y[k] + 0.1 * u[k]
    table = np.column_stack([t, u, y + 1e-3 * rng.normal(size=120)])
    (place / "a.csv").write_text("time [s],u,y\n" + "\n".join(",".join(map(repr, map(float, row))) for row in table))
    signals: dict[str, Any] = {"input": "u", "output": "y"}
    api.identify(place / "a.csv", identifier="arx", options={"order": 1}, out=place / "model.json", **signals)
    return place


def test_a_damaged_model_is_one_line(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sound = json.loads((folder / "model.json").read_text())
    chance, path, refused = random.Random(3), folder / "m.json", 0
    commands = [
        ["list", str(path)],
        ["compare", str(path), str(folder / "a.csv"), "--input", "u", "--output", "y"],
        ["export", str(path), "-o", str(folder / "m.eqs"), "--force"],
    ]
    for number in range(COUNT):
        path.write_text(json.dumps(changed(sound, chance)))
        with pytest.raises(SystemExit) as ended:
            main(commands[number % 3])
        said = capsys.readouterr().err
        assert ended.value.code in (0, 2), (number, said)
        if ended.value.code == 2:
            refused += 1
            assert len(said.strip().splitlines()) == 1, (number, said)
            assert "remedy" in said, (number, said)
    assert refused > COUNT / 4


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("output_offset", [float("nan")], "output_offset holds nan"),
        ("a_matrix", [[1e308]], r"a_matrix holds 1e\+308"),
        ("notes", 3.0, "not a model"),
    ],
)
def test_numbers_that_are_none_are_named(folder: Path, key: str, value: Any, words: str, tmp_path: Path) -> None:
    content = json.loads((folder / "model.json").read_text())
    assert isinstance(read_model(folder / "model.json").spec.nu, int)
    if key == "notes":
        content["notes"][KEY] = value
    else:
        assert np.shape(content[key]) == np.shape(value), "the place is that of a sound model"
        content[key] = value
    (tmp_path / "model.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match=words):
        read_model(tmp_path / "model.json")
    with pytest.raises(InputError, match="not a model"):
        api.export(tmp_path / "model.json", out=tmp_path / "model.fmu")


REPORT: dict[str, Any] = {
    "format": f"{FORMAT}1",
    "version": "1",
    "dataset": "d",
    "model": "pendulum",
    "verdict": "effects_found",
    "adequacy": "explained",
    "converged": True,
    "effects": [{"name": "coulomb_friction", "at": "theta"}],
    "tie_sets": [[{"name": "coulomb_friction", "at": "theta"}]],
    "candidates": [{"name": "coulomb_friction", "at": "theta"}],
    "parameters": {"after": {"J": {"value": 0.1, "low": 0.09, "high": 0.11, "unit": "kg m^2"}}},
    "errors": {"after": {"simulation_error": {"validation": {"theta": {"rms": 0.01, "unit": "rad"}}}}},
    "policy": {"search": {"gain": {"value": 3.0, "reason": "x"}}},
}


def test_a_damaged_report_is_one_line_that_names_it(tmp_path: Path) -> None:
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "report.json").write_text(json.dumps(REPORT))
    assert compare_reports(tmp_path / "one", tmp_path / "two").differences == ()
    chance = random.Random(4)
    refused: list[InputError] = []
    for _ in range(2 * COUNT):
        (tmp_path / "two" / "report.json").write_text(json.dumps(changed(REPORT, chance)))
        try:
            compare_reports(tmp_path / "one", tmp_path / "two")
        except InputError as error:
            refused.append(error)
    assert len(refused) > COUNT / 4
    assert all("two" in str(error.file) and "\n" not in str(error) for error in refused)
