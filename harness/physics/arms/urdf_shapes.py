"""Bounding boxes of the bodies of an arm, from the collision shapes of its URDF or MJCF."""

from __future__ import annotations

import struct
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from harness.errors import InputError
from harness.physics.arms.formats.mjcf import rotation_of
from harness.physics.arms.formats.mjcf_spec import compiled, read_spec
from harness.physics.arms.formats.urdf import pose_of, vector_of
from harness.signals import FloatArray

if TYPE_CHECKING:
    from harness.physics.arms.arm import ArmModel

Box = tuple[FloatArray, FloatArray]


def bounding_boxes(model: ArmModel) -> list[Box | None]:
    """Return the box (low (3,), high (3,)) [m] of every body in its joint's frame; None for one without shape.

    Raises InputError if a mesh is missing or of another kind.

    - ``model``: read from a file. Meshes of a URDF: STL (binary) and OBJ, beside it. Of an MJCF what MuJoCo collides
      counts, or all shapes of a body of which it collides none.
    """
    if model.mjcf is not None:
        return _of_mjcf(model.mjcf)
    if model.path is None:
        raise InputError("shapes of an arm", expected="an arm read from a file", got="none", remedy="use load_arm")
    root = ElementTree.parse(model.path).getroot()
    links = {link.get("name"): link for link in root.findall("link")}
    children = {joint.get("name"): joint.find("child") for joint in root.findall("joint")}
    found: list[Box | None] = []
    for joint in model.arm.joints:
        child = children[joint.name]
        assert child is not None  # the file was read before
        link = links[child.get("link")]
        points = [_points(shape, model.path, joint.name) for shape in link.findall("collision")]
        whole = np.concatenate(points) if points else np.zeros((0, 3))
        found.append((whole.min(axis=0), whole.max(axis=0)) if len(whole) else None)
    return found


def _of_mjcf(file: Path) -> list[Box | None]:
    """Return the boxes of the bodies of an MJCF, in the order of its arm's joints."""
    model = compiled(read_spec(file), file)
    corners = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)], dtype=float)
    found: list[Box | None] = []
    for body in range(1, model.nbody):
        count, last = int(model.body_jntnum[body]), int(model.body_jntadr[body] + model.body_jntnum[body]) - 1
        found += [None] * (count - 1)  # the last joint of a body carries it
        anchor = np.array(model.jnt_pos[last]) if count else np.zeros(3)
        geoms = np.flatnonzero(model.geom_bodyid == body)
        solid = [geom for geom in geoms if model.geom_contype[geom] or model.geom_conaffinity[geom]]
        points = []
        for geom in solid or geoms.tolist():
            centre, half = model.geom_aabb[geom][:3], model.geom_aabb[geom][3:]
            points.append(
                (centre + corners * half) @ rotation_of(model.geom_quat[geom]).T + model.geom_pos[geom] - anchor
            )
        whole = np.concatenate(points) if points else np.zeros((0, 3))
        found.append((whole.min(axis=0), whole.max(axis=0)) if len(whole) else None)
    return found


def _points(shape: ElementTree.Element, file: Path, name: str) -> FloatArray:
    """Return points (N, 3) whose hull holds a shape, in the frame of the link."""
    rotation, place = pose_of(shape.find("origin"), file, f"collision behind joint {name}")
    geometry = shape.find("geometry")
    kind = None if geometry is None or not len(geometry) else geometry[0]
    if kind is None:
        return np.zeros((0, 3))
    corners = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)], dtype=float)
    if kind.tag == "box":
        points = corners * vector_of(kind, "size", (0.0, 0.0, 0.0), file, name) / 2
    elif kind.tag in ("cylinder", "capsule"):
        radius, length = float(kind.get("radius", 0)), float(kind.get("length", 0))
        points = corners * [radius, radius, length / 2 + (radius if kind.tag == "capsule" else 0.0)]
    elif kind.tag == "sphere":
        points = corners * float(kind.get("radius", 0))
    else:
        scale = vector_of(kind, "scale", (1.0, 1.0, 1.0), file, name)
        points = _mesh(file, kind.get("filename", ""), name) * scale
    return np.asarray(points @ rotation.T + place)


def _mesh(file: Path, text: str, name: str) -> FloatArray:
    """Return the vertices (N, 3) of a mesh file."""
    path = file.parent / text.removeprefix("file://").removeprefix("package://")
    if path.suffix.lower() == ".obj" and path.is_file():
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
        return np.array([[float(x) for x in line.split()[1:4]] for line in lines if line.startswith("v ")])
    if path.suffix.lower() == ".stl" and path.is_file():
        data = path.read_bytes()
        count = struct.unpack("<I", data[80:84])[0] if len(data) >= 84 else -1
        if len(data) == 84 + 50 * count:
            rows = np.frombuffer(data[84:], dtype=np.dtype([("v", "<f4", (4, 3)), ("rest", "<u2")]))
            return np.asarray(rows["v"][:, 1:], dtype=float).reshape(-1, 3)
    raise InputError(
        f"mesh behind joint {name}",
        expected="an OBJ or binary STL file beside the URDF",
        got=text,
        remedy="leave out hull, or replace the mesh by a box",
        file=file,
    )
