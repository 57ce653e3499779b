"""Where the joints of an arm are: forward kinematics for whole records."""

from __future__ import annotations

import numpy as np

from harness.errors import InputError
from harness.physics.arms.joints import MOVING
from harness.physics.arms.rigid_tree import Arm
from harness.signals import FloatArray


def joint_places(arm: Arm, q: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the origins and the rotation matrices of all joints' frames, in the frame of the base.

    Raises InputError if q has another number of columns.

    - ``q`` (N, n): positions of the joints that move
    - returns ``places, rotations`` (N, joints, 3) [m] and (N, joints, 3, 3)

    Examples
    --------
    >>> from harness.physics.arms.rigid_tree import pendulum_for_the_example
    >>> joint_places(pendulum_for_the_example(), np.array([[0.3]]))[0].tolist()
    [[[0.0, 0.0, 0.0]]]
    """
    q = np.asarray(q, dtype=float)
    if q.ndim != 2 or q.shape[1] != arm.n:
        raise InputError(
            "joint positions", expected=f"shape (N, {arm.n})", got=str(q.shape), remedy="one column for each joint"
        )
    count, index = len(q), 0
    places = np.empty((count, len(arm.joints), 3))
    rotations = np.empty((count, len(arm.joints), 3, 3))
    for number, joint in enumerate(arm.joints):
        turn = np.broadcast_to(np.eye(3), (count, 3, 3)) if joint.parent < 0 else rotations[:, joint.parent]
        place = np.zeros((count, 3)) if joint.parent < 0 else places[:, joint.parent]
        place = place + turn @ joint.offset
        turn = turn @ joint.rotation
        if joint.kind == "prismatic":
            place = place + (turn @ joint.axis) * q[:, index, None]
        elif joint.kind in MOVING:
            x, y, z = joint.axis
            cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
            s, c = np.sin(q[:, index, None, None]), np.cos(q[:, index, None, None])
            turn = turn @ (np.eye(3) + s * cross + (1 - c) * (cross @ cross))
        index += joint.kind in MOVING
        places[:, number], rotations[:, number] = place, turn
    return places, rotations
