"""How often the 95 % intervals of linear models hold the true frequency response, step response and poles.

Run: python benchmarks/coverage_of_responses.py [draws] [identifier ...]   (200 draws by default; seeds 10 000 on)

Each identifier meets noise that it is meant for, in open loop and under a proportional controller whose reference
moves; orders are given, for what the choice of an order adds is another question.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator
from typing import Any

import numpy as np

from harness import registry
from harness.models.spread import (
    deviation_of,
    gain_and_phase_deviation,
    gains,
    pole_covariance,
    quantile,
    response_covariance,
    steps,
)
from harness.signals import Channel, FloatArray, PlantSpec, Trajectory

SPEC = PlantSpec((Channel("u", "V"),), (Channel("y", "m"),), 0.1)
STATES = PlantSpec((Channel("u", "V"),), (Channel("y", "m"), Channel("v", "m")), 0.1)
F = np.array([1.0, -1.5, 0.7])  # Poles 0.75 +- 0.37i: 0.84 in modulus.
B = np.array([0.0, 1.0, 0.5])
GAIN = 0.15
FREQUENCY = np.array([0.02, 0.1, 0.3, 0.5, 0.8, 1.2, 2.0, 3.0])
SAMPLES = np.array([1, 2, 4, 8, 15, 30, 60])
MATRICES = (np.array([[0.0, 1.0], [-0.7, 1.5]]), np.array([[0.0], [1.0]]), np.array([[0.5, 1.0]]), np.zeros((1, 1)))


def record(seed: int, noise: str, *, closed: bool, states: bool, samples: int = 1500) -> Trajectory:
    """Return a record: noise on the output (white), in the equation (``arx``), or coloured; open or closed loop."""
    rng = np.random.default_rng(seed)
    moved, e = rng.normal(size=samples), rng.normal(size=samples)
    a, b, c, _ = MATRICES
    x, n, before = np.zeros(2), 0.0, np.zeros(2)
    u, y, both = np.zeros(samples), np.zeros(samples), np.zeros((samples, 2))
    for k in range(samples):
        if noise == "white":
            n = 0.7 * e[k]
        elif noise == "coloured":
            n = 0.8 * n + 0.4 * e[k]
        y[k] = float((c @ x)[0]) + (n if noise in ("white", "coloured") else before[0])
        both[k] = x
        u[k] = moved[k] - (GAIN * y[k] if closed else 0.0)
        x = a @ x + b[:, 0] * u[k]
        if noise == "states":
            x = x + 0.3 * np.array([e[k], rng.normal()])
        if noise == "equation":  # (1 + f1 q^-1 + f2 q^-2) y = B u + e
            now = -F[1] * before[0] - F[2] * before[1] + 0.5 * e[k]
            before = np.array([now, before[0]])
    t = np.arange(samples) * 0.1
    if states:
        return Trajectory(t, u[:, None], both, STATES)
    return Trajectory(t, u[:, None], y[:, None], SPEC)


CASES: dict[str, tuple[str, dict[str, Any], str, bool]] = {
    "arx": ("arx", {"order": 2}, "equation", False),
    "least-squares": ("least-squares", {}, "states", True),
    "dmdc": ("dmdc", {}, "states", True),
    "dmdc rank": ("dmdc", {"rank": 2}, "states", True),
    "dmdc ridge": ("dmdc", {"delays": 2, "ridge": 1e-4, "offset": True}, "equation", False),
    "edmdc": ("edmdc", {"degree": 1}, "states", True),
    "n4sid cva": ("n4sid", {"order": 2, "method": "cva"}, "white", False),
    "n4sid parsim": ("n4sid", {"order": 2, "method": "parsim"}, "white", False),
    "n4sid pbsid": ("n4sid", {"order": 2, "method": "pbsid"}, "white", False),
    "n4sid auto, coloured": ("n4sid", {"order": 3}, "coloured", False),
    "n4sid auto": ("n4sid", {"order": 2}, "white", False),
    "ho-kalman": ("ho-kalman", {"order": 2, "markov": 60}, "white", False),
    "ho-kalman plain": ("ho-kalman", {"order": 2, "markov": 60, "regularised": False}, "white", False),
    "ho-kalman coloured": ("ho-kalman", {"order": 2, "markov": 60}, "coloured", False),
    "ho-kalman observer": ("ho-kalman", {"order": 2, "markov": 60, "observer": 12}, "white", False),
    "oe": ("prediction-error", {"order": 2}, "white", False),
    "oe coloured": ("prediction-error", {"order": 2}, "coloured", False),
    "armax": ("prediction-error", {"order": 2, "structure": "armax"}, "white", False),
    "bj": ("prediction-error", {"order": 2, "structure": "bj"}, "coloured", False),
}
BIASED_IN_A_LOOP = ("n4sid cva", "ho-kalman", "ho-kalman plain", "ho-kalman coloured", "oe coloured")
"""Methods that are not meant for data from a closed loop."""


def held(model: Any, states: bool) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray] | None:
    """Return whether gain, phase, step and poles are within their intervals; None where none are claimed."""
    if model.spread is None:
        return None
    truth = (*MATRICES[:2], np.eye(2), np.zeros((2, 1))) if states else MATRICES
    wide = quantile(model.spread)
    right = gains(truth, FREQUENCY, 0.1)
    found = gains(model.matrices, FREQUENCY, 0.1)
    of_gain, of_phase = gain_and_phase_deviation(found, response_covariance(model, FREQUENCY))
    gain = np.abs(np.abs(found) - np.abs(right)) <= wide * of_gain
    phase = np.abs(np.angle(found / right)) <= wide * of_phase
    count = int(SAMPLES[-1]) + 1
    spread = deviation_of(model, lambda one: steps(one, count)[SAMPLES])
    step = np.abs(steps(model.matrices, count)[SAMPLES] - steps(truth, count)[SAMPLES]) <= wide * spread
    poles, covariance = pole_covariance(model)
    own = poles[np.argmin(np.abs(poles - (0.75 + 0.3708j)))]
    both = covariance[int(np.argmin(np.abs(poles - own)))]
    miss = np.array([own.real - 0.75, own.imag - np.sqrt(0.7 - 0.5625)])
    pole = np.abs(miss) <= wide * np.sqrt(np.diag(both))
    return gain, phase, step, pole


def rows(count: int, wanted: list[str]) -> Iterator[str]:
    """Yield one line for each identifier and loop."""
    for name, (identifier, options, noise, states) in CASES.items():
        if wanted and name not in wanted:
            continue
        for closed in (False, True):
            if closed and name in BIASED_IN_A_LOOP:
                continue
            found, given = [], 0
            for seed in range(10_000, 10_000 + count):
                data = record(seed, noise, closed=closed, states=states)
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    model: Any = registry.create("identifiers", identifier, **options).fit(
                        [data[:600], data[600:]], rng=np.random.default_rng(0)
                    )
                if (one := held(model, states)) is not None:
                    given += 1
                    found.append([np.mean(part) for part in one])
            share = 100 * np.mean(found, axis=0) if found else np.full(4, np.nan)
            said = ", ".join(
                f"{what} {value:.1f}" for what, value in zip(("gain", "phase", "step", "poles"), share, strict=True)
            )
            yield f"{name:22} {'closed' if closed else 'open':6} {said} % (intervals in {given} of {count})"


if __name__ == "__main__":
    arguments = sys.argv[1:]
    number = int(arguments[0]) if arguments else 200
    for line in rows(number, arguments[1:]):
        print(line, flush=True)
