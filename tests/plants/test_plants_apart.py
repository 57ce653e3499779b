"""FMUs of a coupling, and an FMU as nominal model, end a process of their own and never the command."""

from __future__ import annotations

import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from harness import api, registry, trusting
from harness.cosim import Connection, Coupled
from harness.errors import PlantError
from harness.fmi.build import build_fmu
from harness.parts.files import make_plant
from plants.mockups import mockup

RNG = np.random.default_rng(0)
LOOP = """
sample_time = 0.01
inputs = { push = "odd.u" }
outputs = ["odd.y", "other.theta"]
[parts.odd]
fmu = "hostile.fmu"
options = { parameters = { mode = MODE } }
[parts.other]
mockup = "pendulum"
[[connections]]
from = "push"
to = "odd.u"
[[connections]]
from = "push"
to = "other.u"
gain_unit = "N m"
"""


@pytest.mark.parametrize(
    ("mode", "status", "words"),
    [(1, "crashed", "SIGSEGV"), (3, "crashed", "exited with status 0"), (4, "timeout", "1 s")],
)
def test_a_coupling_survives_its_fmus(
    odd_fmu: Callable[..., Path], tmp_path: Path, mode: int, status: str, words: str
) -> None:
    shutil.copy(odd_fmu("hostile"), tmp_path / "hostile.fmu")
    path = tmp_path / "loop.toml"
    path.write_text(LOOP.replace("MODE", str(mode)))
    with trusting(path), make_plant(str(path), {"timeout": 1.0}) as plant:
        for _ in range(2 if mode == 1 else 1):  # and once more, in a new process
            plant.reset(rng=RNG)
            with pytest.raises(PlantError, match=words) as caught:
                [plant.step(np.ones(1)) for _ in range(5)]
            assert caught.value.status == status
            assert str(caught.value).startswith("loop.toml: part 'odd': ")


SUITE = """
name = "broken-part"
seeds = [0]
[[groups]]
plants = [{ id = "loop.toml" }]
scenarios = [{ id = "multisine", options = { duration = 1.0 } }]
identifiers = [{ id = "hold" }]
"""
SYSTEM = """<?xml version="1.0"?>
<SystemStructureDescription xmlns="http://ssp-standard.org/SSP1/SystemStructureDescription" version="1.0" name="plant">
<System name="plant"><Elements>
 <Component name="idle" source="resources/hostile.fmu"/>
 <System name="cellar"><Elements><Component name="odd" source="resources/hostile.fmu"><ParameterBindings>
  <ParameterBinding><ParameterValues>
   <ParameterSet xmlns="http://ssp-standard.org/SSP1/SystemStructureParameterValues" version="1.0" name="p">
    <Parameters><Parameter name="mode"><Integer value="16"/></Parameter></Parameters></ParameterSet>
  </ParameterValues></ParameterBinding></ParameterBindings></Component></Elements></System>
</Elements></System></SystemStructureDescription>
"""


def test_commands_name_the_part_that_ended_the_process(
    odd_fmu: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sysid: Callable[..., Any]
) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copy(odd_fmu("hostile"), "hostile.fmu")
    Path("loop.toml").write_text(LOOP.replace("MODE", "2"))
    Path("suite.toml").write_text(SUITE)
    with zipfile.ZipFile("plant.ssp", "w") as archive:
        archive.writestr("SystemStructure.ssd", SYSTEM)
        archive.write("hostile.fmu", "resources/hostile.fmu")

    def said(*words: str) -> str:
        return sysid(*words, "--trust", ".", status=2).err.splitlines()[-1]

    assert "loop.toml: part 'odd': killed by SIGABRT during " in said("simulate", "loop.toml")
    assert "plant.ssp: part 'cellar.odd': killed by SIGSEGV during reset" in said("simulate", "plant.ssp")
    monkeypatch.setenv("HOSTILE_TO_LOAD", "1")
    assert "loop.toml: part 'odd': killed by SIGKILL during loading" in said("simulate", "loop.toml")
    monkeypatch.delenv("HOSTILE_TO_LOAD")
    with trusting("."):
        (row,) = api.bench("suite.toml", out="table", workers=1).rows
    assert (row.status, "loop.toml: part 'odd': killed by SIGABRT" in row.reason) == ("crashed", True), row.reason


def test_a_part_apart_within_a_coupling_made_in_python_is_named(odd_fmu: Callable[..., Path]) -> None:
    path = odd_fmu("hostile")
    alone = registry.create("plants", "isolated", plant="fmu", path=str(path), sample_time=0.1, parameters={"mode": 3})
    arm = registry.create("plants", "pendulum-ode", sample_time=0.1)
    wires = [Connection("push", "odd.u"), Connection("push", "arm.u", gain_unit="N m")]
    with Coupled({"odd": alone, "arm": arm}, wires, inputs={"push": "odd.u"}, outputs=["arm.theta"]) as both:
        both.reset(rng=RNG)
        with pytest.raises(PlantError, match=r"^part 'odd': hostile-2.fmu: exited with status 0 during step$"):
            [both.step(np.ones(1)) for _ in range(2)]


def test_a_coupling_apart_gives_the_numbers_of_one_that_is_not(tmp_path: Path) -> None:
    text = LOOP.replace("options = { parameters = { mode = MODE } }\n", "").replace("odd.y", "odd.theta")
    path = tmp_path / "loop.toml"
    path.write_text(text.replace("gain_unit", "# gain_unit"))
    shutil.copy(mockup("pendulum"), tmp_path / "hostile.fmu")
    u = np.sin(0.1 * np.arange(200))[:, None]
    found = []
    with trusting(tmp_path):
        for options in ({}, {"isolated": False}):
            with make_plant(str(path), dict(options)) as plant:
                first = plant.reset(rng=RNG, x0={"odd.theta": 0.3})
                found.append(np.vstack([first, *(plant.step(row) for row in u)]))
    assert np.array_equal(*found)


@pytest.mark.parametrize(
    ("mode", "status", "words"),
    [
        (1, "crashed", "the FMU theirs.fmu: .*SIGSEGV"),
        (4, "timeout", r"theirs.fmu: its initialisation, or a first step does not end within 3 s .*--step-limit"),
    ],
)
def test_a_nominal_fmu_ends_in_one_line(tmp_path: Path, mode: int, status: str, words: str) -> None:
    shutil.copytree(Path(__file__).parent / "fmus" / "hostile", tmp_path / "source")
    described = tmp_path / "source" / "modelDescription.xml"
    described.write_text(described.read_text().replace('<Integer start="0"/>', f'<Integer start="{mode}"/>'))
    build_fmu(tmp_path / "source", 2, tmp_path / "theirs.fmu")
    t = 0.01 * np.arange(200)
    rows = "".join(f"{a},{np.sin(3 * a)},{0.3 * (1 - np.cos(3 * a))}\n" for a in t)
    (tmp_path / "run.csv").write_text("time [s],u [1],y [1]\n" + rows)
    with pytest.raises(PlantError, match=words) as caught:
        api.close_loop(
            tmp_path / "run.csv", model=str(tmp_path / "theirs.fmu"), out=tmp_path / "report", step_limit=1.0
        )
    assert caught.value.status == status
    assert "\n" not in str(caught.value)
