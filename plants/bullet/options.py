"""The options of an arm in PyBullet, and what a URDF makes of them."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

from harness.errors import InputError
from plants.bullet.engine import explicit_urdf, moving_joints, stated
from plants.bullet.outputs import Camera, Keypoints
from plants.bullet.world import BulletSettings, Control
from plants.checking import per_item, positive, positives, refuse_option, whole

MOTOR_FORCE = 300.0  # Greatest force [N m] of Bullet's motors at a joint whose file states no effort.


@dataclass(frozen=True, kw_only=True)
class ArmOptions:
    """What can be chosen of an arm in PyBullet; each field has the same name as a keyword of :class:`ArmPlant`.

    Parameters
    ----------
    sample_time : float
        Seconds between samples.
    substeps : int
        Steps of Bullet for each sample.
    control : {"torque", "velocity", "position"}
        What the inputs are. Velocity and position inputs drive Bullet's motors with at most ``motor_force``.
    outputs : sequence of str
        Among ``q``, ``qd`` (joints), ``ee`` (end effector's position [m]), ``base`` (position of a floating base),
        ``contact`` (force of the table on the arm [N], with feedthrough), ``keypoints`` (pixels).
    joint_names, input_names : sequence of str, optional
        Names of the joint coordinates (default ``q1``, ...; rates are called ``q1_rate``) and of the inputs
        (``tau1``, ... for torques, ``rate1``, ``target1`` for the others).
    input_joints : sequence of int, optional
        Which joints are driven, counted from 0; default all.
    input_limit : float or sequence, optional
        Declared range of the inputs, which scenarios use; nothing is clipped. Default: the file's ``<limit>``, its
        ``effort`` under torque control and its ``velocity`` under velocity control, where it states one for every
        driven joint.
    motor_force : float or sequence, optional
        Greatest force of the motors of driven joints under velocity and position control [N m]; default the file's
        ``effort``, and 300 where it states none.
    home : float or sequence
        Initial joint positions [rad].
    joint_damping, joint_friction : float or sequence, optional
        Viscous [N m s/rad] and dry [N m] friction of each joint; those that the file states (``<dynamics>``) if not
        given.
    linear_damping, angular_damping : float
        Bullet's damping of the links.
    velocity_clip : float
        Joint rates are clipped at this value [rad/s] (Bullet's own default is 100).
    joint_limits : bool
        Keep the limits of the file.
    locked : sequence of str
        Names of joints that are made rigid.
    gravity : float
        Along -z [m/s^2].
    inertia : {"file", "shape"}
        Take the links' inertia from the file, or let Bullet compute it from the collision shapes.
    fixed_base : bool
        Fix the first link to the world.
    base_position : sequence of float
        Of the first link [m].
    payload : float
        Point mass [kg] on ``payload_link`` (default: the end effector) at ``payload_offset`` [m].
    end_effector : str, optional
        Name of a link; default the child of the last moving joint.
    table : (x, y, z), optional
        Centre of the top of a square table [m], ``table_size`` wide, with friction coefficient ``table_friction``.
    keypoints : sequence of (link, (x, y, z)), optional
        Points on links [m], seen by ``camera``.
    camera : Camera or mapping, optional
        A pinhole camera, or its ``position``, ``target``, ``up``, ``focal``.

    Raises
    ------
    InputError
        If a value is none that the option can have.
    """

    sample_time: float = 0.004
    substeps: int = 4
    control: Control = "torque"
    outputs: Sequence[str] = ("q", "qd")
    joint_names: Sequence[str] | None = None
    input_names: Sequence[str] | None = None
    input_joints: Sequence[int] | None = None
    input_limit: float | Sequence[float] | None = None
    motor_force: float | Sequence[float] | None = None
    home: float | Sequence[float] = 0.0
    joint_damping: float | Sequence[float] | None = None
    joint_friction: float | Sequence[float] | None = None
    linear_damping: float = 0.0
    angular_damping: float = 0.0
    velocity_clip: float = 1e4
    joint_limits: bool = False
    locked: Sequence[str] = ()
    gravity: float = 9.81
    inertia: Literal["file", "shape"] = "file"
    fixed_base: bool = True
    base_position: Sequence[float] = (0.0, 0.0, 0.0)
    payload: float = 0.0
    payload_link: str | None = None
    payload_offset: Sequence[float] = (0.0, 0.0, 0.0)
    end_effector: str | None = None
    table: Sequence[float] | None = None
    table_size: float = 0.6
    table_friction: float = 0.5
    keypoints: Keypoints = ()
    camera: Camera | Mapping[str, Any] | None = None

    def __post_init__(self) -> None:
        for name, known in (("control", get_args(Control)), ("inertia", ("file", "shape"))):
            chosen = getattr(self, name)
            refuse_option(name, chosen, chosen in known, " or ".join(known))
        whole("substeps", self.substeps)
        positives(sample_time=self.sample_time, velocity_clip=self.velocity_clip, table_size=self.table_size)
        for name in ("linear_damping", "angular_damping", "payload"):
            positive(name, getattr(self, name), zero=True)


@dataclass(frozen=True, eq=False)
class Joints:
    """The moving joints of a URDF, n of them, and what its options say of each."""

    elements: list[ET.Element]  # In the order of the coordinates
    driven: tuple[int, ...]  # Joints that an input drives, counted from 0
    # Viscous [N m s/rad] and dry [N m], of every joint
    damping: tuple[float, ...]
    friction: tuple[float, ...]
    input_ranges: tuple[float, ...] | None  # Largest value of each input; None where one of them has none
    motor_force: tuple[float, ...]  # Of each driven joint [N m]


def joints_of(urdf: str | Path, options: ArmOptions) -> Joints:
    """Return the moving joints of a URDF with their damping, friction, ranges and motors.

    Raises InputError if an option does not fit the joints.
    """
    locked, control = options.locked, options.control
    moving = moving_joints(explicit_urdf(urdf, locked=locked, tensors=options.inertia == "file"))
    n = len(moving)
    stated_damping, stated_friction, effort, velocity = stated(urdf, locked)
    damping, friction = (
        per_item(name, usual if given is None else given, n, "joints")
        for name, usual, given in (
            ("joint_damping", stated_damping, options.joint_damping),
            ("joint_friction", stated_friction, options.joint_friction),
        )
    )
    for name, values in (("joint_damping", damping), ("joint_friction", friction)):
        for value in values:
            positive(name, value, zero=True)
    driven = _driven(options.input_joints, n)
    if control != "torque" and any(friction[joint] for joint in driven):
        raise InputError(
            "dry friction on a joint with a velocity or position motor",
            expected="control = torque",
            got=control,
            remedy="use joint_friction = 0: Bullet's friction is that very motor",
        )
    usual = {"torque": effort, "velocity": velocity, "position": [math.inf] * n}[control]
    ranges = options.input_limit if options.input_limit is not None else [usual[joint] for joint in driven]
    unlimited = options.input_limit is None and not all(math.isfinite(usual[joint]) for joint in driven)
    force = options.motor_force
    if force is None:
        force = [effort[joint] if math.isfinite(effort[joint]) else MOTOR_FORCE for joint in driven]
    return Joints(
        moving,
        tuple(driven),
        tuple(damping),
        tuple(friction),
        None if unlimited else tuple(per_item("input_limit", ranges, len(driven), "inputs")),
        tuple(per_item("motor_force", force, len(driven), "inputs")),
    )


def settings_of(options: ArmOptions, joints: Joints) -> BulletSettings:
    """Return everything that Bullet would otherwise choose in silence."""
    return BulletSettings(
        step=options.sample_time / options.substeps,
        substeps=int(options.substeps),
        control=options.control,
        driven=joints.driven,
        motor_force=joints.motor_force,
        joint_damping=joints.damping,
        joint_friction=joints.friction,
        joint_limits=bool(options.joint_limits),
        linear_damping=float(options.linear_damping),
        angular_damping=float(options.angular_damping),
        velocity_clip=float(options.velocity_clip),
        gravity=float(options.gravity),
        inertia=options.inertia,
        fixed_base=bool(options.fixed_base),
        base_position=_point(options.base_position),
        table=None if options.table is None else _point(options.table),
        table_size=float(options.table_size),
        table_friction=float(options.table_friction),
    )


def _point(values: Sequence[float]) -> tuple[float, float, float]:
    """Return three coordinates."""
    x, y, z = values
    return float(x), float(y), float(z)


def _driven(joints: Sequence[int] | None, n: int) -> list[int]:
    """Return which of n joints are driven; by default all."""
    driven = list(range(n)) if joints is None else [int(joint) for joint in joints]
    fine = bool(driven) and set(driven) <= set(range(n)) and len(set(driven)) == len(driven)
    refuse_option("input_joints", driven, fine, f"different numbers in 0..{n - 1}")
    return driven
