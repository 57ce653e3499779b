"""A joint of a URDF that gives way: the truth is a two-mass equation stepped here, not the law that is fitted."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from scipy.signal import cont2discrete, lsim

from harness.diagnosis.arm.effects import wide_effects
from harness.diagnosis.arm.motion import ArmRun, arm_runs, clear_runs
from harness.diagnosis.arm.rotor import Swinging, swinging
from harness.diagnosis.arm.wide import WideResult, wide_search
from harness.diagnosis.close import close_loop
from harness.physics.arms.arm import ArmModel, load_arm
from harness.signals import Dataset, FloatArray, PlantSpec, Run, Trajectory

USES: tuple[Literal["estimation", "validation"], ...] = ("estimation", "validation")
LINK, ROTOR, STEP = 0.06, 0.09, 0.002
"""Inertias of link and rotor [kg m^2], sample time [s]."""
URDF = """<robot name="joint"><link name="base"/>
  <joint name="j" type="revolute"><parent link="base"/><child link="link"/><axis xyz="0 0 1"/>
    <limit lower="-9" upper="9" effort="99" velocity="99"/></joint>
  <link name="link"><inertial><origin xyz="0.2 0 0"/><mass value="1.2"/>
    <inertia ixx="0.012" iyy="0.012" izz="0.012" ixy="0" ixz="0" iyz="0"/></inertial></link>
</robot>
"""


@pytest.fixture(scope="module")
def joint(tmp_path_factory: pytest.TempPathFactory) -> ArmModel:
    """Return one joint about a vertical axis."""
    path: Path = tmp_path_factory.mktemp("joint") / "joint.urdf"
    path.write_text(URDF)
    return load_arm(path)


def log(joint: ArmModel, side: str, frequency: float, seed: int, swing: float = 0.0) -> Dataset:
    """Return two logs of a joint whose link swings at a frequency [Hz] behind its held motor; 0: it is rigid.

    They begin with the link off its motor by an angle [rad].
    """
    k = LINK * (2 * np.pi * frequency) ** 2
    d = 0.06 * np.sqrt(k * LINK)
    if frequency:
        a = np.array([[0, 0, 1, 0], [0, 0, 0, 1], [-k / LINK, k / LINK, -d / LINK, d / LINK],
                      [k / ROTOR, -k / ROTOR, d / ROTOR, -d / ROTOR]])  # fmt: skip
        b = np.array([[0], [0], [0], [1 / ROTOR]])
    else:
        a, b = np.array([[0, 1], [0, 0]]), np.array([[0], [1 / (LINK + ROTOR)]])
    step, push, *_ = cont2discrete((a, b, np.eye(len(a)), np.zeros((len(a), 1))), STEP)
    motor = len(a) // 2 - 1  # its own encoder holds it, whichever is logged
    row = motor if side == "motor" else 0
    runs = []
    for number, use in enumerate(USES):
        rng = np.random.default_rng([seed, number])
        t: FloatArray = np.arange(4000) * STEP
        f = np.geomspace(0.5, 20.0, 12)
        fast = np.cos(2 * np.pi * np.outer(t, f) + rng.uniform(0, 6, len(f))).sum(1)
        x, u, y = np.zeros(len(a)), np.zeros(len(t)), np.zeros(len(t))
        x[0] = swing
        for i in range(len(t)):
            y[i] = x[row]
            u[i] = 0.6 * fast[i] - 8.0 * x[motor] - 1.2 * x[motor + len(a) // 2]
            x = step @ x + push[:, 0] * u[i]
        u = u + 0.01 * np.std(u) * rng.standard_normal(len(t))
        y = y + 1e-5 * rng.standard_normal(len(t))
        runs.append(Run(Trajectory(t, u[:, None], y[:, None], PlantSpec(joint.inputs, joint.positions, STEP)), use))
    return Dataset("joint", tuple(runs))


def searched(joint: ArmModel, data: Dataset) -> WideResult:
    return wide_search(joint, arm_runs(joint, data), [0])


@pytest.mark.parametrize("frequency", [pytest.param(8.0, marks=pytest.mark.slow), 16.0])
@pytest.mark.parametrize(("side", "name"), [("motor", "joint_elasticity"), ("link", "joint_elasticity_of_link")])
def test_an_elastic_joint_is_named_by_the_side_that_was_measured(
    joint: ArmModel, side: str, name: str, frequency: float
) -> None:
    """Friction and a rotor stood there, or the arm was said not to fit."""
    result = searched(joint, log(joint, side, frequency, 1))
    assert [str(one.placed) for one in result.accepted] == [f"{name}@q1"]
    spring = result.accepted[0].placed
    main = result.fit.values[spring.name(spring.effect.parameter_names[0])]
    stiffness = (1.0 if side == "motor" else result.rotors[0]) / main
    assert stiffness == pytest.approx(LINK * (2 * np.pi * frequency) ** 2, rel=0.03)
    assert result.rotors[0] == pytest.approx(ROTOR, rel=0.01)


def test_a_record_may_begin_in_the_middle_of_a_swing(joint: ArmModel) -> None:
    """The swing was taken for a misfit of the spring: another joint was named, or a stiffness too surely."""
    result = searched(joint, log(joint, "motor", 16.0, 1, swing=0.03))
    assert [str(one.placed) for one in result.accepted] == ["joint_elasticity@q1"]
    name = result.accepted[0].placed.name("compliance")
    off = np.log(result.fit.values[name] * LINK * (2 * np.pi * 16.0) ** 2)
    assert abs(off) < 3 * result.fit.deviations[name]
    run = arm_runs(joint, log(joint, "motor", 16.0, 1, swing=0.03))["validation"][0]
    left = run.slim(run.motion.u - result.torque(run) - result.rotors[0] * run.motion.a)
    assert np.std(left[: len(left) // 10]) < 1.5 * np.std(left[len(left) // 2 :])


def test_a_rigid_joint_with_a_rotor_has_no_spring(joint: ArmModel) -> None:
    result = searched(joint, log(joint, "motor", 0.0, 2))
    assert not result.accepted
    assert result.rotors[0] == pytest.approx(ROTOR, rel=0.01)


def test_dry_friction_in_a_torque_that_is_half_a_sample_late_is_a_clock_and_no_spring(joint: ArmModel) -> None:
    """Where springs are looked for, the clock's column held no jumps: a rigid six-axis arm had an elastic joint."""
    step, t = 0.01, 0.01 * np.arange(1000)
    f, phase = np.array([0.15, 0.3, 0.5]), np.array([0.3, 1.0, 2.0])
    y = np.sin(2 * np.pi * np.outer(t, f) + phase).sum(1)
    spec = PlantSpec(joint.inputs, joint.positions, step)

    def recorded(late: float) -> ArmRun:
        v = np.cos(2 * np.pi * np.outer(t - late, f) + phase) @ (2 * np.pi * f)
        record = Trajectory(t, np.tanh(v / 0.01)[:, None], y[:, None], spec)
        return clear_runs(arm_runs(joint, Dataset("joint", (Run(record, "estimation"),))))["estimation"][0]

    on_time, late = recorded(0.0), recorded(0.5 * step)
    change = late.slim(late.motion.u - on_time.motion.u)
    clock = 0.5 * step * late.slim(late.first)
    assert np.linalg.norm(change + clock) < 0.5 * np.linalg.norm(change)


def slow_log(joint: ArmModel, rows: int) -> Dataset:
    """Return two logs at 100 Hz of a rigid joint on three slow sines, its encoder with noise."""
    t, f = 0.01 * np.arange(rows), np.array([0.15, 0.3, 0.5])
    runs = []
    for number, use in enumerate(USES):
        rng = np.random.default_rng(number)
        turned = 2 * np.pi * np.outer(t, f) + rng.uniform(0, 6, 3)
        y = np.sin(turned).sum(1) + 3e-4 * rng.standard_normal(rows)
        u = -(LINK + ROTOR) * np.sin(turned) @ (2 * np.pi * f) ** 2 + 0.01 * rng.standard_normal(rows)
        runs.append(Run(Trajectory(t, u[:, None], y[:, None], PlantSpec(joint.inputs, joint.positions, 0.01)), use))
    return Dataset("joint", tuple(runs))


def test_rows_of_a_short_record_hold_nothing_beyond_the_band_in_which_its_motion_is_clear(joint: ArmModel) -> None:
    """A spring whose resonance lay there took the noise of the acceleration out of the torque that is needed."""
    run = clear_runs(arm_runs(joint, slow_log(joint, 1000)))["estimation"][0]
    t = 0.01 * np.arange(1000)
    beyond, within = (run.slim(np.sin(2 * np.pi * f * t)[:, None]) for f in (2.0 * run.clear, 0.5))
    assert np.std(beyond) < 0.2 * np.std(within)


def test_a_record_too_short_for_springs_says_so(joint: ArmModel) -> None:
    notes = searched(joint, slow_log(joint, 400)).notes
    assert any("no elastic joint was looked for" in note and "record longer" in note for note in notes)
    assert not searched(joint, slow_log(joint, 3000)).notes


def test_a_stiff_spring_changes_the_torque_in_proportion_to_its_compliance(joint: ArmModel) -> None:
    """The limit that says what the elasticity is where its resonance is far above the motion."""
    run = arm_runs(joint, log(joint, "motor", 0.0, 3))["estimation"][0]
    spring = swinging(joint, 0)(run)
    one, two = (run.slim(spring(np.array([c, 1e-5]))) for c in (1e-7, 2e-7))
    assert np.allclose(two, 2 * one, rtol=0.02, atol=1e-3 * np.abs(one).max())


@pytest.mark.slow
@pytest.mark.parametrize("side", ["motor", "link"])
def test_the_report_gives_the_stiffness_with_its_interval_and_no_friction(
    joint: ArmModel, side: str, tmp_path: Path
) -> None:
    report = close_loop(log(joint, side, 8.0, 4), joint, out=tmp_path / "out")
    effects: dict[str, Any] = {one["name"]: one["parameters"] for one in report.data["effects"]}
    assert set(effects) == {"joint_elasticity" if side == "motor" else "joint_elasticity_of_link", "rotor_inertia"}
    stiffness = next(iter(effects.values()))["stiffness"]
    assert stiffness["unit"] == "N m/rad"
    assert stiffness["low"] < stiffness["value"] < stiffness["high"]
    assert stiffness["value"] == pytest.approx(LINK * (2 * np.pi * 8.0) ** 2, rel=0.03)
    assert not report.data["misfit"]
    page = (tmp_path / "out" / "report.html").read_text()
    row = page[page.index("Joint by joint") :].partition("q1</td>")[2].partition("</tr>")[0]
    assert "joint elasticity" in row
    assert "rotor inertia" in row


def test_springs_of_one_arm_swing_together() -> None:
    """Each was solved as if the others were rigid: 12 % of a stiffness, and 70 % of the other."""
    rng = np.random.default_rng(5)
    t = np.arange(3000) * STEP
    mass, pull = np.array([[0.6, 0.2], [0.2, 0.1]]), np.array([[5.0, 2.0], [2.0, 3.0]])
    compliance, lag = np.array([1 / 4000, 1 / 900]), np.array([1e-3, 2e-3])
    inner = np.linalg.inv(mass)
    still, loss = np.diag(1 / compliance) + pull, np.diag(lag / compliance)
    a = np.block([[np.zeros((2, 2)), np.eye(2)], [-inner @ still, -inner @ loss]])
    torque = np.cos(np.outer(t, 2 * np.pi * np.geomspace(0.5, 20, 9)) + rng.uniform(0, 6, 9)) @ rng.normal(size=(9, 2))
    first = np.concatenate([np.linalg.solve(still, torque[0]), np.zeros(2)])
    true = lsim((a, np.vstack([np.zeros((2, 2)), inner]), np.eye(4), np.zeros((4, 2))), torque, t, first)[1][:, :2]

    def spring(k: int) -> Swinging:
        inertia, drag, weight = (np.tile(part[:, [k]], (len(t), 1, 1)) for part in (mass, 0.0 * mass, pull))
        return Swinging((k,), torque[:, [k]], inertia, drag, weight, STEP)

    together = spring(0).beside(spring(1)).twist(compliance, lag)[300:, :, 0]
    assert np.abs(together - true[300:]).max() < 0.03 * np.abs(true).max()
    alone = spring(1).twist(compliance[1:], lag[1:])[300:, 0, 0]
    assert np.abs(alone - true[300:, 1]).max() > 0.3 * np.abs(true[:, 1]).max()


def test_a_spring_of_an_arm_that_folds_stays_finite() -> None:
    """An arm folded to a sixth of its inertia: twists of 1e266 rad, and logs of two real arms ended in an error."""
    dt = 0.01
    t = np.arange(3000) * dt
    mass = (3.5 + 2.5 * np.cos(2 * np.pi * 0.3 * t))[:, None, None]
    torque = np.sin(2 * np.pi * 2.0 * t)[:, None]
    spring = Swinging((0,), torque, mass, 0.0 * mass, 0.0 * mass, dt)
    for start in spring.starts():
        twist = spring.twist(np.array([start["compliance"]]), np.array([start["lag"]]))[:, :, 0]
        assert np.abs(twist).max() < 5 * start["compliance"]


def test_what_has_no_inertia_about_its_joint_has_no_spring(tmp_path: Path) -> None:
    """A point mass on the axis of a wrist: the equation of its twist was singular."""
    path = tmp_path / "two.urdf"
    path.write_text(LINKS.replace(f'"{C2} 0 0"', '"0 0 0"').replace(f'"{I2}"', '"0"'))
    names = [str(one) for one in wide_effects(load_arm(path), np.ones(2))]
    assert "joint_elasticity@q1" in names
    assert "joint_elasticity@q2" not in names


M1, M2, REACH, C1, C2, I1, I2 = 3.0, 1.5, 0.4, 0.2, 0.18, 0.05, 0.02
"""Two links in a vertical plane: masses, length of the first, centres, inertias about them."""
LINKS = f"""<robot name="two"><link name="base"/>
  <joint name="j1" type="revolute"><parent link="base"/><child link="a"/><axis xyz="0 1 0"/>
    <limit lower="-9" upper="9" effort="99" velocity="99"/></joint>
  <link name="a"><inertial><origin xyz="{C1} 0 0"/><mass value="{M1}"/>
    <inertia ixx="{I1}" iyy="{I1}" izz="{I1}" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="j2" type="revolute"><parent link="a"/><child link="b"/><origin xyz="{REACH} 0 0"/><axis xyz="0 1 0"/>
    <limit lower="-9" upper="9" effort="99" velocity="99"/></joint>
  <link name="b"><inertial><origin xyz="{C2} 0 0"/><mass value="{M2}"/>
    <inertia ixx="{I2}" iyy="{I2}" izz="{I2}" ixy="0" ixz="0" iyz="0"/></inertial></link>
</robot>
"""
ROTORS = np.array([0.3, 0.06])
SUB = 5


def rates(x: FloatArray, u: FloatArray, k: FloatArray, d: FloatArray) -> FloatArray:
    """Return the rates of links, motors and their speeds (8,): each link hangs on its motor by k and d."""
    q, v, w = x[:2], x[4:6], x[6:]
    through = k * (x[2:4] - q) + d * (w - v)
    c, h = np.cos(q[1]), M2 * REACH * C2 * np.sin(q[1])
    far, between = I2 + M2 * C2**2, I2 + M2 * C2**2 + M2 * REACH * C2 * c
    near = I1 + M1 * C1**2 + M2 * REACH**2 + far + 2 * M2 * REACH * C2 * c
    second = 9.81 * M2 * C2 * np.cos(q[0] + q[1])  # weights turn the joints forward
    first = 9.81 * (M1 * C1 + M2 * REACH) * np.cos(q[0]) + second
    one = through[0] + h * (2 * v[0] * v[1] + v[1] ** 2) + first
    two = through[1] - h * v[0] ** 2 + second
    a = np.array([far * one - between * two, near * two - between * one]) / (near * far - between**2)
    return np.concatenate([v, w, a, (u - np.array([0.5, 0.1]) * w - through) / ROTORS])


def two_springs(arm: ArmModel, k: FloatArray, d: FloatArray) -> Dataset:
    """Return two logs of the motors of both joints, by the method of Runge and Kutta."""
    runs = []
    for number, use in enumerate(USES):
        rng, t = np.random.default_rng(number), np.maximum(np.arange(-400, 2500), 0) * STEP  # they begin at rest
        f = np.geomspace(0.5, 25.0, 14)
        push = np.cos(2 * np.pi * np.multiply.outer(t, np.outer([1.0, 1.13], f)) + rng.uniform(0, 6, (2, 14))).sum(2)
        push[:400] = 0.0
        wanted = 0.6 * np.sin(2 * np.pi * np.outer(t, [0.31, 0.43]) + rng.uniform(0, 6, 2)) + [1.3, 0.0]
        x = np.concatenate([wanted[0], wanted[0], np.zeros(4)])
        u, y = np.zeros((len(t), 2)), np.zeros((len(t), 2))
        h = STEP / SUB
        for i in range(len(t)):
            y[i] = x[2:4]
            u[i] = [4.0, 1.0] * push[i] + [60.0, 15.0] * (wanted[i] - x[2:4]) - np.array([8.0, 1.5]) * x[6:]
            for _ in range(SUB):
                a = rates(x, u[i], k, d)
                b = rates(x + h / 2 * a, u[i], k, d)
                c = rates(x + h / 2 * b, u[i], k, d)
                x = x + h / 6 * (a + 2 * b + 2 * c + rates(x + h * c, u[i], k, d))
        kept = slice(400, None)
        torque = u[kept] + 0.01 * u[kept].std(axis=0) * rng.standard_normal(u[kept].shape)
        read = y[kept] + 1e-5 * rng.standard_normal(y[kept].shape)
        runs.append(Run(Trajectory(t[kept], torque, read, PlantSpec(arm.inputs, arm.positions, STEP)), use))
    return Dataset("two", tuple(runs))


def test_gradients_half_way_along_a_twist_give_the_torques_of_the_links(tmp_path: Path) -> None:
    """Taken at the motors, they left 0.2 % of a stiffness to the weight that bends the other joints."""
    path = tmp_path / "two.urdf"
    path.write_text(LINKS)
    arm, t, w = load_arm(path), 0.002 * np.arange(2000), 2 * np.pi * np.array([3.0, 4.0])
    y = np.sin(2 * np.pi * np.outer(t, [0.3, 0.5]))
    record = Trajectory(t, 1.0 + 0.0 * y, y, PlantSpec(arm.inputs, arm.positions, 0.002))
    run = arm_runs(arm, Dataset("two", (Run(record, "estimation"),)))["estimation"][0]
    e, m = 0.05 * np.cos(w * t[:, None]), run.calm
    twist = (e, -0.05 * w * np.sin(w * t[:, None]), -(w**2) * e)
    link = arm.torques(m.q - twist[0], m.v - twist[1], m.a - twist[2]) - arm.torques(m.q, m.v, m.a)
    left = []
    for known in (run, replace(run, twist=e)):
        springs = [swinging(arm, k)(known) for k in range(2)]
        parts = [(one.pull, one.drag, one.mass) for one in springs]
        more = -sum(g[:, :, 0] * d[:, [k]] for k, each in enumerate(parts) for g, d in zip(each, twist, strict=True))
        left.append(float(np.linalg.norm((link - more)[50:-50])))
    assert left[1] < 0.05 * left[0]


@pytest.mark.slow
def test_two_elastic_joints_are_both_named_with_their_stiffness(tmp_path: Path) -> None:
    path = tmp_path / "two.urdf"
    path.write_text(LINKS)
    arm = load_arm(path)
    k = np.array([4500.0, 1300.0])  # 14 and 22 Hz behind their held motors
    result = wide_search(arm, arm_runs(arm, two_springs(arm, k, k / 1800)), [0, 1])
    assert {str(one.placed) for one in result.accepted} == {"joint_elasticity@q1", "joint_elasticity@q2"}
    for one in result.accepted:
        name = one.placed.name("compliance")
        true = k[int(one.placed.at[-1]) - 1]
        assert 1 / result.fit.values[name] == pytest.approx(true, rel=0.002)
        assert abs(np.log(result.fit.values[name] * true)) < 4 * result.fit.deviations[name]
    assert result.rotors == pytest.approx({0: 0.3, 1: 0.06}, rel=0.01)
