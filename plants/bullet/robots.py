"""Arms in PyBullet: KUKA iiwa, Franka Panda, and one and two joints with Bullet's own friction."""

from __future__ import annotations

from typing import Any

from plants.bullet.arm import ArmPlant
from plants.bullet.engine import data_file
from plants.bullet.outputs import Camera
from plants.checking import checked_options, positive, positives

__all__ = ["ArmPlant", "Camera", "acrobot", "double_pendulum", "iiwa", "one_joint_arm", "panda"]


def iiwa(**options: Any) -> ArmPlant:
    """KUKA LBR iiwa (7 joints) from pybullet_data under torque control.

    The damping of 0.5 N m s/rad is the file's own, the torque limits (declared, not enforced) are of the iiwa 14's
    data sheet.

    Parameters
    ----------
    **options
        Of :class:`ArmPlant`.

    Examples
    --------
    >>> with iiwa(outputs=("q",)) as arm:
    ...     arm.spec.nu, arm.spec.ny, arm.declared["joint_damping"][0]
    (7, 7, 0.5)
    """
    defaults: dict[str, Any] = {
        "joint_damping": 0.5,
        "input_limit": (320.0, 320.0, 176.0, 176.0, 110.0, 40.0, 40.0),
        "home": (0.0, 0.4, 0.0, -1.2, 0.0, 0.8, 0.0),
    }
    name = "model.urdf" if options.get("fixed_base", True) else "model_free_base.urdf"
    return ArmPlant(data_file("kuka_iiwa", name), **checked_options("iiwa", ArmPlant, defaults, options))


def one_joint_arm(*, mass: float = 1.0, length: float = 0.5, link_inertia: float = 0.0, **options: Any) -> ArmPlant:
    """Pendulum in PyBullet: a mass at the end of a rod on a hinge; theta = 0 hangs down.

    ``true_parameters`` are those of the built-in model ``pendulum``: J, b, mgl. Dry friction (``joint_friction``)
    and damping (``joint_damping``) are Bullet's own.

    Parameters
    ----------
    mass : float
        In kg.
    length : float
        From hinge to centre of mass [m].
    link_inertia : float
        About the centre of mass [kg m^2].
    **options
        Of :class:`ArmPlant`.

    Examples
    --------
    >>> with one_joint_arm(mass=2.0, length=0.5, joint_damping=0.1) as arm:
    ...     arm.true_parameters
    {'J': 0.5, 'b': 0.1, 'mgl': 9.81}
    """
    mass, length = positive("mass", mass), positive("length", length)
    link_inertia = positive("link_inertia", link_inertia, zero=True)
    hinge = _hinge("hinge", "base", "rod", 0.0)
    text = f'<robot name="one-joint-arm">{_BASE}{_link("rod", mass, length, link_inertia)}{hinge}</robot>'
    defaults: dict[str, Any] = {
        "outputs": ("q",),
        "joint_names": ("theta",),
        "input_names": ("u",),
        "input_limit": 2 * mass * 9.81 * length,
        "substeps": 20,
    }
    arm = ArmPlant(text, **checked_options("one_joint_arm", ArmPlant, defaults, options))
    given = arm.declared
    arm.true_parameters = {
        "J": mass * length**2 + link_inertia,
        "b": given["joint_damping"][0],
        "mgl": mass * given["gravity"] * length,
    }
    return arm


def panda(**options: Any) -> ArmPlant:
    """Franka Panda (7 joints) from pybullet_data under torque control, its gripper rigid.

    The torque limits (declared, not enforced) are of the data sheet. The inertias of the file are placeholders
    (0.1 kg m^2 each); the file's own joint damping is 10 N m s/rad, here 0.5 unless given.

    Parameters
    ----------
    **options
        Of :class:`ArmPlant`.

    Examples
    --------
    >>> with panda(outputs=("q", "ee")) as arm:
    ...     arm.spec.nu, arm.spec.ny
    (7, 10)
    """
    defaults: dict[str, Any] = {
        "joint_damping": 0.5,
        "input_limit": (87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0),
        "home": (0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785),
        "locked": ("panda_finger_joint1", "panda_finger_joint2"),
        "end_effector": "panda_grasptarget",
    }
    return ArmPlant(data_file("franka_panda", "panda.urdf"), **checked_options("panda", ArmPlant, defaults, options))


def double_pendulum(
    *,
    m1: float = 1.0,
    m2: float = 1.0,
    l1: float = 1.0,
    lc1: float = 0.5,
    lc2: float = 1.0,
    I1: float = 0.083,
    I2: float = 0.33,
    **options: Any,
) -> ArmPlant:
    """Planar double pendulum in PyBullet with a torque at each joint; theta2 is relative to link 1, 0 hangs down.

    ``true_parameters`` are those of the built-in model ``double-pendulum``.

    Parameters
    ----------
    m1, m2 : float
        Masses [kg].
    l1 : float
        Length of link 1 [m].
    lc1, lc2 : float
        From joint to centre of mass [m].
    I1, I2 : float
        Inertia about the centre of mass [kg m^2].
    **options
        Of :class:`ArmPlant`; the default ``joint_damping`` is 0.1 N m s/rad.

    Examples
    --------
    >>> with double_pendulum() as plant:
    ...     print(plant.spec)
    u1 [N m], u2 [N m] -> theta1 [rad], theta2 [rad] every 0.004 s
    """
    given = positives(m1=m1, m2=m2, l1=l1, lc1=lc1, lc2=lc2) | positives(I1=I1, I2=I2, zero=True)
    links = _BASE + _link("link1", m1, lc1, I1) + _link("link2", m2, lc2, I2)
    hinges = _hinge("shoulder", "base", "link1", 0.0) + _hinge("elbow", "link1", "link2", l1)
    text = f'<robot name="double-pendulum">{links}{hinges}</robot>'
    defaults: dict[str, Any] = {
        "outputs": ("q",),
        "joint_names": ("theta1", "theta2"),
        "input_names": ("u1", "u2"),
        "input_limit": 10.0,
        "joint_damping": 0.1,
        "substeps": 20,
    }
    arm = ArmPlant(text, **checked_options("double_pendulum", ArmPlant, defaults, options))
    b1, b2 = arm.declared["joint_damping"]
    arm.true_parameters = {**given, "b1": b1, "b2": b2}
    return arm


def acrobot(**options: Any) -> ArmPlant:
    """Acrobot in PyBullet: the double pendulum with a torque at the elbow only.

    Parameters
    ----------
    **options
        Of :func:`double_pendulum`.

    Examples
    --------
    >>> with acrobot() as plant:
    ...     print(plant.spec)
    u [N m] -> theta1 [rad], theta2 [rad] every 0.004 s
    """
    merged: dict[str, Any] = {"input_names": ("u",), "input_joints": (1,), **options}
    return double_pendulum(**merged)


_BASE = """<link name="base"><inertial><mass value="0"/>
<inertia ixx="0" ixy="0" ixz="0" iyy="0" iyz="0" izz="0"/></inertial></link>"""


def _link(name: str, mass: float, centre: float, inertia: float) -> str:
    """Return a link of a planar chain that hangs along -z."""
    return (
        f'<link name="{name}"><inertial><origin xyz="0 0 {-centre!r}" rpy="0 0 0"/><mass value="{mass!r}"/>'
        f'<inertia ixx="{inertia!r}" ixy="0" ixz="0" iyy="{inertia!r}" iyz="0" izz="{inertia!r}"/></inertial></link>'
    )


def _hinge(name: str, parent: str, child: str, below: float) -> str:
    """Return a hinge at a distance below the parent's frame; a positive angle swings towards +x."""
    return (
        f'<joint name="{name}" type="continuous"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="0 0 {-below!r}" rpy="0 0 0"/><axis xyz="0 -1 0"/></joint>'
    )
