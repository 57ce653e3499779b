"""How often the 95 % intervals of linear fits hold the truth, over simulated records, and how often none is given.

Run: python benchmarks/coverage_of_linear_estimates.py [records]   (400 by default; seeds 10 000 on)
"""

from __future__ import annotations

import sys
from collections.abc import Iterator

import numpy as np

from harness.models.estimate import estimate_of
from harness.signals import Channel, FloatArray, PlantSpec, Trajectory
from identifiers.linear.arx import Arx
from identifiers.linear.least_squares import StateLeastSquares
from identifiers.sparse.stlsq import Stlsq

A = np.array([[0.9, 0.3], [-0.2, 0.85]])
B = np.array([[0.0], [1.0]])
SPEC = PlantSpec((Channel("u", "N"),), (Channel("q", "m"), Channel("v", "m/s")), 0.1)


def records(seed: int, process: float, sensor: float, lengths: tuple[int, ...] = (150, 250)) -> list[Trajectory]:
    """Return records of one system with a disturbance at every step, and noise on the sensors."""
    rng = np.random.default_rng(seed)
    found = []
    for n in lengths:
        u, x = rng.normal(size=(n, 1)), np.zeros((n, 2))
        x[0] = rng.normal(size=2)
        for k in range(n - 1):
            x[k + 1] = A @ x[k] + B @ u[k] + process * np.array([0.5, 1.0]) * rng.normal(size=2)
        found.append(Trajectory(np.arange(n) * 0.1, u, x + sensor * rng.normal(size=x.shape), SPEC))
    return found


def coverage(
    identifier: StateLeastSquares | Arx, seeds: range, process: float, sensor: float
) -> tuple[int, FloatArray]:
    """Return how many fits claimed intervals, and for each coefficient in how many of them the truth lay."""
    truth = np.hstack([A, B]).ravel()
    given, held = 0, np.zeros(truth.size)
    for seed in seeds:
        estimate = estimate_of(identifier.fit(records(seed, process, sensor), rng=np.random.default_rng(0)))
        if estimate is None or estimate.intervals is None:
            continue
        given += 1
        held += (estimate.intervals[:, 0] <= truth) & (truth <= estimate.intervals[:, 1])
    return given, held


def sparse(seeds: range) -> str:
    """Return the line of sparse equations in discrete time: a plant with a cubic term, among all monomials."""
    truth, held, given, found = {"y": 0.7, "u": 0.5, "y^3": -0.2}, 0, 0, 0
    spec = PlantSpec((Channel("u"),), (Channel("y"),), 0.1)
    for seed in seeds:
        rng = np.random.default_rng(seed)
        u, y = rng.uniform(-2, 2, size=(300, 1)), np.zeros((300, 1))
        for k in range(299):
            y[k + 1] = 0.7 * y[k] + 0.5 * u[k] - 0.2 * y[k] ** 3 + 0.02 * rng.normal()
        model = Stlsq(degree=3, time="discrete").fit([Trajectory(np.arange(300) * 0.1, u, y, spec)], rng=rng)
        estimate = estimate_of(model)
        found += model.support == (tuple(truth),)
        if estimate is not None and estimate.intervals is not None and model.support == (tuple(truth),):
            given += 1
            low, high = estimate.intervals.T
            held += int(np.sum((low <= list(truth.values())) & (list(truth.values()) <= high)))
    share = 100 * held / max(len(truth) * given, 1)
    return f"{'stlsq, discrete':30} intervals in {given} of {found} with the true terms: mean {share:.1f} %"


def rows(count: int) -> Iterator[str]:
    """Yield one line for each method and kind of noise."""
    seeds = range(10_000, 10_000 + count)
    cases = [
        ("least-squares", StateLeastSquares(), 0.2, 0.0),
        ("least-squares, noisy sensors", StateLeastSquares(least_excitation=0.0), 0.05, 0.5),
        ("arx, order 1", Arx(order=1, offset=False), 0.2, 0.0),
        ("iv, noisy sensors", StateLeastSquares(method="iv", least_excitation=0.0), 0.0, 0.3),
        ("iv, both", StateLeastSquares(method="iv", least_excitation=0.0), 0.2, 0.3),
        ("tls, noisy sensors", StateLeastSquares(method="tls", least_excitation=0.0), 0.0, 0.3),
        ("l1", StateLeastSquares(method="l1", intervals=20), 0.2, 0.0),
    ]
    yield sparse(seeds)
    for name, identifier, process, sensor in cases:
        given, held = coverage(identifier, seeds, process, sensor)
        share = 100 * held / max(given, 1)
        said = f"{share.min():.1f} to {share.max():.1f} %, mean {share.mean():.1f} %" if given else "none"
        yield f"{name:30} intervals in {given} of {count}: {said}"


if __name__ == "__main__":
    for line in rows(int(sys.argv[1]) if len(sys.argv) > 1 else 400):
        print(line, flush=True)
