"""A joint of a URDF that gives way: the truth is a two-mass equation stepped here, not the law that is fitted."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from scipy.signal import cont2discrete

from harness.diagnosis.arm.motion import arm_runs
from harness.diagnosis.arm.rotor import swinging
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


def log(joint: ArmModel, side: str, frequency: float, seed: int) -> Dataset:
    """Return two logs of a joint whose link swings at a frequency [Hz] behind its held motor; 0: it is rigid."""
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


def test_a_rigid_joint_with_a_rotor_has_no_spring(joint: ArmModel) -> None:
    result = searched(joint, log(joint, "motor", 0.0, 2))
    assert not result.accepted
    assert result.rotors[0] == pytest.approx(ROTOR, rel=0.01)


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
