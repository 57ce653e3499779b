"""Inverse dynamics of arms from URDF against an engine that was written by somebody else."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from harness.errors import InputError
from harness.physics.arms.formats.urdf import load_urdf

bullet = pytest.importorskip("pybullet", reason="pybullet has wheels for CPython 3.10 and 3.11 only")
pybullet_data = pytest.importorskip("pybullet_data", reason="comes with pybullet")


@pytest.mark.parametrize("name", ["kuka_iiwa/model.urdf", "franka_panda/panda.urdf"])
def test_inverse_dynamics_equals_bullet(name: str) -> None:
    path = Path(pybullet_data.getDataPath()) / name
    arm = load_urdf(path)
    client = bullet.connect(bullet.DIRECT)
    try:
        body = bullet.loadURDF(
            str(path), useFixedBase=True, flags=bullet.URDF_USE_INERTIA_FROM_FILE, physicsClientId=client
        )
        bullet.setGravity(0, 0, -9.81, physicsClientId=client)
        rng = np.random.default_rng(0)
        for _ in range(20):
            q, v, a = rng.uniform(-1, 1, (3, arm.n))
            theirs = bullet.calculateInverseDynamics(body, list(q), list(v), list(a), physicsClientId=client)
            np.testing.assert_allclose(arm.inverse_dynamics(q, v, a), theirs, atol=1e-9)
    finally:
        bullet.disconnect(client)


def test_limits_are_those_of_the_file() -> None:
    arm = load_urdf(Path(pybullet_data.getDataPath()) / "kuka_iiwa/model.urdf")
    assert arm.n == 7
    assert arm.moving[0].effort == 300
    assert arm.moving[1].upper == pytest.approx(2.0944, abs=1e-4)


def test_the_world_needs_no_declaration(tmp_path: Path) -> None:
    text = """<robot name="r"><link name="base"/>
    <link name="arm"><inertial><origin xyz="0 0 -1"/><mass value="2"/>
      <inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
    <joint name="weld" type="fixed"><parent link="PARENT"/><child link="base"/></joint>
    <joint name="j" type="continuous"><parent link="base"/><child link="arm"/><axis xyz="1 0 0"/></joint></robot>"""
    for parent, declared in (("world", False), ("world", True), ("ground", True)):
        file = tmp_path / f"{parent}-{declared}.urdf"
        link = f'<link name="{parent}"/>' if declared else ""
        file.write_text(text.replace("PARENT", parent).replace("<link", f"{link}<link", 1), encoding="utf-8")
        arm = load_urdf(file)
        assert arm.n == 1
        assert arm.inverse_dynamics([0.3], [0.0], [0.0])[0] == pytest.approx(2 * 9.81 * np.sin(0.3))
    file.write_text(text.replace("PARENT", "ground"), encoding="utf-8")
    with pytest.raises(InputError, match="joint weld"):
        load_urdf(file)


def test_mass_matrix_is_symmetric_and_positive() -> None:
    arm = load_urdf(Path(pybullet_data.getDataPath()) / "kuka_iiwa/model.urdf")
    matrix = arm.mass_matrix(np.linspace(-1, 1, 7))
    np.testing.assert_allclose(matrix, matrix.T, atol=1e-12)
    assert np.linalg.eigvalsh(matrix).min() > 0


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("<robot", "not XML"),
        ("<sdf/>", "not a URDF"),
        ("<robot><link name='a'/><link name='b'/></robot>", "not a tree"),
        (
            "<robot><link name='a'/><link name='b'/><joint name='j' type='ball'><parent link='a'/><child link='b'/>"
            "</joint></robot>",
            "kind of joint",
        ),
        (
            "<robot><link name='a'/><link name='b'/><joint name='j' type='fixed'><parent link='z'/><child link='b'/>"
            "</joint></robot>",
            "a link of the file",
        ),
    ],
)
def test_bad_files_are_refused_with_the_place(tmp_path: Path, text: str, says: str) -> None:
    path = tmp_path / "robot.urdf"
    path.write_text(text)
    with pytest.raises(InputError, match=says) as caught:
        load_urdf(path)
    assert "robot.urdf" in str(caught.value)


def test_missing_file() -> None:
    with pytest.raises(InputError, match="no such URDF"):
        load_urdf("nowhere.urdf")
