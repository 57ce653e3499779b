"""A robot read from a URDF file: its joints and its bodies."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np

from harness.errors import InputError
from harness.physics.arms.joints import MOVING, Joint
from harness.physics.arms.rigid_tree import Arm
from harness.signals import FloatArray

WORLD = "world"  # The link that needs no declaration: what a robot is fastened to, as Drake and ROS read it.


def load_urdf(path: str | Path) -> Arm:
    """Read a robot with a fixed base.

    Raises InputError if the file cannot be read, is no URDF, has a joint of another kind, or is no tree.

    - ``path``: URDF file; meshes are not looked at
    - returns joints in the order of a depth-first walk, children in the order of the file (the order of Bullet)
    """
    file = Path(path)
    if not file.is_file():
        raise InputError("no such URDF", expected="a file", got="no file", remedy="check the path", file=file)
    try:
        root = ElementTree.parse(file).getroot()
    except ElementTree.ParseError as error:
        raise InputError("not XML", expected="a URDF file", got=str(error), remedy="repair it", file=file) from error
    bodies = {link.get("name", ""): inertial_of(link, file) for link in root.findall("link")}
    if root.tag != "robot" or not bodies:
        raise InputError(
            "not a URDF", expected="a <robot> with links", got=f"<{root.tag}>", remedy="check the file", file=file
        )
    elements = root.findall("joint")
    if WORLD not in bodies and WORLD in {parent.get("link") for parent in root.iterfind("joint/parent")}:
        bodies[WORLD] = 0.0, np.zeros(3), np.zeros((3, 3))
    children, _ = ({_end(element, end, bodies, file) for element in elements} for end in ("child", "parent"))
    roots = [name for name in bodies if name not in children]
    if len(roots) != 1 or len(children) != len(elements):
        raise InputError(
            "not a tree",
            expected="one base link, one parent for each other link",
            got=f"{len(roots)} base links, {len(elements)} joints to {len(children)} links",
            remedy="repair the joints",
            file=file,
        )
    joints: list[Joint] = []

    def walk(link: str, index: int) -> None:
        for element in elements:
            if _end(element, "parent", bodies, file) == link:
                child = _end(element, "child", bodies, file)
                joints.append(_joint(element, index, bodies[child], file))
                walk(child, len(joints) - 1)

    walk(roots[0], -1)
    return Arm(root.get("name", file.stem), tuple(joints))


def _end(element: ElementTree.Element, end: str, bodies: dict[str, Any], file: Path) -> str:
    """Return the link that a joint names as its parent or child."""
    found = element.find(end)
    name = "" if found is None else found.get("link", "")
    if name not in bodies:
        raise InputError(
            f"{end} of joint {element.get('name')!r}",
            expected="a link of the file",
            got=repr(name),
            remedy="correct the name",
            file=file,
            place=f"joint {element.get('name')}",
        )
    return name


def _joint(element: ElementTree.Element, parent: int, body: tuple[float, FloatArray, FloatArray], file: Path) -> Joint:
    """Return the joint of an element."""
    kind, name = element.get("type", ""), element.get("name", "")
    place = f"joint {name}"
    if kind not in MOVING | {"fixed"}:
        raise InputError(
            "kind of joint",
            expected=f"one of {', '.join(sorted(MOVING))}, fixed",
            got=repr(kind),
            remedy="split it into such joints; a base that floats is not an arm's",
            file=file,
            place=place,
        )
    rotation, offset = pose_of(element.find("origin"), file, place)
    axis = vector_of(None if kind == "fixed" else element.find("axis"), "xyz", (1.0, 0.0, 0.0), file, place)
    length = float(np.linalg.norm(axis))
    if not length > 0:
        raise InputError(
            "axis", expected="a direction", got="a zero vector", remedy="correct it", file=file, place=place
        )
    limit = element.find("limit")
    bounded = limit is not None and kind in ("revolute", "prismatic")
    return Joint(
        name,
        parent,
        kind,
        rotation,
        offset,
        axis / length,
        *body,
        lower=_number(limit, "lower", 0.0, file, place) if bounded else -math.inf,
        upper=_number(limit, "upper", 0.0, file, place) if bounded else math.inf,
        effort=_number(limit, "effort", math.inf, file, place),
        velocity=_number(limit, "velocity", math.inf, file, place),
    )


def inertial_of(link: ElementTree.Element, file: Path | None) -> tuple[float, FloatArray, FloatArray]:
    """Return mass, centre of mass and inertia about it (3, 3) of a link; zeros where it has none.

    Raises InputError if a number is none, or the mass is negative.
    """
    place = f"link {link.get('name')}"
    inertial = link.find("inertial")
    if inertial is None:
        return 0.0, np.zeros(3), np.zeros((3, 3))
    rotation, centre = pose_of(inertial.find("origin"), file, place)
    mass = _number(inertial.find("mass"), "value", 0.0, file, place)
    if not 0 <= mass < math.inf:
        raise InputError(
            "mass", expected="a mass >= 0", got=f"{mass:g} kg", remedy="correct it", file=file, place=place
        )
    element = inertial.find("inertia")
    xx, xy, xz, yy, yz, zz = (_number(element, f"i{n}", 0.0, file, place) for n in ("xx", "xy", "xz", "yy", "yz", "zz"))
    inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return mass, centre, rotation @ inertia @ rotation.T


def dynamics_of(root: ElementTree.Element, file: Path | None) -> dict[str, tuple[float, float]]:
    """Return damping and friction of every joint that states them, by name.

    Raises InputError if one is no number >= 0.
    """
    result = {}
    for joint in root.findall("joint"):
        element = joint.find("dynamics")
        if element is None:
            continue
        place = f"joint {joint.get('name')}"
        values = [_number(element, key, 0.0, file, place) for key in ("damping", "friction")]
        for key, value in zip(("damping", "friction"), values, strict=True):
            if not 0 <= value < math.inf:
                raise InputError(
                    key, expected="a number >= 0", got=f"{value:g}", remedy="correct it", file=file, place=place
                )
        result[joint.get("name", "")] = (values[0], values[1])
    return result


def limits_of(root: ElementTree.Element, file: Path | None) -> dict[str, tuple[float, float]]:
    """Return the limits of force [N m or N] and rate [rad/s or m/s] of every joint by name, infinite where none is.

    Exporters write 0 where they know none, which would let nothing move: it is none.

    Examples
    --------
    >>> robot = ElementTree.fromstring('<robot><joint name="j"><limit effort="30" velocity="0"/></joint></robot>')
    >>> limits_of(robot, None)
    {'j': (30.0, inf)}
    """
    found = {}
    for joint in root.findall("joint"):
        name, element = joint.get("name", ""), joint.find("limit")
        values = [_number(element, key, math.inf, file, f"joint {name}") for key in ("effort", "velocity")]
        found[name] = tuple(value if value > 0 else math.inf for value in values)
    return {name: (effort, velocity) for name, (effort, velocity) in found.items()}


def rotors_of(root: ElementTree.Element, file: Path | None) -> dict[str, float]:
    """Return the inertia of rotors behind their gears [kg m^2] by joint, of drives that state one.

    ``<rotor_inertia value>`` and ``<gear_ratio value>`` of a ``<transmission>``, in any namespace (Drake's URDFs have
    them); a ratio that is not stated there is that of ``<mechanicalReduction>``, or 1.

    Raises InputError if one is no number >= 0.

    Examples
    --------
    >>> rotors_of(ElementTree.fromstring('<robot><transmission><joint name="j"/><actuator name="m">'
    ...     '<rotor_inertia value="2e-5"/><gear_ratio value="100"/></actuator></transmission></robot>'), None)
    {'j': 0.2}
    """
    found = {}
    for drive in root.findall("transmission"):
        parts = {element.tag.rpartition("}")[2]: element for element in drive.iter()}
        if "rotor_inertia" not in parts or "joint" not in parts:
            continue
        name = parts["joint"].get("name", "")
        place = f"transmission of joint {name}"
        reduction = parts.get("mechanicalReduction")
        geared = (reduction.text or "1") if reduction is not None else "1"
        stated = ElementTree.Element("ratio", value=geared) if "gear_ratio" not in parts else parts["gear_ratio"]
        inertia = _number(parts["rotor_inertia"], "value", 0.0, file, place)
        ratio = _number(stated, "value", 1.0, file, place)
        if not 0 <= inertia * ratio**2 < math.inf:
            raise InputError(
                "rotor inertia", expected="a number >= 0", got=f"{inertia:g}", remedy="correct it", file=file,
                place=place,
            )  # fmt: skip
        found[name] = inertia * ratio**2
    return found


def refuse_dependent(root: ElementTree.Element, locked: Collection[str], file: Path | None) -> None:
    """Refuse joints that follow another one (``<mimic>``) and are not locked: they are no coordinates of their own."""
    for joint in root.findall("joint"):
        mimic, name = joint.find("mimic"), joint.get("name", "")
        if mimic is not None and name not in locked:
            raise InputError(
                "a joint that follows another one",
                expected="joints that move by themselves",
                got=f"<mimic joint={mimic.get('joint', '')!r}>",
                remedy=f"lock it (option locked = [{name!r}]), or remove <mimic> where nothing couples the two",
                file=file,
                place=f"joint {name}",
            )


def pose_of(origin: ElementTree.Element | None, file: Path | None, place: str) -> tuple[FloatArray, FloatArray]:
    """Return rotation matrix and position of an ``origin`` (rpy: about fixed x, then y, then z)."""
    roll, pitch, yaw = vector_of(origin, "rpy", (0.0, 0.0, 0.0), file, place)
    cr, sr, cp, sp, cy, sy = (f(x) for x in (roll, pitch, yaw) for f in (math.cos, math.sin))
    rotation = np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )
    return rotation, vector_of(origin, "xyz", (0.0, 0.0, 0.0), file, place)


def vector_of(
    element: ElementTree.Element | None, key: str, default: tuple[float, float, float], file: Path | None, place: str
) -> FloatArray:
    """Return three numbers of an attribute."""
    text = None if element is None else element.get(key)
    if text is None:
        return np.array(default)
    try:
        values = [float(part) for part in text.split()]
    except ValueError:
        values = []
    if len(values) != 3 or not all(math.isfinite(value) for value in values):
        raise InputError(key, expected="three numbers", got=repr(text), remedy="correct it", file=file, place=place)
    return np.array(values)


def _number(element: ElementTree.Element | None, key: str, default: float, file: Path | None, place: str) -> float:
    """Return a number of an attribute."""
    text = None if element is None else element.get(key)
    if text is None:
        return default
    try:
        return float(text)
    except ValueError as error:
        raise InputError(
            key, expected="a number", got=repr(text), remedy="correct it", file=file, place=place
        ) from error
