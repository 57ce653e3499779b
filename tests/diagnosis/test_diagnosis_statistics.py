"""Each statistic of the diagnosis against its known distribution, on seeds below 1000."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import kolmogorov
from scipy.stats import chi2

from harness.diagnosis.effort import EFFORT
from harness.diagnosis.number import described
from harness.diagnosis.policy import DATA_POLICY, POLICY, RUN_POLICY
from harness.diagnosis.runs import residual_tests as tests
from harness.diagnosis.runs.closed_loop_bias import Shift, _autoregression, _spread, laguerre

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


def test_correlations_are_the_sums_that_their_formulas_say() -> None:
    rng = np.random.default_rng(5)
    u, r = rng.standard_normal(40) + 2.0, rng.standard_normal(40) - 1.0
    x, e = u - u.mean(), r - r.mean()
    rho = [e[k:] @ e[: 40 - k] / (e @ e) for k in range(6)]
    assert tests.autocorrelation(r, 5) == pytest.approx(rho)
    assert tests.max_autocorrelation(r, 5) == pytest.approx(max(map(abs, rho[1:])))
    scale = np.sqrt((x @ x) * (e @ e))
    later = [x[: 40 - k] @ e[k:] / scale for k in range(4)]  # the residual after the input
    earlier = [x[k:] @ e[: 40 - k] / scale for k in range(3, 0, -1)]
    assert tests.cross_correlation(u, r, 3) == pytest.approx([*earlier, *later])
    assert tests.cross_correlation(u, r, 0) == pytest.approx(later[:1])
    found = tests.ljung_box(r, 5, fitted=2)
    q = 40 * 42 * sum(one**2 / (40 - k) for k, one in enumerate(rho[1:], 1))
    assert (found.statistic, found.dof, found.p) == pytest.approx((q, 3, chi2.sf(q, 3)))
    rows = np.column_stack([x[3 - k : 40 - k] for k in range(4)])
    rows, cut = rows - rows.mean(axis=0), r[3:] - r[3:].mean()
    explained = rows @ np.linalg.lstsq(rows, cut, rcond=None)[0]
    q = 37 * (explained @ explained) / (cut @ cut)
    found = tests.input_correlation(u, r, 3)
    assert (found.statistic, found.dof, found.p) == pytest.approx((q, 4, chi2.sf(q, 4)))
    path, band, found = tests.cusum_of_squares(r)
    sums = [(r[: k + 1] ** 2).sum() / (r @ r) - (k + 1) / 40 for k in range(40)]
    assert path == pytest.approx(np.array(sums))
    assert (band, found.statistic) == pytest.approx((2.58 / np.sqrt(40), np.abs(sums).max()))
    spread = (r**2).std() / (r**2).mean()
    assert found.p == pytest.approx(kolmogorov(np.abs(sums).max() * np.sqrt(40) / spread))


def test_units_of_residual_and_input_change_no_test() -> None:
    rng = np.random.default_rng(6)
    u, r = coloured(300, rng), rng.standard_normal(300)
    plain, small = (
        [tests.ljung_box(a * r).p, tests.input_correlation(a * u, a * r).p, tests.cusum_of_squares(a * r)[2].p,
         tests.effective_samples(a * r), *tests.autocorrelation(a * r, 3), *tests.cross_correlation(a * u, a * r, 3)]
        for a in (1.0, 1e-6)
    )  # fmt: skip
    assert small == pytest.approx(plain)


def test_of_a_residual_that_is_nothing_no_test_says_anything() -> None:
    nothing, u = np.zeros(50), np.random.default_rng(0).standard_normal(50)
    assert tests.autocorrelation(nothing, 3).tolist() == [1.0, 0.0, 0.0, 0.0]
    assert tests.cross_correlation(u, nothing, 2).tolist() == [0.0] * 5
    for found in (tests.input_correlation(u, nothing), tests.cusum_of_squares(nothing)[2]):
        assert np.isnan(found.p)
        assert found.to_dict()["p"] is None
    assert tests.cusum_of_squares(np.ones(50))[2].to_dict()["p"] is None, "its squares do not scatter"
    assert tests.input_correlation(np.ones(50), u).dof == 0, "an input that stands still tells nothing"


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


# ---- the spread of what a closed loop shifts -------------------------------------------------------------------------


def vector_noise(count: int, n: int) -> np.ndarray:
    """Return draws (count, n, 2) of an autoregression of two outputs."""
    found = np.random.default_rng(0).standard_normal((count, n, 2)) @ MIX.T
    for k in range(1, n):
        found[:, k] += found[:, k - 1] @ MATRIX.T
    return found


MATRIX, MIX = np.array([[0.7, 0.2], [0.0, 0.5]]), np.array([[1.0, 0.0], [0.5, 2.0]])


def test_an_autoregression_of_two_outputs_is_found_with_its_noise() -> None:
    lags, noise = _autoregression(list(vector_noise(2, 6000)))
    assert len(lags) == 1
    assert lags[0] == pytest.approx(MATRIX, abs=0.03)
    assert noise == pytest.approx(MIX @ MIX.T, abs=0.1)


@pytest.mark.parametrize("windows", [1, 60])
def test_the_spread_of_weighted_sums_is_that_of_coloured_noise(windows: int) -> None:
    """In long records by an autoregression, over many windows by their own sums: as over many draws."""
    n, rng = 1500, np.random.default_rng(0)
    weights = np.repeat(rng.standard_normal((n // 10, 2, 2)), 10, axis=0).reshape(-1, 2)  # slow, as a motion is
    draws = vector_noise(400, n).reshape(400, -1)
    many = [_spread(weights, r, [n // windows] * windows, 2, 2) for r in draws[:4]]
    wanted = np.cov((draws @ weights).T)
    off = np.mean([found for found, _ in many], axis=0) - wanted
    assert np.abs(off / np.sqrt(np.outer(np.diag(wanted), np.diag(wanted)))).max() < 0.3
    free = {second for _, second in many}
    assert free == {58} if windows == 60 else 100 < min(free) <= max(free) < 1000


def test_the_first_of_laguerres_filters_is_a_lag_of_the_time_constant() -> None:
    out = laguerre(np.r_[1.0, np.zeros(300)], 0.1, 2.0, 4)
    assert out[1:, 0] / out[:-1, 0] == pytest.approx(np.exp(-0.1 / 2.0))
    assert out.T @ out == pytest.approx(np.eye(4), abs=1e-5)
    nine = laguerre(np.ones(800), 0.1, 2.0, 2)[-1]
    assert nine == pytest.approx(np.sqrt((1 + np.exp(-0.05)) / (1 - np.exp(-0.05))) * np.ones(2))


def test_a_shift_is_told_over_both_errors() -> None:
    told = Shift(2.0, 3.0, 0.5, 0.25).to_dict("kg")
    assert (told["shift_in_standard_errors"], told["shift_over_its_own_error"]) == (2.0, 4.0)
    assert (told["value"], told["instrumented"], told["unit"]) == (2.0, 3.0, "kg")
    untold = Shift(2.0, np.nan, 0.0, 0.0).to_dict("kg")
    assert [untold[name] for name in ("instrumented", "shift_in_standard_errors", "shift_over_its_own_error")] == [
        None
    ] * 3
