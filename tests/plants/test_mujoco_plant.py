"""MuJoCo plants: the contract, agreement with the equations of motion, options that act, files that are refused."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from harness import registry, trust
from harness.conformance import check_plant
from harness.errors import InputError, PlantError
from harness.protocols import Experiment
from harness.rollout import perform

mujoco = pytest.importorskip("mujoco", reason="MuJoCo is not installed: pip install 'sysid-harness[mujoco]'")

from plants.mujoco.plant import MujocoPlant  # noqa: E402
from plants.mujoco.robots import one_joint_arm  # noqa: E402

from .conftest import pendulum_reference  # noqa: E402

RNG = np.random.default_rng
HOPPER = """<mujoco model="hopper"><option timestep="0.002"/><worldbody><geom type="plane" size="5 5 1"/>
<body name="trunk" pos="0 0 .4"><freejoint/><geom size=".1" mass="2"/>
<body name="leg" pos="0 0 -.1"><joint name="hip" axis="0 1 0" damping=".2" armature=".01" range="-60 60"/>
<site name="imu"/><geom name="foot" type="capsule" fromto="0 0 0 0 0 -.25" size=".03" mass=".3"/>
<body pos="0 0 -.2"><joint name="toe" type="ball"/><geom size=".02" pos=".05 0 0" mass=".05"/></body></body></body>
</worldbody><actuator><position name="servo" joint="hip" kp="20" delay=".006" nsample="3"/>
<motor name="geared" joint="hip" gear="5" ctrlrange="-1 1"/><general name="filtered" joint="hip" dyntype="filter"
dynprm=".02"/></actuator><sensor><accelerometer name="acc" site="imu"/><framepos name="where" objtype="body"
objname="leg"/><jointpos name="angle" joint="hip"/></sensor><keyframe><key name="bent"
qpos="0 0 .5 1 0 0 0 .4 1 0 0 0"/></keyframe></mujoco>"""


@pytest.mark.parametrize(
    ("integrator", "substeps", "order", "error"), [("euler", (10, 20), 0.9, 4e-3), ("rk4", (1, 2), 3.5, 2e-6)]
)
def test_the_arm_converges_to_the_pendulum_with_the_order_of_its_integrator(
    integrator: str, substeps: tuple[int, int], order: float, error: float
) -> None:
    inputs = (1.5 * np.sin(0.05 * np.arange(100)) + 0.5 * np.sin(0.14 * np.arange(100)))[:, None]
    errors = []
    for count in substeps:
        given = {"integrator": integrator, "substeps": count, "joint_damping": 0.05, "armature": 0.1}
        with one_joint_arm(sample_time=0.02, **given) as arm:
            log = perform(arm, Experiment(inputs, x0={"theta": 1.0}), rng=RNG(0))
            assert arm.true_parameters["J"] == pytest.approx(0.35)
            errors.append(np.abs(log.y[:, 0] - pendulum_reference(arm, inputs, 1.0)).max())
    assert errors[-1] < error
    assert np.log2(errors[0] / errors[1]) > order, errors


def test_dry_friction_is_coulombs_and_holds_the_arm() -> None:
    inputs = (3.0 * np.sin(0.05 * np.arange(150)))[:, None]
    with one_joint_arm(sample_time=0.02, substeps=20, joint_friction=0.4, joint_damping=0.05) as arm:
        log = perform(arm, Experiment(inputs, x0={"theta": 1.0}), rng=RNG(0))
        assert np.abs(log.y[:, 0] - pendulum_reference(arm, inputs, 1.0, dry=0.4)).max() < 5e-3
        arm.reset(rng=RNG(0))
        held = arm.rollout(np.full((500, 1), 0.39))
        slipping = arm.rollout(np.full((100, 1), 0.6))
    assert np.abs(held).max() < 0.01
    assert slipping[-1, 0] > 0.05


CASES: dict[str, Callable[[], MujocoPlant]] = {
    "one joint": one_joint_arm,
    "dry, first order": partial(one_joint_arm, joint_friction=0.2, integrator="euler"),
    "contact, free base, ball, delay, activation": partial(MujocoPlant, HOPPER),
    "sensors with feedthrough": partial(MujocoPlant, HOPPER, outputs=["q", "sensors"], sample_time=0.01),
    "a sensor without, from a keyframe": partial(
        MujocoPlant, HOPPER, outputs=["where", "q2", "base_z_rate"], joint_names=["q2"], keyframe="bent"
    ),
    "some actuators, and a force": partial(MujocoPlant, HOPPER, actuators=["geared"], forces=["hip"], contact=False),
}


@pytest.mark.parametrize("case", CASES)
def test_plants_keep_the_contract(case: str) -> None:
    failed = [result for result in check_plant(CASES[case]) if not result.passed]
    assert not failed, failed


def test_signals_have_the_models_names_and_units() -> None:
    with MujocoPlant(HOPPER, outputs=["q", "acc", "angle"]) as plant:
        spec = plant.spec
        assert [str(channel) for channel in spec.inputs] == ["target1 [rad]", "geared [N m]", "filtered [1]"]
        assert (spec.inputs[1].minimum, spec.inputs[1].maximum) == (-1.0, 1.0)
        assert [str(channel) for channel in spec.outputs[7:]] == [
            *("q1 [rad]", "toe_qw [1]", "toe_qx [1]", "toe_qy [1]", "toe_qz [1]"),
            *("acc_x [m/s^2]", "acc_y [m/s^2]", "acc_z [m/s^2]", "angle [rad]"),
        ]
        assert spec.feedthrough
        assert [channel.name for channel in spec.states][-1] == "activation1"
        plant.reset(rng=RNG(0), x0={"q1": 0.3})
        assert plant.output(np.zeros(3))[-1] == pytest.approx(0.3)
    with MujocoPlant(HOPPER, locked=["hip"], outputs=["q"]) as stiff:
        assert stiff.spec.nu == 0  # its actuators went with the joint


def test_a_step_is_that_of_mujoco_itself() -> None:
    """The same calls by hand, and the sensor read at the end of the step."""
    model = mujoco.MjModel.from_xml_string(HOPPER)
    data = mujoco.MjData(model)
    inputs = RNG(1).normal(size=(60, 3))
    with MujocoPlant(HOPPER, outputs=["q", "qd", "where"], substeps=2) as plant:
        plant.reset(rng=RNG(0))
        ours, states = plant.rollout_truth(inputs)
    for row, y, x in zip(inputs, ours, states, strict=True):
        data.ctrl[:] = row
        mujoco.mj_step(model, data, 2)
        assert np.array_equal(y[:22], [*data.qpos, *data.qvel])
        assert np.array_equal(x, [*data.qpos, *data.qvel, *data.act])
        mujoco.mj_kinematics(model, data)
        assert np.allclose(y[22:], data.body("leg").xipos, rtol=0, atol=1e-15)


def test_contact_and_limits_are_options_that_act() -> None:
    fall = np.zeros((400, 3))
    heights = {}
    for contact in (True, False):
        with MujocoPlant(HOPPER, contact=contact, outputs=["base_z"]) as plant:
            plant.reset(rng=RNG(0))
            heights[contact] = float(plant.rollout(fall)[-1, 0])
    assert heights[True] > 0.0
    assert heights[False] == pytest.approx(0.4 - 9.81 / 2 * 0.8**2, abs=0.01)
    reached = {}
    for limits in (True, False):
        options = {"gravity": 0.0, "contact": False, "outputs": ["q1"], "actuators": [], "forces": ["hip"]}
        with MujocoPlant(HOPPER, joint_limits=limits, **options) as plant:
            plant.reset(rng=RNG(0))
            reached[limits] = float(np.abs(plant.rollout(np.full((300, 1), 25.0))).max())
    assert reached[True] < 1.3 < 1.8 < reached[False]


def test_times_are_those_that_are_given() -> None:
    with (
        MujocoPlant(HOPPER) as alone,
        MujocoPlant(HOPPER, sample_time=0.01) as sampled,
        MujocoPlant(HOPPER, sample_time=0.01, substeps=20) as fine,
        MujocoPlant(HOPPER, substeps=3, timestep=0.001) as both,
        MujocoPlant(HOPPER, sample_time=0.003) as divided,
    ):
        found = [
            (p.spec.sample_time, p.declared["timestep"], p.declared["substeps"])
            for p in (alone, sampled, fine, both, divided)
        ]
    assert np.allclose(
        found, [(0.002, 0.002, 1), (0.01, 0.002, 5), (0.01, 0.0005, 20), (0.003, 0.001, 3), (0.003, 0.0015, 2)]
    )


@pytest.mark.parametrize(
    ("options", "word"),
    [
        ({"sample_time": 0.003, "timestep": 0.002}, "substeps"),
        ({"sample_time": 0.01, "timestep": 0.001, "substeps": 3}, "substeps"),
        ({"substeps": 0}, "integer"),
        ({"integrator": "midpoint"}, "implicitfast"),
        ({"solver": "lcp"}, "newton"),
        ({"gravity": [1.0]}, "along -z"),
        ({"outputs": ["angel"]}, "angle"),
        ({"outputs": []}, "at least one"),
        ({"outputs": ["q", "q1"]}, "none twice"),
        ({"actuators": ["engine"]}, "geared"),
        ({"forces": ["toe"]}, "hip"),
        ({"joint_names": ["a", "b"]}, "1 names"),
        ({"input_names": ["a"]}, "target1"),
        ({"input_limit": -1.0}, "positive"),
        ({"keyframe": "straight"}, "bent"),
        ({"locked": ["knee"]}, "hip"),
        ({"joint_friction": -0.1}, "joint_friction"),
        ({"joint_damping": [0.1, 0.2]}, "joints"),
        ({"friction_time": 0.0}, "friction_time"),
    ],
)
def test_options_that_do_not_fit_are_refused_with_what_would(options: dict[str, object], word: str) -> None:
    with pytest.raises(InputError, match=word):
        MujocoPlant(HOPPER, **options)  # type: ignore[arg-type]


def test_a_run_that_diverges_ends_with_an_error_and_the_next_one_works(tmp_path: Path) -> None:
    here = Path.cwd()
    os.chdir(tmp_path)
    try:
        with one_joint_arm(sample_time=1.0, substeps=1, integrator="euler", joint_damping=0.0) as arm:
            arm.reset(rng=RNG(0), x0={"theta_rate": 1e200})
            with pytest.raises(PlantError, match=r"diverged .* substeps") as caught:
                arm.rollout(np.full((200, 1), 1e308))
            assert caught.value.status == "diverged"
            assert arm.warnings
            assert np.isfinite(arm.reset(rng=RNG(0))).all()
            assert np.isfinite(arm.step(np.array([0.0]))).all()
            assert not arm.warnings
    finally:
        os.chdir(here)
    assert not list(tmp_path.iterdir()), "MuJoCo's log"


def test_a_closed_plant_says_so() -> None:
    arm = one_joint_arm()
    arm.reset(rng=RNG(0))
    arm.close()
    arm.close()
    for act in (lambda: arm.step(np.zeros(1)), lambda: arm.reset(rng=RNG(0)), arm.truth, arm.get_state):
        with pytest.raises(PlantError, match="closed"):
            act()


def write(folder: Path, name: str, text: str) -> Path:
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    return path


MESH = (
    "<worldbody><body><joint/><inertial pos='0 0 1' mass='1' diaginertia='1 1 1'/><geom type='mesh' mesh='m'/></body>"
    "</worldbody>"
)
TETRA = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


@pytest.mark.parametrize(
    "inside",
    [
        "<include file='../secret.xml'/>",
        "<include file='parts/deep.xml'/>",
        "<asset><mesh name='m' file='../m.obj'/></asset>",
        "<compiler meshdir='..'/><asset><mesh name='m' file='m.obj'/></asset>",
        "<compiler assetdir='/'/><asset><texture name='t' type='2d' file='t.png'/></asset>",
        "<asset><texture name='t' type='cube' fileright='/t.png'/></asset>",
        "<asset><hfield name='h' file='/h.bin'/></asset>",
        "<asset><model name='other' file='../secret.xml'/></asset>",
        "<asset><mesh name='m' file='http://example.org/m.obj'/></asset>",
        "<asset><mesh name='m' file='engine.so'/></asset>",
    ],
)
def test_a_file_opens_nothing_outside_its_folder(tmp_path: Path, inside: str) -> None:
    write(tmp_path, "secret.xml", "<mujoco/>")
    write(tmp_path, "m.obj", TETRA)
    write(tmp_path, "robot/parts/deep.xml", "<mujoco><asset><mesh name='m' file='../../m.obj'/></asset></mujoco>")
    robot = write(tmp_path, "robot/robot.xml", f"<mujoco>{inside}{MESH}</mujoco>")
    with pytest.raises(InputError, match=r"out of its folder|is fetched|runs code"):
        MujocoPlant(robot)


def test_a_trusted_file_may_and_meshes_of_the_own_folder_need_no_trust(tmp_path: Path) -> None:
    write(tmp_path, "m.obj", TETRA)
    write(tmp_path, "robot/meshes/m.obj", TETRA)
    own = f"<mujoco><compiler meshdir='meshes'/><asset><mesh name='m' file='m.obj'/></asset>{MESH}</mujoco>"
    robot = write(tmp_path, "robot/robot.xml", own)
    outside = write(tmp_path, "robot/outside.xml", own.replace("meshes", ".."))
    MujocoPlant(robot).close()
    with trust.trusting(outside):
        MujocoPlant(outside).close()
    (tmp_path / "robot" / "meshes" / "m.obj").unlink()
    with pytest.raises(InputError, match=r"m\.obj'; remedy: .*shapes = false"):
        MujocoPlant(robot)
    with MujocoPlant(robot, shapes=False, outputs=["q"]) as light:
        light.reset(rng=RNG(0))
        assert np.isfinite(light.step(np.array([1.0]))).all()


GRIPPER = """<mujoco><asset><texture name="skin" type="2d" file="skin.png"/><material name="grey" texture="skin"/>
<mesh name="m" file="m.obj"/></asset><worldbody><body><joint name="wrist" axis="0 1 0"/><geom type="mesh" mesh="m"
material="grey"/><inertial pos="0 0 .1" mass="1" diaginertia=".01 .01 .01"/><body><joint name="f1" type="slide"/>
<inertial pos="0 0 0" mass=".1" diaginertia="1e-4 1e-4 1e-4"/></body><body><joint name="f2" type="slide" axis="0 1 0"/>
<inertial pos="0 0 0" mass=".1" diaginertia="1e-4 1e-4 1e-4"/></body></body></worldbody><tendon><fixed name="both">
<joint joint="f1" coef=".5"/><joint joint="f2" coef=".5"/></fixed></tendon><equality><joint joint1="f1" joint2="f2"/>
</equality><actuator><motor joint="wrist"/><position name="grip" tendon="both" kp="9"/></actuator><sensor>
<tendonpos name="opening" tendon="both"/><jointactuatorfrc name="torque" joint="wrist"/></sensor></mujoco>"""


def test_a_locked_gripper_takes_its_tendon_and_its_actuator_with_it() -> None:
    """Neither meshes nor textures are there, and both are left out with the shapes."""
    with MujocoPlant(GRIPPER, shapes=False, outputs=["q", "opening"]) as free:
        assert [str(channel) for channel in free.spec.inputs] == ["tau1 [N m]", "grip [1]"]
        assert str(free.spec.outputs[-1]) == "opening [m]"
    with MujocoPlant(GRIPPER, shapes=False, locked=["f1", "f2"], outputs=["q", "sensors"]) as locked:
        assert str(locked.spec) == "tau1 [N m] -> q1 [rad], torque [N m] every 0.002 s"
        locked.reset(rng=RNG(0))
        locked.step(np.array([0.5]))
        assert locked.output(np.array([0.7]))[1] == 0.7


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("<mujoco", "not XML"),
        ("<sdf/>", "URDF"),
        ("<mujoco><bodies/></mujoco>", "unrecognized"),
        ("<mujoco/>", "without joints"),
        ("<mujoco><extension><plugin plugin='mine'/></extension></mujoco>", "not found"),
        (
            "<mujoco><worldbody><body><joint/><inertial pos='0 0 1' mass='1' diaginertia='9 1 1'/></body></worldbody>"
            "</mujoco>",
            "inertia must satisfy",
        ),
    ],
)
def test_what_is_no_robot_is_refused_in_one_line(tmp_path: Path, text: str, word: str) -> None:
    with pytest.raises(InputError, match=word) as caught:
        MujocoPlant(write(tmp_path, "robot.xml", text))
    assert len(str(caught.value).splitlines()) == 1


def test_a_missing_file_is_named() -> None:
    with pytest.raises(InputError, match=r"nowhere\.xml"):
        MujocoPlant("nowhere.xml")


def test_without_mujoco_the_remedy_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(InputError, match=r"pip install 'sysid-harness\[mujoco\]'") as caught:
        registry.create("plants", "arm-mujoco")
    assert len(str(caught.value).splitlines()) == 1
