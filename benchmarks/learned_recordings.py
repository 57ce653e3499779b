"""Learned models on two public recordings, beside the named physics of the closed loop.

Run ``SYSID_HARNESS_DATA=... python benchmarks/learned_recordings.py [silverbox|cascaded-tanks]``. Prints the rms
of the free run on every run of the recording, the initial state estimated from the first 50 samples, and the CPU
time of the fit. Named physics (``sysid close-loop``): Silverbox 0.24 mV on the test multisine, tanks 0.244 V.
"""

from __future__ import annotations

import sys
import time

import numpy as np

from harness import registry
from harness.data import load_dataset
from harness.scoring import simulation_error
from harness.signals import Trajectory

CASES = {
    "silverbox": [
        ("arx", {"order": 4}),
        (
            "neural-output-error",
            {
                "order": 2,
                "hidden": 8,
                "outside": 2,
                "ridge": 1e-3,
                "starts": 3,
                "members": 1,
                "iterations": 60,
                "direct": True,
            },
        ),
        ("neural-state-space", {"order": 3, "hidden": 16, "window": 60, "direct": True, "steps": 2500}),
    ],
    "cascaded-tanks": [
        ("arx", {"order": 3}),
        ("gaussian-process", {"order": 2}),
        ("neural-output-error", {}),
        ("neural-state-space", {"order": 5, "hidden": 16, "window": 80, "batch": 32, "rate": 1e-2, "steps": 800}),
    ],
}
FIRST = 50
WHOLE = ("cascaded-tanks",)
"""Recordings whose validation run goes on where the estimation run ends, in one part of the benchmark: identifiers hold
out the end of their data themselves, so they get all of it, as published figures do. The test run is never learned
from, nor chosen by."""


def compare(name: str) -> None:
    """Print the table of one recording."""
    data = load_dataset(registry.dataset_path(name)).dataset
    learn = [one.measured() for one in data.estimation]
    if name in WHOLE:
        parts = [*learn, *(one.measured() for one in data.validation)]
        u, y = np.vstack([one.u for one in parts]), np.vstack([one.y for one in parts])
        learn = [Trajectory(np.arange(len(u)) * data.spec.sample_time, u, y, data.spec)]
    print(f"{data.name}: {sum(map(len, learn))} samples to learn from")
    for identifier, options in CASES[name]:
        started = time.process_time()
        model = registry.create("identifiers", identifier, **options).fit(learn, rng=np.random.default_rng(0))
        spent = time.process_time() - started
        errors = [
            f"{run.label or run.use} {1e3 * simulation_error(model, run.trajectory, initial_samples=FIRST).rms[0]:.2f}"
            for run in data
            if run.use != "estimation"
        ]
        print(f"  {identifier:20s} {spent:6.1f} s of CPU   free run, in thousandths of the unit: {'; '.join(errors)}")


if __name__ == "__main__":
    chosen = [name for name in sys.argv[1:] if name in CASES] or list(CASES)
    for case in chosen:
        compare(case)
