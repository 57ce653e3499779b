"""What a MuJoCo plant simulates: the robot's file with the options put into it, as a compiled model."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from harness.errors import InputError, refuse_unknown
from harness.physics.arms.formats.mjcf import simple_joints
from harness.physics.arms.formats.mjcf_spec import compiled, mujoco, parsed, read_spec, wrapped
from harness.physics.arms.formats.urdf import rotors_of
from plants.checking import per_item, positive, whole

Integrator = Literal["euler", "rk4", "implicit", "implicitfast"]
Solver = Literal["pgs", "cg", "newton"]
Cone = Literal["pyramidal", "elliptic"]

WHOLE = 1e-6  # Relative difference from a whole number of engine steps that is rounding of the two times.


@dataclass(frozen=True, kw_only=True)
class MujocoSettings:
    """Options of :class:`plants.mujoco.plant.MujocoPlant`; None keeps what the file says."""

    sample_time: float | None = None
    timestep: float | None = None
    substeps: int | None = None
    outputs: Sequence[str] = ("q", "qd")
    actuators: Sequence[str] | None = None
    forces: Sequence[str] | None = None
    joint_names: Sequence[str] | None = None
    input_names: Sequence[str] | None = None
    input_limit: float | Sequence[float] | None = None
    keyframe: str | None = None
    integrator: Integrator | None = None
    solver: Solver | None = None
    cone: Cone | None = None
    iterations: int | None = None
    tolerance: float | None = None
    gravity: float | Sequence[float] | None = None
    contact: bool = True
    joint_limits: bool = True
    joint_damping: float | Sequence[float] | None = None
    joint_friction: float | Sequence[float] | None = None
    armature: float | Sequence[float] | None = None
    friction_time: float | None = None
    locked: Sequence[str] = ()
    shapes: bool | None = None


def built(source: str | Path, given: MujocoSettings) -> Any:
    """Return the compiled model of a robot with the options in it.

    Raises InputError if the file cannot be used or an option does not fit it.

    - ``source``: an MJCF or URDF, or the text of one
    """
    root, file = parsed(source)
    urdf = root.tag == "robot"
    spec = read_spec(source, shapes=not urdf if given.shapes is None else given.shapes)
    rotors = rotors_of(root, file) if urdf else {}
    for joint in list(spec.joints):
        if joint.name in rotors:
            joint.armature = rotors[joint.name]
    _lock(spec, given.locked)
    _put_options(spec, given)
    model = compiled(spec, file)
    engine, simple = mujoco(), simple_joints(model)
    dofs = np.array([int(model.jnt_dofadr[k]) for k in simple], dtype=int)
    for name, field in _AT_JOINTS.items():
        value = getattr(given, name)
        if value is not None:
            values = per_item(name, value, len(simple), "joints")
            for one in values:
                positive(name, one, zero=True)
            getattr(model, field)[dofs] = values
    if given.friction_time is not None:
        model.dof_solref[dofs] = [positive("friction_time", given.friction_time), 1.0]
    engine.mj_setConst(model, engine.MjData(model))  # what follows from inertia, once more
    return model


_AT_JOINTS = {"joint_damping": "dof_damping", "joint_friction": "dof_frictionloss", "armature": "dof_armature"}


def times(
    source: str | Path, sample_time: float | None, timestep: float | None, substeps: int | None
) -> tuple[Any, ...]:
    """Return sample time [s], engine step [s] and steps a sample from those of them that are given.

    The step is the file's if neither it nor both others are given, or the next smaller one that divides the sample
    time; one step a sample if only the step is known. Raises InputError if they contradict each other, or the sample
    time is no whole number of steps.
    """
    if substeps is not None:
        whole("substeps", substeps)
    for name, value in (("sample_time", sample_time), ("timestep", timestep)):
        if value is not None:
            positive(name, value)
    if timestep is None and sample_time is not None and substeps is not None:
        return float(sample_time), sample_time / substeps, int(substeps)
    step = float(read_spec(source, shapes=False).option.timestep) if timestep is None else float(timestep)
    if sample_time is None:
        count = 1 if substeps is None else int(substeps)
        return step * count, step, count
    if timestep is None:
        count = math.ceil(sample_time / step * (1 - WHOLE))
        return float(sample_time), sample_time / count, count
    count = round(sample_time / step)
    if count < 1 or abs(count * step - sample_time) > WHOLE * sample_time or (substeps or count) != count:
        raise InputError(
            "sample time and engine step",
            expected="a sample time of a whole number of steps" + (f", {substeps}" if substeps else ""),
            got=f"{sample_time:g} s and a step of {step:g} s",
            remedy="give substeps instead of timestep",
        )
    return float(sample_time), step, count


def _lock(spec: Any, locked: Sequence[str]) -> None:
    """Take joints out of a spec, with the tendons, actuators, equalities and sensors that need them."""
    known = {joint.name: joint for joint in spec.joints}
    for name in locked:
        if not name or name not in known:
            raise InputError(
                "option locked",
                expected=f"joints among {', '.join(filter(None, known))}",
                got=repr(name),
                remedy="correct it",
            )
        tendons = [tendon for tendon in spec.tendons if name in wrapped(tendon)]
        gone = {name, *(tendon.name for tendon in tendons)}
        for equality in [one for one in spec.equalities if gone & {one.name1, one.name2}]:
            spec.delete(equality)
        actuators = [one for one in spec.actuators if one.target in gone]
        gone |= {one.name for one in actuators if one.name}
        for part in [*(one for one in spec.sensors if one.objname in gone), *actuators, *tendons, known[name]]:
            spec.delete(part)
    for key in list(spec.keys) if locked else []:  # their lists of positions are those of all joints
        spec.delete(key)


def _put_options(spec: Any, given: MujocoSettings) -> None:
    """Put the options of the solver into a spec."""
    engine, option = mujoco(), spec.option
    words = (("integrator", Integrator, "INT"), ("solver", Solver, "SOL"), ("cone", Cone, "CONE"))
    for name, known, prefix in words:
        value = getattr(given, name)
        if value is not None:
            choices = known.__args__  # type: ignore[attr-defined]
            refuse_unknown(f"option {name}", value, choices, remedy="correct it")
            setattr(option, name, getattr(getattr(engine, f"mjt{name.capitalize()}"), f"mj{prefix}_{value.upper()}"))
    for name in ("timestep", "iterations", "tolerance"):
        if getattr(given, name) is not None:
            setattr(option, name, getattr(given, name))
    if given.gravity is not None:
        pull = np.asarray(given.gravity, dtype=float)
        if pull.shape not in ((), (3,)) or not np.isfinite(pull).all():
            raise InputError(
                "option gravity",
                expected="a number (along -z) or three [m/s^2]",
                got=repr(given.gravity),
                remedy="correct it",
            )
        option.gravity = [0.0, 0.0, -float(pull)] if pull.shape == () else pull
    bits = engine.mjtDisableBit
    off = [bits.mjDSBL_AUTORESET]  # MuJoCo would start anew in silence where a run diverges
    off += [] if given.contact else [bits.mjDSBL_CONTACT]
    off += [] if given.joint_limits else [bits.mjDSBL_LIMIT]
    for bit in off:
        option.disableflags = int(option.disableflags) | int(bit)
