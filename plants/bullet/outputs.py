"""What can be measured on a PyBullet arm: joints, end effector, base, contact force, camera keypoints."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from harness.errors import InputError, PlantError, refuse_unknown
from harness.signals import Channel, FloatArray
from plants.bullet.world import World

OUTPUTS = ("q", "qd", "ee", "base", "contact", "keypoints")
BASE_STATES = (
    *(Channel(f"base_{axis}", "m") for axis in "xyz"),
    *(Channel(f"base_q{axis}", "1", -1.0, 1.0) for axis in "xyzw"),
    *(Channel(f"base_{axis}_rate", "m/s") for axis in "xyz"),
    *(Channel(f"base_w{axis}", "rad/s") for axis in "xyz"),
)
Keypoints = Sequence[tuple[str, Sequence[float]]]


@dataclass(frozen=True)
class Camera:
    """A pinhole camera: where it stands, where it looks, its focal length in pixels.

    Pixels are counted from the optical axis, right and down as in images.

    Examples
    --------
    >>> camera = Camera(position=(0, -2, 0), target=(0, 0, 0), focal=100.0)
    >>> camera.project(np.array([[0.2, 0.0, 0.4]])).tolist()
    [[10.0, -20.0]]
    """

    position: tuple[float, float, float] = (0.0, -3.0, 0.5)
    target: tuple[float, float, float] = (0.0, 0.0, 0.5)
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    focal: float = 600.0

    def project(self, points: FloatArray) -> FloatArray:
        """Return the pixels (n, 2) of points (n, 3) in the world [m].

        Raises PlantError if a point lies behind the camera.
        """
        eye = np.asarray(self.position, dtype=float)
        forward = np.asarray(self.target, dtype=float) - eye
        forward = forward / np.linalg.norm(forward)
        right = np.cross(forward, np.asarray(self.up, dtype=float))
        right = right / np.linalg.norm(right)
        down = np.cross(forward, right)
        relative = points - eye
        depth = relative @ forward
        if (depth <= 0).any():
            raise PlantError("a keypoint is behind the camera: move the camera away from the plant")
        pixels: FloatArray = self.focal * np.stack([relative @ right, relative @ down], axis=-1) / depth[:, None]
        return pixels


def channels(
    outputs: Sequence[str],
    joints: tuple[Channel, ...],
    rates: tuple[Channel, ...],
    keypoints: Keypoints,
    *,
    floating: bool,
    table: bool,
) -> tuple[Channel, ...]:
    """Return the channels of a choice of outputs.

    Raises InputError if an output needs what the plant does not have.
    """
    needs = {"base": (floating, "fixed_base = False"), "contact": (table, "a table")}
    needs["keypoints"] = (bool(keypoints), "keypoints")
    refuse_unknown("option outputs", outputs, OUTPUTS)
    for name in outputs:
        if not needs.get(name, (True, ""))[0]:
            raise InputError(
                f"output {name!r}", expected=f"a plant with {needs[name][1]}", got="none", remedy="add it or remove it"
            )
    pixels = tuple(Channel(f"{axis}{i + 1}", "pixel") for i in range(len(keypoints)) for axis in ("right", "down"))
    groups = {
        "q": joints,
        "qd": rates,
        "ee": tuple(Channel(f"ee_{axis}", "m") for axis in "xyz"),
        "base": BASE_STATES[:3],
        "contact": tuple(Channel(f"contact_{axis}", "N") for axis in "xyz"),
        "keypoints": pixels,
    }
    return tuple(channel for name in outputs for channel in groups[name])


def reader(
    world: World, outputs: Sequence[str], tip: str, keypoints: Keypoints, camera: Camera
) -> Callable[[], FloatArray]:
    """Return a function that measures the outputs (ny,) now.

    Raises InputError if a link that carries a keypoint or the end effector is unknown.
    """
    p, client, body, joints = world.engine, world.client, world.body, world.joints

    measured = _measuring(world)

    def positions() -> FloatArray:
        return measured()[: len(joints)]

    if tuple(outputs) == ("q", "qd"):
        return measured
    if tuple(outputs) == ("q",):
        return positions
    numbers = {
        p.getJointInfo(body, joint, physicsClientId=client)[12].decode(): joint
        for joint in range(p.getNumJoints(body, physicsClientId=client))
    }
    for link in ("ee" in outputs) * [tip] + [link for link, _ in keypoints]:
        refuse_unknown("unknown link", link, numbers)

    def frame(link: str) -> tuple[FloatArray, FloatArray]:
        state = p.getLinkState(body, numbers[link], computeForwardKinematics=1, physicsClientId=client)
        return np.array(state[4]), np.array(p.getMatrixFromQuaternion(state[5])).reshape(3, 3)

    def rates() -> FloatArray:
        return measured()[len(joints) :]

    def tip_position() -> FloatArray:
        return frame(tip)[0]

    def base() -> FloatArray:
        return np.array(p.getBasePositionAndOrientation(body, physicsClientId=client)[0])

    def contact() -> FloatArray:
        total = np.zeros(3)
        for point in p.getContactPoints(body, world.table, physicsClientId=client):
            for force, direction in ((point[9], point[7]), (point[10], point[11]), (point[12], point[13])):
                total += force * np.array(direction)
        return total

    def pixels() -> FloatArray:
        points = [frame(link)[0] + frame(link)[1] @ np.asarray(offset, dtype=float) for link, offset in keypoints]
        return camera.project(np.array(points)).ravel()

    parts = {"q": positions, "qd": rates, "ee": tip_position, "base": base, "contact": contact, "keypoints": pixels}
    chosen = [parts[name] for name in outputs]
    return lambda: np.concatenate([part() for part in chosen])


def _measuring(world: World) -> Callable[[], FloatArray]:
    """Return a function that reads positions and rates of the n joints as an array (2 n,).

    Its loop is written out for this n, as ``dataclasses`` does: that costs half of what a loop does.
    """
    n = len(world.joints)
    left = ", ".join(f"(q{i}, v{i}, _, _)" for i in range(n))
    right = ", ".join([*(f"q{i}" for i in range(n)), *(f"v{i}" for i in range(n))])
    row = np.empty(2 * n)
    names: dict[str, Any] = {"pack": struct.Struct(f"{2 * n}d").pack_into, "row": row, "copy": row.copy}
    names |= {"states": world.engine.getJointStates, "body": world.body, "joints": world.joints, "of": world.client}
    exec(f"def measured():\n ({left},) = states(body, joints, of)\n pack(row, 0, {right})\n return copy()", names)
    measured: Callable[[], FloatArray] = names["measured"]
    return measured
