"""Any URDF in PyBullet as a plant."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from math import hypot, isfinite
from pathlib import Path
from typing import Any, Literal, Self, get_args

import numpy as np
from numpy import ndarray

from harness.errors import InputError, PlantError
from harness.protocols import Ability
from harness.signals import Channel, FloatArray, PlantSpec
from plants.bullet.engine import explicit_urdf, moving_joints, stated_dynamics, stated_limits, stiffest_rate
from plants.bullet.outputs import BASE_STATES, Camera, Keypoints, channels, reader
from plants.bullet.world import Control, Saved, Settings, World
from plants.checking import checked_inputs, initial_values, per_item, positive, refuse_input

__all__ = ["ArmPlant"]

MOTOR_FORCE = 300.0
"""Greatest force [N m] of Bullet's motors at a joint whose file states no effort."""
GREATEST_DAMPED_STEP = 0.9
"""Joint damping times step over inertia beyond which a plant is refused: Bullet's damping is explicit."""


class ArmPlant:
    """A URDF in PyBullet with every hidden default written down.

    The engine integrates by semi-implicit Euler: the error falls with the first power of the step
    ``sample_time / substeps``. Friction and damping are Bullet's own: a velocity motor with target 0 and bounded
    force, and an explicit torque.

    Parameters
    ----------
    urdf : str or Path
        A file, or the text of one.
    sample_time : float
        Seconds between samples.
    substeps : int
        Engine steps for each sample.
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
        If an option does not fit the URDF, or joint damping is too large for the step.
    PluginError
        If pybullet is not installed.

    Examples
    --------
    >>> from plants.bullet.robots import one_joint_arm
    >>> with one_joint_arm(mass=1.0, length=0.5) as arm:
    ...     start = arm.reset(rng=np.random.default_rng(0), x0={"theta": 0.3})
    ...     print(arm.spec, start)
    u [N m] -> theta [rad] every 0.004 s [0.3]
    """

    def __init__(
        self,
        urdf: str | Path,
        *,
        sample_time: float = 0.004,
        substeps: int = 4,
        control: Control = "torque",
        outputs: Sequence[str] = ("q", "qd"),
        joint_names: Sequence[str] | None = None,
        input_names: Sequence[str] | None = None,
        input_joints: Sequence[int] | None = None,
        input_limit: float | Sequence[float] | None = None,
        motor_force: float | Sequence[float] | None = None,
        home: float | Sequence[float] = 0.0,
        joint_damping: float | Sequence[float] | None = None,
        joint_friction: float | Sequence[float] | None = None,
        linear_damping: float = 0.0,
        angular_damping: float = 0.0,
        velocity_clip: float = 1e4,
        joint_limits: bool = False,
        locked: Sequence[str] = (),
        gravity: float = 9.81,
        inertia: Literal["file", "shape"] = "file",
        fixed_base: bool = True,
        base_position: Sequence[float] = (0.0, 0.0, 0.0),
        payload: float = 0.0,
        payload_link: str | None = None,
        payload_offset: Sequence[float] = (0.0, 0.0, 0.0),
        end_effector: str | None = None,
        table: Sequence[float] | None = None,
        table_size: float = 0.6,
        table_friction: float = 0.5,
        keypoints: Keypoints = (),
        camera: Camera | Mapping[str, Any] | None = None,
    ) -> None:
        _refuse_choice("control", control, get_args(Control))
        _refuse_choice("inertia", inertia, ("file", "shape"))
        if int(substeps) != substeps or substeps < 1:
            raise InputError("option substeps", expected="an integer >= 1", got=repr(substeps), remedy="correct it")
        tensors = inertia == "file"
        moving = moving_joints(explicit_urdf(urdf, locked=locked, tensors=tensors))
        n = len(moving)
        stated, (effort, velocity) = stated_dynamics(urdf, locked), stated_limits(urdf, locked)
        tip = end_effector or next(str(child.get("link")) for child in moving[-1].iter("child"))
        damping = per_item("joint_damping", stated[0] if joint_damping is None else joint_damping, n, "joints")
        friction = per_item("joint_friction", stated[1] if joint_friction is None else joint_friction, n, "joints")
        for name, values in (
            ("joint_damping", damping),
            ("joint_friction", friction),
            ("linear_damping", [linear_damping]),
            ("angular_damping", [angular_damping]),
            ("payload", [payload]),
        ):
            for value in values:
                positive(name, value, zero=True)
        driven = _driven(input_joints, n)
        if control != "torque":
            _refuse_friction_beside_motors(control, [friction[joint] for joint in driven])
        known = {"torque": effort, "velocity": velocity, "position": [math.inf] * n}[control]
        ranges = [known[joint] for joint in driven] if input_limit is None else input_limit
        usual = [effort[joint] if math.isfinite(effort[joint]) else MOTOR_FORCE for joint in driven]
        motors = usual if motor_force is None else motor_force
        settings = Settings(
            step=positive("sample_time", sample_time) / substeps,
            substeps=int(substeps),
            control=control,
            driven=tuple(driven),
            motor_force=tuple(per_item("motor_force", motors, len(driven), "inputs")),
            joint_damping=tuple(damping),
            joint_friction=tuple(friction),
            joint_limits=bool(joint_limits),
            linear_damping=float(linear_damping),
            angular_damping=float(angular_damping),
            velocity_clip=positive("velocity_clip", velocity_clip),
            gravity=float(gravity),
            inertia=inertia,
            fixed_base=bool(fixed_base),
            base_position=(float(base_position[0]), float(base_position[1]), float(base_position[2])),
            table=None if table is None else (float(table[0]), float(table[1]), float(table[2])),
            table_size=positive("table_size", table_size),
            table_friction=float(table_friction),
        )
        self._home = np.array(per_item("home", home, n, "joints"))
        names, called = _names(joint_names, input_names, n, [f"{_PREFIX[control]}{joint + 1}" for joint in driven])
        clip = settings.velocity_clip
        joints = tuple(Channel(name, _unit(joint)) for name, joint in zip(names, moving, strict=True))
        rates = tuple(Channel(f"{c.name}_rate", f"{c.unit}/s", -clip, clip) for c in joints)
        unlimited = input_limit is None and not np.isfinite(ranges).all()
        limits = None if unlimited else per_item("input_limit", ranges, len(driven), "inputs")
        inputs = _input_channels(called, [_input_unit(control, joints[joint].unit) for joint in driven], limits)
        measured = channels(outputs, joints, rates, keypoints, floating=not fixed_base, table=table is not None)
        states = joints + rates + (() if fixed_base else BASE_STATES)
        self._spec = PlantSpec(inputs, measured, float(sample_time), states, feedthrough="contact" in outputs)
        self._forces = [i for i, channel in enumerate(measured) if channel.name.startswith("contact_")]
        self.true_parameters: dict[str, float] = {}
        load_at = (payload_link or tip, payload, payload_offset) if payload > 0 else None
        shapes = table is not None or inertia == "shape"
        text = explicit_urdf(
            urdf, damping=damping, limits=joint_limits, payload=load_at, shapes=shapes, locked=locked, tensors=tensors
        )
        self._world = World(text, settings)
        seen_by = camera if isinstance(camera, Camera) else Camera(**(camera or {}))
        self._measured = (outputs, tip, keypoints, seen_by)
        self._shape = (len(driven),)
        try:
            self._bind()
            self._refuse_stiff_damping()
        except BaseException:
            self.close()
            raise

    @property
    def spec(self) -> PlantSpec:
        """Channels and sample time."""
        return self._spec

    @property
    def abilities(self) -> frozenset[Ability]:
        """Snapshots (bit for bit), batch, truth; feedthrough where the contact force is measured."""
        found: set[Ability] = {"snapshots", "batch", "truth"}
        return frozenset(found | {"feedthrough"} if self.spec.feedthrough else found)

    @property
    def declared(self) -> dict[str, Any]:
        """Every setting that Bullet would otherwise choose in silence, by name."""
        return asdict(self._world.settings)

    @property
    def urdf(self) -> str:
        """Text of the URDF that is simulated: damping, limits, locked joints and payload as the options say."""
        return self._world.urdf

    def reset(self, *, rng: np.random.Generator, x0: Mapping[str, float] | None = None) -> FloatArray:
        """Start anew from ``home`` at rest, or from named states; returns ``y[0]`` (ny,). ``rng`` is not used."""
        self._need_client()
        world, n = self._world, len(self._home)
        start = [*self._home, *[0.0] * n]
        if not world.settings.fixed_base:
            start += [*world.settings.base_position, 0.0, 0.0, 0.0, 1.0, *[0.0] * 6]
        values = initial_values(x0, self.spec.states, start)
        if not np.isfinite(world.state()).all():
            world.build()  # one NaN stays in Bullet for ever
            self._bind()
        if world.origin is not None:
            world.restore(world.origin)
        world.set_joints(values[:n], values[n : 2 * n])
        if not world.settings.fixed_base:
            world.set_base(values[2 * n :])
        y = self._read()
        y[self._forces] = 0.0  # what is in the engine is from before the reset
        return y

    def step(self, u: FloatArray) -> FloatArray:
        """Hold ``u`` (nu,) for one sample time; returns the next output (ny,).

        Raises
        ------
        InputError
            If ``u`` has the wrong shape or is not finite (Bullet would accept NaN).
        PlantError
            If the plant is closed.
        """
        if not (isinstance(u, ndarray) and u.shape == self._shape and isfinite(hypot(*(values := u.tolist())))):
            refuse_input(u, self._spec)
        try:
            self._advance(values)
            return self._read()
        except self._world.engine.error:
            self._need_client()
            raise

    def rollout(self, inputs: FloatArray) -> FloatArray:
        """Apply ``inputs`` (N, nu) from the present state; row k of the result (N, ny) is what ``step`` returned."""
        self._need_client()
        rows = checked_inputs(inputs, self.spec).tolist()
        outputs = np.empty((len(rows), self.spec.ny))
        advance, read = self._advance, self._read
        for k, row in enumerate(rows):
            advance(row)
            outputs[k] = read()
        return outputs

    def output(self, u: FloatArray) -> FloatArray:
        """Return the output (ny,) with ``u`` applied, while no time passes.

        The contact force is measured over one engine step, which is then undone.
        """
        self._need_client()
        values, y = self._values(u), self._read()
        if self._forces:
            before = self._world.save()
            self._world.advance_one_step(values)
            y[self._forces] = self._read()[self._forces]
            self._world.restore(before)
        return y

    def truth(self) -> FloatArray:
        """Return joint positions, joint rates and, for a floating base, the base's pose and velocity (nx,)."""
        self._need_client()
        return self._world.state()

    def get_state(self) -> Any:
        """Return the joints' positions and rates, or Bullet's whole state where contacts, limits or a base need it.

        The continuation repeats bit for bit.
        """
        self._need_client()
        return self._world.save() if self._world.settings.whole_state else tuple(self._world.state().tolist())

    def set_state(self, state: Any) -> None:
        """Go back to a state of this same plant object."""
        self._need_client()
        if isinstance(state, Saved):
            self._world.restore(state)
        else:
            self._world.set_joints(state[: len(self._home)], state[len(self._home) :])

    def close(self) -> None:
        """Disconnect from the engine; may be called twice."""
        self._world.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def _bind(self) -> None:
        """Keep the functions that move and read the world at hand."""
        self._read = reader(self._world, *self._measured)
        self._advance = self._world.advance

    def _values(self, u: FloatArray) -> list[float]:
        """Return the input as a list, refusing a wrong shape, NaN or infinity."""
        if not (isinstance(u, ndarray) and u.shape == self._shape and isfinite(hypot(*(values := u.tolist())))):
            refuse_input(u, self._spec)
        checked: list[float] = values
        return checked

    def _need_client(self) -> None:
        """Refuse the use of a closed plant."""
        if not self._world.alive:
            raise PlantError("the plant is closed: make a new one", status="terminated")

    def _refuse_stiff_damping(self) -> None:
        """Refuse joint damping that the explicit integration cannot take."""
        given = self._world.settings
        if not given.fixed_base:
            return
        rate = stiffest_rate(self._world.client, self._world.body, given.joint_damping, self._home)
        if rate * given.step > GREATEST_DAMPED_STEP:
            raise InputError(
                "joint damping is too large for the step: Bullet integrates it explicitly",
                expected=f"damping * step / inertia <= {GREATEST_DAMPED_STEP}",
                got=f"{rate * given.step:.3g} at a step of {given.step:g} s",
                remedy=f"use substeps >= {math.ceil(given.substeps * rate * given.step / GREATEST_DAMPED_STEP)}",
            )


_PREFIX = {"torque": "tau", "velocity": "rate", "position": "target"}


def _refuse_choice(name: str, chosen: str, known: Sequence[str]) -> None:
    """Refuse an option that is none of the known ones."""
    if chosen not in known:
        raise InputError(f"option {name}", expected=" or ".join(known), got=repr(chosen), remedy="correct it")


def _driven(joints: Sequence[int] | None, n: int) -> list[int]:
    """Return which of n joints are driven; by default all."""
    driven = list(range(n)) if joints is None else [int(joint) for joint in joints]
    if not driven or not set(driven) <= set(range(n)) or len(set(driven)) != len(driven):
        raise InputError(
            "option input_joints", expected=f"different numbers in 0..{n - 1}", got=str(driven), remedy="correct it"
        )
    return driven


def _refuse_friction_beside_motors(control: Control, friction: Sequence[float]) -> None:
    """Refuse dry friction of joints that Bullet's motors drive."""
    if any(friction):
        raise InputError(
            "dry friction on a joint with a velocity or position motor",
            expected="control = torque",
            got=control,
            remedy="use joint_friction = 0: Bullet's friction is that very motor",
        )


def _names(
    joints: Sequence[str] | None, inputs: Sequence[str] | None, n: int, usual: Sequence[str]
) -> tuple[list[str], list[str]]:
    """Return the names of n joints and of the inputs, one for each."""
    names, called = list(joints or [f"q{i + 1}" for i in range(n)]), list(inputs or usual)
    if len(names) != n or len(called) != len(usual):
        raise InputError(
            "names of joints or inputs",
            expected=f"{n} joints and {len(usual)} inputs",
            got=f"{names} and {called}",
            remedy="give one name for each",
        )
    return names, called


def _input_channels(names: Sequence[str], units: Sequence[str], limits: Sequence[float] | None) -> tuple[Channel, ...]:
    """Return the channels of the inputs, with their declared ranges."""
    if limits is None:
        return tuple(map(Channel, names, units))
    return tuple(Channel(name, unit, -limit, limit) for name, unit, limit in zip(names, units, limits, strict=True))


def _unit(joint: ET.Element) -> str:
    """Return the unit of a joint's position."""
    return "m" if joint.get("type") == "prismatic" else "rad"


def _input_unit(control: str, unit: str) -> str:
    """Return the unit of an input that drives a joint."""
    if control == "torque":
        return "N" if unit == "m" else "N m"
    return unit if control == "position" else f"{unit}/s"
