"""The coloured error of a joint: its density against dense matrices, its estimate, and intervals beside it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import lfilter

from harness.diagnosis.arm.regression import RegressionForm
from harness.diagnosis.arm.wide_regression import LinearEquation, LinearRegressors
from harness.diagnosis.search.coloured import Before, Coloured, fitted_error
from harness.diagnosis.search.compare import compared
from harness.physics.definition.parameters import Parameter
from harness.signals import FloatArray


def log_likelihood(error: Coloured, values: FloatArray, before: Before) -> float:
    """Return the log-density of the rows that count, each given those before it."""
    e, s = error.innovations(values, before)
    return float(np.sum(-0.5 * e**2 / s - 0.5 * np.log(2 * np.pi * s)))


def dense(error: Coloured, values: FloatArray, rows: np.ndarray) -> float:
    """Return the log-density of the rows that count, from the covariance matrix of all."""
    rho = error.correlation(int(rows.max()))
    matrix = error.deviation**2 * rho[np.abs(rows[:, None] - rows[None, :])]
    part = values[rows]
    _, logarithm = np.linalg.slogdet(2 * np.pi * matrix)
    return float(-0.5 * logarithm - 0.5 * part @ np.linalg.solve(matrix, part))


@settings(max_examples=40, deadline=None)
@given(
    partial=st.lists(st.floats(-0.9, 0.9), min_size=1, max_size=4),
    deviation=st.floats(0.01, 100.0),
    seed=st.integers(0, 10**6),
)
def test_density_is_that_of_the_covariance_matrix(partial: list[float], deviation: float, seed: int) -> None:
    error = Coloured(np.array(partial), deviation)
    values = deviation * np.random.default_rng(seed).standard_normal(60)
    before = Before.of(np.ones(60), len(partial))
    assert log_likelihood(error, values, before) == pytest.approx(dense(error, values, before.rows), rel=1e-6, abs=1e-4)


@settings(max_examples=40, deadline=None)
@given(phi=st.floats(-0.95, 0.95), seed=st.integers(0, 10**6))
def test_density_of_order_one_is_exact_with_gaps(phi: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    counts = (rng.random(80) > 0.3).astype(float)
    counts[0] = 1.0
    error, values = Coloured(np.array([phi]), 1.5), rng.standard_normal(80)
    before = Before.of(counts, 1)
    assert log_likelihood(error, values, before) == pytest.approx(dense(error, values, before.rows), rel=1e-6, abs=1e-4)


RAMP = np.linspace(-1, 1, 400)


class Line:
    """A constant and a slope under a coloured error; every record has a slope and a noise. See TorqueRegression."""

    def __init__(
        self, seed: int, estimation: Sequence[tuple[float, float]] = ((-1.0, 1.0),),
        validation: Sequence[tuple[float, float]] = ((-1.0, 1.0),), along: FloatArray = RAMP, fixed: bool = False,
    ) -> None:  # fmt: skip
        self.nominal = LinearRegressors((Parameter("level", "1", 0.0), Parameter("slope", "1", 0.0, fixed=fixed)))
        self.own: frozenset[str] = frozenset()
        self.counts, self._target, self._columns = {}, {}, {}
        x = np.stack([np.ones(400), along], axis=1)[:, None, :]
        for role, (use, days) in enumerate({"estimation": estimation, "validation": validation}.items()):
            self.counts[use], self._columns[use] = [np.ones((400, 1))] * len(days), [x] * len(days)
            self._target[use] = []
            for day, (slope, noise) in enumerate(days):
                white = noise * np.random.default_rng([seed, role, day]).standard_normal(400)
                error = lfilter([1.0], [1.0, -0.8], white)[:, None]
                self._target[use].append(x @ np.array([3.0, slope]) + error)

    def equation(self, effects: object) -> LinearEquation:
        return LinearEquation(self.nominal, self._target, self._columns)

    def changes(self, values: object, candidates: object) -> list[object]:
        return []

    def free_torques(self) -> list[object]:
        return []


@pytest.mark.slow
def test_intervals_hold_under_a_coloured_error() -> None:
    inside = []
    for seed in range(60):
        fit = RegressionForm(Line(seed)).fit((), [{}], None)  # type: ignore[arg-type]
        assert fit is not None
        for name, true in (("level", 3.0), ("slope", -1.0)):
            low, high = fit.interval(name)
            inside.append(low <= true <= high)
    assert 0.88 <= np.mean(inside) <= 0.99  # white errors would give 50 %


@pytest.mark.parametrize("noise", [0.25, 4.0])
@pytest.mark.parametrize(("slope", "right"), [(-10.0, True), (10.0, False)])
def test_a_record_of_another_day_is_judged_by_errors_of_its_own_size(noise: float, slope: float, right: bool) -> None:
    """Errors four times as large there do not speak against a law that holds; one that turns round is refused."""
    for seed in range(3):
        along = np.sign(np.sin(20 * RAMP))
        fit, base = (
            RegressionForm(Line(seed, ((-10.0, 1.0),), ((slope, noise),), along, fixed)).fit((), [{}], None)  # type: ignore[arg-type]
            for fixed in (False, True)
        )
        assert fit is not None
        assert base is not None
        assert (compared(fit, base).validation > 0) == right


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_loud_record_takes_nothing_from_a_quiet_one(seed: int) -> None:
    """With one size of error for both, the slope would be known four times less well than from the quiet one alone."""
    alone, beside = (
        RegressionForm(Line(seed, days)).fit((), [{}], None)  # type: ignore[arg-type]
        for days in (((-1.0, 1.0),), ((-1.0, 1.0), (-1.0, 8.0)))
    )
    assert alone is not None
    assert beside is not None
    assert beside.deviations["slope"] < 1.5 * alone.deviations["slope"]
    assert abs(beside.values["slope"] - alone.values["slope"]) < 0.5 * alone.deviations["slope"]


@pytest.mark.parametrize("steepest", [0.99, 0.999, 0.9999])
def test_an_error_of_several_slow_parts_remembers_long(steepest: float) -> None:
    """Their poles nearly coincide, and rounding may put one beyond 1."""
    alone = Coloured(np.array([steepest]), 1.0).memory
    assert alone == pytest.approx(1 / (1 - steepest), rel=0.01)
    assert Coloured(np.full(4, steepest), 1.0).memory > alone


def test_a_drift_is_found_from_white_errors() -> None:
    """A descent that began at white errors ended where every partial autocorrelation lies on its bound."""
    values = 10 * RAMP + 0.1 * np.random.default_rng(0).standard_normal(400)
    before = Before.of(np.ones(400), 4)
    alone, led = (fitted_error([values], [before], 4, 1e-9, start) for start in (None, Coloured(np.zeros(4), 1.0)))
    assert log_likelihood(led, values, before) > log_likelihood(alone, values, before) - 1.0


def test_the_estimate_is_the_likeliest() -> None:
    rng = np.random.default_rng(3)
    values = np.convolve(rng.standard_normal(900), [1.0, 0.6, 0.3], "same")
    before = Before.of((rng.random(900) > 0.1).astype(float), 4)
    best = fitted_error([values], [before], 4, 1e-9)
    top = log_likelihood(best, values, before)
    for k in range(4):
        for step in (-0.03, 0.03):
            other = best.partial.copy()
            other[k] += step
            assert log_likelihood(Coloured(other, best.deviation), values, before) < top
    for factor in (0.97, 1.03):
        assert log_likelihood(Coloured(best.partial, factor * best.deviation), values, before) < top
