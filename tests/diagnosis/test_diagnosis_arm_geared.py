"""A geared joint: friction and a rotor above the link's own inertia, torques from noisy currents, encoders."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest

from harness.diagnosis.arm.effects import wide_effects
from harness.diagnosis.arm.joint import JointRegression, joint_dictionary
from harness.diagnosis.arm.motion import arm_runs, moving_rows
from harness.diagnosis.arm.regression import RegressionForm, regression_detail
from harness.diagnosis.close import close_loop
from harness.physics.arms.arm import ArmModel, load_arm
from harness.signals import Dataset, FloatArray, PlantSpec, Run, Trajectory

USES: tuple[Literal["estimation", "validation"], ...] = ("estimation", "validation")
INERTIA = 0.1
"""Of the link about its axis [kg m^2]: 2 kg at 0.2 m, and 0.02."""
URDF = """<robot name="joint"><link name="base"/>
  <joint name="j" type="revolute"><parent link="base"/><child link="link"/><axis xyz="0 0 1"/>
    <limit lower="-9" upper="9" effort="99" velocity="99"/></joint>
  <link name="link"><inertial><origin xyz="0.2 0 0"/><mass value="2"/>
    <inertia ixx="0.02" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial></link>
</robot>
"""
Torque = Callable[[FloatArray, FloatArray], FloatArray]


@pytest.fixture(scope="module")
def joint(tmp_path_factory: pytest.TempPathFactory) -> ArmModel:
    """Return one joint about a vertical axis: gravity tells nothing."""
    path: Path = tmp_path_factory.mktemp("joint") / "joint.urdf"
    path.write_text(URDF)
    return load_arm(path)


def motion(seed: int, dt: float, seconds: float = 8.0) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return instants, and a sum of five sines with its rate, of 2 rad/s at most, and acceleration."""
    rng = np.random.default_rng(seed)
    t: FloatArray = np.asarray(np.arange(round(seconds / dt)) * dt, dtype=np.float64)
    w = 2 * np.pi * 0.2 * np.arange(1, 6)
    size, phase = rng.normal(size=5), rng.uniform(0, 6, 5)
    turn = np.outer(t, w) + phase
    q, v, a = (size / w * np.sin(turn)).sum(1), (size * np.cos(turn)).sum(1), (-size * w * np.sin(turn)).sum(1)
    most = 2.0 / np.abs(v).max()
    return t, most * q, most * v, most * a


def records(
    joint: ArmModel, more: Torque, noise: float, intersample: str, angle: float = 1e-5, dt: float = 0.002
) -> Dataset:
    """Return two logs of a joint with a torque more(v, a), the whole noisy by this share of its size."""
    runs = []
    for seed, use in enumerate(USES):
        t, q, v, a = motion(seed, dt)
        rng = np.random.default_rng(10 + seed)
        u = INERTIA * a + more(v, a)
        u = u + noise * np.std(u) * rng.normal(size=len(u))
        y = q + angle * rng.normal(size=len(q))
        runs.append(Run(Trajectory(t, u[:, None], y[:, None], PlantSpec(joint.inputs, joint.positions, dt)), use))
    return Dataset("joint", tuple(runs), intersample=intersample)  # type: ignore[arg-type]


def found(report: Any) -> dict[str, dict[str, float]]:
    return {one["name"]: {k: v["value"] for k, v in one["parameters"].items()} for one in report.data["effects"]}


@pytest.mark.parametrize("intersample", ["zoh", pytest.param("smooth", marks=pytest.mark.slow)])
@pytest.mark.parametrize("noise", [0.02, pytest.param(0.1, marks=pytest.mark.slow)])
def test_the_noise_of_a_torque_is_no_spring(joint: ArmModel, noise: float, intersample: str) -> None:
    """A compliance whose column held the measured torque was found in every third such log."""
    report = close_loop(records(joint, lambda v, a: 0.0 * v, noise, intersample), joint)
    assert report.verdict == "nothing_missing", report.data["summary"]


def test_what_a_spring_carries_is_what_the_bodies_need(joint: ArmModel) -> None:
    """Neither the noise of the measured torque nor the friction of the motor shows in the column."""
    plain, other = (
        arm_runs(joint, records(joint, more, noise, "smooth"))["estimation"][0]
        for more, noise in ((lambda v, a: 0.0 * v, 0.0), (lambda v, a: np.sign(v), 0.1))
    )
    torques = np.ones(1)
    (spring,) = [one for one in wide_effects(joint, torques) if one.placed.effect.name == "joint_elasticity"]
    assert np.array_equal(spring.columns(plain), spring.columns(other))


def test_a_motion_that_is_followed_less_than_its_torque_leaves_nothing(joint: ArmModel) -> None:
    """Positions were filtered and held torques were not: the difference was a spring's."""
    run = arm_runs(joint, records(joint, lambda v, a: 0.0 * v, 0.0, "zoh"))["estimation"][0]
    rows = run.motion.inside
    left = run.motion.u[rows, 0] - run.rigid[rows, 0]
    late = run.first[rows, 0]
    left = left - late * (late @ left) / (late @ late)  # half a sample
    assert np.std(left) < 2e-3 * np.std(run.rigid[rows, 0])


def test_an_interpolated_record_has_no_ringing_at_its_ends(joint: ArmModel) -> None:
    """Exact positions are followed on a finer grid, which rings within ten samples of the ends."""
    run = arm_runs(joint, records(joint, lambda v, a: 0.0 * v, 0.0, "smooth", angle=0.0))["estimation"][0]
    left = np.abs((run.motion.u - run.rigid)[run.motion.inside, 0])
    middle = left[len(left) // 4 : -len(left) // 4].max()
    assert max(left[:40].max(), left[-40:].max()) < 1e-4
    assert middle < 1e-6


def test_what_a_pause_hides_is_carried_nowhere(joint: ArmModel) -> None:
    """The torque of a joint at rest may be anything, and a filter carries it into the motion before and after."""
    dt, rest = 0.002, slice(1500, 2500)
    t, q, v, a = motion(0, dt)
    fade = np.ones(len(t))
    fade[rest] = 0.0
    ramp = np.hanning(101) / np.hanning(101).sum()
    v = v * np.convolve(fade, ramp, "same")
    q, a = np.cumsum(v) * dt, np.gradient(v, dt)
    rng = np.random.default_rng(0)
    y = q + 1e-5 * rng.normal(size=len(q))
    logs = []
    for held in (0.0, 0.9):  # what keeps the joint at rest
        u = INERTIA * a + np.tanh(v / 1e-3)
        u[1540:2460] += held
        spec = PlantSpec(joint.inputs, joint.positions, dt)
        runs = tuple(Run(Trajectory(t, u[:, None], y[:, None], spec), use) for use in USES)
        logs.append(arm_runs(joint, Dataset("joint", runs, intersample="smooth"))["estimation"][0])
    rows = moving_rows(logs[0].motion)[:, 0] > 0
    one, other = (run.slim(run.motion.u)[rows, 0] for run in logs)
    assert rows.mean() > 0.5
    assert np.abs(one - other).max() < 0.05


@pytest.mark.slow
@pytest.mark.parametrize("noise", [0.02, 0.1])
def test_a_rotor_beside_dry_friction_and_drag_is_found(joint: ArmModel, noise: float) -> None:
    """Alone none of them was confirmed: an error that remembers takes up what the others leave."""
    data = records(joint, lambda v, a: 0.15 * a + 0.6 * np.tanh(v / 0.01) + 0.15 * v * np.abs(v), noise, "smooth")
    effects = found(report := close_loop(data, joint))
    assert set(effects) == {"coulomb_friction", "quadratic_drag", "rotor_inertia"}, report.data["summary"]
    assert effects["rotor_inertia"]["J"] == pytest.approx(0.15, rel=0.05)
    assert effects["coulomb_friction"]["Fc"] == pytest.approx(0.6, rel=0.05)
    rotor = next(tie for tie in report.data["tie_sets"] if tie[0]["name"] == "rotor_inertia")
    assert "input_gain" in {member["name"] for member in rotor}, "without gravity the two are one"


@pytest.mark.slow
def test_friction_of_the_load_is_told_beside_dry_friction(joint: ArmModel) -> None:
    """Friction in proportion to what the bodies need, not to a torque that is mostly friction itself."""

    def load(v: FloatArray, a: FloatArray) -> FloatArray:
        return INERTIA * a * (1 / (1 - 0.2 * np.sign(a) * np.tanh(v / 0.01)) - 1)

    data = records(joint, lambda v, a: load(v, a) + 0.5 * np.tanh(v / 0.01) + 0.1 * v, 0.005, "smooth")
    effects = found(report := close_loop(data, joint))
    assert set(effects) == {"coulomb_friction", "viscous_friction", "load_dependent_friction"}, report.data["summary"]
    assert effects["load_dependent_friction"]["mu"] == pytest.approx(0.2, rel=0.15)


def test_dry_friction_jumps_where_the_joint_turns_and_not_at_the_next_of_few_samples(joint: ArmModel) -> None:
    """Looked at at every tenth sample, the sign was widened to fit one record and erred by as much in the next."""
    data = records(joint, lambda v, a: 2.0 * np.tanh(v / 0.005), 0.003, "smooth")
    runs = arm_runs(joint, data)
    known = {use: [run.rigid[:, 0] for run in parts] for use, parts in runs.items()}
    regression = JointRegression(joint, 0, runs, known)
    dry = [one for one in joint_dictionary(joint, 0, regression) if one.effect.name == "coulomb_friction"]
    fit = RegressionForm(regression).fit(dry, [{}], None)
    assert fit is not None
    left = {use: float(np.std(parts[0])) for use, parts in regression_detail(fit).residual.items()}
    assert regression.motions["estimation"][0].factor >= 8, "few rows are judged"
    assert left["validation"] < 1.5 * left["estimation"]
    assert fit.values["coulomb_friction@q1.w"] < 0.02


@pytest.mark.slow
def test_a_level_that_falls_is_found_beside_a_drag_and_a_rotor(joint: ArmModel) -> None:
    """From nothing the search ended with Coulomb's friction: with Stribeck's begun from one start only, too."""

    def brakes(v: FloatArray, a: FloatArray) -> FloatArray:
        return 0.15 * a + (0.8 + 0.7 * np.exp(-((v / 0.3) ** 2))) * np.tanh(v / 0.005) + 0.3 * v

    report = close_loop(records(joint, brakes, 0.01, "smooth"), joint)
    assert set(found(report)) == {"stribeck_friction", "viscous_friction", "rotor_inertia"}, report.data["summary"]


@pytest.mark.slow
def test_two_effects_that_are_one_law_at_its_limit_are_tied_with_it(joint: ArmModel) -> None:
    """Noise of a tenth does not tell stiff grease from dry and viscous friction, and only the two were named."""

    def grease(v: FloatArray, a: FloatArray) -> FloatArray:
        return (0.3 + 0.15 * np.abs(v) ** 0.6) * np.tanh(v / 0.005)

    report = close_loop(records(joint, grease, 0.1, "smooth"), joint)
    groups = [{member["name"] for member in tie} for tie in report.data["tie_sets"]]
    assert "yield_friction" in found(report) or any("yield_friction" in group for group in groups)
