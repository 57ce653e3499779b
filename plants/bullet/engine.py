"""PyBullet made explicit: a quiet import, a URDF with nothing hidden, a client that declares what it simulates.

What Bullet 3.2 does behind the back, each measured and each handled here:

* The library prints to the process's stdout when it is imported and when it reads a file.
* ``changeDynamics(jointDamping=0)`` is ignored and limits once read from a file cannot be taken away again, so both
  are written into the URDF before it is read.
* Velocity motors are on by default; every joint's motor is set to the declared friction (0 by default).
* An inertia tensor that no body has becomes 0; joints that are floating or planar, ``<mimic>``, and the rotors of a
  ``<transmission>`` are left out: all are refused by name. ``<dynamics>`` and effort and velocity of ``<limit>`` are
  read by :func:`stated`: Bullet forgets the friction, and enforces neither limit.
* Links have 0.04 linear and angular damping; rates are clipped at 100 rad/s.
* Joint damping is an explicit torque computed once for each ``stepSimulation``, whatever ``numSubSteps`` says: with
  damping the substeps are separate calls. The motor's greatest impulse is computed from the whole time step: with
  ``numSubSteps = n`` the force is divided by n.
* After one NaN every later step is NaN, resets included: the world is built anew.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import os
import sys
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from harness.errors import InputError, PlantError, PluginError, refuse_unknown
from harness.physics.arms.formats.urdf import dynamics_of, inertial_of, limits_of, refuse_dependent, rotors_of
from harness.physics.arms.inertia import triangle_excess
from harness.physics.arms.joints import MOVING
from harness.signals import FloatArray


@contextlib.contextmanager
def quiet(*streams: int) -> Iterator[None]:
    """Silence what a C library prints to stdout, or to these file descriptors."""
    sys.stdout.flush()
    sys.stderr.flush()
    kept = {number: os.dup(number) for number in streams or (1,)}
    try:
        with open(os.devnull, "w", encoding="ascii") as nowhere:
            for number in kept:
                os.dup2(nowhere.fileno(), number)
            try:
                yield
            finally:
                if os.name == "posix":
                    ctypes.CDLL(None).fflush(None)  # C's own buffer would come out later, at exit
                for number, original in kept.items():
                    os.dup2(original, number)
    finally:
        for original in kept.values():
            os.close(original)


@functools.cache
def bullet() -> Any:
    """Return the pybullet module.

    Raises PluginError if it is not installed: its wheels exist for CPython 3.10 and 3.11 only.
    """
    try:
        with quiet(1, 2):
            import pybullet
    except ImportError as error:
        version = f"{sys.version_info.major}.{sys.version_info.minor}"
        raise PluginError(
            f"this plant needs pybullet: expected the package, got none for Python {version}; "
            "remedy: use Python 3.11, for which it has wheels (pip install pybullet), or a plant of another engine, as "
            "arm-mujoco (sysid list plants)"
        ) from error
    return pybullet


def data_file(*parts: str) -> Path:
    """Return the path of a file that PyBullet brings along."""
    bullet()
    import pybullet_data

    return Path(pybullet_data.getDataPath()).joinpath(*parts)


def moving_joints(root: ET.Element) -> list[ET.Element]:
    """Return the joints of a URDF that move, in the order of the file."""
    return [joint for joint in root.iter("joint") if joint.get("type") in ("revolute", "continuous", "prismatic")]


def explicit_urdf(
    source: str | Path,
    *,
    damping: float | Sequence[float] = 0.0,
    limits: bool = False,
    payload: tuple[str, float, Sequence[float]] | None = None,
    shapes: bool = True,
    locked: Sequence[str] = (),
    tensors: bool = True,
) -> ET.Element:
    """Return a URDF with nothing left to Bullet's defaults, its meshes found.

    Raises InputError if it cannot be read, has no moving joint, has no such link, or holds what Bullet would leave out
    in silence: joints of other kinds, joints that follow others, impossible inertias, rotors behind a gear.

    - ``source``: a file, or the text of one (it starts with ``<``)
    - ``damping``: viscous damping of the moving joints [N m s/rad or N s/m]
    - ``limits``: keep the joint limits of the file
    - ``payload`` (link, mass, offset): point mass [kg] fixed to a link at an offset [m] from its frame
    - ``shapes``: keep the shapes for collisions; without them loading and stepping are faster
    - ``locked``: joints that are made rigid
    - ``tensors``: the inertia tensors of the file are used: Bullet makes one that no body has zero, so that it is
      refused
    """
    root, folder = _parsed(source)
    joints = {str(joint.get("name")): joint for joint in root.iter("joint")}
    refuse_unknown("unknown joint", locked, joints)
    for name in locked:
        joints[name].set("type", "fixed")
        for mimic in joints[name].findall("mimic"):
            joints[name].remove(mimic)
    _refuse_left_out(root, None if folder is None else Path(source), locked, tensors=tensors)
    moving = moving_joints(root)
    if not moving:
        raise InputError(
            "no joint moves",
            expected="a revolute, continuous or prismatic joint",
            got="none",
            remedy="give another URDF",
            file=None if folder is None else source,
        )
    for joint, value in zip(moving, np.broadcast_to(np.asarray(damping, dtype=float), len(moving)), strict=True):
        for dynamics in joint.findall("dynamics"):
            joint.remove(dynamics)
        ET.SubElement(joint, "dynamics", damping=repr(float(value)), friction="0.0")
        if not limits:
            if joint.get("type") == "revolute":
                joint.set("type", "continuous")
            for limit in joint.findall("limit"):
                joint.remove(limit)
            # lower > upper is Bullet's word for "no limit"; a sliding joint without the element is not read at all
            ET.SubElement(joint, "limit", lower="0", upper="-1", effort="0", velocity="0")
    for link in root.iter("link"):
        for shape in link.findall("visual") + ([] if shapes else link.findall("collision")):
            link.remove(shape)
    if payload is not None:
        _add_payload(root, *payload)
    base = folder if folder is not None else Path()
    for mesh in root.iter("mesh"):
        name = mesh.get("filename", "").removeprefix("package://")
        mesh.set("filename", str((base / name).resolve()))
    return root


def stated(source: str | Path, locked: Sequence[str] = ()) -> tuple[list[float], ...]:
    """Return the damping, friction, effort and velocity that a URDF states of the joints that move.

    - ``source``: a file, or the text of one
    - ``locked``: joints that are made rigid
    - returns ``damping, friction, effort, velocity``: 0 and infinite where it states none
    """
    root, folder = _parsed(source)
    file = None if folder is None else Path(source)
    dynamics, limits = dynamics_of(root, file), limits_of(root, file)
    names = [str(joint.get("name")) for joint in moving_joints(root) if joint.get("name") not in locked]
    columns = zip(*((*dynamics.get(name, (0.0, 0.0)), *limits[name]) for name in names), strict=True)
    return tuple(map(list, columns))


def _refuse_left_out(root: ET.Element, file: Path | None, locked: Sequence[str], *, tensors: bool) -> None:
    """Refuse by name what Bullet would leave out of a URDF without a word."""
    refuse_dependent(root, locked, file)
    for joint in root.findall("joint"):
        kind, name = joint.get("type", ""), joint.get("name", "")
        if kind not in (*MOVING, "fixed"):
            raise InputError(
                "kind of joint",
                expected=f"one of {', '.join(sorted(MOVING))}, fixed",
                got=repr(kind),
                remedy="split it into such joints, lock it, or for a free base use fixed_base = false",
                file=file,
                place=f"joint {name}",
            )
    for name, rotor in rotors_of(root, file).items():
        if rotor > 0 and name not in locked:
            raise InputError(
                "a rotor behind a gear, for which Bullet has no place",
                expected="no rotor inertia",
                got=f"{rotor:g} kg m^2 at the joint",
                remedy="simulate the URDF in MuJoCo (plant mjcf), or remove <rotor_inertia>",
                file=file,
                place=f"transmission of joint {name}",
            )
    for link in root.findall("link"):
        mass, _, inertia = inertial_of(link, file)
        excess = triangle_excess(inertia) if tensors and mass > 0 else 0.0
        if excess > 0:
            raise InputError(
                "an inertia that no body has, which Bullet makes 0",
                expected="principal moments >= 0, each at most the sum of the other two",
                got=f"one that is too large by {100 * excess:.2g} % of itself",
                remedy="correct <inertia>, or use inertia = shape",
                file=file,
                place=f"link {link.get('name')}",
            )


def load(client: int, root: ET.Element, *, fixed_base: bool, inertia_from_file: bool, position: Sequence[float]) -> int:
    """Load a URDF into a client and return Bullet's number of the body.

    Raises PlantError if Bullet cannot read it.
    """
    engine = bullet()
    flags = engine.URDF_USE_INERTIA_FROM_FILE if inertia_from_file else 0
    with tempfile.TemporaryDirectory(prefix="sysid-urdf-") as scratch:
        path = Path(scratch) / "body.urdf"
        path.write_bytes(ET.tostring(root))
        try:
            with quiet():
                return int(
                    engine.loadURDF(
                        str(path),
                        basePosition=list(position),
                        useFixedBase=fixed_base,
                        flags=flags,
                        physicsClientId=client,
                    )
                )
        except engine.error as error:
            raise PlantError(f"PyBullet cannot load the URDF {root.get('name')!r}: {error}") from error


def stiffest_rate(client: int, body: int, damping: Sequence[float], home: FloatArray) -> float:
    """Return the largest eigenvalue [1/s] of M(q)^-1 D over the home position and 32 others.

    Explicit damping needs the step times this rate well below 1; it is unstable above 2.
    """
    if not any(damping):
        return 0.0
    engine = bullet()
    rng = np.random.default_rng(0)
    fastest = 0.0
    n_base = len(engine.calculateMassMatrix(body, home.tolist(), physicsClientId=client)) - len(damping)
    for trial in range(33):
        q = home if trial == 0 else rng.uniform(-np.pi, np.pi, len(damping))
        mass = np.array(engine.calculateMassMatrix(body, q.tolist(), physicsClientId=client))
        response = np.linalg.pinv(mass)[n_base:, n_base:]
        fastest = max(fastest, float(np.abs(np.linalg.eigvals(response * np.asarray(damping))).max()))
    return fastest


def engine_joints(client: int, body: int, root: ET.Element) -> list[int]:
    """Return Bullet's numbers of the moving joints, in the order of the URDF."""
    engine = bullet()
    infos = [
        engine.getJointInfo(body, joint, physicsClientId=client)
        for joint in range(engine.getNumJoints(body, physicsClientId=client))
    ]
    numbers = {info[1].decode(): int(info[0]) for info in infos}
    return [numbers[str(joint.get("name"))] for joint in moving_joints(root)]


def _parsed(source: str | Path) -> tuple[ET.Element, Path | None]:
    """Return the root of a URDF and its folder (None for a text)."""
    folder: Path | None = None
    text = str(source)
    if not text.lstrip().startswith("<"):
        path = Path(source)
        if not path.is_file():
            raise InputError(
                "no such URDF", expected="a URDF file", got="no file", remedy="check the path", file=str(source)
            )
        folder, text = path.parent, path.read_text(encoding="utf-8")
    try:
        root = ET.fromstring(text)
    except ET.ParseError as error:
        raise InputError(
            "the URDF is not well-formed XML",
            expected="XML",
            got=str(error),
            remedy="repair the file",
            file=None if folder is None else str(source),
        ) from error
    if root.tag != "robot":
        raise InputError(
            "not a URDF", expected="the root element <robot>", got=f"<{root.tag}>", remedy="give a URDF file"
        )
    return root, folder


def _add_payload(root: ET.Element, link: str, mass: float, offset: Sequence[float]) -> None:
    """Fix a point mass to a link."""
    links = [str(element.get("name")) for element in root.iter("link")]
    refuse_unknown("payload on an unknown link", link, links, remedy="name a link of the URDF")
    place = " ".join(repr(float(value)) for value in offset)
    body = ET.SubElement(ET.SubElement(root, "link", name="payload"), "inertial")
    ET.SubElement(body, "mass", value=repr(float(mass)))
    ET.SubElement(body, "inertia", ixx="0", ixy="0", ixz="0", iyy="0", iyz="0", izz="0")
    joint = ET.SubElement(root, "joint", name="payload_joint", type="fixed")
    ET.SubElement(joint, "parent", link=link)
    ET.SubElement(joint, "child", link="payload")
    ET.SubElement(joint, "origin", xyz=place, rpy="0 0 0")
