"""How often the 95 % intervals of linear models hold the true frequency response, step response and poles.

Run: python benchmarks/coverage_of_responses.py [draws] [--only WORD ...] [--base SEED] [--apart]

Each identifier meets noise that it is meant for, in open loop and under a proportional controller whose reference
moves; draws go round three plants (a resonant one, a slow damped one with a zero, one of third order that answers two
samples late) and three sizes of the noise. Orders are given, for what the choice of an order adds is another question.
``--apart`` shows each plant and size by itself. Seeds begin at 10000.
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from harness import registry
from harness.errors import HarnessError
from harness.models.spread import (
    Matrices,
    deviation_of,
    gain_and_phase_deviation,
    gains,
    pole_covariance,
    quantile,
    response_covariance,
    steps,
)
from harness.signals import Channel, PlantSpec, Trajectory
from identifiers.linear.spectral import etfe, welch

SAMPLES, STEP = 1500, 0.1
SIZES = (0.1, 0.4, 1.0)  # Of the noise, over the outputs.
FREQUENCY = np.array([0.02, 0.1, 0.3, 0.5, 0.8, 1.2, 2.0, 3.0])
COUNTED = np.array([1, 2, 4, 8, 15, 30, 60])


@dataclass(frozen=True)
class Plant:
    """``y = B(q^-1) / F(q^-1) u``, and the gain of a proportional controller that keeps it stable."""

    f: tuple[float, ...]
    b: tuple[float, ...]  # From the sample before on
    gain: float
    watched: complex  # The pole whose interval is asked

    @property
    def order(self) -> int:
        """Number of states."""
        return max(len(self.f) - 1, len(self.b))

    @property
    def matrices(self) -> Matrices:
        """A, B, C, D."""
        n = self.order
        f, b = np.zeros(n + 1), np.zeros(n + 1)
        f[: len(self.f)], b[1 : 1 + len(self.b)] = self.f, self.b
        a = np.vstack([-f[1:], np.eye(n)[:-1]])
        return a, np.eye(n)[:, :1], b[None, 1:], np.zeros((1, 1))


PLANTS = {
    "resonant": Plant((1.0, -1.5, 0.7), (1.0, 0.5), 0.15, 0.75 + 1j * np.sqrt(0.7 - 0.5625)),
    "slow": Plant((1.0, -1.62, 0.645), (0.1, 0.06), 0.2, 0.9174),
    "third": Plant((1.0, -1.7, 1.1, -0.25), (0.0, 0.5, 0.3), 0.1, 0.5),
}


def _watched(plant: Plant) -> complex:
    poles = np.roots(plant.f)
    return complex(poles[np.argmin(np.abs(poles - plant.watched))])


def record(plant: Plant, seed: int, noise: str, size: float, *, closed: bool) -> Trajectory:
    """Return a record: noise on the output (white, coloured), in the equation or on the states; open or closed loop."""
    rng = np.random.default_rng(seed)
    moved, e, more = rng.normal(size=SAMPLES), rng.normal(size=SAMPLES), rng.normal(size=(SAMPLES, plant.order))
    a, b, c, _ = plant.matrices
    pulse = steps(plant.matrices, 400, "impulse")[:, 0, 0]
    spread = size * float(np.sqrt(np.sum(pulse**2)))
    own = np.zeros(400)
    state = np.zeros(len(plant.f) - 1)
    for k in range(400):  # 1 / F
        own[k] = (k == 0) - np.asarray(plant.f[1:]) @ state
        state = np.concatenate([[own[k]], state[:-1]])
    n = np.zeros(SAMPLES)
    if noise == "white":
        n = spread * e
    elif noise == "coloured":
        for k in range(SAMPLES):
            n[k] = 0.8 * (n[k - 1] if k else 0.0) + 0.6 * spread * e[k]
    elif noise == "equation":
        n = np.convolve(spread / np.sqrt(np.sum(own**2)) * e, own)[:SAMPLES]
    x = np.zeros(len(a))
    u, y, states = np.zeros(SAMPLES), np.zeros(SAMPLES), np.zeros((SAMPLES, len(a)))
    for k in range(SAMPLES):
        y[k] = float((c @ x)[0]) + n[k]
        states[k] = x
        u[k] = moved[k] - (plant.gain * y[k] if closed else 0.0)
        x = a @ x + b[:, 0] * u[k]
        if noise == "states":
            x = x + 0.5 * size * more[k]
    t = np.arange(SAMPLES) * STEP
    if noise == "states":
        names = tuple(Channel(f"x{i}", "m") for i in range(len(a)))
        return Trajectory(t, u[:, None], states, PlantSpec((Channel("u", "V"),), names, STEP))
    return Trajectory(t, u[:, None], y[:, None], PlantSpec((Channel("u", "V"),), (Channel("y", "m"),), STEP))


Case = tuple[str, dict[str, Any], str]
# identifier, options (order, delays, rank: the plant's order, and so many more), noise
CASES: dict[str, Case] = {
    "arx": ("arx", {"order": 0}, "equation"),
    "least-squares": ("least-squares", {}, "states"),
    "dmdc": ("dmdc", {}, "states"),
    "dmdc rank": ("dmdc", {"rank": 0}, "states"),
    "dmdc ridge": ("dmdc", {"delays": 0, "ridge": 1e-4, "offset": True}, "equation"),
    "dmdc delays": ("dmdc", {"delays": 0}, "equation"),
    "edmdc": ("edmdc", {"degree": 1}, "states"),
    "n4sid cva": ("n4sid", {"order": 0, "method": "cva"}, "white"),
    "n4sid parsim": ("n4sid", {"order": 0, "method": "parsim"}, "white"),
    "n4sid pbsid": ("n4sid", {"order": 0, "method": "pbsid"}, "white"),
    "n4sid coloured": ("n4sid", {"order": 1}, "coloured"),
    "ho-kalman": ("ho-kalman", {"order": 0, "markov": 60}, "white"),
    "ho-kalman coloured": ("ho-kalman", {"order": 0, "markov": 60}, "coloured"),
    "ho-kalman observer": ("ho-kalman", {"order": 0, "markov": 60, "observer": 12}, "white"),
    "ho-kalman observer auto": ("ho-kalman", {"order": 0, "observer": "auto"}, "white"),
    "state-space": ("prediction-error", {"order": 0}, "white"),
    "oe": ("prediction-error", {"order": 0, "structure": "oe"}, "white"),
    "oe coloured": ("prediction-error", {"order": 0, "structure": "oe"}, "coloured"),
    "armax": ("prediction-error", {"order": 0, "structure": "armax"}, "white"),
    "armax equation": ("prediction-error", {"order": 0, "structure": "armax"}, "equation"),
    "bj": ("prediction-error", {"order": 0, "structure": "bj"}, "coloured"),
    "transfer-function": ("transfer-function", {"order": 0, "delay": 0.0}, "white"),
    "transfer-function coloured": ("transfer-function", {"order": 0, "delay": 0.0}, "coloured"),
    "impulse-response": ("impulse-response", {"length": 60}, "white"),
    "welch": ("welch", {"segment": 128}, "white"),
    "welch coloured": ("welch", {"segment": 128}, "coloured"),
    "etfe": ("etfe", {"smoothing": 4}, "white"),
}
BIASED_IN_A_LOOP = ("n4sid cva", "ho-kalman", "ho-kalman coloured", "oe coloured", "transfer-function coloured",
                    "impulse-response", "welch", "welch coloured", "etfe", "transfer-function")  # fmt: skip
"""Methods that are not meant for data from a closed loop."""
WHAT = ("gain", "phase", "step", "poles")
Held = dict[str, float]


def held(model: Any, plant: Plant, truth: Matrices) -> Held:
    """Return whether gain, phase, step and poles are within their intervals, of those that are claimed."""
    if (low := model.notes.get("low")) is not None:
        right = steps(truth, 61, "impulse")[1:, 0, 0]
        count = len(low)
        own = (np.array(low)[:, 0, 0] <= right[:count]) & (right[:count] <= np.array(model.notes["high"])[:, 0, 0])
        return {"step": float(own.mean())}
    if getattr(model, "spread", None) is None:
        return {}
    wide = quantile(model.spread)
    right = gains(truth, FREQUENCY, STEP)
    found = gains(model.matrices, FREQUENCY, STEP)
    of_gain, of_phase = gain_and_phase_deviation(found, response_covariance(model, FREQUENCY))
    count = int(COUNTED[-1]) + 1
    spread = deviation_of(model, lambda one: steps(one, count)[COUNTED])
    step = np.abs(steps(model.matrices, count)[COUNTED] - steps(truth, count)[COUNTED]) <= wide * spread
    poles, covariance = pole_covariance(model)
    goal = _watched(plant)
    at = int(np.argmin(np.abs(poles - goal)))
    miss = np.array([poles[at].real - goal.real, poles[at].imag - goal.imag])
    real = goal.imag == 0
    pole = (np.abs(miss) <= wide * np.sqrt(np.diag(covariance[at])))[: 1 if real else 2]
    return {
        "gain": float(np.mean(np.abs(np.abs(found) - np.abs(right)) <= wide * of_gain)),
        "phase": float(np.mean(np.abs(np.angle(found / right)) <= wide * of_phase)),
        "step": float(np.mean(step)),
        "poles": float(np.mean(pole)),
    }


def answer(case: Case, plant: Plant, data: Trajectory, truth: Matrices) -> Held:
    """Return what one fit's intervals hold."""
    identifier, options, _ = case
    options = {k: plant.order + v if k in ("order", "delays", "rank") else v for k, v in options.items()}
    if identifier in ("welch", "etfe"):
        response = (welch if identifier == "welch" else etfe)([data], **options)
        right = gains(truth, response.frequency, STEP)
        return {"gain": float(np.nanmean(np.abs(response.response - right) <= response.radius()))}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        # The judge of records takes as long as a fit, and changes none.
        fitted: Any = registry.create("identifiers", identifier, least_excitation=0.0, **options)
        return held(fitted.fit([data[:600], data[600:]], rng=np.random.default_rng(0)), plant, truth)


def rows(count: int, wanted: list[str], base: int = 10_000, *, apart: bool = False) -> Iterator[str]:
    """Yield one line for each identifier and loop."""
    for name, case in CASES.items():
        if wanted and name not in wanted:
            continue
        for closed in (False, True):
            if closed and name in BIASED_IN_A_LOOP:
                continue
            found: dict[tuple[str, float], list[Held]] = {}
            refused = 0
            for draw in range(count):
                title, plant = list(PLANTS.items())[draw % 3]
                size = SIZES[draw // 3 % 3]
                data = record(plant, base + draw, case[2], size, closed=closed)
                truth = plant.matrices
                if case[2] == "states":
                    truth = (*truth[:2], np.eye(plant.order), np.zeros((plant.order, 1)))
                try:
                    found.setdefault((title, size), []).append(answer(case, plant, data, truth))
                except HarnessError:
                    refused += 1
                    found.setdefault((title, size), []).append({})
            whole = [one for part in found.values() for one in part]
            loop = "closed" if closed else "open"
            yield f"{name:27} {loop:6} {_said(whole)}" + (f", {refused} refused" if refused else "")
            if apart:
                for (title, size), part in sorted(found.items()):
                    yield f"    {title:10} {size:4g} {_said(part)}"


def _said(found: list[Held]) -> str:
    given = [one for one in found if one]
    share = [(what, 100 * float(np.mean([one[what] for one in given if what in one]))) for what in WHAT
             if any(what in one for one in given)]  # fmt: skip
    return ", ".join(f"{what} {value:.1f}" for what, value in share) + f" % (intervals in {len(given)} of {len(found)})"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("draws", type=int, nargs="?", default=200)
    parser.add_argument("--only", nargs="*", default=[])
    parser.add_argument("--base", type=int, default=10_000)
    parser.add_argument("--apart", action="store_true")
    asked = parser.parse_args()
    for line in rows(asked.draws, asked.only, asked.base, apart=asked.apart):
        print(line, flush=True)
