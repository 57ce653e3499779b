"""Robots whose base floats: MuJoCo's inverse dynamics, Jacobians and contacts; bodies from a record of a quadruped."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harness import api
from harness.errors import FitError, InputError
from harness.physics.arms.contact import friction_cone, restitution
from harness.physics.arms.floating import BaseMotion, FloatingRobot, eliminated, load_floating, rotation_matrices
from harness.signals import Dataset, Run, Trajectory

mujoco = pytest.importorskip("mujoco", reason="MuJoCo is not installed: pip install 'sysid-harness[mujoco]'")

DOG = Path(__file__).parents[2] / "examples" / "quadruped.xml"
FEET = ("FL", "FR", "RL", "RR")


@cache
def robot() -> FloatingRobot:
    return load_floating(DOG)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10**6), rate=st.floats(0.0, 5.0))
def test_forces_and_jacobians_are_those_of_mujoco(seed: int, rate: float) -> None:
    rng = np.random.default_rng(seed)
    q, v, a = rng.normal(size=(3, 1, 12)) * np.array([1.0, rate, 5.0])[:, None, None]
    quaternion = rng.normal(size=(1, 4))
    velocity, acceleration, spin, turning = rng.normal(size=(4, 1, 3)) * np.array([1, 3, rate, 4.0])[:, None, None]
    R = rotation_matrices(quaternion)
    found = robot().forces(BaseMotion(R, acceleration, spin, turning), q, v, a)[0]
    model = mujoco.MjModel.from_xml_path(str(DOG))
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    data = mujoco.MjData(model)
    data.qpos[:] = np.concatenate([rng.normal(size=3), quaternion[0] / np.linalg.norm(quaternion), q[0]])
    data.qvel[:] = np.concatenate([velocity[0], spin[0], v[0]])
    data.qacc[:] = np.concatenate([acceleration[0], turning[0], a[0]])
    mujoco.mj_inverse(model, data)
    wanted = data.qfrc_inverse.copy()
    wanted[:3] = R[0].T @ wanted[:3]  # MuJoCo's is in the axes of the world
    assert np.abs(found - wanted).max() < 1e-10 * max(np.abs(wanted).max(), 1.0)
    moved, turned = np.zeros((2, 3, 18))
    mujoco.mj_jacSite(model, data, moved, turned, model.site("RR").id)
    own = np.concatenate([R[0].T @ moved, R[0].T @ turned])
    own[:, :3] = own[:, :3] @ R[0]
    assert np.abs(robot().jacobian("RR", q)[0] - own).max() < 1e-12


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10**6), feet=st.sets(st.sampled_from(FEET), min_size=1))
def test_no_force_at_a_contact_works_on_what_is_left(seed: int, feet: set[str]) -> None:
    q = np.random.default_rng(seed).normal(size=(3, 12))
    jacobian = np.concatenate([robot().jacobian(foot, q)[:, :3] for foot in sorted(feet)], axis=1)
    directions, count = eliminated(jacobian)
    assert np.abs(jacobian @ directions).max() < 1e-12
    assert count.tolist() == [18 - int(np.linalg.matrix_rank(one)) for one in jacobian]
    assert np.allclose(np.sum(directions**2, axis=(1, 2)), count)


@cache
def stance() -> Trajectory:
    """Return a record of the quadruped as it shifts its weight, feet lifting and setting down."""
    options = {"model": str(DOG), "sample_time": 0.001, "substeps": 2, "outputs": ["q", "qd", "sensors"]}
    scenario = {"duration": 2.0, "noise": 0.0, "amplitude": 0.1, "band": [0.4, 3.0]}
    return api.simulate("mjcf", scenario="multisine", options=options, scenario_options=scenario)


@pytest.mark.parametrize("unmeasured", [(), FEET], ids=["forces measured", "forces eliminated"])
def test_the_mass_of_a_trunk_is_recovered_with_and_without_forces_at_the_feet(
    tmp_path: Path, unmeasured: tuple[str, ...]
) -> None:
    """The file says 5 kg, and a centre elsewhere; the record is of 6.5 kg."""
    wrong = tmp_path / "dog.xml"
    text = DOG.read_text(encoding="utf-8").replace('pos=".01 .002 .005" mass="6.5"', 'pos="0 0 0" mass="5"')
    wrong.write_text(text, encoding="utf-8")
    found = analysed(model=str(wrong), free=["trunk"], unmeasured=unmeasured, trust=1.0)
    (trunk,) = found.rows
    assert trunk["mass [kg]"] == pytest.approx(6.5, rel=0.01)
    assert trunk["centre x [m]"] == pytest.approx(0.01, abs=2e-3)
    assert trunk["+- (95 %)"] < 0.1
    assert any("eliminated" in text for text in found.words) == bool(unmeasured)


def analysed(**options: Any) -> Any:
    from identifiers.mechanics.arms.floating import FloatingInertial

    data = Dataset("dog", (Run(stance(), "estimation"),))
    made = FloatingInertial(contacts=FEET, radius=0.02, **options)
    return made.of(data, rng=np.random.default_rng(0))


def test_a_floating_tree_has_three_base_parameters_less_for_every_joint() -> None:
    found = analysed(model=str(DOG))
    assert "94 combinations of 130 inertial parameters" in found.words[1]
    assert {row["body"] for row in found.rows} == set(robot().names)
    for row in found.rows:
        assert abs(row["mass [kg]"] - row["mass of the file [kg]"]) < 1.5 * row["+- (95 %)"]


def test_a_contact_that_the_file_lacks_and_a_base_that_stands_are_refused() -> None:
    with pytest.raises(InputError, match="contact 'XX'"):
        robot().jacobian("XX", np.zeros((1, 12)))
    with pytest.raises(InputError, match="one free joint"):
        load_floating(DOG.parent / "gripper_arm.xml")


def block(mu: float, slope: float, bounce: tuple[float, float] | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Return forces (N, 3) and velocities (N, 3) of a ball that MuJoCo pushes along a floor, or lets fall."""
    soft = "" if bounce is None else f'solref="-{bounce[0]} -{bounce[1]}"'
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><option timestep="0.0002" cone="elliptic" impratio="20"
    gravity="{9.81 * slope} 0 -9.81" integrator="implicitfast"/><worldbody><geom type="plane" size="0 0 1"
    friction="{mu}" {soft}/><body pos="0 0 {0.1 if bounce is None else 0.6}"><joint type="slide" axis="1 0 0"/>
    <joint type="slide" axis="0 0 1"/><geom type="sphere" size=".1" mass="1" friction="{mu}" {soft}/></body></worldbody>
    <sensor><contact geom1="floor" data="force" reduce="netforce"/></sensor></mujoco>""".replace(
            'type="plane"', 'type="plane" name="floor"'
        )
    )
    data, force, speed = mujoco.MjData(model), [], []
    for _ in range(5000):
        mujoco.mj_forward(model, data)
        force.append(data.sensordata.copy())
        speed.append([data.qvel[0], 0.0, data.qvel[1]])
        mujoco.mj_step(model, data)
    return np.abs(np.array(force)) * np.array([-1.0, 1.0, 1.0]), np.array(speed)


@pytest.mark.parametrize("mu", [0.2, 0.5])
def test_the_friction_of_a_ball_that_slides_in_mujoco(mu: float) -> None:
    cone = friction_cone(*block(mu, slope=2 * mu))
    assert cone.sliding == pytest.approx(mu, rel=0.02)
    held = friction_cone(*block(mu, slope=0.5 * mu))
    assert np.isnan(held.sliding)
    assert 0.499 * mu < held.at_least < mu


@pytest.mark.parametrize("damping", [10.0, 60.0])
def test_the_restitution_of_a_ball_that_falls_in_mujoco(damping: float) -> None:
    """Of a spring that does not pull: Schwager & Poeschel 2007, *Granular Matter* 9:465, eq. 20."""
    force, speed = block(0.5, 0.0, (1e4, damping))
    decay, turn = damping / 2, np.sqrt(1e4 - (damping / 2) ** 2)
    wanted = np.exp(-decay / turn * (np.pi - np.arctan(2 * decay * turn / (turn**2 - decay**2))))
    assert restitution(speed[:, 2], force[:, 2], least=0.5).coefficient == pytest.approx(wanted, abs=0.02)


def test_no_contact_and_no_impact_are_said() -> None:
    with pytest.raises(FitError, match="along the normal"):
        friction_cone(np.zeros((20, 3)), np.zeros((20, 3)))
    with pytest.raises(FitError, match="impact"):
        restitution(np.zeros(20), np.ones(20))
