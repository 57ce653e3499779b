"""A joint of a robot with the body that hangs on it."""

from __future__ import annotations

from dataclasses import dataclass

from harness.signals import FloatArray

MOVING = {"revolute", "continuous", "prismatic"}  # Kinds of joints that move.


@dataclass(frozen=True, eq=False)
class Joint:
    """A joint with the body that hangs on it."""

    name: str  # Of the joint
    parent: int  # Index of the joint that carries this one; -1 is the base
    kind: str  # A continuous joint is a revolute one without limits
    # arrays (3, 3) and (3,): Pose of the joint's frame in the frame of its parent at joint position 0 [m]
    rotation: FloatArray
    offset: FloatArray
    axis: FloatArray  # (3,): Unit vector in the joint's own frame
    # float [kg], array (3,) [m], array (3, 3) [kg m^2]: Of the body; the inertia is about its centre of mass, in the
    # axes of the joint's frame
    mass: float
    centre: FloatArray
    inertia: FloatArray
    # Limits of position [rad or m], force [N m or N] and rate; infinite where the file states none
    lower: float
    upper: float
    effort: float
    velocity: float
