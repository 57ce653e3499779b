"""A robot read from an MJCF: the joints and bodies of a fixed-base arm, what acts at its joints, what it cannot hold.

MuJoCo's own compiler reads the file, so that defaults, includes, frames, units of angles and inertias of shapes mean
what they mean there; :mod:`harness.physics.arms.formats.mjcf_spec` holds it to the file rule.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from harness.errors import InputError
from harness.physics.arms.formats.mjcf_spec import compiled, mujoco, read_spec
from harness.physics.arms.joints import Joint
from harness.physics.arms.rigid_tree import Arm
from harness.signals import FloatArray

EARTH = 9.81
SAME_GRAVITY = 1e-3  # Relative difference of the gravity that is no other planet: 9.80665 is 3e-4 from 9.81.


@dataclass(frozen=True, eq=False)
class Stated:
    """What a robot's file states."""

    arm: Arm
    at_joints: dict[str, tuple[float, float, float]]
    """Viscous damping [N m s/rad], dry friction [N m] and rotor inertia behind the gear [kg m^2] by joint (N s/m, N and
    kg where it slides); joints without any may be missing.
    """
    notes: tuple[str, ...] = ()  # What its reader should know
    driven: frozenset[str] = frozenset()  # Joints that a motor drives; empty where the file states no motors


@dataclass(frozen=True)
class Drive:
    """An actuator of a compiled model."""

    name: str  # Empty if it has none
    number: int  # Its number among the actuators
    joint: int | None  # The joint that it drives; None if it drives something else (a tendon, a site)
    gear: float  # Of its first output
    controls: range  # Places of its controls in ``ctrl``: one, or several for an orientation


def drives(model: Any) -> list[Drive]:
    """Return the actuators of a compiled model."""
    kinds, found = mujoco().mjtTrn, []
    for k in range(model.nactuator):
        on_joint = int(model.actuator_trntype[k]) in (kinds.mjTRN_JOINT, kinds.mjTRN_JOINTINPARENT)
        first, count = int(model.actuator_ctrladr[k]), int(model.actuator_ctrlnum[k])
        found.append(
            Drive(
                model.actuator(k).name,
                k,
                int(model.actuator_trnid[k][0]) if on_joint else None,
                float(model.actuator_gear[int(model.actuator_outadr[k])][0]),
                range(first, first + count),
            )
        )
    return found


def load_mjcf(path: str | Path, *, locked: Collection[str] = ()) -> Stated:
    """Read an arm with a fixed base from an MJCF.

    Raises InputError if it cannot be read, or if coordinates are not those of an arm: a base that floats, ball joints,
    joints that an equality couples, another gravity.

    - ``path``: an MJCF, or the text of one. The shapes of bodies whose inertia is stated are not looked at.
    - ``locked``: joints that stay at their reference position; a ball or a coupled joint can be used only so

    Examples
    --------
    >>> import importlib.util
    >>> if importlib.util.find_spec("mujoco"):
    ...     stated = load_mjcf('<mujoco><worldbody><body name="rod"><joint name="hinge" axis="0 1 0" damping="0.1"/>'
    ...         '<inertial pos="0 0 -0.5" mass="2" diaginertia="0.1 0.1 0.01"/></body></worldbody></mujoco>')
    ...     assert stated.at_joints == {"hinge": (0.1, 0.0, 0.0)} and stated.arm.joints[0].mass == 2.0
    """
    file = None if str(path).lstrip().startswith("<") else Path(path)
    spec = read_spec(path, shapes=False)
    shaped = {body.name for body in spec.bodies if not body.explicitinertial}
    model = compiled(spec, file)
    engine, names = mujoco(), joint_names(model)
    _refuse_other_coordinates(engine, model, names, locked, file)
    joints: list[Joint] = []
    last: dict[int, tuple[int, FloatArray]] = {0: (-1, np.zeros(3))}  # body -> its last joint and that one's anchor
    for body in range(1, model.nbody):
        parent, anchor = last[int(model.body_parentid[body])]
        rotation, offset = rotation_of(model.body_quat[body]), model.body_pos[body] - anchor
        first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
        own = [*range(first, first + count)]
        for place, number in enumerate(own):
            at = np.array(model.jnt_pos[number])
            shift = rotation @ at if place == 0 else at - model.jnt_pos[number - 1]
            pose = rotation if place == 0 else np.eye(3)
            start = offset + shift if place == 0 else shift
            carries = number == own[-1]
            still = names[number] in locked
            joints.append(_joint(engine, model, number, names[number], parent, pose, start, carries, still))
            parent = len(joints) - 1
        if not own:
            joints.append(_welded(model, body, parent, rotation, offset, {joint.name for joint in joints} | {*names}))
            parent = len(joints) - 1
        last[body] = (parent, np.array(model.jnt_pos[own[-1]]) if own else np.zeros(3))
    arm = Arm(spec.modelname or ("robot" if file is None else file.stem), tuple(joints))
    notes = tuple(_notes(model, names, locked, shaped))
    return Stated(arm, _at_joints(model, names), notes, _driven(model, names))


def joint_names(model: Any) -> list[str]:
    """Return the names of a compiled model's joints; one without a name is called after its body."""
    names: list[str] = []
    for number in range(model.njnt):
        body = model.body(int(model.jnt_bodyid[number]))
        name = model.joint(number).name or f"joint of {body.name or f'body {body.id}'}"
        names.append(name if name not in names else f"{name} ({number})")
    return names


def simple_joints(model: Any) -> list[int]:
    """Return the numbers of the joints of a compiled model that turn or slide."""
    kinds = mujoco().mjtJoint
    return [k for k in range(model.njnt) if int(model.jnt_type[k]) in (kinds.mjJNT_HINGE, kinds.mjJNT_SLIDE)]


def _joint(
    engine: Any,
    model: Any,
    number: int,
    name: str,
    parent: int,
    rotation: FloatArray,
    offset: FloatArray,
    carries: bool,
    locked: bool,
) -> Joint:
    """Return one joint, with the body's mass if it is the body's last one."""
    kinds = engine.mjtJoint
    kind, axis = int(model.jnt_type[number]), np.array(model.jnt_axis[number])
    moves = kind in (kinds.mjJNT_HINGE, kinds.mjJNT_SLIDE)
    reference = float(model.qpos0[model.jnt_qposadr[number]]) if moves and not locked else 0.0
    if kind == kinds.mjJNT_SLIDE:
        offset = offset - rotation @ axis * reference
    elif reference:
        rotation = rotation @ _turned(axis, -reference)
    low, high = model.jnt_range[number] if model.jnt_limited[number] else (-math.inf, math.inf)
    body = int(model.jnt_bodyid[number])
    mass, centre, inertia = _body(model, body, np.array(model.jnt_pos[number])) if carries else _NOTHING
    return Joint(
        name,
        parent,
        "fixed" if not moves else "prismatic" if kind == kinds.mjJNT_SLIDE else "revolute",
        rotation,
        offset,
        axis if moves else np.array([1.0, 0.0, 0.0]),
        mass,
        centre,
        inertia,
        lower=float(low),
        upper=float(high),
        effort=float(model.jnt_actfrcrange[number][1]) if model.jnt_actfrclimited[number] else math.inf,
        velocity=math.inf,
    )


_NOTHING = (0.0, np.zeros(3), np.zeros((3, 3)))


def _welded(
    model: Any, body: int, parent: int, rotation: FloatArray, offset: FloatArray, taken: Collection[str]
) -> Joint:
    """Return a body without joints as one that is fixed to its parent."""
    name = model.body(body).name or f"body {body}"
    mass, centre, inertia = _body(model, body, np.zeros(3))
    unlimited = {"lower": -math.inf, "upper": math.inf, "effort": math.inf, "velocity": math.inf}
    name = name if name not in taken else f"{name} (body)"
    return Joint(name, parent, "fixed", rotation, offset, np.array([1.0, 0.0, 0.0]), mass, centre, inertia, **unlimited)


def _body(model: Any, body: int, anchor: FloatArray) -> tuple[float, FloatArray, FloatArray]:
    """Return mass, centre of mass and inertia about it (3, 3) in the frame of a joint at an anchor."""
    turn = rotation_of(model.body_iquat[body])
    inertia = turn @ np.diag(model.body_inertia[body]) @ turn.T
    return float(model.body_mass[body]), model.body_ipos[body] - anchor, (inertia + inertia.T) / 2


def _at_joints(model: Any, names: Sequence[str]) -> dict[str, tuple[float, float, float]]:
    """Return damping, dry friction and rotor inertia of the joints, those of their actuators' own parts among them."""
    found = {}
    for number, name in enumerate(names):
        dof = int(model.jnt_dofadr[number])
        found[name] = [float(x[dof]) for x in (model.dof_damping, model.dof_frictionloss, model.dof_armature)]
    for drive in drives(model):
        if drive.joint is not None:
            found[names[drive.joint]][0] += drive.gear**2 * float(model.actuator_damping[drive.number])
            found[names[drive.joint]][2] += drive.gear**2 * float(model.actuator_armature[drive.number])
    return {name: (damping, friction, rotor) for name, (damping, friction, rotor) in found.items()}


def _driven(model: Any, names: Sequence[str]) -> frozenset[str]:
    """Return the joints that actuators drive; none where one of them drives something else than joints."""
    driven = [drive.joint for drive in drives(model)]
    return frozenset() if None in driven else frozenset(names[joint] for joint in driven if joint is not None)


def _refuse_other_coordinates(
    engine: Any, model: Any, names: Sequence[str], locked: Collection[str], file: Path | None
) -> None:
    """Refuse what makes the coordinates other ones than an arm's, by name."""
    kinds = {engine.mjtJoint.mjJNT_FREE: "free", engine.mjtJoint.mjJNT_BALL: "ball"}
    for number, name in enumerate(names):
        kind = kinds.get(engine.mjtJoint(int(model.jnt_type[number])))
        if kind is not None and name not in locked:
            raise InputError(
                "kind of joint",
                expected="hinge or slide",
                got=f"a {kind} joint",
                remedy="weld the base to the world, or lock the joint (locked)" if kind == "free"
                else "split it into hinges, or lock it (locked)",
                file=file,
                place=f"joint {name}",
            )  # fmt: skip
    for number in range(model.neq):
        what, between = _equality(engine, model, number, names)
        if model.eq_active0[number] and not (between and set(between) <= set(locked)):
            raise InputError(
                "an equality constraint couples the coordinates",
                expected="joints that move by themselves",
                got=what,
                remedy=f"lock them (locked = {list(between)})" if between else "set it inactive, or remove it",
                file=file,
                place="equality",
            )
    pull = np.array(model.opt.gravity)
    if np.linalg.norm(pull - [0.0, 0.0, -EARTH]) > SAME_GRAVITY * EARTH:
        raise InputError(
            "gravity",
            expected=f"0 0 -{EARTH} m/s^2, in which arms are judged",
            got=" ".join(f"{x:g}" for x in pull),
            remedy="set <option gravity>; where the base is mounted otherwise, turn its first body",
            file=file,
            place="option",
        )


def _equality(engine: Any, model: Any, number: int, names: Sequence[str]) -> tuple[str, tuple[str, ...]]:
    """Return an equality constraint in words, and the joints that it is about."""
    kind = engine.mjtEq(int(model.eq_type[number]))
    word = kind.name.removeprefix("mjEQ_").lower()
    called = model.eq(number).name
    what = f"{word} {called}".strip()
    ends = (int(model.eq_obj1id[number]), int(model.eq_obj2id[number]))
    if kind == engine.mjtEq.mjEQ_JOINT:
        between = tuple(names[end] for end in ends if end >= 0)
        return f"{what} between {' and '.join(between)}", between
    if kind == engine.mjtEq.mjEQ_TENDON:
        return what, tuple(dict.fromkeys(name for end in ends if end >= 0 for name in _joints_of(model, end, names)))
    return what, ()


def _joints_of(model: Any, tendon: int, names: Sequence[str]) -> list[str]:
    """Return the joints that a fixed tendon is made of."""
    first = int(model.tendon_adr[tendon])
    of_joint = int(mujoco().mjtWrap.mjWRAP_JOINT)
    parts = range(first, first + int(model.tendon_num[tendon]))
    return [names[int(model.wrap_objid[k])] for k in parts if int(model.wrap_type[k]) == of_joint]


def _notes(model: Any, names: Sequence[str], locked: Collection[str], shaped: Collection[str]) -> Iterator[str]:
    """Yield what an arm does not hold of the MJCF, by name, and what is assumed."""
    for what, where in _left_out(model, names, locked):
        if where:
            yield f"the MJCF states {what}, which the model of an arm leaves out: {', '.join(where)}"
    heavy = [model.body(k).name or str(k) for k in range(1, model.nbody) if model.body_mass[k] > 0]
    if own := [name for name in heavy if name in shaped]:
        yield f"the MJCF gives no <inertial> to these bodies, their masses are those of their shapes: {', '.join(own)}"
    others = [drive.name or str(drive.number) for drive in drives(model) if drive.joint is None]
    gears = [f"{d.gear:g} at {names[d.joint]}" for d in drives(model) if d.joint is not None and d.gear != 1.0]
    if gears:
        yield f"the MJCF states gears, torques are taken on the side of the joint: {', '.join(gears)}"
    if others:
        yield f"actuators of the MJCF that do not drive one joint, torques are those on the joints: {', '.join(others)}"


def _left_out(model: Any, names: Sequence[str], locked: Collection[str]) -> Iterator[tuple[str, list[str]]]:
    """Yield each kind of force that the model of an arm does not have, and where the MJCF states it."""
    free = [(names[k], k, int(model.jnt_dofadr[k])) for k in range(model.njnt) if names[k] not in locked]
    springs = [name for name, k, _ in free if model.jnt_stiffness[k] or np.any(model.jnt_stiffnesspoly[k])]
    curved = [name for name, _, dof in free if np.any(model.dof_dampingpoly[dof])]
    acts = np.array([model.tendon_stiffness, model.tendon_damping, model.tendon_frictionloss, model.tendon_armature])
    tendons = [
        model.tendon(k).name or str(k) for k in range(model.ntendon) if acts[:, k].any() or model.tendon_limited[k]
    ]
    lifted = [model.body(k).name for k in range(1, model.nbody) if model.body_gravcomp[k]]
    medium = ["density or viscosity"] if model.opt.density or model.opt.viscosity else []
    yield "springs at joints", springs
    yield "damping that is not linear at joints", curved
    yield "tendons that pull at joints", tendons
    yield "compensated gravity of bodies", lifted
    yield "a medium", medium


def rotation_of(quaternion: FloatArray) -> FloatArray:
    """Return the rotation matrix of a quaternion (w, x, y, z)."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_quat(np.roll(quaternion, -1)).as_matrix(), dtype=np.float64)


def _turned(axis: FloatArray, angle: float) -> FloatArray:
    """Return the rotation matrix about a unit axis."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_rotvec(angle * np.asarray(axis)).as_matrix(), dtype=np.float64)
