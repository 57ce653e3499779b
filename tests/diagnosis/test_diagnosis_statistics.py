"""Each statistic of the diagnosis against its known distribution, on seeds below 1000."""

from __future__ import annotations

import numpy as np
import pytest

from harness.diagnosis import policy
from harness.diagnosis.policy import described
from harness.diagnosis.runs import residual_tests as tests

REPEATS = 400


def rate(p_values: list[float], level: float = 0.05) -> float:
    return float(np.mean(np.array(p_values) <= level))


def coloured(n: int, rng: np.random.Generator, pole: float = 0.95) -> np.ndarray:
    from scipy.signal import lfilter

    return np.asarray(lfilter([1.0], [1.0, -pole], rng.standard_normal(n + 200))[200:])


def test_whiteness_tests_alarm_at_their_level_on_white_residuals() -> None:
    whiteness, inputs, squares, steady, line = [], [], [], [], []
    for seed in range(REPEATS):
        rng = np.random.default_rng(seed)
        r, u = rng.standard_normal(600), coloured(600, rng)
        y = coloured(600, rng)
        whiteness.append(tests.ljung_box(r).p)
        inputs.append(tests.input_correlation(u, r).p)
        squares.append(tests.higher_order(u, y, r)[0].p)
        steady.append(tests.cusum_of_squares(r)[2].p)
        line.append(tests.fisher_g(r, 0.01).p)
    for found in (whiteness, inputs, squares, steady):
        assert 0.015 < rate(found) < 0.1
    assert rate(line) < 0.2  # the running median makes it liberal; a line must also stand on validation


def test_each_test_sees_what_it_is_for() -> None:
    rng = np.random.default_rng(7)
    n = 2000
    u, e = coloured(n, rng), rng.standard_normal(n)
    late = np.r_[e[:1000], 2 * e[1000:]]
    assert tests.ljung_box(coloured(n, rng, 0.3)).p < 1e-6
    assert tests.input_correlation(u, e + 0.1 * np.roll(u, 3)).p < 1e-6
    assert tests.higher_order(u, u, e + 0.05 * u**2)[0].p < 1e-6
    assert tests.cusum_of_squares(late)[2].p < 1e-6
    path, band, _ = tests.cusum_of_squares(late)
    assert np.abs(path).max() > band
    found = tests.fisher_g(e + 0.5 * np.sin(2 * np.pi * 1.7 * np.arange(n) * 0.01), 0.01)
    assert found.p < 1e-6
    assert found.omega == pytest.approx(2 * np.pi * 1.7, abs=2 * np.pi / (n * 0.01))


def test_fisher_probability_agrees_with_simulation() -> None:
    rng = np.random.default_rng(3)
    power = rng.exponential(size=(20000, 50))
    g = power.max(axis=1) / power.sum(axis=1)
    level = float(np.quantile(g, 0.95))
    assert tests._fisher_p(level, 50) == pytest.approx(0.05, abs=0.006)


def test_effective_samples_of_white_and_of_first_order_noise() -> None:
    rng = np.random.default_rng(11)
    assert tests.effective_samples(rng.standard_normal(20000)) > 17000
    # N (1 - a) / (1 + a) independent samples in an AR(1) of pole a
    assert tests.effective_samples(coloured(40000, rng, 0.9)) == pytest.approx(40000 * 0.1 / 1.9, rel=0.25)


def test_detection_is_by_effect_size_and_short_records_get_their_chance_value() -> None:
    assert tests.detect(1.2, 0.0, 5000)
    assert tests.detect(None, 0.11, 5000)
    assert not tests.detect(1.1, 0.09, 5000)
    assert not tests.detect(None, 0.15, 300)


def test_no_two_numbers_of_the_policy_share_a_name_and_each_has_a_reason() -> None:
    groups = [described(one) for one in (policy.POLICY, policy.EFFORT, policy.DATA_POLICY, policy.RUN_POLICY)]
    names = [name for group in groups for name in group]
    assert len(names) == len(set(names)), "one would hide the other in report.json"
    assert all(number["reason"] and number["source"] for group in groups for number in group.values())
