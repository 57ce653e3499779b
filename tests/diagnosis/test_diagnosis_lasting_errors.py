"""Errors that last: their density where readings are missing, and what is accepted beside one that remembers."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from linear_form import placed
from made_fits import FORM, NoForm, a_fit
from scipy.linalg import solve_discrete_lyapunov

from harness.diagnosis.policy import POLICY
from harness.diagnosis.search.coloured import Before, Coloured, coloured_likelihood
from harness.diagnosis.search.compare import coloured_gains, drifts, judged
from harness.diagnosis.search.fit import Fit, Jump
from harness.diagnosis.search.refusal import Kind
from harness.signals import FloatArray

USES = ("estimation", "validation")


def covariance(phi: FloatArray, deviation: float, n: int) -> FloatArray:
    """Return the covariance (n, n) of a stationary autoregression, by Lyapunov's equation of its companion matrix."""
    order = len(phi)
    companion = np.eye(order, k=-1)
    companion[0] = phi
    kicks = np.zeros((order, order))
    kicks[0, 0] = 1.0
    state = solve_discrete_lyapunov(companion, kicks)
    lags = [(np.linalg.matrix_power(companion, k) @ state)[0, 0] for k in range(n)]
    return np.asarray(deviation**2 / lags[0] * np.array([[lags[abs(i - j)] for j in range(n)] for i in range(n)]))


@pytest.mark.parametrize("partial", [[0.8], [0.9, -0.5], [0.6, 0.3, -0.2]])
def test_a_row_is_told_by_the_rows_before_it_that_count(partial: list[float]) -> None:
    error, order = Coloured(np.array(partial), 1.7), len(partial)
    counts = np.ones(30)
    counts[[0, 4, 5, 11, 20, 21, 22]] = 0.0
    rows = np.flatnonzero(counts)
    values = np.random.default_rng(0).standard_normal(30)
    whole = covariance(error.coefficients, 1.7, 30)
    left, variance = error.innovations(values, Before.of(counts, order))
    for k, row in enumerate(rows):
        near = rows[max(k - order, 0) : k]
        weights = np.linalg.solve(whole[np.ix_(near, near)], whole[near, row])
        assert left[k] == pytest.approx(values[row] - weights @ values[near], abs=1e-6)
        assert variance[k] == pytest.approx(whole[row, row] - weights @ whole[near, row], rel=1e-6)


def filtered(readings: FloatArray, walks: float, noise: float) -> float:
    """Return the log-likelihood of a random walk read through noise, by a Kalman filter of one state."""
    level, variance, total = readings[0], noise**2, 0.0
    for reading in readings[1:]:
        variance += walks**2
        if np.isfinite(reading):
            spread = variance + noise**2
            total -= 0.5 * (reading - level) ** 2 / spread + 0.5 * np.log(spread)
            level, variance = level + variance / spread * (reading - level), variance * noise**2 / spread
    return float(total)


@pytest.mark.parametrize(("walks", "noise"), [(0.2, 1.0), (0.05, 2.0), (1.0, 0.1)])
@pytest.mark.parametrize("lost", [0.0, 0.02])
def test_an_error_read_through_noise_is_as_likely_as_a_filter_of_it_says(
    walks: float, noise: float, lost: float
) -> None:
    rng, n, expected = np.random.default_rng(3), 2000, dict.fromkeys(USES, 0.0)
    errors = {}
    for use in USES:
        readings = walks * rng.standard_normal((n, 2)).cumsum(axis=0) + noise * rng.standard_normal((n, 2))
        readings[1:][rng.random((n - 1, 2)) < lost] = np.nan
        expected[use] = sum(filtered(one, walks, noise) for one in readings.T)
        errors[use] = [(readings, np.ones((n, 2)))]
    found = coloured_likelihood(errors, POLICY.order)
    assert found == pytest.approx(expected, abs=0.015 * 2 * n)


def free_run(law: FloatArray, seed: int = 0, **more: object) -> Fit:
    """Return a fit whose free runs err by noise and a law that it lacks (n,)."""
    innovations = {}
    for number, use in enumerate(USES):
        e = np.random.default_rng([seed, number]).standard_normal(len(law)) + law
        innovations[use] = [(e[:, None], np.ones((len(law), 1)))]
    terms = {use: [-0.5 * records[0][0][:, 0] ** 2] for use, records in innovations.items()}
    return a_fit(terms=terms, innovations=innovations, free_run=True, **more)


def test_beside_an_error_that_remembers_parameters_are_paid_too() -> None:
    nothing = np.zeros(500)
    price = coloured_gains(free_run(nothing, count=6), free_run(nothing, count=4), POLICY.order)
    assert price == pytest.approx((-np.log(500), 0.0))


@pytest.mark.parametrize("nothing", [0.0, np.nan])
def test_an_output_that_errs_by_nothing_or_was_never_read_tells_nothing(nothing: float) -> None:
    """The square of the smallest deviation was 0, and divided by."""
    wave, fits = np.sin(np.arange(500) / 20.0), []
    for left in (0.0, 1.0):
        one = free_run(left * wave)
        fits.append(one)
        more = {u: [(np.column_stack([e, e * 0.0 + nothing]), np.ones((500, 2))) for e, _ in one.innovations[u]]
                for u in USES}  # fmt: skip
        fits.append(replace(one, innovations=more))
    assert coloured_gains(fits[1], fits[3], 2) == pytest.approx(coloured_gains(fits[0], fits[2], 2))
    assert Coloured(np.zeros(2), 1.0).memory == 0.0


@pytest.mark.parametrize(
    ("gains", "lost"),
    [
        ((-0.1, 900.0), True),
        ((4.0, 2 * POLICY.evidence - 4.1), True),
        ((4.0, 2 * POLICY.evidence - 3.9), False),
        ((2 * POLICY.evidence + 1.0, 0.0), False),
        ((POLICY.misfit_gain, -1.0), True),
        ((POLICY.misfit_gain + 1.1, -1.0), False),
    ],
)
def test_an_error_that_remembers_is_beaten_where_it_was_fitted_and_by_both_uses(
    gains: tuple[float, float], lost: bool
) -> None:
    """Where the validation records lose, the others must be sure ten times over."""
    assert drifts(gains, POLICY) is lost


def drift(seed: int, memory: float = 0.995) -> FloatArray:
    """Return an error (2000,) that comes and goes."""
    found = np.random.default_rng(seed).standard_normal(2000)
    for k in range(1, len(found)):
        found[k] += memory * found[k - 1]
    return found / found.std()


def verdict(name: str, base: Fit, left: FloatArray, form: Any = FORM, **more: object) -> dict[Kind, Any]:
    """Return what is said of an effect beside which free runs err by this."""
    one = placed(name)
    fit = free_run(left, effects=[one], count=4)
    fit = replace(fit, **more)  # type: ignore[arg-type]
    return {refusal.kind: refusal for refusal in judged(form, [one], fit, base, base).refusals}


def test_a_law_that_only_follows_an_error_for_a_while_is_refused_beside_one_that_remembers() -> None:
    wave = np.sin(np.arange(2000) / 20.0)
    assert verdict("quadratic_drag", free_run(wave), 0.0 * wave) == {}
    error, turns = 5.0 * drift(1), 2 * np.pi * np.arange(2000) / 2000.0
    slow = np.column_stack([np.sin(turns), np.cos(turns)])
    left = error - slow @ np.linalg.lstsq(slow, error, rcond=None)[0]
    refusals = verdict("quadratic_drag", free_run(error), left)
    assert [*refusals] == [Kind.COLOURED], "as white noise it is beyond doubt, on both uses"
    *gains, asked = refusals[Kind.COLOURED].numbers
    assert sum(gains) < asked == 2 * POLICY.evidence
    beside_force = replace(free_run(error), free_run=False)
    assert verdict("quadratic_drag", beside_force, left, free_run=False) == {}, "it remembers for itself"


@pytest.mark.parametrize(("left", "once"), [(0.0, True), (0.6, True), (0.8, False)])
def test_what_happens_once_leaves_no_errors_that_last(left: float, once: bool) -> None:
    """A force that sets in explains most of what lasts; a law of one event beside a draught does not."""
    step = 2.0 * (np.arange(2000) > 900)
    found = verdict("force_step", free_run(step), left * step)
    assert (Kind.LASTING not in found) is once
    if not once:
        refusal = found[Kind.LASTING]
        assert refusal.subject == "force_step@theta"
        assert refusal.numbers == (pytest.approx(left**2, abs=0.1),), "of covariances: a square"
    assert Kind.LASTING not in verdict("quadratic_drag", free_run(step), left * step), "it happens always"


def test_what_happens_once_does_not_happen_again_at_its_place() -> None:
    step = 2.0 * (np.arange(2000) > 900)
    form: Any = NoForm()
    form.jumps = lambda fit: [Jump(at, "estimation", 0, 3.0, 9.0, 0.5) for at in ("theta", "theta", "u")]
    base = replace(free_run(step), free_run=False)
    refusal = verdict("force_step", base, 0.0 * step, form, free_run=False)[Kind.AGAIN]
    assert (refusal.subject, refusal.numbers) == ("force_step@theta", (2,))
    assert verdict("quadratic_drag", base, 0.0 * step, form, free_run=False) == {}, "it happens always"
    form.jumps = lambda fit: [Jump("u", "estimation", 0, 3.0, 9.0, 0.5)]
    assert verdict("force_step", base, 0.0 * step, form, free_run=False) == {}, "elsewhere"
