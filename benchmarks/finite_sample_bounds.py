"""Bounds for finite samples beside the errors that really happen: how often they hold, and how loose they are.

    python benchmarks/finite_sample_bounds.py [draws [base]]        (200 by default; seeds from 10000 on)

Records of known plants are drawn anew, and the error of each estimate is compared with its bound of 95 % and with what
was measured beside it. `loose` is the median bound over the 95 % quantile of the errors that happened: what a bound
would have been that knew the plant.
"""

from __future__ import annotations

import sys

import numpy as np

from harness.models.spread import steps
from harness.signals import Channel, FloatArray, PlantSpec, Trajectory
from identifiers.linear.bounds.regressions import ellipsoids, small_ball
from identifiers.linear.bounds.responses import responses

A, B = np.array([[0.8, 0.2], [-0.2, 0.7]]), np.array([[0.0], [1.0]])
NOISE, LAGS = 0.5, 25
STATES = PlantSpec((Channel("u"),), (Channel("q"), Channel("v")), 1.0)
OUTPUT = PlantSpec((Channel("u"),), (Channel("y"),), 1.0)


def drawn(samples: int, seed: int, gain: float, smooth: float) -> tuple[Trajectory, Trajectory]:
    """Return a record of the states moved by process noise, and one of a noisy output, of the same inputs."""
    rng = np.random.default_rng(seed)
    moves = rng.normal(size=(samples, 1))
    for k in range(1, samples):
        moves[k] = smooth * moves[k - 1] + np.sqrt(1 - smooth**2) * moves[k]
    u, x, clean = np.zeros((samples, 1)), np.zeros((samples, 2)), np.zeros((samples, 2))
    for k in range(samples):
        u[k] = moves[k] + gain * x[k, 1]
        if k + 1 < samples:
            x[k + 1] = A @ x[k] + B @ u[k] + NOISE * rng.normal(size=2)
            clean[k + 1] = A @ clean[k] + B @ moves[k]
    t = np.arange(float(samples))
    return Trajectory(t, u, x, STATES), Trajectory(
        t, moves, clean[:, :1] + NOISE * rng.normal(size=(samples, 1)), OUTPUT
    )


def line(title: str, wrong: FloatArray, bound: FloatArray, measured: FloatArray) -> str:
    """Return a row of the table; the last axis holds draws, the first things that are to hold at once."""
    all_held = np.mean(np.all(wrong <= bound, axis=0))
    each = np.mean(wrong <= measured)
    loose = np.median(np.median(bound, axis=1) / np.quantile(wrong, 0.95, axis=1))
    return f"{title:52} {100 * all_held:>7.1f} {100 * each:>9.1f} {loose:>7.2f} {np.median(bound / measured):>16.2f}"


def main() -> None:
    draws = int(sys.argv[1]) if len(sys.argv) > 1 else 200
    base = int(sys.argv[2]) if len(sys.argv) > 2 else 10_000
    truth = np.vstack([A.T, B.T, np.zeros((1, 2))])
    response = steps((A, B, np.eye(2)[:1], np.zeros((1, 1))), LAGS, "impulse")
    waves = np.exp(-1j * np.outer(np.linspace(0.0, np.pi, 200), np.arange(LAGS)))
    print(f"{'bound':52} {'held %':>7} {'interval':>9} {'loose':>7} {'bound/interval':>16}")
    for samples in (200, 1000, 5000):
        for gain, smooth in ((0.0, 0.0), (-0.4, 0.0), (0.0, 0.8)):
            kind = "feedback" if gain else "smooth inputs" if smooth else "white inputs"
            rows: dict[str, list[tuple[FloatArray, FloatArray, FloatArray]]] = {}
            for draw in range(draws):
                states, output = drawn(samples, base + draw, gain, smooth)
                phi = np.hstack([states.y[:-1], states.u[:-1], np.ones((samples - 1, 1))])
                found = ellipsoids(phi, states.y[1:], 0.95)
                if found is not None:
                    parts = (np.abs(found.coefficients - truth).ravel(), found.half.ravel(), found.measured.ravel())
                    rows.setdefault("coefficients, self-normalised", []).append(parts)
                if gain or draw >= max(draws // 4, 20):
                    continue
                of = responses([output], LAGS, 0.95, np.random.default_rng(draw))
                if of is not None:
                    wrong = of.markov - response
                    largest = np.array([np.abs(np.einsum("fl,lyu->f", waves, wrong)).max()])
                    parts = (largest, np.array([of.gain]), np.array([of.measured_gain]))
                    rows.setdefault("gain at any frequency", []).append(parts)
                    parts = (np.array([np.linalg.norm(wrong)]), np.array([of.block]), np.array([of.measured_block]))
                    rows.setdefault(f"norm of {LAGS} Markov parameters", []).append(parts)
            for name, found_rows in rows.items():
                wrong, bound, measured = (np.array([one[k] for one in found_rows]).T for k in range(3))
                print(line(f"{name}, {kind}, {samples}", wrong, bound, measured), flush=True)
    for samples in (10_000, 100_000, 1_000_000):
        one = small_ball(A, B, np.eye(1), NOISE**2 * np.eye(2), samples, 0.95)
        says = f"{one.bound:.3g}" if one.needed <= samples else f"nothing (from {one.needed:.2g} samples on)"
        print(f"[A B], small balls, {samples} samples: {says}")


if __name__ == "__main__":
    main()
