"""Which wall each jump meets: jumps grouped by the planes on which the positions before them lie."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from harness.signals import FloatArray

_MOST, _STARTS, _ROUNDS = 4, 20, 50
"""Walls that are tried, random starts of each number, and rounds of one start."""

_EXACT = 1e-7
"""Scatter below which planes are exact, in the scale of the positions: the instants of jumps are no better known."""


def grouped(
    places: FloatArray, count: int | None, *, least: int, reset: int, rng: np.random.Generator
) -> npt.NDArray[np.intp]:
    """Return the plane (n,) of each place: those near the same one, for the number of planes of least cost.

    Planes and members in turns, as k-means does with centres (Bradley & Mangasarian 2000, *J. Global Optim.* 16:23).
    The cost is minus twice the classification likelihood, plus ``log n`` for every parameter (Biernacki, Celeux &
    Govaert 2000, *IEEE Trans. PAMI* 22:719): it counts what it takes to say which plane a place belongs to, so noise
    about one plane is not cut in two.

    Parameters
    ----------
    places : array (n, m)
        Positions at the jumps, each scaled to a size of 1.
    count : int, optional
        Of the planes; None chooses it.
    least : int
        Members that a plane needs.
    reset : int
        Parameters that each plane brings beside its own.
    rng : Generator

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> z = np.repeat([0.0, 1.0], 30)[:, None] + 0.01 * rng.normal(size=(60, 1))
    >>> np.bincount(grouped(z, None, least=4, reset=6, rng=rng)).tolist()
    [30, 30]
    >>> int(grouped(z[:30], None, least=4, reset=6, rng=rng).max())
    0
    """
    n, m = places.shape
    numbers = range(1, _MOST + 1) if count is None else [count]
    best, of = np.inf, np.zeros(n, dtype=np.intp)
    for planes in numbers:
        if n < planes * least:
            break
        found = _planes(places, planes, least, rng)
        if found is None:
            continue
        members, squares = found
        share = np.bincount(members, minlength=planes) / n
        cost = n * np.log(squares / n + _EXACT**2) - 2 * n * float(share @ np.log(share))
        cost += planes * (m + reset) * np.log(n)
        if cost < best:
            best, of = cost, members
    return of


def _planes(
    places: FloatArray, planes: int, least: int, rng: np.random.Generator
) -> tuple[npt.NDArray[np.intp], float] | None:
    """Return members and sum of squared distances of the best of some starts; None where a plane stays too empty."""
    n, m = places.shape
    best: tuple[npt.NDArray[np.intp], float] | None = None
    for _ in range(_STARTS if planes > 1 else 1):
        seeds = [_plane(places[rng.choice(n, m, replace=False)]) for _ in range(planes)]
        members = np.argmin(_distances(places, seeds), axis=1)
        for _ in range(_ROUNDS):
            if np.bincount(members, minlength=planes).min() < least:
                break
            far = _distances(places, [_plane(places[members == k]) for k in range(planes)])
            old, members = members, np.argmin(far, axis=1)
            if (old == members).all():
                squares = float(np.sum(far.min(axis=1) ** 2))
                if best is None or squares < best[1]:
                    best = members, squares
                break
    return best


def _plane(places: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return centre and normal (m,) of the plane of least squared distances."""
    centre = places.mean(axis=0)
    return centre, np.linalg.svd(places - centre, full_matrices=True)[2][-1]


def _distances(places: FloatArray, planes: list[tuple[FloatArray, FloatArray]]) -> FloatArray:
    return np.stack([np.abs((places - centre) @ normal) for centre, normal in planes], axis=1)
