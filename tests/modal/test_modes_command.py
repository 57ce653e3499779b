"""`sysid modes` and `harness.modes`: tables, pages, JSON, refusals, and an FMU of a chain."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import harness
from harness import api
from harness.errors import InputError
from harness.physics.models.chain import chain_modes


@pytest.fixture(scope="module")
def ambient(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a record of a chain under wind."""
    path = tmp_path_factory.mktemp("modes") / "ambient.csv"
    api.simulate(
        "chain-ode",
        scenario="free-swing",
        scenario_options={"duration": 300.0, "noise": 1e-2},
        options={"process_noise": 1.0},
        out=path,
    )
    return path


def test_on_the_command_line(ambient: Path, tmp_path: Path, sysid: Callable[..., Any]) -> None:
    folder = tmp_path / "found"
    asked = ["modes", str(ambient), "--input", "none", "--output", "q1", "--output", "q2", "--output", "q3"]
    found = json.loads(sysid(*asked, "--order", "2..12", "-o", str(folder), "--json").out)
    exact = chain_modes()[0]
    assert [mode["frequency"] for mode in found["modes"][:2]] == pytest.approx(exact[:2], rel=0.01)
    assert found["orders"] == [2, 4, 6, 8, 10, 12]
    assert not found["driven"]
    for mode in found["modes"]:
        assert mode["frequency_interval"][0] < mode["frequency"] < mode["frequency_interval"][1]
    names = {"modes.html", "modes.json", "stabilisation.svg", "shapes.svg", "motion.svg"}
    assert {path.name for path in folder.iterdir()} == names
    page = (folder / "modes.html").read_text(encoding="utf-8")
    assert page.count("<img") == 3
    assert "natural" in page or "frequency [Hz]" in page
    assert json.loads((folder / "modes.json").read_text(encoding="utf-8"))["modes"] == found["modes"]
    assert "--force" in sysid(*asked, "-o", str(folder), status=2).err
    text = sysid(*asked, "--order", "2..12").out
    assert "frequency [Hz]" in text
    assert "no input: shapes have no scale" in text


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--order", "9..2"], "--order"),
        (["--mac", "3"], "mac"),
        (["--identifier", "nope"], "unknown identifier"),
        (["--identifier", "edmdc"], "has no order"),
        (["-O", "past=3"], "none without --identifier"),
        (["--window", "100000"], "too short"),
    ],
)
def test_wrong_words_are_one_line(ambient: Path, more: list[str], said: str, sysid: Callable[..., Any]) -> None:
    shown = sysid("modes", ambient, "--model", "mass-chain", *more, status=2).err
    lines = [line for line in shown.splitlines() if line.startswith("sysid: ")]
    assert len(lines) == 1
    assert said in lines[0]


def test_from_python_with_a_table(ambient: Path) -> None:
    assert harness.modes is api.modes
    found = api.modes(ambient, input=["none"], output=["q1", "q3"], orders=range(2, 13, 2))
    assert found.frequencies[0] == pytest.approx(chain_modes()[0][0], rel=0.01)
    assert found.shapes.shape == (len(found.modes), 2)
    assert "<table>" in found._repr_html_()
    assert repr(found).startswith("<Modes of ")
    assert found.coordinates.shape == (len(found.time), len(found.modes))
    # the part of the first mode moves as its frequency says
    wave = found.coordinates[:, 0]
    turns = np.unwrap(np.angle(wave))
    assert (turns[-1] - turns[0]) / (2 * np.pi * (found.time[-1] - found.time[0])) == pytest.approx(
        found.frequencies[0], rel=0.01
    )
    with pytest.raises(InputError, match="the output exists"):
        api.modes(ambient, input=["none"], output=["q1"], out=ambient.parent)


def test_a_record_too_short_for_intervals_says_so_in_the_file_too(ambient: Path, tmp_path: Path) -> None:
    few = tmp_path / "few.csv"
    few.write_text("".join(ambient.read_text(encoding="utf-8").splitlines(keepends=True)[:170]), encoding="utf-8")
    found = api.modes(few, input=["none"], output=["q1", "q2", "q3"], window=8, out=tmp_path / "few")
    assert any("no intervals" in text for text in found.words())
    content = json.loads((tmp_path / "few" / "modes.json").read_text(encoding="utf-8"))
    assert all(mode["frequency_interval"] == [None, None] for mode in content["modes"])


@pytest.mark.slow
def test_an_fmu_of_a_chain_has_the_modes_of_the_chain(tmp_path: Path) -> None:
    from harness.scoring import linearise
    from identifiers.common.linear_model import LinearModel
    from plants.equations.ode import chain_ode

    plant = chain_ode(masses=4)
    exact = linearise(plant)
    n, nu, ny = len(exact.a_matrix), plant.spec.nu, plant.spec.ny
    model = LinearModel(
        plant.spec, exact.a_matrix, exact.b_matrix, exact.c_matrix, np.zeros((ny, nu)), np.zeros((n, ny)),
        np.zeros(n), np.zeros(ny),
    )  # fmt: skip
    (tmp_path / "chain.json").write_text(json.dumps(model.to_dict()), encoding="utf-8")
    api.export(tmp_path / "chain.json", out=tmp_path / "chain.fmu", fmi="2")
    run = api.simulate(
        str(tmp_path / "chain.fmu"),
        scenario="multisine",
        scenario_options={"duration": 400.0, "amplitude": 1.0, "band": [0.1, 4.0], "noise": 1e-4},
        options={"sample_time": 0.1},
        out=tmp_path / "run.csv",
    )
    found = api.modes(
        tmp_path / "run.csv", input=[c.name for c in run.spec.inputs], output=[c.name for c in run.spec.outputs]
    )
    frequency, ratio, _ = chain_modes(4)
    assert found.frequencies == pytest.approx(frequency, rel=2e-3)
    for mode, z in zip(found.modes, ratio, strict=True):
        assert abs(mode.damping - z) < max(4 * mode.pole.damping_deviation, 1e-5)
