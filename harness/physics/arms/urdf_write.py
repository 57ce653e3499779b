"""A URDF with other bodies, damping, friction or frames of joints: what an identification found, as a file."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from harness.errors import InputError
from harness.physics.arms.formats.urdf import rotors_of
from harness.physics.arms.inertia import about_the_centre, refuse_inconsistent
from harness.signals import FloatArray

if TYPE_CHECKING:
    from harness.physics.arms.arm import ArmModel


def urdf_with(
    model: ArmModel,
    parameters: FloatArray,
    *,
    damping: FloatArray | None = None,
    friction: FloatArray | None = None,
    motor_inertia: FloatArray | None = None,
) -> str:
    """Return the text of the arm's URDF with these inertial parameters.

    Raises InputError if the arm has no file, or a body with mass is not physically consistent (other programs would
    refuse it).

    - ``model``: read from a file (its ``path``)
    - ``parameters`` (10 * bodies,): in the order of :attr:`harness.physics.arms.rigid_tree.Arm.parameters`
    - ``damping, friction`` (n,): of the joints that move, into ``<dynamics>``; as in the file by default
    - ``motor_inertia`` (n,): of rotors behind their gears, into ``<transmission>`` (see
      :func:`harness.physics.arms.formats.urdf.rotors_of`); nothing is written where all are those of the file
    """
    if model.path is None:
        raise InputError("URDF of an arm", expected="an arm read from a file", got="none", remedy="use load_arm")
    table = np.asarray(parameters, dtype=float).reshape(len(model.arm.joints), 10)
    refuse_inconsistent([joint.name for joint in model.arm.joints], table)
    tree = ElementTree.parse(model.path)
    root = tree.getroot()
    links = {link.get("name"): link for link in root.findall("link")}
    elements = {joint.get("name"): joint for joint in root.findall("joint")}
    for joint, row in zip(model.arm.joints, table, strict=True):
        child = elements[joint.name].find("child")
        assert child is not None  # the file was read before
        if row.any():
            _write_body(links[child.get("link")], row)
    for number, joint in enumerate(model.arm.moving):
        for key, values in (("damping", damping), ("friction", friction)):
            if values is not None:
                _child(elements[joint.name], "dynamics").set(key, repr(float(values[number])))
    if motor_inertia is not None and not np.array_equal(motor_inertia, model.motor_inertia):
        if not root.findall("transmission"):  # with some there, joints without one would have no motor
            for joint in model.arm.moving:
                drive = ElementTree.SubElement(root, "transmission", name=f"drive of {joint.name}")
                ElementTree.SubElement(drive, "joint", name=joint.name)
        for joint, rotor in zip(model.arm.moving, motor_inertia, strict=True):
            _write_rotor(root, joint.name, float(rotor))
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def urdf_moved(model: ArmModel, frames: Mapping[str, tuple[FloatArray, FloatArray]]) -> str:
    """Return the text of the arm's URDF with these joints in other places.

    Raises InputError if the arm was not read from a URDF.

    - ``frames``: name of a joint to the pose (3, 3), (3,) [m] of its frame in that of its parent
    """
    from scipy.spatial.transform import Rotation

    if model.path is None:
        raise InputError("URDF of an arm", expected="an arm read from a URDF", got=model.name, remedy="give the URDF")
    root = ElementTree.parse(model.path).getroot()
    for joint in root.findall("joint"):
        if joint.get("name") in frames:
            turn, place = frames[joint.get("name", "")]
            origin = _child(joint, "origin")
            origin.set("xyz", " ".join(repr(float(x)) for x in place))
            origin.set("rpy", " ".join(repr(float(x)) for x in Rotation.from_matrix(turn).as_euler("xyz")))
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def _write_rotor(root: ElementTree.Element, joint: str, inertia: float) -> None:
    """Put the inertia of a rotor, seen at its joint, into the joint's transmission."""
    drives = [d for d in root.findall("transmission") if any(j.get("name") == joint for j in d.findall("joint"))]
    if not drives:
        if not inertia:
            return
        drives = [ElementTree.SubElement(root, "transmission", name=f"drive of {joint}")]
        ElementTree.SubElement(drives[0], "joint", name=joint)
    parts = {element.tag.rpartition("}")[2]: element for element in drives[0].iter()}
    rotor = parts.get("rotor_inertia")
    if rotor is None:
        if not inertia:
            return
        rotor = ElementTree.SubElement(parts.get("actuator", drives[0]), "rotor_inertia", value="1")
    else:
        rotor.set("value", "1")
    at_the_joint = rotors_of(root, None)[joint]  # of a rotor of 1 kg m^2: the square of the ratio
    rotor.set("value", repr(inertia / at_the_joint))


def _write_body(link: ElementTree.Element, row: FloatArray) -> None:
    """Put mass, centre and inertia about the centre into a link."""
    mass, centre, inertia = about_the_centre(row)
    inertial = _child(link, "inertial")
    origin = _child(inertial, "origin")
    origin.set("xyz", " ".join(repr(float(component)) for component in centre))
    origin.set("rpy", "0 0 0")
    _child(inertial, "mass").set("value", repr(mass))
    element = _child(inertial, "inertia")
    for name, (i, j) in zip(("xx", "xy", "xz", "yy", "yz", "zz"), zip(*np.triu_indices(3), strict=True), strict=True):
        element.set(f"i{name}", repr(float(inertia[i, j])))


def _child(parent: ElementTree.Element, tag: str) -> ElementTree.Element:
    found = parent.find(tag)
    return ElementTree.SubElement(parent, tag) if found is None else found
