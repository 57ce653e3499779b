"""A URDF in full: what it states about its joints is simulated or refused by name, in Bullet, in MuJoCo, as a model."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from harness import api
from harness.errors import InputError
from harness.physics.arms.arm import load_arm
from harness.physics.arms.urdf_write import urdf_with
from harness.signals import FloatArray
from plants.mujoco.plant import MujocoPlant

pytest.importorskip("pybullet", reason="PyBullet is not installed: its wheels exist for CPython 3.11 only")
pytest.importorskip("mujoco", reason="MuJoCo is not installed: pip install 'sysid-harness[mujoco]'")

from plants.bullet.arm import ArmPlant

RNG = np.random.default_rng
LIMIT = '<limit lower="-9" upper="9" effort="20" velocity="5"/>'
DYNAMICS = '<dynamics damping="0.2" friction="0.3"/>'
ROTOR = """<transmission name="t"><joint name="hinge"/><actuator name="m"><rotor_inertia value="2e-5"/>
<gear_ratio value="100"/></actuator></transmission>"""


def robot(inside: str = LIMIT, *, iyy: float = 0.01, kind: str = "revolute", more: str = "") -> str:
    """Return a pendulum of 1 kg at 0.5 m."""
    return f"""<robot name="p"><link name="base"/><link name="rod"><inertial><origin xyz="0 0 -0.5"/><mass value="1"/>
<inertia ixx="0.01" iyy="{iyy}" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="hinge" type="{kind}">
<parent link="base"/><child link="rod"/><axis xyz="0 1 0"/>{inside}</joint>{more}</robot>"""


FINGER = """<link name="finger"><inertial><mass value="0.1"/><inertia ixx="0.001" iyy="0.001" izz="0.001" ixy="0"
ixz="0" iyz="0"/></inertial></link><joint name="follower" type="revolute"><parent link="rod"/><child link="finger"/>
<axis xyz="0 1 0"/><limit lower="-9" upper="9" effort="1" velocity="1"/><mimic joint="hinge" multiplier="2"/></joint>"""


def swing(plant: Any, seconds: float = 1.0) -> FloatArray:
    """Return position and rate along a free swing from 1 rad."""
    with plant:
        plant.reset(rng=RNG(0), x0={"q1": 1.0})
        steps = round(seconds / plant.spec.sample_time)
        return np.asarray(plant.rollout(np.zeros((steps, plant.spec.nu))))


def test_damping_and_friction_of_the_file_act_alike_in_both_engines() -> None:
    text = robot(LIMIT + DYNAMICS)
    bullet = swing(ArmPlant(text, sample_time=0.004, substeps=8))
    mujoco = swing(MujocoPlant(text, sample_time=0.004, substeps=8, friction_time=0.001))
    free = swing(ArmPlant(robot(), sample_time=0.004, substeps=8))
    assert np.abs(bullet[:, 0] - mujoco[:, 0]).max() < 5e-3
    assert np.abs(bullet[:, 0] - free[:, 0]).max() > 0.1


def test_limits_are_the_declared_ranges_of_what_drives_the_joint() -> None:
    def ranges(plant: Any) -> list[tuple[float, float]]:
        with plant:
            return [(channel.minimum, channel.maximum) for channel in plant.spec.inputs]

    assert ranges(ArmPlant(robot())) == ranges(MujocoPlant(robot())) == [(-20.0, 20.0)]
    assert ranges(ArmPlant(robot(), control="velocity")) == [(-5.0, 5.0)]
    assert ranges(ArmPlant(robot(), input_limit=3.0)) == [(-3.0, 3.0)]
    for none in ("", '<limit lower="-1" upper="1" effort="0" velocity="0"/>'):
        assert ranges(ArmPlant(robot(none))) == [(-np.inf, np.inf)]
    with ArmPlant(robot(), control="position") as servo:
        assert servo.declared["motor_force"] == (20.0,)
    joint = load_arm_text(robot()).arm.joints[0]
    assert (joint.effort, joint.velocity) == (20.0, 5.0)


def load_arm_text(text: str, folder: Path | None = None, **options: Any) -> Any:
    """Return the arm of a URDF's text."""
    import tempfile

    with tempfile.TemporaryDirectory() as scratch:
        path = (folder or Path(scratch)) / "robot.urdf"
        path.write_text(text, encoding="utf-8")
        return load_arm(path, **options)


def test_a_rotor_behind_a_gear_is_inertia_at_the_joint_and_no_weight() -> None:
    arm = load_arm_text(robot(more=ROTOR))
    assert arm.motor_inertia.tolist() == pytest.approx([0.2])
    still, one = np.zeros((1, 1)), np.ones((1, 1))
    assert arm.torques(still, still, one) - arm.torques(still, still, still) == pytest.approx(0.26 + 0.2)
    bare = swing(MujocoPlant(robot(), sample_time=0.001, integrator="rk4"), 0.1)
    geared = swing(MujocoPlant(robot(more=ROTOR), sample_time=0.001, integrator="rk4"), 0.1)
    assert bare[-1, 1] / geared[-1, 1] == pytest.approx(0.46 / 0.26, rel=0.05)
    with pytest.raises(InputError, match=r"transmission of joint hinge: a rotor .* 0\.2 kg m\^2 .* mjcf"):
        ArmPlant(robot(more=ROTOR))


def test_drakes_namespace_and_a_mechanical_reduction_are_read() -> None:
    drake = ROTOR.replace("rotor_inertia", "d:rotor_inertia").replace("gear_ratio", "d:gear_ratio")
    arm = load_arm_text(robot(more=drake).replace("<robot", '<robot xmlns:d="http://drake.mit.edu"'))
    assert arm.motor_inertia.tolist() == pytest.approx([0.2])
    reduced = ROTOR.replace('<gear_ratio value="100"/>', "<mechanicalReduction>50</mechanicalReduction>")
    arm = load_arm_text(robot(more=reduced))
    assert arm.motor_inertia.tolist() == pytest.approx([0.05])
    assert any("gear ratio of 50 at joint hinge" in note and "not in the URDF" not in note for note in arm.notes)
    bare = reduced.replace('<rotor_inertia value="2e-5"/>', "")
    assert any("the inertia of its rotor is not in the URDF" in note for note in load_arm_text(robot(more=bare)).notes)
    with pytest.raises(InputError, match="rotor inertia: expected a number >= 0"):
        load_arm_text(robot(more=ROTOR.replace("2e-5", "-1")))


@pytest.mark.parametrize(
    "more", ["", ROTOR, ROTOR.replace("rotor_inertia", "d:rotor_inertia")], ids=["", "own", "drake"]
)
def test_a_rotor_is_written_where_it_is_read(tmp_path: Path, more: str) -> None:
    text = robot(more=FINGER.replace('<mimic joint="hinge" multiplier="2"/>', "") + more)
    arm = load_arm_text(text.replace("<robot", '<robot xmlns:d="http://drake.mit.edu"'), tmp_path)
    same = urdf_with(arm, arm.arm.parameters, motor_inertia=arm.motor_inertia)
    assert same.count("<transmission") == bool(more)
    found = np.array([0.37, 0.0])
    again = load_arm_text(urdf_with(arm, arm.arm.parameters, motor_inertia=found), tmp_path)
    assert again.motor_inertia == pytest.approx(found)
    assert again.idle == arm.idle


def test_a_joint_that_follows_another_is_refused_locked_or_coupled() -> None:
    text = robot(more=FINGER)
    for use in (ArmPlant, load_arm_text):
        with pytest.raises(
            InputError, match=r"joint follower: a joint that follows another one.* <mimic joint='hinge'>"
        ):
            use(text)
    with ArmPlant(text, locked=["follower"]) as stiff:
        assert stiff.spec.nu == 1
    assert load_arm_text(text, locked=["follower"]).n == 1
    with MujocoPlant(text, sample_time=0.002) as coupled:
        coupled.reset(rng=RNG(0))
        end = coupled.rollout(np.tile([0.5, 0.0], (300, 1)))[-1]
        assert end[1] == pytest.approx(2 * end[0], abs=0.02)
        assert abs(end[0]) > 0.05


@pytest.mark.parametrize("kind", ["floating", "planar"])
def test_free_joints_are_refused_by_arms_and_simulated_by_mujoco(kind: str) -> None:
    text = robot("", kind=kind)
    for use in (ArmPlant, load_arm_text):
        with pytest.raises(InputError, match=rf"joint hinge: kind of joint: .* got '{kind}'"):
            use(text)
    with MujocoPlant(text, outputs=["q"]) as free:
        free.reset(rng=RNG(0))
        free.rollout(np.zeros((500, free.spec.nu)))
        assert free.spec.ny == (7 if kind == "floating" else 3)
        assert np.isfinite(free.truth()).all()
        if kind == "floating":
            assert free.truth()[2] == pytest.approx(-9.81 / 2, rel=0.01)


@pytest.mark.parametrize("iyy", [0.5, -0.01])
def test_an_inertia_that_no_body_has_is_refused_or_said_by_name(iyy: float) -> None:
    text = robot(iyy=iyy)
    with pytest.raises(InputError, match="link rod: an inertia that no body has"):
        ArmPlant(text)
    with pytest.raises(InputError, match=r"MuJoCo refuses the robot: .*inertia must"):
        MujocoPlant(text)
    assert any("link rod an inertia that no body has" in note for note in load_arm_text(text).notes)
    with pytest.raises(InputError, match="link rod: mass: expected a mass >= 0"):
        ArmPlant(text.replace('value="1"', 'value="-1"'))


@pytest.mark.slow
def test_a_repaired_urdf_is_simulated_as_the_machine_that_was_recorded(tmp_path: Path) -> None:
    """Friction and damping that Bullet hid come back in the URDF, and the plant of that file moves as the recorded."""
    nominal = tmp_path / "nominal.urdf"
    nominal.write_text(robot(), encoding="utf-8")
    hidden = {"joint_friction": 0.3, "joint_damping": 0.1}
    logs = {}
    for role in ("estimation", "validation"):
        logs[role] = tmp_path / f"{role}.csv"
        api.simulate(
            "urdf-bullet",
            scenario="multisine",
            options={"urdf": str(nominal), **hidden},
            scenario_options={"duration": 10.0, "amplitude": 2.0, "noise": 1e-4},
            role=f"{role}/0",
            out=logs[role],
        )
    api.close_loop(logs["estimation"], validation=logs["validation"], model=str(nominal), out=tmp_path / "arm")
    report = json.loads((tmp_path / "arm" / "report.json").read_text(encoding="utf-8"))
    assert {effect["name"] for effect in report["effects"]} == {"coulomb_friction", "viscous_friction"}
    repaired = tmp_path / "arm" / "repaired.urdf"
    machine, again, before = (
        swing(ArmPlant(nominal, **hidden), 4.0),
        swing(ArmPlant(repaired), 4.0),
        swing(ArmPlant(nominal), 4.0),
    )
    assert np.abs(again[:, 0] - machine[:, 0]).max() < 0.1 * np.abs(before[:, 0] - machine[:, 0]).max()
