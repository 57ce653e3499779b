"""MuJoCo beside FMUs in one loop: from TOML, and against the same machine in MuJoCo alone."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from harness import api

pytest.importorskip("mujoco", reason="MuJoCo is not installed: pip install 'sysid-harness[mujoco]'")

EXAMPLES = Path(__file__).parents[2] / "examples"


def test_a_gripper_on_an_arm_comes_to_the_one_model_with_the_first_power_of_the_step(
    script: Callable[[str], ModuleType],
) -> None:
    gripper = script("examples/gripper_on_arm.py")
    errors = {
        step: float(np.abs(gripper.coupled(step, "jacobi") - gripper.truth(step))[:, 1].max()) for step in (4e-3, 2e-3)
    }
    assert errors[2e-3] < 2e-3
    assert np.log2(errors[4e-3] / errors[2e-3]) == pytest.approx(1.0, abs=0.2)


def test_the_coupling_in_toml_finds_its_mjcf_from_any_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    run = api.simulate(
        str(EXAMPLES / "gripper_on_arm.toml"),
        scenario="multisine",
        scenario_options={"duration": 0.5, "amplitude": 1.0},
    )
    assert [channel.name for channel in run.spec.outputs] == ["arm.q1", "arm.q2", "motor.q"]
    assert np.ptp(run.y[:, 1]) > 1e-3
