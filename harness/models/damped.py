"""Damped least squares (Levenberg 1944; Marquardt 1963, J. SIAM 11:431): one loop, whatever the normal equations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

Point = TypeVar("Point")
System = TypeVar("System")


@dataclass(frozen=True)
class Damping:
    """How a descent is damped, and when it ends."""

    start: float = 1e-3  # Marquardt's lambda of the first step
    growth: float = 10.0  # Factor after a step that lowers nothing
    fall: float = 0.1  # Factor after one that does
    # Least lambda, and the one from which on no step is tried
    least: float = 1e-12
    most: float = 1e8
    trials: int = 1000  # Steps that are tried from one point
    enough: float = 1e-6  # Relative decrease of the cost below which the descent ends
    rounds: int = 50  # Points from which a step is taken, at most


def damped_descent(
    point: Point,
    cost: Callable[[Point], float],
    linearised: Callable[[Point], System | None],
    moved: Callable[[Point, System, float], Point],
    damping: Damping,
) -> Point:
    """Return the point where no damped step lowers a sum of squares any more, or not by enough.

    - ``point``: where it begins
    - ``cost``: the sum of squares at a point; infinite where there is none
    - ``linearised``: what the steps from a point are made of, such as J'J and J'r; None ends the descent there
    - ``moved``: ``moved(point, system, lambda)``: where the damped step leads

    Examples
    --------
    >>> residual, slope = (lambda x: x**3 - 8.0), (lambda x: 3.0 * x**2)
    >>> found = damped_descent(5.0, lambda x: residual(x) ** 2, lambda x: (slope(x) ** 2, slope(x) * residual(x)),
    ...                        lambda x, system, damp: x - system[1] / (system[0] * (1.0 + damp)), Damping())
    >>> round(found, 6)
    2.0
    """
    now, size = cost(point), damping.start
    for _ in range(damping.rounds):
        system = linearised(point)
        if system is None:
            break
        then = now
        for _ in range(damping.trials):
            if size >= damping.most:
                break
            trial = moved(point, system, size)
            then = cost(trial)
            if then < now:
                break
            size *= damping.growth
        if not then < now:
            break
        gain, point, now, size = (now - then) / now, trial, then, max(size * damping.fall, damping.least)
        if gain < damping.enough:
            break
    return point
