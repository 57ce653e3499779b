"""Exact logs of one geared joint: laws that are simpler ones at their limit, torques that explain themselves."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import pytest

from harness.diagnosis.arm.rotor import rotor_inertia
from harness.diagnosis.arm.simpler import becomes
from harness.diagnosis.close import close_loop
from harness.effects import builtin
from harness.errors import InputError
from harness.physics.arms.arm import ArmModel, load_arm
from harness.physics.arms.formats.urdf import load_urdf
from harness.signals import Dataset, FloatArray, PlantSpec, Run, Trajectory

DT, ROWS = 0.005, 800
T = np.arange(ROWS) * DT
USES: tuple[Literal["estimation", "validation"], ...] = ("estimation", "validation")
J = 0.05 + 5 * 0.2**2
"""Of the link about its vertical axis [kg m^2]."""


NAMES = ("viscous_friction", "coulomb_friction", "sublinear_friction", "yield_friction", "input_gain")
LAWS = [*(builtin()[name] for name in NAMES), rotor_inertia]
"""Those that were named wrongly, and the right ones: a search of all takes longer."""


@pytest.fixture(scope="module")
def urdf(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("arm") / "geared.urdf"
    path.write_text(
        '<robot name="geared"><link name="base"/><joint name="j1" type="revolute"><parent link="base"/>'
        '<child link="l1"/><axis xyz="0 0 1"/></joint><link name="l1"><inertial><origin xyz="0.2 0 0.1"/>'
        '<mass value="5"/><inertia ixx="0.05" iyy="0.05" izz="0.05" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>'
    )
    return str(path)


def motion(seed: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return position, rate and acceleration of four sines, at most 2.5 rad/s."""
    rng = np.random.default_rng(seed)
    w = 2 * np.pi * np.array([0.25, 0.5, 0.75, 1.0])
    size, turn = rng.normal(size=4) / w, T[:, None] * w + rng.uniform(0, 6.28, 4)
    q, v, a = np.sin(turn) @ size, np.cos(turn) @ (w * size), -np.sin(turn) @ (w**2 * size)
    k = 2.5 / np.abs(v).max()
    return k * q, k * v, k * a


def log(arm: ArmModel, *, dry: float = 0.0, viscous: float = 0.0, rotor: float = 0.0, noise: float = 0.05) -> Dataset:
    """Return records whose torque is written from its law."""
    runs = []
    for seed, use in enumerate(USES, start=1):
        q, v, a = motion(seed)
        rng = np.random.default_rng(seed + 9)
        u = (J + rotor) * a + viscous * v + dry * np.tanh(v / 0.01) + noise * rng.normal(size=ROWS)
        y = q + 1e-5 * rng.normal(size=ROWS)
        runs.append(Run(Trajectory(T, u[:, None], y[:, None], PlantSpec(arm.inputs, arm.positions, DT)), use))
    return Dataset("geared", tuple(runs))


def named(data: dict[str, Any]) -> dict[str, float]:
    """Return the effects with their first value."""
    return {one["name"]: next(iter(one["parameters"].values()))["value"] for one in data["effects"]}


@pytest.mark.slow
def test_a_geared_joint_with_free_inertia_is_not_explained_by_a_torque_near_zero(urdf: str) -> None:
    """The gain fell to 0.002: the measured torque stood on both sides, and explained itself."""
    arm = load_arm(urdf, inertia="calibrated")
    report = close_loop(log(arm, dry=0.5, viscous=0.5), arm, dictionary=LAWS)
    assert named(report.data) == {
        "coulomb_friction": pytest.approx(0.5, rel=0.05),
        "viscous_friction": pytest.approx(0.5, rel=0.05),
    }, report.data["summary"]
    assert not report.data["stand_in"]["flagged"]


@pytest.mark.slow
def test_a_rotor_of_many_times_the_link_is_no_gain_of_another_unit(urdf: str) -> None:
    arm = load_arm(urdf)
    report = close_loop(log(arm, dry=2.0, viscous=2.0, rotor=0.9), arm, dictionary=LAWS)
    found = named(report.data)
    assert set(found) == {"coulomb_friction", "viscous_friction", "rotor_inertia"}, report.data["summary"]
    assert found["rotor_inertia"] == pytest.approx(0.9, rel=0.05)


def test_every_law_becomes_only_laws_of_fewer_parameters() -> None:
    """So taking simpler ones ends; whatever order the dictionary has."""
    known = builtin()
    for effect in known.values():
        free = sum(not parameter.fixed for parameter in effect.parameters)
        assert all(sum(not p.fixed for p in law.parameters) < free for law in becomes(effect, known))
    turned = dict(reversed(known.items()))
    for name in known:
        assert set(becomes(known[name], turned)) == set(becomes(known[name], known))
    assert {law.name for law in becomes(known["sublinear_friction"], known)} == {"coulomb_friction", "viscous_friction"}


@pytest.mark.parametrize("level", [0.0, 3.0])
def test_torques_that_never_change_are_refused_in_plain_words(urdf: str, level: float) -> None:
    """A percentage of 300 digits stood in the headline."""
    arm = load_arm(urdf)
    data = log(arm)
    runs = [
        Run(Trajectory(T, np.full((ROWS, 1), level), one.trajectory.y, one.trajectory.spec), one.use)
        for one in data.runs
    ]
    with pytest.raises(InputError, match=f"tau1 = {level:g} N m in every row"):
        close_loop(Dataset("zeros", tuple(runs)), arm)


def test_a_joint_whose_position_is_noise_stands_still(urdf: str) -> None:
    arm = load_arm(urdf)
    runs = [
        Run(Trajectory(T, one.trajectory.u, one.trajectory.y * 0 + noise, one.trajectory.spec), one.use)
        for one, noise in zip(log(arm).runs, np.random.default_rng(0).normal(0, 1e-5, (2, ROWS, 1)), strict=True)
    ]
    with pytest.raises(InputError, match="no joint of 'still' moves"):
        close_loop(Dataset("still", tuple(runs)), arm)


TWO = """<robot name="two"><link name="base"/>
<joint name="j1" type="revolute"><parent link="base"/><child link="l1"/><axis xyz="0 1 0"/></joint>
<link name="l1"><inertial><origin xyz="0.2 0 0"/><mass value="5"/>
<inertia ixx="0.02" iyy="0.08" izz="0.08" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="j2" type="revolute"><parent link="l1"/><child link="l2"/><axis xyz="0 1 0"/><origin
xyz="0.45 0 0"/></joint>
<link name="l2"><inertial><origin xyz="0.15 0 0"/><mass value="3"/>
<inertia ixx="0.01" iyy="0.04" izz="0.04" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>"""


def two_links(arm: ArmModel) -> Dataset:
    """Return records of an arm with friction and noise."""
    runs = []
    for number, use in enumerate(USES):
        q, v, a = (np.stack(columns, axis=1) for columns in zip(motion(10 + number), motion(20 + number), strict=True))
        rng = np.random.default_rng(number)
        u = arm.torques(q, v, a) + np.array([0.2, 0.1]) * (v + np.tanh(v / 0.01))
        u += 0.05 * rng.normal(size=u.shape)
        y = q + 1e-5 * rng.normal(size=q.shape)
        runs.append(Run(Trajectory(T, u, y, PlantSpec(arm.inputs, arm.positions, DT)), use))
    return Dataset("two links", tuple(runs), intersample="smooth")


def loaded(folder: Any, text: str) -> ArmModel:
    path = folder / "arm.urdf"
    path.write_text(text)
    return load_arm(path)


@pytest.mark.slow
def test_a_urdf_with_half_of_the_masses_is_not_explained_away(tmp_path: Any) -> None:
    data = two_links(loaded(tmp_path, TWO))
    light = TWO
    for whole, half in (('mass value="5"', 'mass value="2.5"'), ('mass value="3"', 'mass value="1.5"')):
        light = light.replace(whole, half)
    report = close_loop(data, loaded(tmp_path, light), dictionary=[])
    assert report.verdict == "model_does_not_fit", report.data["summary"]
    assert "does not describe this arm: masses or lengths" in report.data["summary"]
    assert not report.data["effects"]


def test_what_a_reader_should_know_of_a_urdf_is_said() -> None:
    assert not load_urdf_notes(TWO)
    bare = TWO.replace('ixx="0.01" iyy="0.04" izz="0.04"', 'ixx="0" iyy="0" izz="0"')
    assert "link l2 no inertia tensor" in load_urdf_notes(bare)
    wrong = TWO.replace('ixx="0.01" iyy="0.04" izz="0.04"', 'ixx="0.01" iyy="0.4" izz="0.01"')
    assert "link l2 an inertia that no body has" in load_urdf_notes(wrong)
    geared = TWO.replace(
        "</robot>",
        '<transmission name="t"><joint name="j2"/><actuator name="m"><mechanicalReduction>50</mechanicalReduction>'
        "</actuator></transmission></robot>",
    )
    assert "gear ratio of 50 at joint j2" in load_urdf_notes(geared)


def load_urdf_notes(text: str) -> str:
    """Return the notes of an arm."""
    import tempfile
    from pathlib import Path

    with tempfile.TemporaryDirectory() as folder:
        return "; ".join(loaded(Path(folder), text).notes)


def test_a_joint_that_follows_another_one_has_to_be_locked(tmp_path: Any) -> None:
    text = TWO.replace('<axis xyz="0 1 0"/><origin', '<mimic joint="j1"/><axis xyz="0 1 0"/><origin')
    with pytest.raises(InputError, match="joint j2: a joint that follows another one"):
        loaded(tmp_path, text)
    assert load_arm(tmp_path / "arm.urdf", locked=["j2"]).n == 1
    assert load_urdf(tmp_path / "arm.urdf").n == 2
