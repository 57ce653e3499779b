"""Adequacy: a disturbance is not blamed on physics, a missing force is seen."""

from __future__ import annotations

import numpy as np
from scipy.signal import lfilter

from harness.diagnosis.adequacy import grade, hat_basis, predictable_part


def record(seed: int, n: int = 1500) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    v = np.asarray(lfilter([1.0], np.poly([0.97, 0.9]), rng.standard_normal(n + 300))[300:])
    disturbance = np.asarray(lfilter([1.0], [1.0, -0.97], rng.standard_normal(n + 300))[300:])
    return v / v.std(), disturbance[:, None] / disturbance.std()


def families(*records: np.ndarray) -> list[np.ndarray]:
    return [hat_basis(v, np.linspace(-2, 2, 7))[:, None, :] for v in records]


def test_a_coloured_residual_without_cause_is_a_disturbance() -> None:
    alarms = 0
    for seed in range(0, 100, 2):
        (v, r), (w, s) = record(seed), record(seed + 1)
        found, null = predictable_part(
            [r], [s], {"v": (families(v), families(w))}, rng=np.random.default_rng(seed), count=99
        )
        alarms += grade(found, null, [s], [0.1], rng=np.random.default_rng(0)).predictable
    assert alarms <= 2


def test_a_missing_force_is_predictable_and_graded_by_its_size() -> None:
    (v, r), (w, s) = record(0), record(1)
    for size, expected in ((0.3, "explained"), (1.2, "mostly_explained"), (6.0, "proxy_or_incomplete")):
        noisy = [0.2 * r + size * np.sign(v)[:, None], 0.2 * s + size * np.sign(w)[:, None]]
        found, null = predictable_part(
            noisy[:1], noisy[1:], {"v": (families(v), families(w))}, rng=np.random.default_rng(0), count=99
        )
        verdict = grade(found, null, noisy[1:], [1.0], rng=np.random.default_rng(0))
        assert verdict.grade == expected
        assert verdict.best is not None
        assert verdict.best.axes == "v"
