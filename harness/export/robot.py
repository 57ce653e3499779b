"""An arm with what was found about it, as the kind of file that it was read from: a URDF or an MJCF."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from harness.errors import InputError
from harness.physics.arms.arm import ArmModel, load_arm
from harness.physics.arms.mjcf_write import mjcf_with
from harness.physics.arms.urdf_write import urdf_with
from harness.signals import FloatArray

AT_JOINTS = {"viscous_friction": ("damping", "b"), "coulomb_friction": ("friction", "Fc"),
             "rotor_inertia": ("motor_inertia", "J")}  # fmt: skip
"""Effects that an MJCF holds at a joint: what they are there, and the parameter that says how much."""


def write_robot(content: Mapping[str, Any], target: Path) -> Path:
    """Write an identified arm (``model.json`` of kind ``arm``) as its file with the parameters that were found.

    Raises InputError if the arm's own file is missing, ``target`` is of the other kind, or a body is one that cannot
    be.

    - ``content``: what ``model.json`` holds
    - ``target``: ``.urdf`` for an arm read from a URDF, ``.xml`` or ``.mjcf`` for one read from an MJCF
    """
    arm = load_arm(content["model"])
    kinds = (".urdf",) if arm.mjcf is None else (".xml", ".mjcf")
    if target.suffix not in kinds:
        raise InputError(
            "output",
            expected=f"a name that ends in {' or '.join(kinds)}, as the file that the arm was read from",
            got=target.name,
            remedy=f"--out {target.stem}{kinds[0]}",
        )
    inertial, damping, friction, rotors = (
        np.array(content[name], dtype=float) for name in ("inertial", "damping", "friction", "motor_inertia")
    )
    write = urdf_with if arm.mjcf is None else mjcf_with
    text = write(arm, inertial, damping=damping, friction=friction, motor_inertia=rotors)
    target.write_text(text, encoding="utf-8")
    return target


def repaired_mjcf(arm: ArmModel, effects: Sequence[Mapping[str, Any]], bodies: FloatArray | None = None) -> str:
    """Return the text of an arm's MJCF with what it can hold of what a loop found; the rest is a comment in it.

    It holds viscous and Coulomb friction and rotors of joints, a payload, inertia tensors, and bodies that were
    calibrated. Raises InputError if the arm was not read from an MJCF, or a body or joint cannot be found in its text.

    - ``arm``: read from an MJCF
    - ``effects``: as in ``report.json``: ``name``, ``at``, and ``parameters`` by name with their ``value``
    - ``bodies`` (10 * bodies,): inertial parameters in the order of
      :attr:`harness.physics.arms.rigid_tree.Arm.parameters`
    """
    places = {channel.name: k for k, channel in enumerate(arm.positions)}
    at_joints = {
        "damping": arm.damping.copy(),
        "friction": arm.friction.copy(),
        "motor_inertia": arm.motor_inertia.copy(),
    }
    table = (arm.arm.parameters if bodies is None else np.asarray(bodies, dtype=float)).reshape(-1, 10).copy()
    payload: FloatArray | None = None
    beyond: list[str] = []
    for effect in effects:
        name, at = str(effect["name"]), str(effect["at"])
        values = {key: float(entry["value"]) for key, entry in effect["parameters"].items()}
        if name in AT_JOINTS and at in places:
            kind, amount = AT_JOINTS[name]
            at_joints[kind][places[at]] += values[amount]
        elif name.startswith("payload") and values["m"] > 0:
            payload = np.array([values["m"], *(values.get(f"m{axis}", 0.0) for axis in "xyz")])
        elif name == "link_inertia":
            _turn(table[[joint.name for joint in arm.arm.joints].index(at.removeprefix("link of "))], values["I"])
        else:
            beyond.append(f"{name} at {at}")
    return mjcf_with(arm, table.ravel(), **at_joints, payload=payload, beyond=beyond)


def _turn(row: FloatArray, moment: float) -> None:
    """Give a body (10,) the inertia tensor of a ball about its centre of mass."""
    centre = row[1:4] / row[0]
    tensor = moment * np.eye(3) + row[0] * (centre @ centre * np.eye(3) - np.outer(centre, centre))
    row[4:] = tensor[np.triu_indices(3)]
