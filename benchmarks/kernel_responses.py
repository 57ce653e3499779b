"""Kernel-regularised impulse responses: error beside least squares, and how often the posterior bands hold the truth.

    python benchmarks/kernel_responses.py [systems]        (100 by default; seeds 10000 on)

Random stable systems of order 1 to 6 with 1 or 2 inputs and 2 outputs of unequal noise, 400 samples of white or slow
inputs, 60 lags. The error is ``100 (1 - |g - g0| / |g0|)``, the fit of the impulse response (Chen, Ohlsson & Ljung
2012, sec. 6), in the mean; coverage is over all lags, and over the first ten.
"""

from __future__ import annotations

import sys
import time

import numpy as np

from harness.signals import Channel, FloatArray, PlantSpec, Trajectory
from identifiers.linear.impulse.identifier import ImpulseResponse
from identifiers.linear.markov import markov_parameters

LAGS, SAMPLES, BASE, SETTLE = 60, 400, 10_000, 200


def drawn(seed: int, slow: bool) -> tuple[Trajectory, FloatArray]:
    """Return a record, and the true response (LAGS, ny, nu) from lag 1 on."""
    rng = np.random.default_rng([BASE + seed, int(slow)])
    n, nu = int(rng.integers(1, 7)), int(rng.integers(1, 3))
    a = rng.normal(size=(n, n))
    a *= rng.uniform(0.5, 0.93) / np.abs(np.linalg.eigvals(a)).max()
    b, c = rng.normal(size=(n, nu)), rng.normal(size=(2, n))
    truth, x = np.zeros((LAGS, 2, nu)), b
    for k in range(LAGS):
        truth[k] = c @ x
        x = a @ x
    u = rng.normal(size=(SAMPLES + SETTLE, nu))
    for k in range(1, len(u) if slow else 0):
        u[k] = 0.8 * u[k - 1] + 0.6 * u[k]
    y, state = np.zeros((len(u), 2)), np.zeros(n)
    for k in range(len(u)):
        y[k] = c @ state
        state = a @ state + b @ u[k]
    y = y + np.array([0.1, 0.5]) * y.std(axis=0) * rng.normal(size=y.shape)
    spec = PlantSpec(tuple(Channel(f"u{j}") for j in range(nu)), (Channel("quiet"), Channel("loud")), 1.0)
    return Trajectory(np.arange(SAMPLES) * 1.0, u[SETTLE:], y[SETTLE:], spec), truth


def fit_of(found: FloatArray, truth: FloatArray) -> float:
    """Return the fit of responses in percent, the mean over inputs and outputs."""
    wrong = np.linalg.norm(found - truth, axis=0) / np.linalg.norm(truth, axis=0)
    return float(np.mean(100.0 * (1.0 - wrong)))


def main() -> None:
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 100
    print(f"{'input':6} {'kernel':14} {'fit %':>7} {'held %':>7} {'lags 1-10':>10} {'CPU s':>7}")
    for slow in (False, True):
        for kernel in ("least squares", "tc", "dc", "ss", "auto"):
            fits, held, early, spent = [], [], [], []
            for seed in range(count):
                data, truth = drawn(seed, slow)
                start = time.process_time()
                if kernel == "least squares":
                    fits.append(fit_of(markov_parameters([data], LAGS + 1)[0][1:], truth))
                    spent.append(time.process_time() - start)
                    continue
                model = ImpulseResponse(length=LAGS, kernel=kernel).fit([data], rng=np.random.default_rng(0))  # type: ignore[arg-type]
                spent.append(time.process_time() - start)
                found, deviation = (np.array(model.notes[name]) for name in ("response", "deviation"))
                fits.append(fit_of(found, truth))
                inside = np.abs(found - truth) <= 1.96 * deviation
                held.append(inside.mean())
                early.append(inside[:10].mean())
            shares = f"{100 * np.mean(held):>7.1f} {100 * np.mean(early):>10.1f}" if held else f"{'':>18}"
            row = f"{'slow' if slow else 'white':6} {kernel:14} {np.mean(fits):>7.1f} {shares}"
            print(f"{row} {np.median(spent):>7.2f}", flush=True)


if __name__ == "__main__":
    main()
