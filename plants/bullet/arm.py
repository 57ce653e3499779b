"""Any URDF in PyBullet as a plant."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from math import hypot, isfinite
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray

from harness.errors import InputError, PlantError
from harness.signals import Channel, FloatArray, PlantSpec
from plants.base import BasePlant
from plants.bullet.engine import explicit_urdf, stiffest_rate
from plants.bullet.options import ArmOptions, Joints, joints_of, settings_of
from plants.bullet.outputs import BASE_STATES, Camera, channels, reader
from plants.bullet.world import Saved, World
from plants.checking import checked_inputs, initial_values, per_item, refuse_input, with_fields

GREATEST_DAMPED_STEP = 0.9
"""Joint damping times step over inertia beyond which a plant is refused: Bullet's damping is explicit."""


class ArmPlant(BasePlant):
    """A URDF in PyBullet with every hidden default written down.

    The engine integrates by semi-implicit Euler: the error falls with the first power of the step
    ``sample_time / substeps``. Friction and damping are Bullet's own: a velocity motor with target 0 and bounded
    force, and an explicit torque.

    Parameters
    ----------
    urdf : str or Path
        A file, or the text of one.
    options : ArmOptions, optional
        All other options in one object; default those of :class:`plants.bullet.options.ArmOptions`.
    **named
        Fields of :class:`plants.bullet.options.ArmOptions` by name, which overwrite those of ``options``.

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

    Options = ArmOptions
    __signature__ = with_fields(ArmOptions, "urdf")

    def __init__(self, urdf: str | Path, options: ArmOptions | None = None, **named: Any) -> None:
        given = replace(options or ArmOptions(), **named)
        joints = joints_of(urdf, given)
        settings = settings_of(given, joints)
        self._home = np.array(per_item("home", given.home, len(joints.elements), "joints"))
        self._spec = _spec_of(given, joints)
        measured = self._spec.outputs
        self._forces = [i for i, channel in enumerate(measured) if channel.name.startswith("contact_")]
        self.true_parameters: dict[str, float] = {}
        tip = given.end_effector or next(str(child.get("link")) for child in joints.elements[-1].iter("child"))
        payload = (given.payload_link or tip, given.payload, given.payload_offset) if given.payload > 0 else None
        text = explicit_urdf(
            urdf,
            damping=joints.damping,
            limits=given.joint_limits,
            payload=payload,
            shapes=given.table is not None or given.inertia == "shape",
            locked=given.locked,
            tensors=given.inertia == "file",
        )
        self._world = World(text, settings)
        camera = given.camera if isinstance(given.camera, Camera) else Camera(**(given.camera or {}))
        self._measured = (given.outputs, tip, given.keypoints, camera)
        self._shape = (len(joints.driven),)
        try:
            self._bind()
            self._refuse_stiff_damping()
        except BaseException:
            self.close()
            raise

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
        """Hold ``u`` (nu,) for one sample time; returns the next output (ny,)."""
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


def _spec_of(options: ArmOptions, joints: Joints) -> PlantSpec:
    """Return the channels of an arm: its joints and their rates are states, its outputs what the options ask for."""
    usual = [f"{_PREFIX[options.control]}{joint + 1}" for joint in joints.driven]
    names, called = _names(options.joint_names, options.input_names, len(joints.elements), usual)
    clip = options.velocity_clip
    positions = tuple(Channel(name, _unit(joint)) for name, joint in zip(names, joints.elements, strict=True))
    rates = tuple(Channel(f"{c.name}_rate", f"{c.unit}/s", -clip, clip) for c in positions)
    units = [_input_unit(options.control, positions[joint].unit) for joint in joints.driven]
    inputs = _input_channels(called, units, joints.input_ranges)
    floating, table = not options.fixed_base, options.table is not None
    outputs = channels(options.outputs, positions, rates, options.keypoints, floating=floating, table=table)
    states = positions + rates + (BASE_STATES if floating else ())
    return PlantSpec(inputs, outputs, float(options.sample_time), states, feedthrough="contact" in options.outputs)


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
