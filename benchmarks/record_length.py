"""Does the record length that a pilot asks for reach the accuracy: 100 pilots each of four plants, and what followed.

    python benchmarks/record_length.py [draws [base]]        (100 by default; seeds from 10000 on)

Every draw has a pilot of its own, from which `sysid analyse record-length` says how long to record for 5 %; a fresh
record of that length is made and fitted in the same way. Counted is how often the error of the quantity that took
longest is below 5 %, and how often all are: at the length by the pilot (`samples`: 95 % where the pilot is right, less
where it flattered) and at the `safe` one. The last columns are the length that was asked for over the one at which
95 % really keep 5 % (from the errors of all long records, as they fall with the root of the length), and its spread.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from harness import registry
from harness.signals import Channel, Dataset, FloatArray, PlantSpec, Run, Trajectory
from identifiers.linear.length.quantities import items_of_matrices
from identifiers.linear.length.record_length import RecordLength

ACCURACY, BASE = 0.05, 10_000


@dataclass(frozen=True)
class Case:
    """A plant, its pilot, and what is asked."""

    record: Callable[[int, int], Trajectory]
    pilot: int
    asked: RecordLength
    truth: dict[str, FloatArray]


def linear(a: Any, b: Any, c: Any, noise: float, process: float = 0.0) -> Callable[[int, int], Trajectory]:
    """Return a maker of records of a linear plant under white inputs, with noise of sensors and process."""
    a, b, c = (np.asarray(m, dtype=float) for m in (a, b, c))
    spec = PlantSpec(
        tuple(Channel(f"u{j}") for j in range(b.shape[1])), tuple(Channel(f"y{i}") for i in range(len(c))), 0.1
    )

    def record(samples: int, seed: int) -> Trajectory:
        rng, settle = np.random.default_rng(seed), 200
        n = samples + settle
        u, x, y = rng.normal(size=(n, b.shape[1])), np.zeros(len(a)), np.zeros((n, len(c)))
        pushed = process * rng.normal(size=(n, len(a)))
        for k in range(n):
            y[k] = c @ x
            x = a @ x + b @ u[k] + pushed[k]
        y += noise * rng.normal(size=y.shape)
        return Trajectory(np.arange(samples) * 0.1, u[settle:], y[settle:], spec)

    return record


def truth_of(a: Any, b: Any, c: Any, quantity: Any, outputs: int, inputs: int) -> dict[str, FloatArray]:
    """Return true values by name."""
    spec = PlantSpec(
        tuple(Channel(f"u{j}") for j in range(inputs)), tuple(Channel(f"y{i}") for i in range(outputs)), 0.1
    )
    matrices = (*(np.asarray(m, dtype=float) for m in (a, b, c)), np.zeros((outputs, inputs)))
    return {item.name: item.value for item in items_of_matrices(matrices, spec, quantity)[0]}  # type: ignore[arg-type]


def swinging(samples: int, seed: int) -> Trajectory:
    """Return a record of a pendulum under steps of its torque, noise 0.2 rad."""
    from harness.physics.models import pendulum

    system, rng = pendulum().system(), np.random.default_rng(seed)
    u = np.repeat(rng.normal(size=(samples // 10 + 1, 1)), 10, axis=0)[:samples] * 0.3
    y = system.simulator(0.05).rollout([0.1, 0.05, 1.0], [0.3, 0.0], u)
    y = y + 0.2 * rng.normal(size=y.shape)
    return Trajectory(np.arange(samples) * 0.05, u, y, PlantSpec(system.inputs, system.outputs, 0.05))


def cases() -> dict[str, Case]:
    """Return the plants."""
    first = ([[0.9]], [[0.4]], [[1.0]])
    two = (
        [[0.9, 0.1, 0.0], [0.0, 0.8, 0.2], [0.1, 0.0, 0.7]],
        [[1.0, 0.2], [0.0, 1.0], [0.5, 0.2]],
        [[1.0, 0.0, 0.3], [0.2, 1.0, 0.0]],
    )
    turning = ([[0.92, 0.25], [-0.25, 0.92]], [[0.0], [1.0]], [[1.0, 0.0]])
    swing = {"J": 0.1, "b": 0.05, "mgl": 1.0}
    return {
        "first order, n4sid": Case(
            linear(*first, noise=0.6, process=0.1),
            600,
            RecordLength(quantity="gain", options={"order": 1}),
            truth_of(*first, "gain", 1, 1),
        ),
        "two by two, n4sid": Case(
            linear(*two, noise=1.0, process=0.1),
            1500,
            RecordLength(quantity="gain", options={"order": 3}),
            truth_of(*two, "gain", 2, 2),
        ),
        "oscillator, prediction-error": Case(
            linear(*turning, noise=4.0),
            400,
            RecordLength(quantity="pole", identifier="prediction-error", options={"order": 2}),
            truth_of(*turning, "pole", 1, 1),
        ),
        "pendulum, output-error": Case(
            swinging,
            200,
            RecordLength(quantity="parameter", identifier="output-error", options={"model": "pendulum"}),
            {name: np.array([value]) for name, value in swing.items()},
        ),
    }


def errors_of(record: Trajectory, case: Case) -> dict[str, float]:
    """Return the relative errors of a fit to a record."""
    made: Any = registry.create("identifiers", case.asked.identifier, **dict(case.asked.options))
    model = made.fit([record], rng=np.random.default_rng(0))
    if case.asked.quantity == "parameter":
        found = {name: np.array([value]) for name, value in model.parameters.items()}
    else:
        items, _ = items_of_matrices(model.matrices, record.spec, case.asked.quantity)
        found = {item.name: item.value for item in items}
    return {
        name: float(np.linalg.norm(found[name] - value) / np.linalg.norm(value))
        if name in found and found[name].shape == value.shape
        else np.inf
        for name, value in case.truth.items()
    }


def main() -> None:
    draws = int(sys.argv[1]) if len(sys.argv) > 1 else 100
    base = int(sys.argv[2]) if len(sys.argv) > 2 else BASE
    print(f"{'plant':30} {'pilot':>6} {'now %':>6} {'samples':>8} {'kept %':>7} {'all %':>6} {'safe':>7} {'kept %':>7} "
          f"{'all %':>6} {'asked/needed':>13} {'5 to 95 %':>13} {'CPU s':>6}")  # fmt: skip
    for name, case in cases().items():
        kept: dict[str, list[bool]] = {"samples": [], "safe": []}
        every: dict[str, list[bool]] = {"samples": [], "safe": []}
        lengths: dict[str, list[float]] = {"samples": [], "safe": []}
        now, scaled, spent = [], [], []
        for draw in range(draws):
            seed = base + 1000 * draw
            start = time.process_time()
            pilot = Dataset("pilot", (Run(case.record(case.pilot, seed)),))
            rows = case.asked.of(pilot, rng=np.random.default_rng(seed)).rows
            spent.append(time.process_time() - start)
            worst = max(rows, key=lambda row: float(row["samples"]))
            now.append(worst["now [%]"])
            for number, which in enumerate(kept):
                length = int(worst[which])
                errors = errors_of(case.record(length, seed + 1 + number), case)
                kept[which].append(errors[worst["what"]] <= ACCURACY)
                every[which].append(max(errors.values()) <= ACCURACY)
                lengths[which].append(length)
                scaled.append(errors[worst["what"]] * np.sqrt(length))
        needed = (float(np.quantile(scaled, 0.95)) / ACCURACY) ** 2
        ratio = np.array(lengths["samples"]) / needed
        edges = np.quantile(ratio, [0.05, 0.95])
        text = f"{name:30} {case.pilot:>6} {np.median(now):>6.1f}"
        for which in kept:
            text += f" {np.median(lengths[which]):>{8 if which == 'samples' else 7}.0f}"
            text += f" {100 * np.mean(kept[which]):>7.1f} {100 * np.mean(every[which]):>6.1f}"
        text += f" {np.median(ratio):>13.2f} {edges[0]:>6.2f} {edges[1]:>6.2f} {np.median(spent):>6.2f}"
        print(text, flush=True)


if __name__ == "__main__":
    main()
