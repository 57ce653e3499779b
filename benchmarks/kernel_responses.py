"""Kernel-regularised impulse responses: error beside least squares, and how often bands and intervals hold the truth.

    python benchmarks/kernel_responses.py [systems [base]]        (100 systems by default; seeds 10000 on)

Random stable systems of order 1 to 6 with 1 or 2 inputs and 2 outputs of unequal noise, 400 samples of white or slow
inputs, 60 lags. The error is ``100 (1 - |g - g0| / |g0|)``, the fit of the impulse response (Chen, Ohlsson & Ljung
2012, sec. 6), in the mean. Coverage is that of the 95 % intervals, over all lags and over the first ten; beside it that
of the posterior at the numbers that fit best, which nothing claims, and the widths (geometric mean) over those of least
squares. Intervals are refused where residuals are correlated in time: how often stands last.
"""

from __future__ import annotations

import sys
import time

import numpy as np
from scipy.stats import t as t_of

from harness.signals import Channel, FloatArray, PlantSpec, Trajectory
from identifiers.linear.impulse.identifier import ImpulseResponse
from identifiers.linear.markov import markov_parameters

LAGS, SAMPLES, BASE, SETTLE = 60, 400, 10_000, 200


def drawn(seed: int, slow: bool, base: int = BASE) -> tuple[Trajectory, FloatArray]:
    """Return a record, and the true response (LAGS, ny, nu) from lag 1 on."""
    rng = np.random.default_rng([base + seed, int(slow)])
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
    base = int(sys.argv[2]) if len(sys.argv) > 2 else BASE
    print(
        f"{'input':6} {'kernel':14} {'fit %':>6} {'held %':>7} {'lags 1-10':>10} {'posterior':>10} {'lags 1-10':>10} "
        f"{'width':>6} {'lags 1-10':>10} {'refused':>8} {'CPU s':>6}"
    )
    for slow in (False, True):
        widths = []
        for kernel in ("least squares", "tc", "dc", "ss", "auto"):
            fits, held, own, wide, spent, refused = [], [], [], [], [], 0
            for seed in range(count):
                data, truth = drawn(seed, slow, base)
                start = time.process_time()
                if kernel == "least squares":
                    fits.append(fit_of(markov_parameters([data], LAGS + 1)[0][1:], truth))
                    spent.append(time.process_time() - start)
                    widths.append(widths_of_least_squares(data))
                    continue
                model = ImpulseResponse(length=LAGS, kernel=kernel).fit([data], rng=np.random.default_rng(0))  # type: ignore[arg-type]
                spent.append(time.process_time() - start)
                found, deviation = (np.array(model.notes[name]) for name in ("response", "deviation"))
                fits.append(fit_of(found, truth))
                own.append(np.abs(found - truth) <= 1.96 * deviation)
                if "low" not in model.notes:
                    refused += 1
                    continue
                low, high = np.array(model.notes["low"]), np.array(model.notes["high"])
                held.append((low <= truth) & (truth <= high))
                wide.append(np.log((high - low) / widths[seed]))
            row = f"{'slow' if slow else 'white':6} {kernel:14} {np.mean(fits):>6.1f}"
            if held:
                row += "".join(
                    f" {100 * _mean(part):>{w}.1f} {100 * _mean(part, 10):>10.1f}" for part, w in ((held, 7), (own, 10))
                )
                row += f" {np.exp(_mean(wide)):>6.2f} {np.exp(_mean(wide, 10)):>10.2f} {refused:>8}"
            print(f"{row} {np.median(spent):>6.2f}", flush=True)


def _mean(parts: list[FloatArray], lags: int | None = None) -> float:
    """Return the mean over systems of means over the first lags."""
    return float(np.mean([part[:lags].mean() for part in parts]))


def widths_of_least_squares(data: Trajectory) -> FloatArray:
    """Return the widths (LAGS, ny, nu) of the 95 % intervals of least squares with as many lags."""
    u, y, nu = data.u, data.y, data.spec.nu
    rows = np.hstack([*(u[LAGS - k : len(u) - k] for k in range(1, LAGS + 1)), np.ones((len(u) - LAGS, 1))])
    left = y[LAGS:] - rows @ np.linalg.lstsq(rows, y[LAGS:], rcond=None)[0]
    freedom = len(rows) - rows.shape[1]
    noise = np.sqrt(np.sum(left**2, axis=0) / freedom)
    each = np.sqrt(np.diag(np.linalg.inv(rows.T @ rows)))[:-1].reshape(LAGS, 1, nu)
    return np.asarray(2.0 * float(t_of.ppf(0.975, freedom)) * each * noise[:, None])


if __name__ == "__main__":
    main()
