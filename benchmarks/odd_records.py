"""Faults of columns against clean records: what is named, what is named falsely, and which rows are left out.

    python benchmarks/odd_records.py [--plants N] [--rows N ...] [--seeds N]

Every plant is recorded clean, by several excitations, and with each fault of the list. A clean record must bring no
fault; a corrupted one the kind of its fault and no other.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable

import numpy as np

from harness.algebra import runge_kutta
from harness.data.oddities import examined
from harness.signals import Channel, Dataset, FloatArray, PlantSpec, Run, Trajectory

Step = Callable[[FloatArray, float], FloatArray]
NOISE = (1e-4, 1e-3, 1e-2)  # Sensor noise over the spread of the output.
SUBSTEPS = 4


def _mechanical(inertia: float, force: Callable[[float, float, float], float]) -> Step:
    return lambda x, u: np.array([x[1], force(x[0], x[1], u) / inertia])


PLANTS: dict[str, tuple[Step, float, float, int]] = {
    # rates, sample time [s], size of the input, states
    "pendulum": (_mechanical(0.05, lambda q, v, u: u - 0.02 * v - np.sin(q)), 0.01, 0.5, 2),
    "pendulum with dry friction": (
        _mechanical(0.05, lambda q, v, u: u - 0.02 * v - np.sin(q) - 0.2 * np.tanh(v / 1e-2)),
        0.01,
        0.5,
        2,
    ),
    "oscillator": (_mechanical(1.0, lambda q, v, u: u - 0.4 * v - 30 * q), 0.01, 3.0, 2),
    "oscillator with play at the input": (
        _mechanical(1.0, lambda q, v, u: np.sign(u) * max(abs(u) - 1.0, 0.0) - 0.4 * v - 30 * q),
        0.01,
        3.0,
        2,
    ),
    "drive": (_mechanical(0.2, lambda q, v, u: u - 0.3 * v), 0.02, 1.0, 2),
    "end stop": (
        _mechanical(1.0, lambda q, v, u: u - 0.8 * v - 20 * q - 5e3 * max(abs(q) - 0.1, 0.0) * np.sign(q)),
        0.005,
        3.0,
        2,
    ),
    "room": (lambda x, u: np.array([(u - x[0]) / 8.0, (x[0] - x[1]) / 3.0]), 0.5, 1.0, 2),
    "tank": (lambda x, u: np.array([0.3 * (u + 1.5) - 0.25 * np.sqrt(max(x[0], 0.0))]), 0.5, 0.8, 1),
    "first order": (lambda x, u: np.array([(u - x[0]) / 0.5]), 0.05, 1.0, 1),
    "fast first order": (lambda x, u: np.array([(u - x[0]) / 0.02]), 0.02, 1.0, 1),
}


def excitation(kind: str, n: int, dt: float, size: float, rng: np.random.Generator) -> FloatArray:
    """Return an input (n,)."""
    t = np.arange(n) * dt
    if kind == "multisine":
        f = np.linspace(0.001, 0.03, 15) / dt
        return np.asarray(size * np.sqrt(2 / 15) * np.sin(2 * np.pi * np.outer(t, f) + rng.uniform(0, 6.3, 15)).sum(1))
    if kind == "clipped multisine":
        return np.asarray(np.clip(excitation("multisine", n, dt, 1.5 * size, rng), -size, size))
    if kind == "prbs":
        return np.repeat(rng.choice([-size, size], n // 7 + 1), 7)[:n]
    if kind == "steps":
        return np.repeat(rng.uniform(-size, size, n // 100 + 1), 100)[:n]
    if kind == "bang-bang":
        return np.asarray(size * np.sign(np.sin(2 * np.pi * t * 0.005 / dt)))
    pulses = np.zeros(n)
    pulses[rng.choice(n, 5, replace=False)] = 10 * size
    return pulses


EXCITATIONS = ("multisine", "clipped multisine", "prbs", "steps", "bang-bang", "pulses")


def simulated(plant: str, u: FloatArray) -> FloatArray:
    """Return the output (n,) of a plant."""
    rates, dt, _, states = PLANTS[plant]
    h = dt / SUBSTEPS
    x, y = np.zeros(states), np.empty(len(u))
    for k, value in enumerate(u):
        y[k] = x[0] if states < 2 or plant != "room" else x[1]
        for _ in range(SUBSTEPS):
            x = runge_kutta(lambda state, held=value: rates(state, held), x, h)
    return y


def _held(y: FloatArray, every: int, first: int = 0) -> FloatArray:
    return np.asarray(y[np.maximum((np.arange(len(y)) - first) // every * every + first, 0)])


def _at(y: FloatArray, rows: FloatArray, values: FloatArray | float) -> FloatArray:
    y = y.copy()
    y[rows] = values
    return y


def _some(rng: np.random.Generator, n: int, count: int) -> FloatArray:
    return rng.choice(np.arange(10, n - 10), count, replace=False)


Fault = Callable[[FloatArray, float, np.random.Generator], FloatArray]
# y, its spread, random numbers -> y as it is logged
OUTPUTS: dict[str, tuple[str, Fault]] = {
    "one spike": ("spike", lambda y, s, r: y + _at(0 * y, _some(r, len(y), 1), s)),
    "one small spike": ("spike", lambda y, s, r: y + _at(0 * y, _some(r, len(y), 1), 0.3 * s)),
    "one huge spike": ("spike", lambda y, s, r: y + _at(0 * y, _some(r, len(y), 1), 1e4 * s)),
    "four spikes": ("spike", lambda y, s, r: y + _at(0 * y, _some(r, len(y), 4), s * r.choice([-2, 2], 4))),
    "1 % spikes": ("spike", lambda y, s, r: y + _at(0 * y, _some(r, len(y), len(y) // 100), s)),
    "two rows wrong": ("spike", lambda y, s, r: y + _at(0 * y, int(_some(r, len(y), 1)[0]) + np.arange(2), 3 * s)),
    "9999": ("word", lambda y, s, r: _at(y, _some(r, len(y), 3), 9999.0)),
    "9999 twice in a row": ("word", lambda y, s, r: _at(y, int(_some(r, len(y), 1)[0]) + np.arange(2), 9999.0)),
    "-999": ("word", lambda y, s, r: _at(y, _some(r, len(y), 2), -999.0)),
    "-1 for missing": ("word", lambda y, s, r: _at(y, np.flatnonzero(np.abs(y + 1) > 2 * s)[:: len(y) // 5], -1.0)),
    "65535": ("word", lambda y, s, r: _at(y, _some(r, len(y), 3), 65535.0)),
    "zeros": ("word", lambda y, s, r: _at(y, np.flatnonzero(np.abs(y) > s)[3 :: len(y) // 9], 0.0)),
    "every 2nd": ("held", lambda y, s, r: _held(y, 2)),
    "every 3rd, late": ("held", lambda y, s, r: _held(y, 3, 1)),
    "every 5th": ("held", lambda y, s, r: _held(y, 5)),
    "every 10th": ("held", lambda y, s, r: _held(y, 10)),
    "held at random": (
        "held",
        lambda y, s, r: y[np.maximum.accumulate(np.where(r.random(len(y)) < 0.7, np.arange(len(y)), 0))],
    ),
    "rarely held": (
        "held",
        lambda y, s, r: y[np.maximum.accumulate(np.where(r.random(len(y)) < 0.95, np.arange(len(y)), 0))],
    ),
    "stuck": ("stuck", lambda y, s, r: _at(y, len(y) // 3 + np.arange(60), y[len(y) // 3])),
    "stuck in four places": (
        "stuck",
        lambda y, s, r: y[
            np.maximum.accumulate(
                np.where(
                    np.any([abs(np.arange(len(y)) - k * len(y) // 5 - 6 * k) < 6 * k for k in range(1, 5)], 0), 0, 1
                )
                * np.arange(len(y))
            )
        ],
    ),
    "clipped above": ("rail", lambda y, s, r: np.minimum(y, np.quantile(y, 0.9))),
    "clipped below": ("rail", lambda y, s, r: np.maximum(y, np.quantile(y, 0.1))),
    "coarse": ("step", lambda y, s, r: np.round(y / (0.1 * s)) * 0.1 * s),
    "very coarse": ("step", lambda y, s, r: np.round(y / (0.5 * s)) * 0.5 * s),
    "drift": ("trend", lambda y, s, r: y + np.linspace(0, 8 * s, len(y))),
}
INPUTS: dict[str, tuple[str, Fault]] = {
    "u: one glitch": ("spike", lambda u, s, r: _at(u, _some(r, len(u), 1), 50 * s)),
    "u: two glitches": ("spike", lambda u, s, r: _at(u, _some(r, len(u), 2), np.array([-50 * s, 80 * s]))),
    "u: 9999": ("word", lambda u, s, r: _at(u, _some(r, len(u), 2), 9999.0)),
}
PROPERTIES = ("step", "slow", "fast", "trend")


def record(plant: str, u: FloatArray, y: FloatArray) -> Dataset:
    """Return a data set of one run."""
    spec = PlantSpec((Channel("u", "N"),), (Channel("y", "m"),), PLANTS[plant][1])
    return Dataset(plant, (Run(Trajectory(np.arange(len(u)) * spec.sample_time, u[:, None], y[:, None], spec)),))


def main() -> None:
    """Print how many faults are named, and what clean records bring."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--plants", type=int, default=len(PLANTS))
    parser.add_argument("--rows", type=int, nargs="*", default=[250, 1000, 2000])
    parser.add_argument("--seeds", type=int, default=1)
    asked = parser.parse_args()
    clean, named, other, total = Counter[str](), Counter[str](), Counter[str](), Counter[str]()
    looked = 0
    for plant in list(PLANTS)[: asked.plants]:
        for rows in asked.rows:
            for seed in range(asked.seeds):
                rng = np.random.default_rng([seed, rows])
                for kind in EXCITATIONS:
                    u = excitation(kind, rows, PLANTS[plant][1], PLANTS[plant][2], rng)
                    exact = simulated(plant, u)
                    spread = float(np.std(exact)) or 1.0
                    for noise in (0.0, *NOISE):
                        y = exact + noise * spread * rng.standard_normal(rows)
                        looked += 1
                        for odd in examined(record(plant, u, y)).oddities or ():
                            if odd.fault:
                                clean[odd.kind] += 1
                                print(f"false: {plant}, {kind}, {rows} rows, noise {noise:g}: {odd.words}", flush=True)
                    if kind not in ("multisine", "prbs"):
                        continue
                    y = exact + 1e-3 * spread * rng.standard_normal(rows)
                    faults = [(name, what, u, make(y, spread, rng)) for name, (what, make) in OUTPUTS.items()]
                    if kind == "multisine":
                        made = PLANTS[plant][2]
                        faults += [(name, what, make(u, made, rng), y) for name, (what, make) in INPUTS.items()]
                    for name, what, logged, read in faults:
                        found = examined(record(plant, logged, read)).oddities or ()
                        total[name] += 1
                        named[name] += any(odd.kind == what for odd in found)
                        wrong = [odd.kind for odd in found if odd.kind != what and odd.fault]
                        other[name] += bool(wrong)
                        if wrong or not any(odd.kind == what for odd in found):
                            print(f"{name}: {plant}, {kind}, {rows} rows: {[odd.words for odd in found]}", flush=True)
    for name in total:
        print(f"{name:22s} named {named[name]:3d} of {total[name]:3d}, with another fault besides {other[name]:3d}")
    print(f"clean records: {looked}, false faults: {dict(clean) or 'none'}")


if __name__ == "__main__":
    main()
