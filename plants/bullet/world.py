"""One PyBullet client with one body in it, built from declared settings, driven one sample at a time."""

from __future__ import annotations

import weakref
import xml.etree.ElementTree as ET
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import repeat
from typing import Any, Literal

import numpy as np

from harness.errors import PlantError
from harness.signals import FloatArray
from plants.bullet.engine import bullet, engine_joints, load

Control = Literal["torque", "velocity", "position"]


@dataclass(frozen=True)
class BulletSettings:
    """Everything that Bullet would otherwise choose in silence; see :class:`plants.bullet.robots.ArmPlant`."""

    step: float
    substeps: int
    control: Control
    driven: tuple[int, ...]
    motor_force: tuple[float, ...]
    joint_damping: tuple[float, ...]
    joint_friction: tuple[float, ...]
    joint_limits: bool
    linear_damping: float
    angular_damping: float
    velocity_clip: float
    gravity: float
    inertia: Literal["file", "shape"]
    fixed_base: bool
    base_position: tuple[float, float, float]
    table: tuple[float, float, float] | None
    table_size: float
    table_friction: float
    integrator: str = "semi-implicit Euler"

    @property
    def whole_state(self) -> bool:
        """Whether contacts, limits or a free base make positions and rates of the joints an incomplete state."""
        return self.joint_limits or self.table is not None or not self.fixed_base

    @property
    def split(self) -> bool:
        """Whether each substep must be a call of its own: damping and limits are computed once for each call."""
        return self.whole_state or any(self.joint_damping)


class World:
    """A client, its body and what drives it.

    - ``urdf``: with nothing left to Bullet's defaults; see :func:`plants.bullet.engine.explicit_urdf`
    - ``settings``: what to build
    """

    def __init__(self, urdf: ET.Element, settings: BulletSettings) -> None:
        self.engine = bullet()
        self.client: int = self.engine.connect(self.engine.DIRECT)
        self.settings = settings
        self._urdf = urdf
        self._release = weakref.finalize(self, _disconnect, self.engine, self.client)
        self.build()

    @property
    def urdf(self) -> str:
        """Text of the URDF."""
        return ET.tostring(self._urdf, encoding="unicode")

    @property
    def alive(self) -> bool:
        """Whether the client is connected."""
        return self._release.alive

    def close(self) -> None:
        """Disconnect; may be called twice."""
        self._release()

    def build(self) -> None:
        """Make the world anew in the one client."""
        p, client, given = self.engine, self.client, self.settings
        p.resetSimulation(physicsClientId=client)
        p.setGravity(0.0, 0.0, -given.gravity, physicsClientId=client)
        self.body = load(
            client,
            self._urdf,
            fixed_base=given.fixed_base,
            inertia_from_file=given.inertia == "file",
            position=given.base_position,
        )
        self.joints = engine_joints(client, self.body, self._urdf)
        for link in range(-1, p.getNumJoints(self.body, physicsClientId=client)):
            p.changeDynamics(
                self.body,
                link,
                linearDamping=given.linear_damping,
                angularDamping=given.angular_damping,
                maxJointVelocity=given.velocity_clip,
                lateralFriction=given.table_friction,
                physicsClientId=client,
            )
        self.table: int | None = None
        if given.table is not None:
            half, thick = given.table_size / 2, 0.05
            box = p.createCollisionShape(p.GEOM_BOX, halfExtents=[half, half, thick], physicsClientId=client)
            x, y, top = given.table
            self.table = p.createMultiBody(0, box, -1, [x, y, top - thick], physicsClientId=client)
            p.changeDynamics(self.table, -1, lateralFriction=1.0, restitution=0.0, physicsClientId=client)
        inside = 1 if given.split else given.substeps
        p.setPhysicsEngineParameter(
            fixedTimeStep=given.step * inside,
            numSubSteps=0 if inside == 1 else inside,
            deterministicOverlappingPairs=1,
            physicsClientId=client,
        )
        for joint, force in zip(self.joints, given.joint_friction, strict=True):
            p.setJointMotorControl2(
                self.body, joint, p.VELOCITY_CONTROL, targetVelocity=0.0, force=force / inside, physicsClientId=client
            )
        self.origin: int | None = p.saveState(physicsClientId=client) if given.whole_state else None
        calls = given.substeps if given.split else 1
        self.advance = self._driver(calls, inside)
        self.advance_one_step = self._driver(1, inside)

    def _driver(self, calls: int, inside: int) -> Callable[[list[float]], None]:
        """Return a function of the inputs that moves on by some engine calls.

        The engine's functions are bound here, so that a step costs little more than they do.
        """
        p, client, body, given = self.engine, self.client, self.body, self.settings
        control, step = p.setJointMotorControlArray, p.stepSimulation
        joints, mode = [self.joints[joint] for joint in given.driven], p.TORQUE_CONTROL
        force = [limit / inside for limit in given.motor_force]

        def torque(values: list[float]) -> None:
            control(body, joints, mode, forces=values, physicsClientId=client)
            step(client)

        def torque_again(values: list[float]) -> None:
            for _ in repeat(None, calls):  # Bullet forgets torques after every call
                control(body, joints, mode, forces=values, physicsClientId=client)
                step(client)

        def velocity(values: list[float]) -> None:
            control(body, joints, p.VELOCITY_CONTROL, targetVelocities=values, forces=force, physicsClientId=client)
            for _ in repeat(None, calls):
                step(client)

        def position(values: list[float]) -> None:
            control(body, joints, p.POSITION_CONTROL, targetPositions=values, forces=force, physicsClientId=client)
            for _ in repeat(None, calls):
                step(client)

        if calls > 1:
            torque = torque_again
        return {"torque": torque, "velocity": velocity, "position": position}[given.control]

    def set_joints(self, positions: Sequence[float], rates: Sequence[float]) -> None:
        """Put the joints at positions and rates."""
        for joint, q, qd in zip(self.joints, positions, rates, strict=True):
            self.engine.resetJointState(self.body, joint, q, qd, physicsClientId=self.client)

    def set_base(self, values: Sequence[float]) -> None:
        """Put a free base at a pose (x, y, z, quaternion) and a velocity (linear, angular)."""
        pose, speed = values[:7], values[7:]
        self.engine.resetBasePositionAndOrientation(self.body, pose[:3], pose[3:], physicsClientId=self.client)
        self.engine.resetBaseVelocity(self.body, speed[:3], speed[3:], physicsClientId=self.client)

    def state(self) -> FloatArray:
        """Return joint positions, joint rates and, for a free base, its pose and velocity."""
        q, qd, *_ = zip(*self.engine.getJointStates(self.body, self.joints, physicsClientId=self.client), strict=True)
        if self.settings.fixed_base:
            return np.array(q + qd)
        position, turn = self.engine.getBasePositionAndOrientation(self.body, physicsClientId=self.client)
        linear, angular = self.engine.getBaseVelocity(self.body, physicsClientId=self.client)
        return np.array([*q, *qd, *position, *turn, *linear, *angular])

    def save(self) -> Saved:
        """Return the engine's whole state."""
        return Saved(self)

    def restore(self, saved: Saved | int) -> None:
        """Go back to a saved state of this world."""
        number = saved if isinstance(saved, int) else saved.number
        if isinstance(saved, Saved) and saved.world() is not self:
            raise PlantError("the saved state belongs to another plant or to an engine that was built anew")
        self.engine.restoreState(number, physicsClientId=self.client)


class Saved:
    """A state inside Bullet; released with the object."""

    def __init__(self, world: World) -> None:
        self.world = weakref.ref(world)
        self.number: int = world.engine.saveState(physicsClientId=world.client)
        weakref.finalize(self, _forget, self.world, self.number)


def _disconnect(engine: Any, client: int) -> None:
    """Disconnect a client."""
    engine.disconnect(client)


def _forget(world: weakref.ref[World], number: int) -> None:
    """Release a saved state where its client still lives."""
    alive = world()
    if alive is not None and alive.alive:
        alive.engine.removeState(number, physicsClientId=alive.client)
