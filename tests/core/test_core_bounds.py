"""Values outside the bounds of a model: run, and said once; nothing is said inside them."""

from __future__ import annotations

import json
import warnings
from pathlib import Path
from typing import Any

import pytest

from harness import api
from harness.command import main
from harness.options import BoundsWarning
from plants.mockups import mockup

COUPLING = """
sample_time = 0.01
outputs = ["arm.theta"]
inputs = ["arm.u"]
[parts.arm]
mockup = "pendulum"
options = { parameters = { b = %s } }
"""


def ended(command: list[str]) -> object:
    with pytest.raises(SystemExit) as end:
        main(command)
    return end.value.code


def pair(folder: Path, b: float) -> str:
    path = folder / "pair.toml"
    path.write_text(COUPLING % b)
    return str(path)


def test_an_equation_warns_in_python_and_names_parameter_value_and_bounds(tmp_path: Path) -> None:
    options = {"parameters": {"b": -0.01}}
    with pytest.warns(BoundsWarning, match=r"^b = -0.01 N m s/rad is outside its bounds, at least 0 N m s/rad$"):
        api.simulate("pendulum-ode", scenario="free-swing", options=options)
    said: list[str] = []
    api.simulate("pendulum-ode", scenario="free-swing", options=options, note=said.append)
    assert len(said) == 1


@pytest.mark.parametrize("value", [0.0, 0.3])
def test_nothing_is_said_inside_the_bounds_or_on_them(tmp_path: Path, value: float) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error", BoundsWarning)
        api.simulate("pendulum-ode", scenario="free-swing", options={"parameters": {"b": value}})
        api.simulate(str(mockup("pendulum")), stop=0.1, step=0.01, options={"parameters": {"b": value}})
        api.simulate(pair(tmp_path, value), stop=0.1)


@pytest.mark.parametrize("isolated", [True, False])
def test_an_fmu_warns_whether_it_runs_here_or_in_a_process_of_its_own(isolated: bool) -> None:
    options: dict[str, Any] = {"parameters": {"b": -0.01}, "isolated": isolated}
    for more in ({"stop": 0.1, "step": 0.01}, {"scenario": "multisine"}):
        given = {**options, "sample_time": 0.01} if "scenario" in more else options
        with pytest.warns(BoundsWarning, match="b = -0.01"):
            api.simulate(str(mockup("pendulum")), options=given, **more)


def test_a_coupling_names_the_part(tmp_path: Path) -> None:
    with pytest.warns(BoundsWarning, match=r"^arm\.b = -0.01 N m s/rad is outside"):
        api.simulate(pair(tmp_path, -0.01), stop=0.1)


def test_bounds_that_a_model_file_declares_itself_are_those_that_count(tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    file.write_text(
        "from dataclasses import replace\nfrom harness.physics.models import pendulum\n\n\ndef mine():\n"
        "    made = pendulum().system()\n    b = replace(made.parameter('b'), minimum=-1.0)\n"
        "    return made.with_parameters({'b': b})\n"
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error", BoundsWarning)
        api.simulate("ode", scenario="free-swing", options={"model": f"{file}:mine", "parameters": {"b": -0.01}})


def test_the_command_says_one_line_and_json_holds_it(capsys: pytest.CaptureFixture[str]) -> None:
    command = ["simulate", "pendulum-ode", "--scenario", "free-swing", "-O", "parameters.b=-0.01"]
    assert ended(command) == 0
    assert capsys.readouterr().err.count("b = -0.01 N m s/rad is outside its bounds") == 1
    assert ended([*command, "--json"]) == 0
    printed = capsys.readouterr()
    assert len(json.loads(printed.out)["notes"]) == 1
