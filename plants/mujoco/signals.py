"""Inputs, outputs and states of a compiled MuJoCo model: names, units, and where their numbers stand."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from harness.errors import InputError, refuse_unknown
from harness.physics.arms.formats.mjcf import Drive, drives, joint_names, simple_joints
from harness.physics.arms.formats.mjcf_spec import mujoco
from harness.signals import Channel
from plants.checking import per_item, positive
from plants.mujoco.settings import MujocoSettings

GROUPS = ("q", "qd", "sensors")
AXES = {1: ("",), 3: ("_x", "_y", "_z"), 4: ("_w", "_x", "_y", "_z")}


@dataclass(frozen=True)
class States:
    """The states of a model: positions, rates, activations of actuators, in MuJoCo's order."""

    positions: tuple[Channel, ...]
    rates: tuple[Channel, ...]
    activations: tuple[Channel, ...]
    scalar: tuple[int, ...]  # Numbers of the joints that turn or slide.

    @property
    def channels(self) -> tuple[Channel, ...]:
        """All of them."""
        return (*self.positions, *self.rates, *self.activations)


@dataclass(frozen=True)
class Inputs:
    """The inputs of a model: controls of actuators, then forces on joints."""

    channels: tuple[Channel, ...]
    controls: tuple[int, ...]
    forces: tuple[int, ...]


@dataclass(frozen=True)
class Outputs:
    """The outputs of a model, each a place in a part of the engine's data."""

    channels: tuple[Channel, ...]
    parts: tuple[tuple[str, tuple[int, ...]], ...]
    """Tuple of (str, tuple of int): Name of the data (``qpos``, ``qvel``, ``sensordata``) and places in it, in the
    order of the channels."""
    stage: int  # The stage of MuJoCo's forward pass that must be up to date; 0 if none is needed


def states_of(model: Any, called: Sequence[str] | None) -> States:
    """Return the states of a model.

    Joints that turn or slide are q1, q2, ... unless named, with rates q1_rate, ...; a floating body is called ``base``
    if it is the only one, else by its joint or body: position, quaternion (w, x, y, z), velocity in the world, angular
    velocity in its own frame. Raises InputError if the number of names is not that of these joints.
    """
    kinds, names, simple = mujoco().mjtJoint, joint_names(model), simple_joints(model)
    given = [f"q{place + 1}" for place in range(len(simple))] if called is None else list(called)
    if len(given) != len(simple):
        raise InputError(
            "option joint_names",
            expected=f"{len(simple)} names",
            got=f"{len(given)}: {', '.join(given)}",
            remedy="one for each joint that turns or slides",
        )
    floating = [k for k in range(model.njnt) if int(model.jnt_type[k]) == kinds.mjJNT_FREE]
    positions: list[Channel] = []
    rates: list[Channel] = []
    for k in range(model.njnt):
        if k in simple:
            name, unit = given[simple.index(k)], "rad" if int(model.jnt_type[k]) == kinds.mjJNT_HINGE else "m"
            positions.append(Channel(name, unit))
            rates.append(Channel(f"{name}_rate", f"{unit}/s"))
            continue
        name = "base" if floating == [k] else names[k]
        if k in floating:
            positions += [Channel(f"{name}_{axis}", "m") for axis in "xyz"]
            rates += [Channel(f"{name}_{axis}_rate", "m/s") for axis in "xyz"]
        positions += [Channel(f"{name}_q{axis}", "1", -1.0, 1.0) for axis in "wxyz"]
        rates += [Channel(f"{name}_w{axis}", "rad/s") for axis in "xyz"]
    activations = [Channel(f"activation{k + 1}", "1") for k in range(model.na)]
    return States(tuple(positions), tuple(rates), tuple(activations), tuple(simple))


def inputs_of(model: Any, states: States, given: MujocoSettings) -> Inputs:
    """Return the inputs: chosen actuators, and forces on joints (of a model without actuators, on every joint).

    A motor without gear at a joint is ``tau1``, a position or velocity servo ``target1`` or ``rate1``, by the number of
    the joint; others have their own name. Raises InputError if an actuator or a joint is unknown, or the number of
    names or limits is not that of the inputs.
    """
    every, called, limits = drives(model), given.input_names, given.input_limit
    chosen = every if given.actuators is None else [_by_name(every, name) for name in given.actuators]
    pushed = _pushed(model, states, every, given.forces)
    channels = [channel for drive in chosen for channel in _controls(model, drive, states)]
    channels += [_force(model, states, place) for place in pushed]
    if called is not None and len(called) != len(channels):
        raise InputError(
            "option input_names",
            expected=f"{len(channels)}, for {', '.join(channel.name for channel in channels) or 'no inputs'}",
            got=f"{len(called)}: {', '.join(called)}",
            remedy="one for each input",
        )
    titles = [channel.name for channel in channels] if called is None else list(called)
    channels = [Channel(t, c.unit, c.minimum, c.maximum) for t, c in zip(_apart(titles), channels, strict=True)]
    if limits is not None:
        each = [positive("input_limit", one) for one in per_item("input_limit", limits, len(channels), "inputs")]
        channels = [Channel(c.name, c.unit, -limit, limit) for c, limit in zip(channels, each, strict=True)]
    dofs = [int(model.jnt_dofadr[states.scalar[place]]) for place in pushed]
    return Inputs(tuple(channels), tuple(k for drive in chosen for k in drive.controls), tuple(dofs))


def _pushed(model: Any, states: States, every: Sequence[Drive], forces: Sequence[str] | None) -> list[int]:
    """Return the places among the simple joints that a force acts on: those named, or all where nothing drives any."""
    names = joint_names(model)
    simple = [names[k] for k in states.scalar]
    pushed = list(forces) if forces is not None else [] if every else simple
    refuse_unknown("option forces", pushed, simple)
    return [simple.index(name) for name in pushed]


def _force(model: Any, states: States, place: int) -> Channel:
    """Return the channel of a force on a simple joint; its range is a URDF's effort, or ``actuatorfrcrange``."""
    joint = states.scalar[place]
    low, high = model.jnt_actfrcrange[joint] if model.jnt_actfrclimited[joint] else (-np.inf, np.inf)
    return Channel(f"tau{place + 1}", "N m" if _turns(model, states, place) else "N", float(low), float(high))


def outputs_of(model: Any, states: States, chosen: Sequence[str]) -> Outputs:
    """Return the outputs: ``q`` (positions), ``qd`` (rates), ``sensors`` (all), names of sensors or of states.

    Raises InputError if one is unknown, or named twice.
    """
    sensors = {name: k for k, name in enumerate(_sensor_names(model))}
    places = {channel.name: ("qpos", k) for k, channel in enumerate(states.positions)}
    places |= {channel.name: ("qvel", k) for k, channel in enumerate(states.rates)}
    known = {channel.name: channel for channel in states.channels}
    channels: list[Channel] = []
    parts: list[tuple[str, tuple[int, ...]]] = []
    stage = 0
    for name in chosen:
        if name == "q":
            channels += states.positions
            parts.append(("qpos", tuple(range(model.nq))))
        elif name == "qd":
            channels += states.rates
            parts.append(("qvel", tuple(range(model.nv))))
        elif name in places:
            channels.append(known[name])
            parts.append((places[name][0], (places[name][1],)))
        elif name == "sensors" or name in sensors:
            for title in sensors if name == "sensors" else [name]:
                k = sensors[title]
                channels += _sensor_channels(model, k, title)
                first = int(model.sensor_adr[k])
                parts.append(("sensordata", tuple(range(first, first + int(model.sensor_dim[k])))))
                stage = max(stage, int(model.sensor_needstage[k]))
        else:
            raise InputError(
                "option outputs",
                expected=f"names among {', '.join((*GROUPS, *sensors, *places))}",
                got=repr(name),
                remedy="correct it",
            )
    titles = [channel.name for channel in channels]
    if not titles or len(set(titles)) != len(titles):
        raise InputError(
            "option outputs",
            expected="at least one, and none twice",
            got=", ".join(titles) or "none: the model has no sensors",
            remedy="choose others, or give sensors other names",
        )
    return Outputs(tuple(channels), tuple(parts), stage)


def _by_name(every: Sequence[Drive], name: str) -> Drive:
    """Return an actuator by its name."""
    found = [drive for drive in every if drive.name == name]
    if not found:
        raise InputError(
            "option actuators",
            expected=f"names among {', '.join(drive.name or '(one without a name)' for drive in every) or 'none'}",
            got=repr(name),
            remedy="correct it",
        )
    return found[0]


def _position(model: Any, states: States, place: int) -> int:
    """Return where the position of a simple joint stands among all positions."""
    return int(model.jnt_qposadr[states.scalar[place]])


def _turns(model: Any, states: States, place: int) -> bool:
    """Return True for a simple joint that turns, False for one that slides."""
    return states.positions[_position(model, states, place)].unit == "rad"


def _servo(model: Any, drive: Drive) -> str:
    """Return what an actuator at a joint is: ``tau`` (a motor), ``target`` or ``rate`` (a servo), else nothing."""
    engine, number = mujoco(), drive.number
    plain = int(model.actuator_gaintype[number]) == engine.mjtGain.mjGAIN_FIXED
    if int(model.actuator_dyntype[number]) != engine.mjtDyn.mjDYN_NONE or not plain:
        return ""
    gain, bias = np.array(model.actuator_gainprm[number]), np.array(model.actuator_biasprm[number])
    if int(model.actuator_biastype[number]) != engine.mjtBias.mjBIAS_AFFINE:
        return "tau" if gain[0] == 1.0 else ""
    if not gain[0] or bias[0] or drive.gear != 1.0:
        return ""
    if bias[1] == -gain[0]:
        return "target"
    return "rate" if bias[2] == -gain[0] and not bias[1] else ""


SERVOS = {"": ("1", "1"), "tau": ("N m", "N"), "target": ("rad", "m"), "rate": ("rad/s", "m/s")}
"""Units of what an actuator follows, at a joint that turns and at one that slides."""


def _controls(model: Any, drive: Drive, states: States) -> list[Channel]:
    """Return the channels of an actuator's controls."""
    place = states.scalar.index(drive.joint) if drive.joint in states.scalar else None
    prefix = _servo(model, drive) if place is not None else ""
    unit = SERVOS[prefix][0 if place is not None and _turns(model, states, place) else 1]
    own = drive.name or f"u{drive.number + 1}"
    name = f"{prefix}{place + 1}" if prefix and place is not None and drive.gear == 1.0 else own
    endings = AXES.get(len(drive.controls), tuple(f"_{k + 1}" for k in range(len(drive.controls))))
    channels = []
    for ending, k in zip(endings, drive.controls, strict=True):
        low, high = model.actuator_ctrlrange[k] if model.actuator_ctrllimited[k] else (-np.inf, np.inf)
        channels.append(Channel(f"{name}{ending}", unit, float(low), float(high)))
    return channels


def _apart(names: Sequence[str]) -> list[str]:
    """Return names of which none stands twice: those that do are numbered."""
    seen: Counter[str] = Counter()
    found = []
    for name in names:
        seen[name] += 1
        found.append(name if names.count(name) == 1 else f"{name}_{seen[name]}")
    return found


def _sensor_names(model: Any) -> list[str]:
    """Return the names of the sensors; one without is called by its type and number."""
    kinds = mujoco().mjtSensor
    return [
        model.sensor(k).name or f"{kinds(int(model.sensor_type[k])).name.removeprefix('mjSENS_').lower()}{k + 1}"
        for k in range(model.nsensor)
    ]


def _sensor_channels(model: Any, number: int, name: str) -> list[Channel]:
    """Return the channels of a sensor."""
    kind = mujoco().mjtSensor(int(model.sensor_type[number])).name.removeprefix("mjSENS_")
    size = int(model.sensor_dim[number])
    endings = AXES.get(size, tuple(f"_{k + 1}" for k in range(size)))
    unit = UNITS.get(kind, "1")
    if kind == "CONTACT" and int(model.sensor_intprm[number][0]) == ONLY_FORCE:
        unit = "N"
    if kind in OF_JOINTS:
        unit = _of_joint(model, kind, int(model.sensor_objid[number]))
    return [Channel(f"{name}{ending}", unit) for ending in endings]


ONLY_FORCE = 1 << 1  # What a sensor of contacts reports, as bits (mjtConDataField): its force alone.
UNITS = {
    "TOUCH": "N",
    "ACCELEROMETER": "m/s^2",
    "VELOCIMETER": "m/s",
    "GYRO": "rad/s",
    "FORCE": "N",
    "TORQUE": "N m",
    "MAGNETOMETER": "T",
    "RANGEFINDER": "m",
    "CAMPROJECTION": "pixel",
    "TENDONPOS": "m",
    "TENDONVEL": "m/s",
    "TENDONACTFRC": "N",
    "BALLANGVEL": "rad/s",
    "FRAMEPOS": "m",
    "FRAMELINVEL": "m/s",
    "FRAMEANGVEL": "rad/s",
    "FRAMELINACC": "m/s^2",
    "FRAMEANGACC": "rad/s^2",
    "SUBTREECOM": "m",
    "SUBTREELINVEL": "m/s",
    "SUBTREEANGMOM": "N m s",
    "GEOMDIST": "m",
    "E_POTENTIAL": "J",
    "E_KINETIC": "J",
    "CLOCK": "s",
}
"""Of the sensors whose unit does not depend on a joint (MuJoCo's XML reference); what is not here has none."""
OF_JOINTS = {
    "JOINTPOS": ("rad", "m"),
    "JOINTVEL": ("rad/s", "m/s"),
    "JOINTACTFRC": ("N m", "N"),
    "JOINTLIMITPOS": ("rad", "m"),
    "JOINTLIMITVEL": ("rad/s", "m/s"),
    "JOINTLIMITFRC": ("N m", "N"),
    "ACTUATORPOS": ("rad", "m"),
    "ACTUATORVEL": ("rad/s", "m/s"),
    "ACTUATORFRC": ("N m", "N"),
}
"""Units of a sensor on a joint, or on an actuator that drives one, that turns and that slides."""


def _of_joint(model: Any, kind: str, number: int) -> str:
    """Return the unit of a sensor on a joint or on an actuator; "1" for an actuator that drives no joint."""
    joint = drives(model)[number].joint if kind.startswith("ACTUATOR") else number
    if joint is None:
        return "1"
    turning, sliding = OF_JOINTS[kind]
    return sliding if int(model.jnt_type[joint]) == mujoco().mjtJoint.mjJNT_SLIDE else turning
