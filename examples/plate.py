"""A thin plate, simply supported along its edges, as finite differences: a structure in two directions.

``sysid simulate ode --option model=examples/plate.py:plate ...`` moves it, ``sysid modes`` finds its modes, and
:func:`plate_modes` says what they are: exactly those of the grid, and those of the plate that the grid stands for.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import sympy as sp

from harness.physics import Ode

WIDTH, HEIGHT = 0.6, 0.4
"""Sides [m]."""
THICKNESS, YOUNG, POISSON, DENSITY = 2e-3, 70e9, 0.33, 2700.0
"""[m], [Pa], [1], [kg/m^3]: a sheet of aluminium."""
LOSS = 4e-5
"""Time of the Kelvin-Voigt damping [s]: the stress is E (strain + LOSS strain rate), a ratio of omega LOSS / 2."""
ACROSS, ALONG = 5, 3
"""Inner points of the grid over width and height."""
HAMMERS = ((1, 1), (4, 2))
"""Points at which a force acts, counted from 1."""


def points() -> Iterator[tuple[str, int, int]]:
    """Yield name and place on the grid (from 1) of every inner point."""
    for j in range(1, ALONG + 1):
        for i in range(1, ACROSS + 1):
            yield f"w{i}{j}", i, j


def places() -> dict[str, tuple[float, float]]:
    """Return where every sensor stands [m]."""
    return {name: (i * WIDTH / (ACROSS + 1), j * HEIGHT / (ALONG + 1)) for name, i, j in points()}


def plate() -> Ode:
    """Plate ``rho h w'' + D lap lap (w + LOSS w') = p``, every inner point of its grid measured, two hammers.

    Kirchhoff's equation (Timoshenko & Woinowsky-Krieger 1959, eq. 103) with five-point differences for the Laplacian;
    at a simply supported edge deflection and moment vanish, so the Laplacian is applied twice with zeros outside.
    """
    names = [name for name, _, _ in points()]
    forces = [f"f{i}{j}" for i, j in HAMMERS]
    ode = Ode("plate", x=" ".join(names + [f"{name}_rate" for name in names]), u=" ".join(forces))
    n = len(names)
    square = bending() @ bending() / (DENSITY * THICKNESS)
    cell = WIDTH / (ACROSS + 1) * HEIGHT / (ALONG + 1) * DENSITY * THICKNESS
    place = {(i, j): row for row, (_, i, j) in enumerate(points())}
    w, rates = ode.x[:n], ode.x[n:]
    pushes = [sp.Integer(0)] * n
    for force, hammer in zip(ode.u, HAMMERS, strict=True):
        pushes[place[hammer]] += force / cell
    bent = [a + LOSS * b for a, b in zip(w, rates, strict=True)]
    accelerations = [
        push - sum(float(value) * b for value, b in zip(row, bent, strict=True) if value)
        for push, row in zip(pushes, square, strict=True)
    ]
    ode.rhs = [*rates, *accelerations]
    ode.outputs = {name: (value, "m") for name, value in zip(names, w, strict=True)}
    return ode


def bending() -> np.ndarray:
    """Return the root of D times the Laplacian (n, n) of the grid, negative definite."""
    stiff = YOUNG * THICKNESS**3 / (12 * (1 - POISSON**2))
    one, two = (
        (np.eye(k, k=1) + np.eye(k, k=-1) - 2 * np.eye(k)) / (length / (k + 1)) ** 2
        for k, length in ((ACROSS, WIDTH), (ALONG, HEIGHT))
    )
    laplacian: np.ndarray = np.kron(np.eye(ALONG), one) + np.kron(two, np.eye(ACROSS))
    return np.sqrt(stiff) * laplacian


def plate_modes() -> list[dict[str, object]]:
    """Return the modes by frequency: half waves, frequency [Hz] of grid and plate, damping ratio, shape (n,).

    Of the grid ``omega = c (4 / dx^2 sin^2(p pi / 2 (nx + 1)) + 4 / dy^2 sin^2(q pi / 2 (ny + 1)))``, of the plate
    ``omega = c pi^2 (p^2 / a^2 + q^2 / b^2)`` (Navier), with c the root of D / (rho h); shapes are products of sines.
    """
    speed = np.sqrt(YOUNG * THICKNESS**3 / (12 * (1 - POISSON**2)) / (DENSITY * THICKNESS))
    found: list[dict[str, object]] = []
    for p in range(1, ACROSS + 1):
        for q in range(1, ALONG + 1):
            parts = [
                4 * (k + 1) ** 2 / length**2 * np.sin(half * np.pi / (2 * (k + 1))) ** 2
                for k, length, half in ((ACROSS, WIDTH, p), (ALONG, HEIGHT, q))
            ]
            omega = speed * sum(parts)
            shape = np.array(
                [np.sin(p * np.pi * i / (ACROSS + 1)) * np.sin(q * np.pi * j / (ALONG + 1)) for _, i, j in points()]
            )
            found.append(
                {
                    "waves": (p, q),
                    "frequency": omega / (2 * np.pi),
                    "of the plate": speed * np.pi * (p**2 / WIDTH**2 + q**2 / HEIGHT**2) / 2,
                    "damping": omega * LOSS / 2,
                    "shape": shape / np.linalg.norm(shape),
                }
            )
    return sorted(found, key=lambda mode: float(mode["frequency"]))  # type: ignore[arg-type]
