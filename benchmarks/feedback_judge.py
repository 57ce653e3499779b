"""Records that show only a controller, and records that show the plant: what every identifier makes of them.

    python benchmarks/feedback_judge.py [--seeds N] [--base SEED] [--slow] [--verbose]

Closed loops: six plants under seven controllers, moved by a disturbance or by their start alone, with sensor noise of 0
to 10 % of the outputs, and nothing beside the controller moving the inputs. A fit is *refused*, *warned* of in its
notes, or *right* (some controllers, of higher order than the plant or late by a sample, determine it: Soderstrom &
Stoica 1989, sec. 10.3); else it is *silent*: wrong. Every controller sees recorded outputs, with their sensors' noise
or without; one that sees what no sensor records looks like an excitation, and nothing in a record tells.

Open loops: the same plants under multisines, PRBS, noise, sweeps and steps; a refusal that names a law of the outputs
is a *false alarm*. Loops that are excited by a tenth of the input or more are counted last: at a tenth and 1000 samples
the excitation does not stand out of what sensors could have left. Seeds begin at 10000.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from harness import registry
from harness.errors import HarnessError
from harness.scoring import predict
from harness.signals import Channel, FloatArray, PlantSpec, Trajectory

NOISES = (0.0, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 0.05, 0.1)  # Of the sensors, relative to the outputs.
SAMPLES = 1000  # Of a record.
RIGHT = 0.5
"""One-step error under fresh inputs, relative to that of the last value, of a model that knows the plant still."""
BASE = 10_000  # First seed: those below may be used while tuning.
IDENTIFIERS: tuple[tuple[str, dict[str, Any]], ...] = (
    ("least-squares", {}),
    ("least-squares", {"method": "iv"}),
    ("least-squares", {"method": "tls"}),
    ("arx", {}),
    ("arx", {"order": 1}),
    ("arx", {"order": 4}),
    ("arx", {"na": 2, "nb": 2, "nk": 1}),
    ("dmdc", {}),
    ("dmdc", {"delays": 3}),
    ("edmdc", {}),
    ("n4sid", {}),
    ("n4sid", {"order": 2}),
    ("ho-kalman", {}),
    ("ho-kalman", {"observer": "auto"}),
    ("piecewise-affine", {}),
    ("stlsq", {"time": "discrete"}),
    ("narx", {}),
)
SLOW: tuple[tuple[str, dict[str, Any]], ...] = (
    ("prediction-error", {}),
    ("transfer-function", {}),
    ("wiener-hammerstein", {}),
)


@dataclass(frozen=True)
class Plant:
    """``x[k+1] = A x[k] + B u[k]``, ``y = C x``, and a state feedback that holds it."""

    a: FloatArray
    b: FloatArray
    c: FloatArray
    gain: FloatArray

    @property
    def spec(self) -> PlantSpec:
        """Its channels."""
        inputs = tuple(Channel(f"u{j}") for j in range(self.b.shape[1]))
        return PlantSpec(inputs, tuple(Channel(f"y{i}") for i in range(len(self.c))), 0.1)


def _plants() -> dict[str, Plant]:
    two = np.eye(2)
    return {
        "first order": Plant(np.array([[0.9]]), np.array([[0.1]]), np.eye(1), np.array([[4.0]])),
        "integrator": Plant(np.array([[1.0]]), np.array([[0.05]]), np.eye(1), np.array([[6.0]])),
        "oscillator": Plant(
            np.array([[0.95, 0.2], [-0.1, 0.8]]), np.array([[0.0], [1.0]]), two, np.array([[0.3, 0.5]])
        ),
        "oscillator, position": Plant(
            np.array([[0.98, 0.1], [-0.3, 0.95]]), np.array([[0.005], [0.1]]), two[:1], np.array([[1.5, 2.0]])
        ),
        "unstable": Plant(np.array([[1.05, 0.2], [0.0, 0.9]]), np.array([[0.0], [1.0]]), two, np.array([[1.2, 0.9]])),
        "two inputs": Plant(
            np.array([[0.9, 0.1, 0.0], [0.0, 0.8, 0.2], [0.1, 0.0, 0.7]]),
            np.array([[1.0, 0.0], [0.0, 1.0], [0.5, 0.2]]),
            np.eye(3),
            np.array([[0.5, 0.1, 0.0], [0.0, 0.4, 0.2]]),
        ),
    }


Controller = Callable[[Plant, FloatArray, FloatArray, dict[str, FloatArray]], FloatArray]


def _seen(plant: Plant, y: FloatArray) -> FloatArray:
    """Return the law's proportional part: of the outputs, where they are the states; else of the first."""
    gain = plant.gain if len(plant.c) == len(plant.a) else plant.gain[:, :1]
    return np.asarray(-gain @ y)


def _truth(plant: Plant, x: FloatArray, y: FloatArray, memory: dict[str, FloatArray]) -> FloatArray:
    return _seen(plant, plant.c @ x)


def _measured(plant: Plant, x: FloatArray, y: FloatArray, memory: dict[str, FloatArray]) -> FloatArray:
    return _seen(plant, y)


def _setpoint(plant: Plant, x: FloatArray, y: FloatArray, memory: dict[str, FloatArray]) -> FloatArray:
    return _seen(plant, y - 1.0)


def _integral(plant: Plant, x: FloatArray, y: FloatArray, memory: dict[str, FloatArray]) -> FloatArray:
    now = _seen(plant, y)
    memory["sum"] = memory.get("sum", np.zeros_like(now)) + 0.05 * now
    return np.asarray(now + memory["sum"])


def _derivative(plant: Plant, x: FloatArray, y: FloatArray, memory: dict[str, FloatArray]) -> FloatArray:
    now = _seen(plant, y)
    change = now - memory.get("last", now)
    memory["last"] = now
    return np.asarray(0.7 * now + 0.5 * change)


def _filtered(plant: Plant, x: FloatArray, y: FloatArray, memory: dict[str, FloatArray]) -> FloatArray:
    now = _seen(plant, y)
    memory["slow"] = 0.6 * memory.get("slow", now) + 0.4 * now
    return np.asarray(memory["slow"])


def _late(plant: Plant, x: FloatArray, y: FloatArray, memory: dict[str, FloatArray]) -> FloatArray:
    now = 0.5 * _seen(plant, y)
    before = memory.get("last", now)
    memory["last"] = now
    return before


CONTROLLERS: dict[str, Controller] = {
    "true outputs": _truth,
    "measured outputs": _measured,
    "setpoint": _setpoint,
    "PI": _integral,
    "PD": _derivative,
    "filtered": _filtered,
    "late": _late,
}
MOTIONS = ("white disturbance", "slow disturbance", "start alone")


def closed_loop(
    plant: Plant, controller: Controller, motion: str, noise: float, seed: int, dither: float = 0.0, n: int = SAMPLES
) -> Trajectory:
    """Return a record under a controller, with a dither of that share of the input beside it."""
    size, spread = np.zeros(plant.b.shape[1]), np.ones(len(plant.c))
    for turn in range(3):  # once to learn the sizes, then with noise and dither of their share
        rng = np.random.default_rng([seed, 7])
        x, slow, memory = rng.normal(size=len(plant.a)), np.zeros(len(plant.a)), {}
        states, u, y = np.zeros((n, len(x))), np.zeros((n, len(size))), np.zeros((n, len(plant.c)))
        for k in range(n):
            if motion == "start alone" and k % 50 == 0:
                x, memory = rng.normal(size=len(plant.a)), {}
            y[k] = plant.c @ x + noise * (turn > 0) * spread * rng.normal(size=len(plant.c))
            u[k] = controller(plant, x, y[k], memory) + dither * (turn > 0) * size * rng.normal(size=len(size))
            states[k] = x
            pushed = 0.1 * rng.normal(size=len(x))
            slow = 0.97 * slow + 0.2 * pushed
            x = plant.a @ x + plant.b @ u[k]
            x = x + (pushed if motion == "white disturbance" else slow if motion == "slow disturbance" else 0.0)
        size, spread = u.std(axis=0), (states @ plant.c.T).std(axis=0)
    return Trajectory(np.arange(n) * 0.1, u, y, plant.spec)


def records_of(plant: Plant, controller: Controller, motion: str, noise: float, seed: int) -> list[Trajectory]:
    """Return the records that one loop leaves: one, or runs of 50 samples from a start each."""
    whole = closed_loop(plant, controller, motion, noise, seed)
    if motion != "start alone":
        return [whole]
    return [whole[low : low + 50] for low in range(0, len(whole), 50)]


def excitation(kind: str, n: int, nu: int, rng: np.random.Generator) -> FloatArray:
    """Return an input (n, nu) of an open loop."""
    k = np.arange(n)[:, None]
    if kind.startswith("multisine"):
        lines = int(kind.split()[1])
        f = rng.permutation(np.linspace(0.004, 0.35, lines * nu)).reshape(nu, lines)
        phase = rng.uniform(0, 2 * np.pi, (nu, lines))
        return np.asarray(np.sin(2 * np.pi * k[..., None] * f + phase).sum(axis=2) * np.sqrt(2 / lines))
    if kind == "prbs":
        return np.repeat(rng.choice([-1.0, 1.0], (n // 5 + 1, nu)), 5, axis=0)[:n]
    if kind == "steps":
        return np.repeat(rng.uniform(-1.0, 1.0, (n // 50 + 1, nu)), 50, axis=0)[:n]
    if kind == "sweep":
        return np.asarray(np.sin(2 * np.pi * (0.002 * k + 0.2 * k**2 / (2 * n)) + np.arange(nu)))
    white = rng.normal(size=(n, nu))
    if kind == "noise":
        return white
    for row in range(1, n):  # noise of one pole at 0.95
        white[row] = 0.95 * white[row - 1] + 0.3 * white[row]
    return white


OPEN = ("multisine 3", "multisine 10", "multisine 30", "prbs", "steps", "sweep", "noise", "slow noise")


def open_loop(plant: Plant, kind: str, disturbed: float, noise: float, seed: int, n: int = SAMPLES) -> Trajectory:
    """Return an open-loop record; a plant that runs away is shown in runs of its stable part only."""
    rng = np.random.default_rng([seed, 11])
    a = plant.a / max(1.0, float(np.abs(np.linalg.eigvals(plant.a)).max()) / 0.97)
    u = excitation(kind, n, plant.b.shape[1], rng)
    x, y = np.zeros(len(a)), np.zeros((n, len(plant.c)))
    drive = disturbed * np.abs(plant.b).max()
    for k in range(n):
        y[k] = plant.c @ x
        x = a @ x + plant.b @ u[k] + drive * rng.normal(size=len(x))
    return Trajectory(np.arange(n) * 0.1, u, y + noise * y.std(axis=0) * rng.normal(size=y.shape), plant.spec)


def _names_a_law(error: HarnessError) -> bool:
    """Return True if a refusal blames a law of the outputs, not an input that excites too little."""
    text = str(error)
    return "beside the controller" in text or ("would leave" in text and " y" in text)


def _right(model: Any, plant: Plant, seed: int) -> bool:
    fresh = Plant(plant.a, plant.b, plant.c, plant.gain)
    record = closed_loop(fresh, _measured, "start alone", 0.0, seed, dither=3.0, n=300)
    try:
        foretold = predict(model, record, 1)
    except HarnessError:
        return False
    skip = [k for k in range(int(model.burn_in) + 2, 300) if k % 50 > int(model.burn_in) + 1]
    if not skip:
        skip = list(range(int(model.burn_in) + 2, 300))
    own = np.mean((record.y - foretold)[skip] ** 2, axis=0)
    last = np.mean((record.y - np.roll(record.y, 1, axis=0))[skip] ** 2, axis=0)
    return bool(np.sqrt(np.nan_to_num(own / last, nan=np.inf)).max() < RIGHT)


def outcome(name: str, options: dict[str, Any], records: list[Trajectory], plant: Plant, seed: int) -> str:
    """Return refused, warned, right or silent."""
    try:
        model: Any = registry.create("identifiers", name, **options).fit(records, rng=np.random.default_rng(0))
    except HarnessError as error:
        return "law" if _names_a_law(error) else "refused"
    notes = getattr(model, "notes", {})
    if notes.get("warning") or notes.get("warnings"):
        return "warned"
    return "right" if _right(model, plant, seed) else "silent"


def tables(
    seeds: int, identifiers: tuple[tuple[str, dict[str, Any]], ...], verbose: bool, base: int = BASE
) -> Iterator[str]:
    """Yield the lines of three tables: pure feedback, open loop, loops that are excited."""
    plants = _plants()
    pure: dict[int, Counter[str]] = {i: Counter() for i in range(len(identifiers))}
    by: dict[str, Counter[str]] = {}
    count = 0
    for number, ((plant_name, plant), (law_name, law)) in enumerate(
        (p, c) for p in plants.items() for c in CONTROLLERS.items()
    ):
        for level, noise in enumerate(NOISES):
            for turn in range(seeds):
                motion = MOTIONS[(number + level + turn) % 3]
                seed = base + 1000 * number + 10 * level + turn
                records = records_of(plant, law, motion, noise, seed)
                count += 1
                for i, (name, options) in enumerate(identifiers):
                    found = outcome(name, options, records, plant, seed)
                    pure[i][found] += 1
                    for key in (plant_name, law_name, f"noise {noise:g}", motion):
                        by.setdefault(key, Counter())[found] += 1
                    if verbose and found == "silent":
                        yield f"  silent: {name} {options} | {plant_name} | {law_name} | {motion} | {noise:g} | {seed}"
    yield f"pure feedback: {count} records of {SAMPLES} samples, {count * len(identifiers)} fits"
    yield f"{'identifier':44} {'refused':>8} {'warned':>7} {'right':>6} {'silent':>7}"
    for i, (name, options) in enumerate(identifiers):
        yield _line(f"{name} {options or ''}", pure[i])
    for key, counts in by.items():
        yield _line(f"  {key}", counts)

    alarms: dict[int, Counter[str]] = {i: Counter() for i in range(len(identifiers))}
    count, kinds = 0, Counter[str]()
    for plant_name, plant in plants.items():
        for kind in OPEN:
            for disturbed in (0.0, 0.3):
                for noise in (0.0, 1e-3, 0.05):
                    for turn in range(seeds):
                        count += 1
                        seed = base + 100_000 + 10 * count + turn
                        record = open_loop(plant, kind, disturbed, noise, seed)
                        for i, (name, options) in enumerate(identifiers):
                            found = outcome(name, options, [record], plant, seed)
                            alarms[i][found] += 1
                            if found == "law":
                                kinds[kind] += 1
                                if verbose:
                                    said = f"{plant_name} | {kind} | {disturbed} {noise} {seed}"
                                    yield f"  false: {name} {options} | {said}"
    yield f"\nopen loop: {count} records, {count * len(identifiers)} fits; false alarms by kind: {dict(kinds)}"
    yield f"{'identifier':44} {'false alarms':>12} {'other refusals':>15}"
    for i, (name, options) in enumerate(identifiers):
        yield f"{name} {options or ''}"[:44].ljust(44) + f" {alarms[i]['law']:>12} {alarms[i]['refused']:>15}"

    excited, count = Counter[str](), 0
    names: dict[str, Counter[str]] = {}
    for plant_name, plant in plants.items():
        for law_name, law in CONTROLLERS.items():
            for dither in (0.1, 0.3, 1.0):
                for noise in (1e-4, 1e-2):
                    count += 1
                    seed = base + 200_000 + count
                    record = closed_loop(plant, law, "white disturbance", noise, seed, dither)
                    for name, options in identifiers:
                        found = outcome(name, options, [record], plant, seed)
                        excited[found] += 1
                        names.setdefault(f"{name} {options or ''}", Counter())[found] += 1
                        if verbose and found == "law":
                            said = f"{plant_name} | {law_name} | dither {dither} {noise} {seed}"
                            yield f"  false: {name} {options} | {said}"
    yield f"\nloops that are excited: {count} records; {dict(excited)}"
    for key, counts in names.items():
        yield _line(key, counts)


def _line(title: str, counts: Counter[str]) -> str:
    refused = counts["law"] + counts["refused"]
    return f"{title[:44]:44} {refused:>8} {counts['warned']:>7} {counts['right']:>6} {counts['silent']:>7}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=1, help="records of every case")
    parser.add_argument("--base", type=int, default=BASE, help="first seed")
    parser.add_argument("--slow", action="store_true", help="identifiers that take seconds as well")
    parser.add_argument("--verbose", action="store_true", help="every wrong one by itself")
    given = parser.parse_args()
    for line in tables(given.seeds, IDENTIFIERS + (SLOW if given.slow else ()), given.verbose, given.base):
        print(line, flush=True)


if __name__ == "__main__":
    main()
