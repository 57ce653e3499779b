"""What a contact is like, from its force and the motion of its point: friction cone and restitution."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from harness.errors import FitError
from harness.signals import FloatArray

LOADED = 0.02  # Share of the largest normal force below which a contact counts as open.
FEW = 10  # Samples of sliding below which nothing is said about it.


@dataclass(frozen=True)
class FrictionCone:
    """Coulomb friction of a contact."""

    sliding: float  # Coefficient while it slides; NaN if it did not
    spread: float  # Standard deviation of single samples about it
    at_least: float
    """Largest ratio of tangential to normal force while it stuck: the coefficient is not below; NaN if it never did."""
    samples: int  # Of sliding


@dataclass(frozen=True, eq=False)
class Restitution:
    """How fast a contact lets go, over how fast it came (Newton)."""

    coefficient: float  # Median of the impacts
    # (impacts,): Speed along the normal, towards and away [m/s]
    before: FloatArray
    after: FloatArray


def friction_cone(force: FloatArray, slip: FloatArray, *, fast: float = 0.01) -> FrictionCone:
    """Return the friction of a contact from its forces and the velocity of its point.

    While it slides the tangential force is the coefficient times the normal one, against the velocity; only that part
    of it is counted, by least squares.

    Raises FitError if the contact never closes.

    - ``force`` (N, 3): on the body [N]
    - ``slip`` (N, 3): velocity of the point of contact against what it touches [m/s]
    - ``fast``: speed from which on it slides [m/s]

    Examples
    --------
    >>> slip = np.array([[0.1, 0.0, 0.0]] * 20 + [[0.0, 0.0, 0.0]] * 5)
    >>> force = np.array([[-4.0, 0.0, 10.0]] * 20 + [[3.0, 0.0, 10.0]] * 5)
    >>> cone = friction_cone(force, slip)
    >>> round(cone.sliding, 3), round(cone.at_least, 3)
    (0.4, 0.3)
    """
    n = np.array([0.0, 0.0, 1.0])
    push = force @ n
    closed = push > LOADED * max(float(push.max(initial=0.0)), 1e-12)
    if not closed.any():
        raise FitError(
            "friction of a contact",
            expected="a force along the normal",
            got=f"at most {push.max(initial=0.0):.3g} N",
            remedy="record the contact closed, or turn the sign of its force",
        )
    tangential, moved = force - push[:, None] * n, slip - (slip @ n)[:, None] * n
    speed = np.linalg.norm(moved, axis=1)
    sliding, sticking = closed & (speed > fast), closed & (speed <= fast)
    at_least = float("nan")
    if sticking.any():
        at_least = float(np.max(np.linalg.norm(tangential[sticking], axis=1) / push[sticking]))
    count = int(sliding.sum())
    if count < FEW:
        return FrictionCone(float("nan"), float("nan"), at_least, count)
    against = -np.sum(tangential[sliding] * moved[sliding], axis=1) / speed[sliding]
    mu = float(against @ push[sliding] / (push[sliding] @ push[sliding]))
    return FrictionCone(mu, float(np.std(against / push[sliding] - mu)), at_least, count)


def restitution(speed: FloatArray, push: FloatArray, *, least: float = 0.05) -> Restitution:
    """Return the restitution of a contact from the impacts of a record.

    Parameters
    ----------
    speed : array (N,)
        Of the point of contact along the normal, away from what it touches [m/s].
    push : array (N,)
        Normal force [N].
    least : float
        Slowest impact that counts [m/s].

    Raises
    ------
    FitError
        If there is no impact that ends within the record.

    Examples
    --------
    >>> speed = np.array([-1.0, -1.0, -0.5, 0.3, 0.6, 0.6])
    >>> restitution(speed, np.array([0.0, 0.0, 9.0, 8.0, 0.0, 0.0])).coefficient
    0.6
    """
    closed = push > LOADED * max(float(push.max(initial=0.0)), 1e-12)
    edges = np.diff(closed.astype(int))
    starts, ends = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1) + 1
    pairs = [(start, int(ends[ends > start][0])) for start in starts if (ends > start).any()]
    before = np.array([-speed[start] for start, _ in pairs])
    after = np.array([speed[end] for _, end in pairs])
    kept = before >= least
    if not kept.any():
        raise FitError(
            "restitution of a contact",
            expected=f"an impact faster than {least:g} m/s after which the contact opens",
            got=f"{len(pairs)} impacts, none as fast" if pairs else "none",
            remedy="record it falling",
        )
    return Restitution(float(np.median(after[kept] / before[kept])), before[kept], after[kept])
