"""How often the 95 % intervals of mechanical estimates hold the truth, over simulated records; how often none is given.

Run: python benchmarks/coverage_of_estimates.py [records [model [identifier]]]   (200 by default; seeds 10 000 on)
"""

from __future__ import annotations

import sys

import numpy as np

from harness.errors import FitError
from harness.estimate import estimate_of
from harness.physics import load_model
from harness.signals import Channel, PlantSpec, Trajectory
from identifiers.grey_box import OutputError
from identifiers.lumped import lumped_energy, lumped_momentum, lumped_torque

NOISE_POSITION, NOISE_RATE = 1e-3, 1e-2
SAMPLES, DT = 1500, 0.01
COPIES = 40


def record(model: str, rates: bool, seed: int) -> tuple[Trajectory, dict[str, float]]:
    """Return a record of a model at its nominal values under a held random force, with sensor noise."""
    system = load_model(model)
    rng = np.random.default_rng(seed)
    size = 10.0 if model == "cart-pole" else 1.0
    u = size * np.repeat(rng.uniform(-1, 1, size=(SAMPLES // 10, 1)), 10, axis=0)
    n = len(system.coordinates)
    x = system.simulator(DT, substeps=2).states(system.vector(), 0.2 * rng.normal(size=2 * n), u)
    names = (*system.outputs, *(Channel(f"{one.name}_rate", f"{one.unit}/s") for one in system.outputs))
    keep = 2 * n if rates else n
    noise = np.repeat([NOISE_POSITION, NOISE_RATE], n)[:keep]
    spec = PlantSpec(system.inputs, names[:keep], DT)
    y = x[:, :keep] + noise * rng.normal(size=(SAMPLES, keep))
    return Trajectory(np.arange(SAMPLES) * DT, u, y, spec), system.values()


def _within(held: int, given: int) -> bool:
    """Return True unless the share lies outside 90 to 98 % by more than two standard deviations of so many records."""
    low = 0.90 * given - 2 * np.sqrt(0.90 * 0.10 * given)
    high = 0.98 * given + 2 * np.sqrt(0.98 * 0.02 * given)
    return bool(low <= held <= high)


def main() -> None:
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 200
    makers = {
        "lumped-torque": lambda name: lumped_torque(name, intervals=COPIES),
        "lumped-energy": lambda name: lumped_energy(name, intervals=COPIES),
        "lumped-momentum": lambda name: lumped_momentum(name, intervals=COPIES),
        "output-error": lambda name: OutputError(model=name),
    }
    for model, rates in (("pendulum", False), ("cart-pole", True)):
        for identifier, make in makers.items():
            if any(chosen not in (model, identifier) for chosen in sys.argv[2:]):
                continue
            held: dict[str, int] = {}
            given = refused = 0
            for seed in range(10_000, 10_000 + count):
                data, truth = record(model, rates, seed)
                try:
                    found = estimate_of(make(model).fit([data], rng=np.random.default_rng(seed)))
                except FitError:
                    refused += 1
                    continue
                if found is None or found.intervals is None:
                    continue
                given += 1
                for name in found.names:
                    low, high = found.interval(name) or (np.nan, np.nan)
                    held[name] = held.get(name, 0) + (low <= truth[name] <= high)
            share = ", ".join(f"{name} {100 * n / given:.1f} %" for name, n in held.items()) or "-"
            print(f"{model:10} {identifier:16} intervals in {given} of {count}, refused {refused}: {share}", flush=True)
            outside = [name for name, n in held.items() if given and not _within(n, given)]
            if outside:
                print(f"{'':27} not 90 to 98 %, by more than chance: {', '.join(outside)}", flush=True)


if __name__ == "__main__":
    main()
