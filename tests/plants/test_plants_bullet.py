"""PyBullet arms: nothing hidden, snapshots bit for bit, energy, and agreement with the equations of motion."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from harness.errors import InputError, PlantError
from harness.parts.listing import describe_part
from harness.protocols import Experiment
from harness.rollout import perform
from harness.signals import FloatArray

pybullet = pytest.importorskip("pybullet", reason="PyBullet is not installed: its wheels exist for CPython 3.11 only")

from plants.bullet.options import ArmOptions  # noqa: E402
from plants.bullet.robots import ArmPlant, acrobot, double_pendulum, iiwa, one_joint_arm, panda  # noqa: E402

from .conftest import pendulum_reference  # noqa: E402

RNG = np.random.default_rng


def swing(n: int, dt: float) -> FloatArray:
    """Return a smooth torque, held for each sample."""
    t = np.arange(n) * dt
    return (1.5 * np.sin(2.5 * t) + 0.5 * np.sin(7.0 * t))[:, None]


@pytest.mark.parametrize(("damping", "dry"), [(0.0, 0.0), (0.05, 0.0), (0.0, 0.2), (0.05, 0.2)])
def test_one_joint_arm_converges_to_the_pendulum_with_first_order(damping: float, dry: float) -> None:
    inputs = swing(150, 0.02)
    errors = []
    for substeps in (10, 20, 40):
        with one_joint_arm(sample_time=0.02, substeps=substeps, joint_damping=damping, joint_friction=dry) as arm:
            log = perform(arm, Experiment(inputs, x0={"theta": 1.0}), rng=RNG(0))
            errors.append(np.abs(log.y[:, 0] - pendulum_reference(arm, inputs, 1.0, dry)).max())
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert errors[-1] < 2e-3, errors
    assert orders.min() > 0.8, (errors, orders)


def test_friction_and_damping_take_energy_and_without_them_it_stays() -> None:
    def energy(**options: float) -> FloatArray:
        with one_joint_arm(sample_time=0.002, substeps=8, outputs=("q", "qd"), **options) as arm:
            log = perform(arm, Experiment(np.zeros((2000, 1)), x0={"theta": 2.0}), rng=RNG(0))
            p = arm.true_parameters
            return p["J"] * log.y[:, 1] ** 2 / 2 - p["mgl"] * np.cos(log.y[:, 0])

    free, dry, wet = energy(), energy(joint_friction=0.1), energy(joint_damping=0.05)
    assert np.abs(free - free[0]).max() < 0.01 * (free[0] + 4.905)
    assert (np.diff(dry[::50]) < 2e-3).all()
    assert dry[-1] < dry[0] - 1.0
    assert wet[-1] < wet[0] - 1.0


def arm_energy(arm: ArmPlant, x: FloatArray) -> float:
    """Return kinetic plus potential energy from Bullet's mass matrix and link positions."""
    world = arm._world
    n = arm.spec.nu
    mass = np.array(pybullet.calculateMassMatrix(world.body, x[:n].tolist(), physicsClientId=world.client))
    height = 0.0
    for joint in world.joints:
        link = pybullet.getLinkState(world.body, joint, computeForwardKinematics=1, physicsClientId=world.client)
        height += pybullet.getDynamicsInfo(world.body, joint, physicsClientId=world.client)[0] * link[0][2]
    return float(x[n:] @ mass @ x[n:] / 2 + 9.81 * height)


def test_undamped_iiwa_keeps_its_energy_to_first_order() -> None:
    drift = []
    for substeps in (4, 8, 16):
        with iiwa(joint_damping=0.0, substeps=substeps) as arm:
            arm.reset(rng=RNG(0))
            start = arm_energy(arm, arm.truth())
            worst = 0.0
            for _ in range(100):
                arm.step(np.zeros(7))
                worst = max(worst, abs(arm_energy(arm, arm.truth()) - start))
            drift.append(worst)
    assert drift[0] > 1.6 * drift[1] > 2.4 * drift[2], drift
    assert drift[2] < 1.0, drift


def test_every_hidden_default_is_declared_and_in_force() -> None:
    with iiwa() as arm:
        declared = arm.declared
        world = arm._world
        for place, joint in enumerate(world.joints):
            info = pybullet.getJointInfo(world.body, joint, physicsClientId=world.client)
            assert info[6] == declared["joint_damping"][place] == 0.5
            assert info[8] > info[9], "limits of the file are off unless declared"
        assert declared["joint_limits"] is False
        assert declared["linear_damping"] == declared["angular_damping"] == 0.0
        gentle = perform(arm, Experiment(np.zeros((50, 7))), rng=RNG(0))
        assert np.abs(gentle.y[-1, :7] - gentle.y[0, :7]).max() > 0.1, "default motors would hold the arm"


def test_velocity_clip_limits_and_rates_are_options_that_act() -> None:
    push = np.full((200, 1), 20.0)
    with (
        one_joint_arm(gravity=0.0, outputs=("qd",), velocity_clip=3.0) as slow,
        one_joint_arm(gravity=0.0, outputs=("qd",)) as free,
    ):
        slow.reset(rng=RNG(0))
        free.reset(rng=RNG(0))
        assert slow.rollout(push).max() == 3.0
        assert free.rollout(push)[-1, 0] == pytest.approx(20.0 / 0.25 * 0.8, rel=1e-9)
    swing_up = np.zeros((300, 7))
    swing_up[:, 3] = -60.0
    with iiwa(joint_limits=True) as stopped, iiwa() as turning:
        for arm in (stopped, turning):
            arm.reset(rng=RNG(0))
        assert stopped.rollout(swing_up)[:, 3].min() > -2.2
        assert turning.rollout(swing_up)[:, 3].min() < -2.5


def test_contact_force_carries_the_arm_and_feeds_through() -> None:
    with one_joint_arm(mass=2.0) as probe:
        assert "feedthrough" not in probe.abilities
    text = """<robot name="foot"><link name="base"><inertial><mass value="0"/>
    <inertia ixx="0" ixy="0" ixz="0" iyy="0" iyz="0" izz="0"/></inertial></link>
    <link name="foot"><inertial><mass value="3"/><inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/>
    </inertial><collision><geometry><sphere radius="0.1"/></geometry></collision></link>
    <joint name="slide" type="prismatic"><parent link="base"/><child link="foot"/><axis xyz="0 0 1"/>
    <origin xyz="0 0 0.1"/></joint></robot>"""
    with ArmPlant(text, table=(0.0, 0.0, 0.0), outputs=("q", "contact"), joint_names=("z",)) as foot:
        assert "feedthrough" in foot.abilities
        foot.reset(rng=RNG(0))
        for _ in range(300):
            foot.step(np.zeros(1))
        before = foot.truth()
        resting, pressed, lifted = (foot.output(np.array([f])) for f in (0.0, -20.0, 40.0))
        assert np.array_equal(foot.truth(), before), "no time passes"
    assert resting[3] == pytest.approx(3 * 9.81, rel=1e-3)
    assert pressed[3] == pytest.approx(3 * 9.81 + 20, rel=1e-3)
    assert lifted[3] == pytest.approx(0.0, abs=0.1)


def test_a_payload_is_a_point_mass_at_its_offset() -> None:
    with (
        one_joint_arm(mass=1.0, length=0.5) as light,
        one_joint_arm(mass=1.0, length=0.5, payload=1.0, payload_offset=(0.0, 0.0, -0.5)) as heavy,
        one_joint_arm(mass=2.0, length=0.5) as double,
    ):
        logs = [
            perform(arm, Experiment(swing(200, 0.004), x0={"theta": 0.5}), rng=RNG(0)).y
            for arm in (light, heavy, double)
        ]
    np.testing.assert_allclose(logs[1], logs[2], atol=1e-9)
    assert np.abs(logs[0] - logs[1]).max() > 0.01


def double_reference(p: dict[str, float], inputs: FloatArray, start: FloatArray, dt: float) -> FloatArray:
    """Return both angles (N, 2) of the double pendulum's equations of motion, derived by hand."""
    from scipy.integrate import solve_ivp

    def rate(_: float, z: FloatArray, u: FloatArray) -> FloatArray:
        a, b = z[0], z[1]
        c = p["m2"] * p["l1"] * p["lc2"]
        outer = p["I2"] + p["m2"] * p["lc2"] ** 2
        m11 = p["I1"] + p["m1"] * p["lc1"] ** 2 + p["m2"] * p["l1"] ** 2 + outer + 2 * c * np.cos(b)
        m12 = outer + c * np.cos(b)
        g2 = 9.81 * p["m2"] * p["lc2"] * np.sin(a + b)
        g1 = 9.81 * (p["m1"] * p["lc1"] + p["m2"] * p["l1"]) * np.sin(a) + g2
        s = c * np.sin(b)
        right = [
            u[0] - p["b1"] * z[2] - g1 + s * (2 * z[2] * z[3] + z[3] ** 2),
            u[1] - p["b2"] * z[3] - g2 - s * z[2] ** 2,
        ]
        return np.concatenate([z[2:], np.linalg.solve([[m11, m12], [m12, outer]], right)])

    z, out = np.concatenate([start, [0.0, 0.0]]), [start]
    for u in inputs[:-1]:
        z = solve_ivp(partial(rate, u=u), (0, dt), z, rtol=1e-9, atol=1e-11).y[:, -1]
        out.append(z[:2])
    return np.array(out)


def test_double_pendulum_and_acrobot_converge_to_their_equations() -> None:
    t = np.arange(100) * 0.02
    inputs = np.column_stack([2 * np.sin(3 * t), np.cos(4 * t)])
    start = {"theta1": 0.6, "theta2": -0.8}
    errors = []
    for substeps in (20, 40):
        with double_pendulum(sample_time=0.02, substeps=substeps) as plant:
            log = perform(plant, Experiment(inputs, x0=start), rng=RNG(0))
            truth = double_reference(plant.true_parameters, inputs, np.array([0.6, -0.8]), 0.02)
        errors.append(np.abs(log.y - truth).max())
    assert errors[1] < 5e-3, errors
    assert np.log2(errors[0] / errors[1]) > 0.8, errors
    with acrobot(sample_time=0.02, substeps=80) as plant:
        assert [c.name for c in plant.spec.inputs] == ["u"]
        log = perform(plant, Experiment(inputs[:, 1:], x0=start), rng=RNG(0))
        truth = double_reference(plant.true_parameters, inputs * [0, 1], np.array([0.6, -0.8]), 0.02)
    assert np.abs(log.y - truth).max() < 5e-3


@pytest.mark.parametrize("make", [iiwa, panda])
@pytest.mark.parametrize("payload", [0.0, 2.0])
def test_one_engine_step_obeys_the_urdfs_equations_of_motion(
    make: Callable[..., ArmPlant], payload: float, tmp_path: Path
) -> None:
    from harness.physics.arms.formats.urdf import load_urdf

    step, rng = 1e-4, RNG(0)
    with make(joint_damping=0.0, substeps=1, sample_time=step, payload=payload, payload_offset=(0.1, 0.0, 0.2)) as arm:
        (tmp_path / "arm.urdf").write_text(arm.urdf)
        equations = load_urdf(tmp_path / "arm.urdf")
        for _ in range(10):
            q, rate, torque = rng.uniform(-2, 2, 7), rng.normal(size=7), 5 * rng.normal(size=7)
            names = (channel.name for channel in arm.spec.states)
            arm.reset(rng=rng, x0=dict(zip(names, [*q, *rate], strict=True)))
            acceleration = (arm.step(torque)[7:] - rate) / step
            # The engine holds the matrices of the step's start, so this is exact, not a limit.
            np.testing.assert_allclose(equations.inverse_dynamics(q, rate, acceleration), torque, atol=1e-9)


def test_panda_moves_seven_joints_and_keeps_its_gripper_rigid() -> None:
    with panda(outputs=("q", "ee")) as arm:
        assert [state.name for state in arm.spec.states[:7]] == [f"q{i}" for i in range(1, 8)]
        y = arm.reset(rng=RNG(0))
        assert 0.2 < y[7] < 0.7
        fallen = arm.rollout(np.zeros((100, 7)))[-1]
    assert fallen[9] < y[9] - 0.05


def test_end_effector_and_camera_see_the_geometry() -> None:
    camera = {"position": (0.0, -3.0, 0.5), "target": (0.0, 0.0, 0.5), "focal": 600.0}
    with one_joint_arm(outputs=("q", "keypoints"), keypoints=[("rod", (0.0, 0.0, -0.5))], camera=camera) as arm:
        y = arm.reset(rng=RNG(0), x0={"theta": 0.7})
        tip = 0.5 * np.array([np.sin(0.7), -np.cos(0.7)])
        np.testing.assert_allclose(y[1:], 600 / 3 * np.array([tip[0], 0.5 - tip[1]]), atol=1e-9)
    with iiwa(outputs=("ee",)) as arm:
        straight_up = arm.reset(rng=RNG(0), x0={f"q{i}": 0.0 for i in range(1, 8)})
        assert straight_up[2] == pytest.approx(1.261, abs=2e-3)
        assert np.abs(straight_up[:2]).max() < 1e-2


def test_a_free_base_falls_with_g() -> None:
    with iiwa(fixed_base=False, outputs=("base",), base_position=(0.0, 0.0, 2.0), joint_damping=0.0) as arm:
        start = arm.reset(rng=RNG(0))
        arm.rollout(np.zeros((25, 7)))
        height = arm.truth()[16]
    assert start.tolist() == [0.0, 0.0, 2.0]
    assert height == pytest.approx(2.0 - 9.81 * 0.1**2 / 2, abs=1e-3)  # nothing holds it: it falls as one body


def test_a_plant_recovers_from_a_state_that_is_not_finite() -> None:
    with one_joint_arm() as arm:
        first = arm.reset(rng=RNG(0), x0={"theta": 0.3})
        record = arm.rollout(np.ones((20, 1)))
        arm._world.advance([float("nan")])
        assert not np.isfinite(arm.truth()).all()
        assert np.array_equal(arm.reset(rng=RNG(0), x0={"theta": 0.3}), first)
        assert np.array_equal(arm.rollout(np.ones((20, 1))), record)


@pytest.mark.parametrize(
    ("options", "word"),
    [
        ({"joint_damping": 0.5, "substeps": 1}, "explicitly"),
        ({"control": "torqe"}, "torque, velocity"),
        ({"outputs": ("q", "speed")}, "outputs"),
        ({"outputs": ("contact",)}, "a table"),
        ({"input_joints": (0, 9)}, "0..6"),
        ({"control": "velocity", "joint_friction": 0.1}, "motor"),
        ({"payload": 1.0, "payload_link": "hand"}, "unknown link"),
        ({"home": (0.0, 1.0)}, "one for each of the 7"),
        ({"colour": "red"}, "remove colour"),
        ({"joint_damping": -1.0}, "joint_damping"),
    ],
)
def test_options_that_do_not_fit_are_refused_with_a_remedy(options: dict[str, object], word: str) -> None:
    with pytest.raises(InputError, match=word):
        iiwa(**options)


def test_a_urdf_that_cannot_be_used_is_refused() -> None:
    for source, word in (
        ("nowhere.urdf", "no such URDF"),
        ("<robot", "well-formed"),
        ("<sdf/>", "not a URDF"),
        ('<robot name="still"><link name="base"/></robot>', "no joint moves"),
    ):
        with pytest.raises(InputError, match=word):
            ArmPlant(source)


def test_a_closed_plant_says_so_and_frees_its_client() -> None:
    arm = one_joint_arm()
    client = arm._world.client
    arm.close()
    arm.close()
    assert not pybullet.isConnected(client)
    forgotten = one_joint_arm()
    client = forgotten._world.client
    assert pybullet.isConnected(client)
    del forgotten
    assert not pybullet.isConnected(client), "a plant that is dropped frees its client too"
    for use in (lambda: arm.step(np.zeros(1)), lambda: arm.reset(rng=RNG(0)), arm.get_state):
        with pytest.raises(PlantError, match="closed"):
            use()


def test_stdout_stays_clean() -> None:
    code = "from plants.bullet.robots import iiwa; arm = iiwa(); arm.close(); print('only this')"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "only this\n"
    assert done.stderr == ""


def hinge(inside: str = "", *, kind: str = "revolute", iyy: float = 0.01) -> str:
    """Return a URDF of one hinged rod of 1 kg."""
    return (
        f'<robot name="p"><link name="base"/><joint name="hinge" type="{kind}"><parent link="base"/><child link="rod"/>'
        f'<axis xyz="0 1 0"/>{inside}</joint><link name="rod"><inertial><origin xyz="0 0 -0.5"/><mass value="1"/>'
        f'<inertia ixx="0.01" iyy="{iyy}" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>'
    )


def fall(urdf: str, **options: Any) -> FloatArray:
    """Return the last outputs of a free swing of 2 s."""
    with ArmPlant(urdf, **options) as arm:
        arm.reset(rng=RNG(0), x0={"q1": 0.5})
        return np.asarray(arm.rollout(np.zeros((500, 1)))[-1])


def test_damping_and_friction_of_the_file_are_simulated_unless_options_say_otherwise() -> None:
    stated = hinge('<dynamics damping="0.2" friction="0.05"/>')
    bare = fall(hinge())
    assert not np.allclose(fall(stated), bare, atol=1e-3)
    np.testing.assert_array_equal(fall(stated), fall(hinge(), joint_damping=0.2, joint_friction=0.05))
    np.testing.assert_array_equal(fall(stated, joint_damping=0.0, joint_friction=0.0), bare)


@pytest.mark.parametrize(
    ("urdf", "words"),
    [
        (hinge(iyy=0.5), "link rod: an inertia that no body has"),
        (hinge('<mimic joint="other"/>'), "joint hinge: a joint that follows another one"),
        (hinge(kind="floating"), "joint hinge: kind of joint"),
        (hinge(kind="planar"), "joint hinge: kind of joint"),
        (hinge('<dynamics friction="-1"/>'), "joint hinge: friction"),
    ],
)
def test_what_bullet_leaves_out_without_a_word_is_refused_by_name(urdf: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        ArmPlant(urdf)


def test_options_come_by_name_or_in_one_object_that_names_overwrite() -> None:
    given = ArmOptions(sample_time=0.01, joint_damping=0.3, control="torque")
    with ArmPlant(hinge(), given, substeps=7) as arm, ArmPlant(hinge(), **vars(given) | {"substeps": 7}) as named:
        assert arm.declared == named.declared
        assert (arm.declared["substeps"], arm.declared["joint_damping"], arm.spec.sample_time) == (7, (0.3,), 0.01)
    for wrong in ({"control": "force"}, {"inertia": "guess"}, {"substeps": 0}, {"payload": -1.0}, {"table_size": 0.0}):
        with pytest.raises(InputError, match=f"option {next(iter(wrong))}"):
            ArmOptions(**wrong)  # type: ignore[arg-type]


def test_every_option_of_an_arm_is_listed_with_its_meaning() -> None:
    described = describe_part("urdf-bullet")
    assert described is not None
    assert [row["name"] for row in described["options"]] == ["urdf", *vars(ArmOptions())]
    told = {row["name"]: row["meaning"] for row in described["options"]}
    assert told["locked"].startswith("Names of joints")
    assert told["velocity_clip"]
    assert told["urdf"] == "A file, or the text of one."
