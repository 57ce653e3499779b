"""What the tests of calibration share: records of our own FMUs with known parameters."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import pytest

from harness import registry
from harness.signals import Dataset, Run, Trajectory

Records = Callable[..., Dataset]


def made_records(
    plant: str,
    truth: Mapping[str, Any],
    *,
    outputs: Sequence[str],
    dt: float,
    n: int,
    starts: Sequence[Mapping[str, float]],
    noise: float,
    size: float,
    seed: int = 0,
) -> Dataset:
    rng = np.random.default_rng(seed)
    runs = []
    with registry.create("plants", plant, sample_time=dt, outputs=outputs, **truth) as made:
        for number, x0 in enumerate(starts):
            u = size * np.repeat(rng.normal(size=(n // 20 + 1, made.spec.nu)), 20, axis=0)[:n]
            y = np.vstack([made.reset(rng=rng, x0=x0), made.rollout(u[:-1])])
            record = Trajectory(np.arange(n) * dt, u, y + noise * rng.normal(size=y.shape), made.spec)
            last = number == len(starts) - 1 and len(starts) > 1
            runs.append(Run(record, "validation" if last else "estimation"))
    return Dataset("records", tuple(runs))


@pytest.fixture(scope="session")
def records() -> Records:
    return made_records
