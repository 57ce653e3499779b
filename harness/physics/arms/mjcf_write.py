"""An MJCF with other inertial parameters, damping, friction and rotors: what an identification found, as a file."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from harness.errors import InputError
from harness.physics.arms.formats.mjcf import joint_names
from harness.physics.arms.formats.mjcf_spec import compiled, read_spec
from harness.physics.arms.inertia import about_the_centre, refuse_inconsistent
from harness.signals import FloatArray

if TYPE_CHECKING:
    from harness.physics.arms.arm import ArmModel

AT_JOINTS = ("damping", "frictionloss", "armature")
SHAPED = ("inertiafromgeom", "settotalmass", "balanceinertia")
"""Attributes of ``<compiler>`` that would change bodies whose inertia is written out."""
SAME = 1e-12  # Relative change of a body's parameters that is none.


def mjcf_with(
    model: ArmModel,
    parameters: FloatArray | None = None,
    *,
    damping: FloatArray | None = None,
    friction: FloatArray | None = None,
    motor_inertia: FloatArray | None = None,
    payload: FloatArray | None = None,
    beyond: Sequence[str] = (),
) -> str:
    """Return the text of the arm's MJCF with these parameters; what it includes is written into it.

    Raises InputError if the arm has no MJCF, a body with mass is not physically consistent (MuJoCo would refuse it), or
    a body or a joint cannot be found in the text by its name (``<replicate>``, ``<attach>``).

    - ``model``: read from an MJCF (its ``mjcf``)
    - ``parameters`` (10 * bodies,): in the order of :attr:`harness.physics.arms.rigid_tree.Arm.parameters`; bodies that
      keep theirs are left as they are written
    - ``damping, friction, motor_inertia`` (n,): of the joints that move, into ``damping``, ``frictionloss`` and
      ``armature``; as in the file by default. What an actuator of the file adds to its joint stays with the actuator.
    - ``payload`` (4,): mass [kg] and first moments [kg m] of a point on the last body, in the frame of its joint
    - ``beyond``: what was found and an MJCF has no place for; written into it as a comment
    """
    if model.mjcf is None:
        raise InputError("MJCF of an arm", expected="an arm read from an MJCF", got="none", remedy="use load_arm")
    text = _Text(model.mjcf)
    names = [joint.name for joint in model.arm.joints]
    if parameters is not None:
        table = np.asarray(parameters, dtype=float).reshape(len(names), 10)
        refuse_inconsistent(names, table)
        before = model.arm.parameters.reshape(table.shape)
        changed = np.any(np.abs(table - before) > SAME * np.maximum(np.abs(before).max(), 1e-300), axis=1)
        for number in np.flatnonzero(changed):
            text.write_body(names[number], table[number])
    known = (model.damping, model.friction, model.motor_inertia)
    for key, values, was in zip(AT_JOINTS, (damping, friction, motor_inertia), known, strict=True):
        for joint, value, now in zip(model.arm.moving, was if values is None else values, was, strict=True):
            if value != now:
                text.write_joint(joint.name, key, float(value - now))
    if payload is not None:
        text.write_payload(model.arm.moving[-1].name, np.asarray(payload, dtype=float))
    if beyond:
        text.root.insert(0, ElementTree.Comment(f" an MJCF cannot hold: {', '.join(beyond)}; see report.json "))
    return ElementTree.tostring(text.root, encoding="unicode") + "\n"


class _Text:
    """The text of an MJCF, beside what MuJoCo made of it."""

    def __init__(self, file: Path) -> None:
        self.file = file
        self.model = compiled(read_spec(file, shapes=False), file)
        self.root = _whole(ElementTree.parse(file).getroot(), file.parent)
        self.joints = joint_names(self.model)
        self.bodies = {body.get("name"): body for body in self.root.iter("body")}
        self.elements = {
            element.get("name") or f"joint of {name}": element
            for name, body in self.bodies.items()
            for element in body.iter("joint")
            if element.get("name") or element in list(body)
        }

    def write_body(self, name: str, row: FloatArray) -> None:
        """Put the ten parameters of a body, in the frame of its joint, into its ``<inertial>``."""
        mass, centre, inertia = about_the_centre(row)
        body = self._body(name)
        for old in body.findall("inertial"):
            body.remove(old)
        (xx, xy, xz), (_, yy, yz), (*_, zz) = inertia
        full = _numbers(np.array([xx, yy, zz, xy, xz, yz]))
        place = _numbers(centre + self._anchor(name))
        body.insert(0, ElementTree.Element("inertial", pos=place, mass=repr(mass), fullinertia=full))
        for compiler in self.root.iter("compiler"):
            for key in SHAPED:
                compiler.attrib.pop(key, None)

    def write_joint(self, name: str, key: str, change: float) -> None:
        """Add to what stands at a joint, defaults of its class included."""
        if name not in self.elements:
            raise self._absent("joint", name)
        number = int(self.model.jnt_dofadr[self.joints.index(name)])
        values = {"damping": "dof_damping", "frictionloss": "dof_frictionloss", "armature": "dof_armature"}
        own = float(getattr(self.model, values[key])[number])
        self.elements[name].set(key, repr(max(own + change, 0.0)))

    def write_payload(self, name: str, load: FloatArray) -> None:
        """Weld a point mass to the body behind a joint."""
        place = _numbers(load[1:] / load[0] + self._anchor(name))
        body = ElementTree.SubElement(self._body(name), "body", name="payload", pos=place)
        ElementTree.SubElement(body, "inertial", pos="0 0 0", mass=repr(float(load[0])), diaginertia="0 0 0")

    def _anchor(self, name: str) -> FloatArray:
        """Return where a joint stands in the frame of its body (3,); a welded body has none."""
        return np.array(self.model.jnt_pos[self.joints.index(name)]) if name in self.joints else np.zeros(3)

    def _body(self, name: str) -> ElementTree.Element:
        """Return the body that a joint carries, or that is welded under this name."""
        called = name
        if name in self.joints:
            called = self.model.body(int(self.model.jnt_bodyid[self.joints.index(name)])).name
        if not called or called not in self.bodies:
            raise self._absent("body", called or f"of joint {name}")
        return self.bodies[called]

    def _absent(self, what: str, name: str) -> InputError:
        return InputError(
            f"MJCF with another {what} {name}",
            expected=f"a <{what}> of this name in the text",
            got="none: it is made by <replicate> or <attach>, or has no name",
            remedy="give it a name, or save the model as one file first (MjSpec.to_xml)",
            file=self.file,
        )


def _whole(element: ElementTree.Element, folder: Path) -> ElementTree.Element:
    """Return an MJCF with the content of the files that it includes in the place of their names."""
    for place, child in reversed(list(enumerate(element))):
        if child.tag == "include":
            inside = ElementTree.parse(folder / child.get("file", "")).getroot()
            element.remove(child)
            for offset, part in enumerate(list(inside)):
                element.insert(place + offset, part)
            _whole(element, folder)
            return element
        _whole(child, folder)
    return element


def _numbers(values: FloatArray) -> str:
    return " ".join(repr(float(value)) for value in values)
