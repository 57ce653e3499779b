"""An arm as a nominal model: what its URDF says of torques, and what it refuses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from harness.errors import InputError
from harness.physics.arms.arm import load_arm

pytest.importorskip("pybullet_data", reason="pybullet has wheels for CPython 3.10 and 3.11 only")

ONE = """<robot name="one"><link name="base"/><link name="rod"><inertial><origin xyz="0.5 0 0"/><mass value="2"/>
<inertia ixx="0" ixy="0" ixz="0" iyy="0" iyz="0" izz="0"/></inertial></link><joint name="hinge" type="continuous">
<parent link="base"/><child link="rod"/><axis xyz="0 -1 0"/>{dynamics}</joint></robot>"""


def one_joint(folder: Path, dynamics: str = "") -> Path:
    path = folder / "one.urdf"
    path.write_text(ONE.format(dynamics=dynamics))
    return path


def test_torques_follow_the_closed_form_of_a_pendulum(tmp_path: Path) -> None:
    arm = load_arm(one_joint(tmp_path, '<dynamics damping="0.3" friction="0.2"/>'))
    q, v, a = np.random.default_rng(0).uniform(-1, 1, (3, 40, 1))
    expected = 2 * 0.25 * a + 2 * 9.81 * 0.5 * np.cos(q)
    np.testing.assert_allclose(arm.torques(q, v, a), expected, atol=1e-12)
    fast = np.full((1, 1), 2.0)
    np.testing.assert_allclose(arm.damped(fast), [[0.3 * 2.0 + 0.2]], atol=1e-9)


def test_torques_are_linear_in_the_inertial_parameters() -> None:
    arm = load_arm("iiwa")
    q, v, a = np.random.default_rng(1).uniform(-1, 1, (3, 30, 7))
    rng = np.random.default_rng(2)
    one, two = rng.standard_normal((2, arm.arm.parameters.size))
    both = arm.torques(q, v, a, parameters=one) + 2.0 * arm.torques(q, v, a, parameters=two)
    np.testing.assert_allclose(arm.torques(q, v, a, parameters=one + 2.0 * two), both, atol=1e-9)
    single = arm.arm.inverse_dynamics(q[0], v[0], a[0])
    np.testing.assert_allclose(arm.torques(q, v, a)[0], single, atol=1e-12)


def test_damping_of_the_iiwa_is_that_of_its_file() -> None:
    assert load_arm("iiwa").damping.tolist() == [0.5] * 7


@pytest.mark.parametrize(
    ("options", "says"),
    [({"inertia": "guessed"}, "fixed or calibrated"), ({"locked": ["nobody"]}, "nobody")],
)
def test_wrong_options_are_refused(options: dict[str, object], says: str) -> None:
    with pytest.raises(InputError, match=says):
        load_arm("iiwa", **options)  # type: ignore[arg-type]


def test_negative_damping_is_refused_with_its_joint(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="hinge"):
        load_arm(one_joint(tmp_path, '<dynamics damping="-1"/>'))


def test_a_locked_joint_is_no_coordinate(tmp_path: Path) -> None:
    assert load_arm("iiwa", locked=["lbr_iiwa_joint_7"]).n == 6
    with pytest.raises(InputError, match="joint that moves"):
        load_arm(one_joint(tmp_path), locked=["hinge"])


def test_a_missing_joint_is_named() -> None:
    with pytest.raises(InputError, match="q7 missing"):
        load_arm("iiwa").with_outputs([f"q{k}" for k in range(1, 7)])


def test_rates_of_joints_are_measured_by_name_or_by_order() -> None:
    """A simulated arm records angles and rates: its columns go into the loop as they are."""
    arm, positions = load_arm("iiwa"), [f"q{k}" for k in range(1, 8)]
    named = arm.with_outputs([*positions, "q2_rate"])
    assert [str(one) for one in named.outputs[7:]] == ["q2_rate [rad/s]"]
    assert named.outputs == arm.with_outputs([*positions, ("q2", 1)]).outputs
    with pytest.raises(InputError, match="got flange; remedy: leave these columns out"):
        arm.with_outputs([*positions, "flange"])
