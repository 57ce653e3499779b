"""The loop on records of MuJoCo: what it hid is named with its value, and nothing where it hid nothing."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from harness import api
from harness.physics.arms.arm import load_arm

pytest.importorskip("mujoco", reason="MuJoCo is not installed: pip install 'sysid-harness[mujoco]'")
pytestmark = pytest.mark.slow

TWO = """<mujoco model="two"><default><joint axis="0 1 0" damping="0.1" armature="0.02"/><motor ctrlrange="-20 20"/>
</default><worldbody><body name="upper" pos="0 0 1"><joint name="shoulder"/>
<inertial pos="0 0 -.2" mass="2" diaginertia=".03 .03 .005"/><body name="fore" pos="0 0 -.4"><joint name="elbow"/>
<inertial pos=".01 0 -.15" mass="1.2" diaginertia=".01 .01 .002"/></body></body></worldbody>
<actuator><motor joint="shoulder"/><motor joint="elbow"/></actuator></mujoco>"""


def closed(folder: Path, plant: str, model: str, options: dict[str, Any], scenario: dict[str, Any]) -> dict[str, Any]:
    """Record two runs, close the loop on them and return the report."""
    logs = [folder / f"{role}.csv" for role in ("estimation", "validation")]
    for role, log in zip(("estimation/0", "validation/0"), logs, strict=True):
        api.simulate(plant, scenario="multisine", options=options, scenario_options=scenario, role=role, out=log)
    api.close_loop(logs[0], model=model, validation=logs[1], out=folder / "out")
    report: dict[str, Any] = json.loads((folder / "out" / "report.json").read_text(encoding="utf-8"))
    return report


@pytest.mark.parametrize("friction", [0.0, 0.15, 0.4])
def test_dry_friction_that_mujoco_hid_is_named_with_its_value(tmp_path: Path, friction: float) -> None:
    options = {"joint_friction": friction, "joint_damping": 0.05}
    report = closed(tmp_path, "arm-mujoco", "pendulum", options, {"duration": 10.0, "noise": 5e-4})
    if not friction:
        assert report["verdict"] == "nothing_missing"
        return
    (found,) = report["effects"]
    assert found["name"] == "coulomb_friction"
    assert found["parameters"]["Fc"]["value"] == pytest.approx(friction, rel=0.01)
    assert not report["stand_in"]["flagged"]


@pytest.mark.parametrize("friction", [None, (0.4, 0.2)], ids=["null", "friction"])
def test_an_arm_whose_mjcf_lacks_its_friction(tmp_path: Path, friction: tuple[float, float] | None) -> None:
    nominal = tmp_path / "two.xml"
    nominal.write_text(TWO, encoding="utf-8")
    options = {"model": str(nominal), "sample_time": 0.002, "substeps": 2, "integrator": "rk4", "friction_time": 0.002}
    hidden = {} if friction is None else {"joint_friction": list(friction)}
    scenario = {"duration": 10.0, "noise": 2e-4, "amplitude": 4.0}
    report = closed(tmp_path, "mjcf", str(nominal), options | hidden, scenario)
    found = {(e["name"], e["at"]): e["parameters"] for e in report["effects"]}
    if friction is None:
        assert report["verdict"] == "nothing_missing"
        assert not found
        return
    assert set(found) == {("coulomb_friction", "q1"), ("coulomb_friction", "q2")}
    for joint, value in zip(("q1", "q2"), friction, strict=True):
        assert found["coulomb_friction", joint]["Fc"]["value"] == pytest.approx(value, rel=0.03)
    assert load_arm(tmp_path / "out" / "repaired.xml").friction == pytest.approx(friction, rel=0.03)


@pytest.mark.parametrize("rotors", [(0.02, 0.08), (0.08, 0.02), (0.12, 0.12)])
def test_rotors_that_mujoco_hid_are_named_and_no_other_arm(tmp_path: Path, rotors: tuple[float, float]) -> None:
    """A fast torque on a joint that hardly follows it: a rotor of .06 at the elbow was called another arm."""
    nominal = tmp_path / "two.xml"
    nominal.write_text(TWO, encoding="utf-8")
    options = {"model": str(nominal), "sample_time": 0.002, "substeps": 2, "integrator": "rk4", "armature": rotors}
    report = closed(tmp_path, "mjcf", str(nominal), options, {"duration": 10.0, "noise": 2e-4, "amplitude": 4.0})
    found = {(e["name"], e["at"]): e["parameters"]["J"]["value"] for e in report["effects"]}
    hidden = {("rotor_inertia", f"q{k + 1}"): J - 0.02 for k, J in enumerate(rotors) if J > 0.02}
    assert report["verdict"] == "effects_found", report["summary"]
    assert found == {place: pytest.approx(J, rel=0.02) for place, J in hidden.items()}
    assert load_arm(tmp_path / "out" / "repaired.xml").motor_inertia == pytest.approx(rotors, rel=0.02)
