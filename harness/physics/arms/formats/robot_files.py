"""What is inside a robot's file: the joints of a URDF or of an MJCF, and what drives and measures them."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from harness.physics.arms.formats.mjcf_spec import parsed


def robot_contents(path: str | Path) -> dict[str, Any]:
    """Return the joints of a robot's file as it states them, nothing computed or filled in.

    Raises InputError if the file is missing or neither.

    - ``path``: a URDF, or an MJCF (``<mujoco>``; files that it includes are not followed)
    - returns ``format``, ``name``, ``bodies``, and ``joints``, ``actuators`` and ``sensors`` as lists of texts by key

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     arm = Path(folder) / "arm.urdf"
    ...     _ = arm.write_text('<robot name="r"><link name="a"/><link name="b"/><joint name="shoulder" type="revolute">'
    ...         '<parent link="a"/><child link="b"/><limit effort="3"/></joint></robot>')
    ...     found = robot_contents(arm)
    >>> found["joints"][0]["joint"], found["joints"][0]["effort"]
    ('shoulder', '3')
    """
    root, _ = parsed(Path(path))
    return _urdf(root) if root.tag == "robot" else _mjcf(root)


def _urdf(root: ElementTree.Element) -> dict[str, Any]:
    """Return what a URDF holds."""

    def of(element: ElementTree.Element | None, tag: str, key: str) -> str:
        child = None if element is None else element.find(tag)
        return "" if child is None else child.get(key, "")

    links = {link.get("name", ""): link for link in root.findall("link")}
    joints = []
    for joint in root.findall("joint"):
        child = of(joint, "child", "link")
        inertial = None if child not in links else links[child].find("inertial")
        joints.append(
            {
                "joint": joint.get("name", ""),
                "type": joint.get("type", ""),
                "parent": of(joint, "parent", "link"),
                "child": child,
                "axis": of(joint, "axis", "xyz") or "1 0 0",
                "lower": of(joint, "limit", "lower"),
                "upper": of(joint, "limit", "upper"),
                "effort": of(joint, "limit", "effort"),
                "damping": of(joint, "dynamics", "damping"),
                "friction": of(joint, "dynamics", "friction"),
                "mass of child": of(inertial, "mass", "value"),
                "inertia of child": "" if inertial is None or inertial.find("inertia") is None else "given",
            }
        )
    return {"format": "URDF", "name": root.get("name", ""), "bodies": len(links), "joints": joints,
            "actuators": [], "sensors": []}  # fmt: skip


def _mjcf(root: ElementTree.Element) -> dict[str, Any]:
    """Return what an MJCF holds."""
    world = root.find("worldbody")
    bodies = [] if world is None else list(world.iter("body"))
    keys = ("type", "axis", "range", "damping", "frictionloss", "armature", "stiffness")
    joints = [
        {"joint": joint.get("name", ""), "body": body.get("name", ""), **{key: joint.get(key, "") for key in keys}}
        for body in bodies
        for joint in (*body.findall("joint"), *body.findall("freejoint"))
    ]
    groups: dict[str, list[dict[str, str]]] = {}
    for group in ("actuator", "sensor"):
        section = root.find(group)
        groups[group] = [
            {
                "name": one.get("name", ""),
                "type": one.tag,
                "joint": one.get("joint", ""),
                "gear": one.get("gear", ""),
                "range": one.get("ctrlrange", ""),
            }
            for one in ([] if section is None else section)
        ]
    return {"format": "MJCF", "name": root.get("model", ""), "bodies": len(bodies), "joints": joints,
            "actuators": groups["actuator"], "sensors": groups["sensor"]}  # fmt: skip
