"""Truth made elsewhere: a pendulum by Heun's method with hand-written laws, not by our models or effect blocks."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from harness.signals import Channel, Dataset, PlantSpec, Run, Trajectory

sys.path.insert(0, str(Path(__file__).parent))  # the linear form is a module beside the tests

Law = Callable[[float, float, float, float], float]
SPEC = PlantSpec((Channel("u", "N m"),), (Channel("theta", "rad", period=2 * np.pi),), 0.01)


def multisine(n: int, dt: float, rng: np.random.Generator, amplitude: float) -> np.ndarray:
    """Return a random-phase multisine up to 2 Hz with this rms."""
    t, lines = np.arange(n) * dt, np.arange(1, int(2.0 * n * dt) + 1) / (n * dt)
    phases = rng.uniform(0, 2 * np.pi, lines.size)
    return amplitude * np.sqrt(2 / lines.size) * np.cos(2 * np.pi * np.outer(t, lines) + phases).sum(axis=1)


def pendulum_dataset(
    seed: int,
    law: Law | None = None,
    *,
    noise: float = 1e-3,
    coloured: float = 0.0,
    n: int = 1500,
    amplitude: float = 0.4,
    command: Callable[[np.ndarray], np.ndarray] | None = None,
) -> Dataset:
    """Return an estimation and a validation run of J = 0.1, b = 0.05, mgl = 1 with a hidden law of (q, v, u, t)."""
    from scipy.signal import lfilter

    dt, runs = SPEC.sample_time, []
    for role, use in enumerate(("estimation", "validation")):
        rng = np.random.default_rng([seed, role])
        u = multisine(n, dt, rng, amplitude)
        slow = np.asarray(lfilter([1.0], [1.0, -0.97], rng.standard_normal(n + 300))[300:])
        force = (u if command is None else command(u)) + coloured * amplitude * slow / slow.std()
        (q, v), y, parts = (0.1, 0.0), np.empty(n), 10
        h = dt / parts
        for k, now in enumerate(force.tolist()):
            y[k] = q
            for s in range(parts):
                a = acceleration(q, v, now, k * dt + s * h, law)
                ahead = v + h * a
                b = acceleration(q + h * v, ahead, now, k * dt + (s + 1) * h, law)
                q, v = q + 0.5 * h * (v + ahead), v + 0.5 * h * (a + b)
        measured = y + noise * rng.standard_normal(n)
        runs.append(Run(Trajectory(np.arange(n) * dt, u[:, None], measured[:, None], SPEC), use))  # type: ignore[arg-type]
    return Dataset(f"pendulum {seed}", tuple(runs))


def acceleration(q: float, v: float, u: float, t: float, law: Law | None) -> float:
    """Return the derivative of the rate."""
    hidden = law(q, v, u, t) if law is not None else 0.0
    return (u - 0.05 * v - math.sin(q) + hidden) / 0.1


@pytest.fixture(scope="session")
def foreign_pendulum() -> Callable[..., Dataset]:
    """Return the maker of foreign pendulum records."""
    return pendulum_dataset
