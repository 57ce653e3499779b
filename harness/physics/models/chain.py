"""A chain of masses between two walls: the structure whose modes are known exactly."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np

from harness.errors import InputError
from harness.physics.symbolic.mechanism import Mechanism
from harness.signals import FloatArray


def mass_chain(
    masses: int = 3, mass: float = 1.0, stiffness: float = 40.0, damping: float = 0.08, coupling: float = 1.0
) -> Mechanism:
    """Masses in a row between two walls, joined by springs and dampers; a force can act on each.

    ``m_i q_i'' = u_i + k_i (q_(i-1) - q_i) + k_(i+1) (q_(i+1) - q_i)`` and the same with c and rates;
    q_0 and q_(n+1) are the walls. Damping is in proportion to stiffness, so the modes are real.

    Parameters
    ----------
    masses : int
        Their number n, at least 1.
    mass : float
        Nominal value of each [kg].
    stiffness, damping : float
        Of the springs at the walls [N/m], [N s/m].
    coupling : float
        Stiffness and damping of the others over those at the walls; a small one makes modes that lie close together.

    Raises
    ------
    InputError
        If a value is out of its range.

    Examples
    --------
    >>> print(mass_chain(2).system())
    mass-chain: u1 [N], u2 [N] -> q1 [m], q2 [m]
    """
    _refuse(masses, mass, stiffness, damping, coupling)
    n = int(masses)
    names = {what: [f"{what}{i + 1}" for i in range(n + (what in "kc"))] for what in ("q", "u", "m", "k", "c")}
    m = Mechanism(
        "mass-chain", q=" ".join(names["q"]), u=" ".join(names["u"]), p=" ".join(names["m"] + names["k"] + names["c"])
    )
    weights, springs, dampers = m.p[:n], m.p[n : 2 * n + 1], m.p[2 * n + 1 :]
    for value, place in zip(weights, m.q, strict=True):
        m.body(value, (place, 0), weight=0)
    places, rates = (0, *m.q, 0), (0, *m.v, 0)
    m.V = sum(k * (b - a) ** 2 / 2 for k, (a, b) in zip(springs, pairwise(places), strict=True))
    forces = [c * (b - a) for c, (a, b) in zip(dampers, pairwise(rates), strict=True)]
    m.Q = [u - before + after for u, (before, after) in zip(m.u, pairwise(forces), strict=True)]
    share = [1.0, *[coupling] * (n - 1), 1.0]
    known: dict[str, Any] = {name: ("kg", mass) for name in names["m"]}
    known |= {name: ("N/m", stiffness * part) for name, part in zip(names["k"], share, strict=True)}
    known |= {name: ("N s/m", damping * part) for name, part in zip(names["c"], share, strict=True)}
    m.parameters(**known)
    return m


def chain_modes(
    masses: int = 3, mass: float = 1.0, stiffness: float = 40.0, damping: float = 0.08, coupling: float = 1.0
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the exact natural frequencies (n,) [Hz], damping ratios (n,) and shapes (n, n), in rows, of a chain.

    ``K phi = omega^2 M phi``; with ``C = (damping / stiffness) K`` the ratio is ``omega damping / (2 stiffness)``. Each
    shape has length 1.

    Parameters
    ----------
    masses, mass, stiffness, damping, coupling
        As for :func:`mass_chain`.

    Examples
    --------
    >>> frequency, ratio, shapes = chain_modes(2)
    >>> frequency.round(3), ratio.round(4), abs(shapes).round(3)[0]
    (array([1.007, 1.743]), array([0.0063, 0.011 ]), array([0.707, 0.707]))
    """
    _refuse(masses, mass, stiffness, damping, coupling)
    n = int(masses)
    springs = stiffness * np.array([1.0, *[coupling] * (n - 1), 1.0])
    between = np.diag(springs[1:-1], 1)
    matrix = np.diag(springs[:-1] + springs[1:]) - between - between.T
    squares, shapes = np.linalg.eigh(matrix / mass)
    speed = np.sqrt(squares)
    return speed / (2 * np.pi), speed * damping / (2 * stiffness), shapes.T


def _refuse(masses: int, mass: float, stiffness: float, damping: float, coupling: float) -> None:
    """Refuse what is no chain."""
    if masses < 1 or int(masses) != masses or min(mass, stiffness, coupling) <= 0 or damping < 0:
        raise InputError(
            "mass chain",
            expected="masses >= 1, mass, stiffness and coupling > 0, damping >= 0",
            got=f"masses={masses}, mass={mass}, stiffness={stiffness}, damping={damping}, coupling={coupling}",
            remedy="correct the options",
        )
