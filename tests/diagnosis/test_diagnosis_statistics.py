"""Each statistic of the diagnosis against its known distribution, on seeds below 1000."""

from __future__ import annotations

import numpy as np
import pytest

from harness.diagnosis.effort import EFFORT
from harness.diagnosis.number import described
from harness.diagnosis.policy import DATA_POLICY, POLICY, RUN_POLICY
from harness.diagnosis.runs import residual_tests as tests

REPEATS = 400


def rate(p_values: list[float], level: float = 0.05) -> float:
    return float(np.mean(np.array(p_values) <= level))


def coloured(n: int, rng: np.random.Generator, pole: float = 0.95) -> np.ndarray:
    from scipy.signal import lfilter

    return np.asarray(lfilter([1.0], [1.0, -pole], rng.standard_normal(n + 200))[200:])


def test_whiteness_tests_alarm_at_their_level_on_white_residuals() -> None:
    whiteness, inputs, steady = [], [], []
    for seed in range(REPEATS):
        rng = np.random.default_rng(seed)
        r, u = rng.standard_normal(600), coloured(600, rng)
        whiteness.append(tests.ljung_box(r).p)
        inputs.append(tests.input_correlation(u, r).p)
        steady.append(tests.cusum_of_squares(r)[2].p)
    for found in (whiteness, inputs, steady):
        assert 0.015 < rate(found) < 0.1


def test_a_record_shorter_than_the_lags_is_tested_over_fewer() -> None:
    rng = np.random.default_rng(3)
    found = tests.input_correlation(rng.standard_normal(24), rng.standard_normal(24))
    assert 0 < found.dof <= 13
    assert 0 < found.p < 1


def test_each_test_sees_what_it_is_for() -> None:
    rng = np.random.default_rng(7)
    n = 2000
    u, e = coloured(n, rng), rng.standard_normal(n)
    late = np.r_[e[:1000], 2 * e[1000:]]
    assert tests.ljung_box(coloured(n, rng, 0.3)).p < 1e-6
    assert tests.input_correlation(u, e + 0.1 * np.roll(u, 3)).p < 1e-6
    assert tests.cusum_of_squares(late)[2].p < 1e-6
    path, band, _ = tests.cusum_of_squares(late)
    assert np.abs(path).max() > band


def test_effective_samples_of_white_and_of_first_order_noise() -> None:
    rng = np.random.default_rng(11)
    assert tests.effective_samples(rng.standard_normal(20000)) > 17000
    # N (1 - a) / (1 + a) independent samples in an AR(1) of pole a
    assert tests.effective_samples(coloured(40000, rng, 0.9)) == pytest.approx(40000 * 0.1 / 1.9, rel=0.25)


def test_no_two_numbers_of_the_policy_share_a_name_and_each_has_a_reason() -> None:
    groups = [described(one) for one in (POLICY, EFFORT, DATA_POLICY, RUN_POLICY)]
    names = [name for group in groups for name in group]
    assert len(names) == len(set(names)), "one would hide the other in report.json"
    assert all(number["reason"] and number["source"] for group in groups for number in group.values())
