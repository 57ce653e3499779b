"""FMUs on the command line: any output, parameters of any type, foreign code that cannot end the command."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from harness import api
from harness.data import read_trajectory
from harness.errors import InputError, PlantError
from plants.mockups import mockup


def test_arrays_texts_and_chosen_outputs_go_into_a_file(
    odd_fmu: Callable[..., Path], tmp_path: Path, sysid: Callable[..., Any]
) -> None:
    out = tmp_path / "run.csv"
    chosen = ["-O", "inputs=['u', 'w']", "-O", "outputs=['y', 'label_length']", "-O", "sample_time=0.1"]
    parameters = ["-O", "parameters.A=[[1, 2], [3, 4]]", "-O", "parameters.label=four"]
    command = ["simulate", odd_fmu("zoo", 3), "--scenario", "steps", *chosen, *parameters, "-o", out]
    sysid(*command)
    run = read_trajectory(out, inputs=["u[1]", "u[2]", "w"])
    assert [channel.name for channel in run.spec.outputs] == ["y[1]", "y[2]", "label_length"]
    assert run.y[1:, :2] == pytest.approx(run.u[:-1, :2] @ np.array([[1.0, 3.0], [2.0, 4.0]]))
    assert (run.y[:, 2] == 4).all()


def test_local_variables_parameters_and_substeps_by_name() -> None:
    options = {"sample_time": 0.01, "step": 0.002, "outputs": ["theta", "der(omega)"]}
    plain = api.simulate(str(mockup("pendulum", 3)), scenario="multisine", options=options)
    rubs = {**options, "parameters": {"Fc": 0.1}}
    rough = api.simulate(str(mockup("pendulum", 3)), scenario="multisine", options=rubs)
    assert [str(channel) for channel in plain.spec.outputs] == ["theta [rad]", "der(omega) [rad/s^2]"]
    assert np.abs(plain.y - rough.y).max() > 0.01


@pytest.mark.parametrize(("mode", "words"), [(1, "killed by SIGSEGV"), (2, "killed by SIGABRT"), (3, "exited with")])
def test_an_fmu_that_takes_its_process_down_does_not_take_the_command(
    odd_fmu: Callable[..., Path], mode: int, words: str, sysid: Callable[..., Any], temporary_folder: Path
) -> None:
    path = odd_fmu("hostile")
    options = ["-O", "sample_time=0.01", "-O", f"parameters.mode={mode}"]
    assert (
        f"hostile-2.fmu: {words}"
        in sysid("simulate", path, "--scenario", "multisine", *options, "-S", "duration=1", status=2).err
    )
    assert not list(temporary_folder.iterdir())


def test_a_hanging_fmu_is_ended_in_the_time_that_the_user_gives(odd_fmu: Callable[..., Path]) -> None:
    options = {"sample_time": 0.01, "parameters": {"mode": 4}, "timeout": 0.5}
    with pytest.raises(PlantError, match=r"the step from t = 0.02 s does not end") as caught:
        api.simulate(str(odd_fmu("hostile")), scenario="multisine", options=options)
    assert caught.value.status == "timeout"


@pytest.mark.parametrize("isolated", [True, False])
def test_a_wrong_option_is_named_either_way(isolated: bool) -> None:
    options = {"sample_time": 0.01, "samples": 3, "isolated": isolated}
    with pytest.raises(InputError, match=r"options of .*plant 'fmu'.*samples"):
        api.simulate(str(mockup("pendulum")), scenario="multisine", options=options)


def test_an_option_may_have_any_name() -> None:
    with pytest.raises(InputError, match=r"options of pendulum-ode.*got id;"):
        api.simulate("pendulum-ode", scenario="multisine", options={"id": "x"})
