"""Strategies of mechanical systems: random arms, chains and trees, with bodies that can exist."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from hypothesis import strategies as st

from harness.signals import Channel, FloatArray

if TYPE_CHECKING:
    from harness.physics.arms.arm import ArmModel


@st.composite
def arms(draw: Any, joints: tuple[int, int] = (1, 4), *, square: bool | None = None, chain: bool = False) -> ArmModel:
    """Draw an arm: revolute, sliding and fixed joints, every body of positive mass and possible inertia.

    Parameters
    ----------
    joints : (least, most)
        Number of joints, the first of which moves.
    square : bool, optional
        Frames and axes turned by right angles only, as most robots are drawn; either kind if not given.
    chain : bool
        No branches.

    Examples
    --------
    >>> from hypothesis import given
    >>> @given(arms())
    ... def heavy(arm):
    ...     assert (arm.arm.parameters.reshape(-1, 10)[:, 0] > 0).all()
    >>> heavy()
    """
    from harness.physics.arms.arm import ArmModel
    from harness.physics.arms.inertia import from_log_cholesky
    from harness.physics.arms.joints import Joint
    from harness.physics.arms.rigid_tree import Arm

    count = draw(st.integers(*joints))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    right = bool(rng.integers(2)) if square is None else square
    found = []
    for number in range(count):
        kind = "revolute" if number == 0 else str(rng.choice(["revolute", "continuous", "prismatic", "fixed"]))
        parent = number - 1 if chain or number == 0 else int(rng.integers(-1, number))
        mass, hx, hy, hz, xx, xy, xz, yy, yz, zz = from_log_cholesky(0.4 * rng.normal(size=10))
        centre = np.array([hx, hy, hz]) / mass
        about_frame = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        inertia = about_frame - mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))
        axis = np.eye(3)[rng.integers(3)] if right else _direction(rng)
        found.append(
            Joint(
                f"joint{number + 1}",
                parent,
                kind,
                random_rotation(rng, square=right),
                np.round(0.4 * rng.normal(size=3), 3),
                axis,
                float(mass),
                centre,
                inertia,
                -2.0,
                2.0,
                np.inf,
                np.inf,
            )
        )
    arm = Arm("random arm", tuple(found))
    slides = [joint.kind == "prismatic" for joint in arm.moving]
    return ArmModel(
        "random arm",
        arm,
        rng.uniform(0.1, 1.0, arm.n),
        rng.uniform(0.1, 1.0, arm.n),
        np.zeros(arm.n),
        tuple(Channel(f"tau{k + 1}", "N" if one else "N m") for k, one in enumerate(slides)),
        tuple(Channel(f"q{k + 1}", "m" if one else "rad") for k, one in enumerate(slides)),
    )


def random_motion(arm: ArmModel, samples: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return positions, rates and accelerations (samples, n) that have nothing to do with each other.

    Parameters
    ----------
    arm : ArmModel
    samples : int
    rng : numpy.random.Generator
    """
    q, v, a = rng.uniform(-1.5, 1.5, size=(3, samples, arm.n))
    return q, v, 3 * a


def random_rotation(rng: np.random.Generator, *, square: bool = False) -> FloatArray:
    """Return a rotation matrix (3, 3), of any angles or of right angles only."""
    if square:
        turned = np.eye(3)[rng.permutation(3)] * rng.choice([-1.0, 1.0], size=3)
    else:
        turned = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    return np.asarray(turned * np.sign(np.linalg.det(turned)))


def _direction(rng: np.random.Generator) -> FloatArray:
    """Return a unit vector."""
    vector = rng.normal(size=3)
    return np.asarray(vector / np.linalg.norm(vector))
