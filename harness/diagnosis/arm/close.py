"""The closed loop of an arm as a user calls it: log and URDF in; a report, a page and a repaired URDF out."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Sequence
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from harness.data.oddities import oddities_data
from harness.diagnosis.arm.diagnose import Progress, diagnose_arm
from harness.diagnosis.arm.found import ArmDiagnosis
from harness.effects.effect import Effect
from harness.errors import InputError
from harness.physics.arms.arm import ArmModel, load_arm
from harness.physics.arms.urdf_write import urdf_with
from harness.signals import Dataset

if TYPE_CHECKING:
    from harness.data import LoadedDataset

URDF = "repaired.urdf"
MJCF = "repaired.xml"


def close_arm(
    dataset: Dataset,
    arm: ArmModel,
    *,
    folder: Path | None,
    progress: Progress | None = None,
    dictionary: Sequence[Effect] | None = None,
) -> tuple[dict[str, Any], Callable[[], dict[str, str]]]:
    """Diagnose an arm, write the report into a folder, and return its content and what draws its pictures.

    Parameters are those of :func:`harness.diagnosis.arm.diagnose.diagnose_arm`. The folder holds ``report.json``,
    ``report.html`` and, where the arm fits its log, ``repaired.urdf``: the URDF with the friction, damping and payload
    that were found, and the bodies where inertial parameters are free (``repaired.xml`` for one read from an MJCF).
    """
    from harness.diagnosis.arm.page import arm_figures, write_arm_html
    from harness.diagnosis.arm.report import arm_report
    from harness.diagnosis.store import write_atomic
    from harness.export.robot import repaired_mjcf

    diagnosis = diagnose_arm(dataset, arm, progress=progress, dictionary=dictionary)
    if progress is not None:
        progress(0.9, "report")
    data = arm_report(diagnosis)
    data["oddities"] = oddities_data(dataset)
    figures = cache(partial(arm_figures, diagnosis, data))
    if folder is not None:
        write_arm_html(data, figures(), folder / "report.html")
        if arm.path is not None and not diagnosis.misfit:
            write_atomic(folder / URDF, repaired_urdf(diagnosis, data))
        if arm.mjcf is not None and not diagnosis.misfit:
            bodies = None if diagnosis.bodies is None else diagnosis.bodies.parameters
            write_atomic(folder / MJCF, repaired_mjcf(arm, data["effects"], bodies))
        write_atomic(folder / "report.json", json.dumps(data, indent=1, allow_nan=False) + "\n")
    if progress is not None:
        progress(1.0, data["summary"])
    return data, figures


def recorded_arm(loaded: LoadedDataset) -> ArmModel:
    """Return the arm that a data set names, measured as its data are.

    Raises
    ------
    InputError
        If an option or a measured output does not fit, or parameters are given.
    """
    nominal = loaded.nominal
    assert nominal is not None
    if nominal.parameters:
        raise InputError(
            "parameters of an arm",
            expected='none: inertial parameters are in the URDF, options = {inertia = "calibrated"} frees them',
            got=", ".join(nominal.parameters),
            remedy="remove [nominal.parameters]",
            file=loaded.path,
        )
    try:
        arm = load_arm(nominal.model, **nominal.options)
    except TypeError as error:
        raise InputError(
            "options of an arm",
            expected="inertia, locked",
            got=", ".join(nominal.options),
            remedy="correct [nominal] options",
            file=loaded.path,
        ) from error
    return arm.with_outputs([(port, derivative) for port, derivative in loaded.measured])


def repaired_urdf(found: ArmDiagnosis, data: dict[str, Any]) -> str:
    """Return the text of the URDF with what it can hold of what was found: bodies, damping, friction, a payload."""
    assert found.arm.path is not None
    if found.bodies is None:
        root = ElementTree.parse(found.arm.path).getroot()
    else:
        root = ElementTree.fromstring(urdf_with(found.arm, found.bodies.parameters))
    joints = {joint.get("name"): joint for joint in root.findall("joint")}
    places = {channel.name: k for k, channel in enumerate(found.arm.positions)}
    left: list[str] = []
    for effect in data["effects"]:
        values = {name: entry["value"] for name, entry in effect["parameters"].items()}
        key = {"viscous_friction": ("damping", "b"), "coulomb_friction": ("friction", "Fc")}.get(effect["name"])
        if key is not None:
            k = places[effect["at"]]
            element = joints[found.arm.arm.moving[k].name]
            dynamics = element.find("dynamics")
            if dynamics is None:
                dynamics = ElementTree.SubElement(element, "dynamics")
            dynamics.set(key[0], f"{float(dynamics.get(key[0], '0')) + values[key[1]]:.9g}")
        elif values.get("m", 0.0) > 0:  # a mass at the flange
            _hang(root, joints[found.arm.arm.moving[-1].name], values)
        elif effect["name"] == "link_inertia":
            _turn(root, joints[effect["at"].removeprefix("link of ")], values["I"])
        else:
            left.append(f"{effect['name']} at {effect['at']}")
    if left:
        root.insert(0, ElementTree.Comment(f" a URDF cannot hold: {', '.join(left)}; see report.json "))
    return str(ElementTree.tostring(root, encoding="unicode")) + "\n"


def _turn(root: ElementTree.Element, joint: ElementTree.Element, moment: float) -> None:
    """Give the link behind a joint the inertia tensor of a ball."""
    child = joint.find("child")
    assert child is not None
    link = next(link for link in root.findall("link") if link.get("name") == child.get("link"))
    inertial = link.find("inertial")
    assert inertial is not None
    element = inertial.find("inertia")
    if element is None:
        element = ElementTree.SubElement(inertial, "inertia")
    for name in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"):
        element.set(name, f"{moment if name[1] == name[2] else 0.0:.9g}")


def _hang(root: ElementTree.Element, last: ElementTree.Element, values: dict[str, float]) -> None:
    """Add a payload as a link that is fixed to the last one."""
    child = last.find("child")
    assert child is not None
    mass = values["m"]
    centre = " ".join(f"{values.get('m' + axis, 0.0) / mass:.9g}" for axis in "xyz")
    link = ElementTree.SubElement(root, "link", name="payload")
    inertial = ElementTree.SubElement(link, "inertial")
    ElementTree.SubElement(inertial, "origin", xyz=centre, rpy="0 0 0")
    ElementTree.SubElement(inertial, "mass", value=f"{mass:.9g}")
    none = {name: "0" for name in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")}
    ElementTree.SubElement(inertial, "inertia", none)
    joint = ElementTree.SubElement(root, "joint", name="payload_joint", type="fixed")
    ElementTree.SubElement(joint, "parent", link=child.get("link", ""))
    ElementTree.SubElement(joint, "child", link="payload")
