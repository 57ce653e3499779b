"""The acceptance rule and its parts."""

from __future__ import annotations

import numpy as np
import pytest

from harness.diagnosis.accept import (
    Comparison,
    Interval,
    bic,
    block_interval,
    compare_blocks,
    information_samples,
    judge,
)


def good(**changes: object) -> dict[str, object]:
    base: dict[str, object] = {
        "converged": True,
        "delta_bic": 50.0,
        "comparison": Comparison(0.3, 0.001),
        "main": Interval(0.5, 0.4, 0.6),
        "sign": 1,
        "minimum": 0.0,
        "maximum": np.inf,
        "surrogate_p": 0.003,
    }
    return {**base, **changes}


def test_a_good_candidate_is_accepted() -> None:
    assert judge(**good()).accepted  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"converged": False}, "converge"),
        ({"delta_bic": 9.0}, "delta BIC"),
        ({"comparison": Comparison(0.005, 0.001)}, "1 %"),
        ({"comparison": Comparison(-0.1, 1.0)}, "grows"),
        ({"comparison": Comparison(0.3, 0.02)}, "chance"),
        ({"main": Interval(0.5, -0.1, 1.1)}, "includes 0"),
        ({"main": Interval(-0.5, -0.6, -0.4), "minimum": -np.inf}, "sign"),
        ({"maximum": 0.5}, "bound"),
        ({"surrogate_p": 0.2}, "surrogates"),
    ],
)
def test_each_failing_condition_rejects_with_its_reason(change: dict[str, object], word: str) -> None:
    found = judge(**good(**change))  # type: ignore[arg-type]
    assert not found.accepted
    assert len(found.reasons) == 1
    assert word in found.reasons[0]


def test_bootstrap_false_alarm_rate_on_equal_models_is_small() -> None:
    alarms = 0
    for seed in range(300):
        rng = np.random.default_rng(seed)
        r = rng.standard_normal((800, 1))
        other = r + 0.1 * rng.standard_normal((800, 1))
        other *= np.sqrt(np.sum(r**2) / np.sum(other**2))
        alarms += compare_blocks([r], [other], rng=rng, draws=500).p <= 0.01
    assert alarms <= 6


def test_equal_models_are_indistinguishable() -> None:
    r = np.random.default_rng(0).standard_normal((500, 1))
    assert not compare_blocks([r], [r], rng=np.random.default_rng(1)).distinguishable


def test_information_counts_independent_samples_when_the_residual_is_coloured() -> None:
    from scipy.signal import lfilter

    r = np.asarray(lfilter([1.0], [1.0, -0.99], np.random.default_rng(0).standard_normal(5000)))[:, None]
    assert information_samples([r], 1.0) == 5000
    assert information_samples([r], 3.0) < 200
    assert information_samples([r], None) < 200


def test_bic_does_not_depend_on_the_scale_of_an_output() -> None:
    r = np.random.default_rng(0).standard_normal((200, 2))
    a = bic([r], 2, 400) - bic([0.9 * r], 3, 400)
    b = bic([r * [1, 1000]], 2, 400) - bic([0.9 * r * [1, 1000]], 3, 400)
    assert a == pytest.approx(b)


@pytest.mark.parametrize("pole", [0.0, 0.95])
def test_intervals_cover_on_white_and_on_coloured_residuals(pole: float) -> None:
    from scipy.signal import lfilter

    covered = 0
    for seed in range(200):
        rng = np.random.default_rng(seed)
        t = np.arange(2000) * 0.01
        x = np.stack([np.sin(t), t / 20], axis=1)
        e = np.asarray(lfilter([1.0], [1.0, -pole], rng.standard_normal(2200))[200:])
        y = x @ [1.0, -2.0] + e
        theta = np.linalg.lstsq(x, y, rcond=None)[0]
        interval = block_interval(theta, [x[:, None, :]], [(y - x @ theta)[:, None]])
        covered += interval[0].low <= 1.0 <= interval[0].high
    assert covered >= 0.88 * 200  # nominal 95 %; Gauss-Newton alone covers about 25 % at pole 0.95


def test_a_direction_the_data_do_not_move_has_no_interval() -> None:
    j = np.zeros((100, 1, 2))
    j[:, 0, 0] = 1.0
    interval = block_interval(np.array([1.0, 2.0]), [j], [np.ones((100, 1))])
    assert np.isfinite(interval[0].high)
    assert interval[1].high == np.inf
