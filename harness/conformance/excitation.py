"""Inputs that any plant can bear: within the declared ranges, held for a few samples, gentle."""

from __future__ import annotations

import numpy as np

from harness.signals import Channel, FloatArray, PlantSpec

STEPS = 60  # Samples of a run in a check.


def inputs_for(spec: PlantSpec, samples: int = STEPS, seed: int = 1) -> FloatArray:
    """Return inputs (N, nu) within the declared range of every channel, gentle where there is none."""
    rng = np.random.default_rng(seed)
    columns = [_values(channel, samples, rng) for channel in spec.inputs]
    return np.column_stack(columns) if columns else np.zeros((samples, 0))


def _values(channel: Channel, n: int, rng: np.random.Generator) -> FloatArray:
    if channel.kind == "category":
        first = int(channel.minimum) if np.isfinite(channel.minimum) else 0
        return rng.integers(first, channel.categories, size=n).astype(float)
    if channel.kind == "boolean":
        return rng.integers(2, size=n).astype(float)
    low = channel.minimum if np.isfinite(channel.minimum) else -1.0
    high = channel.maximum if np.isfinite(channel.maximum) else max(low, 0.0) + 1.0
    low = max(low, high - 2.0) if not np.isfinite(channel.minimum) else low
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    # a tenth of the range: an arm at full torque meets its limits within a few samples
    held = np.repeat(rng.uniform(-1, 1, n // 4 + 1), 4)[:n]
    values = middle + 0.1 * half * held
    return np.round(values) if channel.kind == "integer" else values
