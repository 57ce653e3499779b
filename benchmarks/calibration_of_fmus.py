"""Known parameters of our own FMUs from noisy records: how many come back, and within their 95 % intervals.

Every case draws the truth within a factor of 2 of what the FMU declares, two records for estimation that begin
differently and one for validation, white noise of 1 % of the first record's
deviation, and searches from the declared values.

    python benchmarks/calibration_of_fmus.py [SEEDS]
"""

from __future__ import annotations

import sys
import time
from typing import Any

import numpy as np

from harness import calibrate, registry
from harness.rng import stream
from harness.signals import Dataset, Run, Trajectory
from plants.mockups import mockup

NOISE = 0.01
SAMPLES = 200
CASES: dict[str, dict[str, Any]] = {
    "pendulum": {
        "free": {"J": 0.05, "b": 0.02, "mgl": 1.0},
        "outputs": ["theta"],
        "dt": 0.02,
        "size": 0.3,
        "starts": [{"theta": 0.3}, {"omega": 1.0}, {}],
    },
    "mass_spring": {
        "free": {"m": 1.0, "c": 0.1, "k": 1.0},
        "outputs": ["q"],
        "dt": 0.05,
        "size": 1.0,
        "starts": [{}, {"q": 0.5}, {"v": -0.5}],
    },
    "drive": {
        "free": {"ML": 55.0, "Fv": 200.0},
        "outputs": ["q"],
        "dt": 5e-3,
        "size": 300.0,
        "starts": [{}, {"v": 0.2}, {}],
    },
    "two_tanks": {
        "free": {"k_pump": 0.04, "k_upper": 0.06, "k_lower": 0.06},
        "outputs": ["y"],
        "dt": 4.0,
        "size": 1.0,
        "starts": [{"upper": 2.0, "lower": 2.0}, {"upper": 4.0, "lower": 1.0}, {"upper": 3.0, "lower": 3.0}],
    },
    "cart_pole": {
        "free": {"mc": 1.0, "l": 0.5, "bx": 0.2},
        "outputs": ["x", "theta"],
        "dt": 0.02,
        "size": 2.0,
        "starts": [{"theta": 0.2}, {"v": 0.3}, {}],
    },
}


def records(
    name: str, case: dict[str, Any], truth: dict[str, float], version: int, rng: np.random.Generator
) -> Dataset:
    """Return three noisy records of an FMU with known parameters."""
    runs: list[Run] = []
    noise = np.zeros(0)
    file, options = mockup(name, version), {"sample_time": case["dt"], "outputs": case["outputs"]}
    with registry.create("plants", "fmu", path=file, parameters=truth, **options) as plant:
        for number, x0 in enumerate(case["starts"]):
            u = case["size"] * np.repeat(rng.normal(size=(SAMPLES // 10, plant.spec.nu)), 10, axis=0)
            u = np.abs(u) + 1.0 if name == "two_tanks" else u
            y = np.vstack([plant.reset(rng=rng, x0=x0), plant.rollout(u[:-1])])
            noise = NOISE * np.std(y, axis=0) if number == 0 else noise  # one sensor for all records
            y = y + noise * rng.normal(size=y.shape)
            record = Trajectory(case["dt"] * np.arange(SAMPLES), u, y, plant.spec)
            runs.append(Run(record, "validation" if number == 2 else "estimation"))
    return Dataset(name, tuple(runs))


def main() -> None:
    """Run all cases and print the table."""
    seeds = int(sys.argv[1]) if len(sys.argv) > 1 else 9
    print("model        cases  recovered  inside/intervals  worst deviation  validation rms over noise  CPU [s]")
    total = np.zeros(4, dtype=int)
    for name, case in CASES.items():
        cases, recovered, inside, intervals = 0, 0, 0, 0
        worst, ratios, begun = 0.0, [], time.process_time()
        for seed in range(seeds):
            rng = stream("benchmark", "calibration", name, seed)
            truth = {
                key: value * float(np.exp(rng.uniform(-np.log(2), np.log(2)))) for key, value in case["free"].items()
            }
            version = 2 + seed % 2
            data = records(name, case, truth, version, rng)
            found = calibrate(
                data, model=mockup(name, version), free=list(truth), seed=seed, options={"isolated": False}
            )
            cases += 1
            off = [abs(found.parameters[key] / value - 1) for key, value in truth.items()]
            recovered += max(off) < 0.1
            worst = max(worst, *off)
            for key, value in truth.items():
                interval = found.estimate.interval(key)
                if interval is not None:
                    intervals += 1
                    inside += interval[0] <= value <= interval[1]
            sigma = NOISE * np.std(data.runs[0].trajectory.y, axis=0)
            ratios += [a[0] / b for a, b in zip(found.errors_after["validation"][0].values(), sigma, strict=True)]
        spent = time.process_time() - begun
        print(f"{name:<12} {cases:>5}  {recovered:>9}  {inside:>7}/{intervals:<8}  {100 * worst:>13.2g} %  "
              f"{np.median(ratios):>25.3f}  {spent:>7.1f}", flush=True)  # fmt: skip
        total += [cases, recovered, inside, intervals]
    print(f"all          {total[0]:>5}  {total[1]:>9}  {total[2]:>7}/{total[3]:<8} ({100 * total[2] / total[3]:.1f} %)")


if __name__ == "__main__":
    main()
