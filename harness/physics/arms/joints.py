"""A joint of a robot with the body that hangs on it."""

from __future__ import annotations

from dataclasses import dataclass

from harness.signals import FloatArray

MOVING = {"revolute", "continuous", "prismatic"}  # Kinds of joints that move.


@dataclass(frozen=True, eq=False)
class Joint:
    """A joint with the body that hangs on it.

    Parameters
    ----------
    name : str
        Of the joint.
    parent : int
        Index of the joint that carries this one; -1 is the base.
    kind : {"revolute", "continuous", "prismatic", "fixed"}
        A continuous joint is a revolute one without limits.
    rotation, offset : arrays (3, 3) and (3,)
        Pose of the joint's frame in the frame of its parent at joint position 0 [m].
    axis : array (3,)
        Unit vector in the joint's own frame.
    mass, centre, inertia : float [kg], array (3,) [m], array (3, 3) [kg m^2]
        Of the body; the inertia is about its centre of mass, in the axes of the joint's frame.
    lower, upper, effort, velocity : float
        Limits of position [rad or m], force [N m or N] and rate; infinite where the file states none.
    """

    name: str
    parent: int
    kind: str
    rotation: FloatArray
    offset: FloatArray
    axis: FloatArray
    mass: float
    centre: FloatArray
    inertia: FloatArray
    lower: float
    upper: float
    effort: float
    velocity: float
