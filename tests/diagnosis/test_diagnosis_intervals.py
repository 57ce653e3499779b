"""Intervals of fitted parameters: they hold the truth where the residual rings, and do not depend on units or order."""

from __future__ import annotations

import functools
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_fits import a_fit
from scipy.signal import lfilter

from harness.diagnosis.forms.robust import coloured_deviations, robust_covariance
from harness.diagnosis.runs.fitted import Fitted
from harness.diagnosis.runs.intervals import _blocks, block_interval, correlation_samples
from harness.diagnosis.search.coloured import Before, fitted_error
from harness.physics import load_model
from harness.physics.compiled.windows import Windows
from harness.signals import PlantSpec, Trajectory

N, DT = 2000, 0.015
RINGING = [1.0, -2 * np.exp(-0.5 * DT) * np.cos(6 * DT), np.exp(-1.0 * DT)]
"""A plant with its pole at 6 rad/s, damped by 8 %: what shakes it rings for some 2 s."""
SEEDS = 120


def ringing(rng: np.random.Generator) -> np.ndarray:
    return np.asarray(lfilter([1.0], RINGING, rng.standard_normal(N)))


@functools.cache
def regressors(windows: int) -> tuple[np.ndarray, np.ndarray]:
    """Return what two gains of the plant under a multisine do, and a basis of what the start of a window does."""
    lines = np.arange(0.1, 3.0, 1 / (N * DT))
    phases = np.random.default_rng(0).uniform(0, 2 * np.pi, lines.size)
    drive = np.cos(2 * np.pi * np.outer(np.arange(N) * DT, lines) + phases).sum(axis=1)
    j = np.stack([lfilter([1.0], RINGING, one) for one in (drive, np.cumsum(drive) * DT)], axis=1)
    t = np.arange(N // windows) * DT
    basis = np.linalg.qr(np.exp(-0.5 * t)[:, None] * np.stack([np.cos(6 * t), np.sin(6 * t)], axis=1))[0]
    return without(j, basis), basis


def without(columns: np.ndarray, basis: np.ndarray) -> np.ndarray:
    """Take the starts of all windows out of columns."""
    parts = np.split(columns, len(columns) // len(basis))
    return np.concatenate([one - basis @ (basis.T @ one) for one in parts])


def fitted(
    seed: int, windows: int, slow: float, noise: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, tuple[np.ndarray, ...]]:
    """Fit the gains, and an initial state for each window, to noise; return errors, J, r and the bases."""
    rng = np.random.default_rng(seed)
    j, basis = regressors(windows)
    r = without(slow * ringing(rng) + noise * rng.standard_normal(N), basis)
    error = np.linalg.solve(j.T @ j, j.T @ r)
    return error, j[:, None, :], (r - j @ error)[:, None], (basis,) * windows


def plain_blocks(error: np.ndarray, j: np.ndarray, r: np.ndarray) -> np.ndarray:
    """Return half widths of twenty blocks without any correction."""
    bread = np.linalg.inv(j[:, 0].T @ j[:, 0])
    scores = (j[:, 0] * r).reshape(20, -1, 2).sum(axis=1)
    return np.asarray(2.093 * np.sqrt(np.diag(bread @ (scores.T @ scores * 20 / 19) @ bread)))


@pytest.mark.parametrize("windows", [1, 4])
def test_intervals_hold_the_truth_where_the_residual_rings(windows: int) -> None:
    held = old = 0
    for seed in range(SEEDS):
        error, j, r, starts = fitted(seed, windows, 1.0, 0.01)
        found = block_interval(error, [j], [r], starts=starts)
        held += sum(one.low <= 0 <= one.high for one in found)
        old += int(np.sum(np.abs(error) <= plain_blocks(error, j, r)))
    assert 0.90 * 2 * SEEDS <= held <= 0.985 * 2 * SEEDS
    assert old <= 0.85 * 2 * SEEDS  # what short blocks of depleted residuals hold


def test_a_slow_part_far_below_white_noise_is_seen() -> None:
    held = 0
    for seed in range(SEEDS):
        error, j, r, starts = fitted(seed, 1, 0.03, 1.0)
        held += sum(one.low <= 0 <= one.high for one in block_interval(error, [j], [r], starts=starts))
    assert held >= 0.90 * 2 * SEEDS


@pytest.mark.parametrize(("times", "seen"), [(2.2, True), (1.0, False)])
def test_a_slow_part_is_seen_where_means_vary_twice_as_much_as_of_white_noise(times: float, seen: bool) -> None:
    """A hundredth of the noise's power: over 128 samples it is as much as the noise."""
    rng, n = np.random.default_rng(0), 20_000
    slow = np.sqrt(2.0 * (times - 1.0) / 128.0) * np.sin(np.arange(n) / 700.0)
    assert (correlation_samples([(rng.standard_normal(n) + slow)[:, None]]) > 1.0) is seen


def test_white_residuals_keep_narrow_intervals() -> None:
    held, widths, right = 0, [], []
    for seed in range(SEEDS):
        error, j, r, starts = fitted(seed, 1, 0.0, 1.0)
        found = block_interval(error, [j], [r], starts=starts)
        held += sum(one.low <= 0 <= one.high for one in found)
        widths += [one.high - one.value for one in found]
        right += (1.96 * np.sqrt(np.diag(np.linalg.inv(j[:, 0].T @ j[:, 0])))).tolist()
    assert 0.92 * 2 * SEEDS <= held <= 0.995 * 2 * SEEDS
    assert np.median(np.array(widths) / np.array(right)) < 1.4


@settings(max_examples=30, deadline=None)
@given(
    seed=st.integers(0, 1000),
    scale=st.floats(1e-6, 1e6),
    unit=st.floats(1e-6, 1e6),
    windows=st.sampled_from([1, 2, 4, 10]),
)
def test_units_do_not_matter(seed: int, scale: float, unit: float, windows: int) -> None:
    error, j, r, starts = fitted(seed, windows, 1.0, 0.1)
    one = block_interval(error, [j], [r], starts=starts)
    other = block_interval(error * scale, [j * unit / scale], [r * unit], starts=starts)
    for a, b in zip(one, other, strict=True):
        assert b.high - b.low == pytest.approx(scale * (a.high - a.low), rel=1e-6)


@settings(max_examples=100, deadline=None)
@given(lengths=st.lists(st.integers(1, 400), min_size=1, max_size=12), wanted=st.integers(1, 20))
def test_blocks_hold_every_row_once_and_join_no_parts_of_windows(lengths: list[int], wanted: int) -> None:
    bases = [np.zeros((n, 1)) for n in lengths]
    found = _blocks(lengths, bases, wanted)
    edges = np.cumsum([0, *lengths]).tolist()
    assert [a for a, *_ in found] == [0, *(b for _, b, *_ in found[:-1])]
    assert found[-1][1] == edges[-1]
    assert all(a < b for a, b, *_ in found)
    for a, b, basis, first, last in found:
        if basis is None:
            assert a in edges
            assert b in edges
        else:
            begin = max(edge for edge in edges if edge <= a)
            assert (first, last) == (a - begin, b - begin)
            assert b <= begin + len(basis)


def test_correlation_is_one_sample_for_white_noise_and_long_for_ringing() -> None:
    rng = np.random.default_rng(0)
    white = [correlation_samples([rng.standard_normal((N, 2))]) for _ in range(50)]
    assert sum(one > 1 for one in white) <= 12  # eight tests of 1 % each
    assert 50 < correlation_samples([ringing(rng)[:, None]]) < 600
    assert correlation_samples([np.zeros((N, 1))]) == 1.0


def test_a_short_record_still_has_intervals() -> None:
    rng = np.random.default_rng(0)
    found = block_interval(np.array([1.0]), [rng.standard_normal((3, 1, 1))], [rng.standard_normal((3, 1))])
    assert np.isfinite([found[0].low, found[0].high]).all()


def test_a_fitted_model_counts_what_its_initial_states_took() -> None:
    error, j, r, starts = fitted(3, 1, 1.0, 0.01)
    common = {
        "effects": (), "system": load_model("pendulum"), "values": {"J": error[0] + 1, "mgl": error[1] + 1},
        "free": ("J", "mgl"), "converged": True, "message": "", "estimation": (r,), "validation": (r,),
        "jacobian": (j,),
    }  # fmt: skip
    without_states = Fitted(**common).intervals()["J"]  # type: ignore[arg-type]
    with_states = Fitted(**common, starts=starts).intervals()["J"]  # type: ignore[arg-type]
    assert with_states.high - with_states.low > 1.002 * (without_states.high - without_states.low)


def test_windows_tell_what_their_initial_states_can_do() -> None:
    system = load_model("pendulum")
    simulator = system.simulator(0.01, intersample="zoh", substeps=1, backend="casadi")
    spec = PlantSpec(system.inputs, system.outputs, 0.01)
    t = np.arange(200) * 0.01
    record = Trajectory(t, np.sin(3 * t)[:, None], 0.1 * np.sin(3 * t)[:, None], spec)
    windows = Windows(simulator, [record], 1.0, np.ones(1))
    found = windows.evaluate(system.vector(), np.zeros((2, 2)), keep=True, jacobian=True)
    assert found.jacobian is not None
    assert [one.shape for one in found.starts] == [(100, 2), (100, 2)]
    for basis, part in zip(found.starts, np.split(found.jacobian, 2), strict=True):
        assert basis.T @ basis == pytest.approx(np.eye(2), abs=1e-9)
        assert np.abs(basis.T @ part).max() < 1e-9 * np.abs(part).max()


@pytest.mark.slow
def test_intervals_of_free_runs_hold_the_truth_though_their_errors_are_coloured() -> None:
    """Least squares of a slow and a fast column under an error that lasts 20 samples, 200 times."""
    rng, held = np.random.default_rng(0), np.zeros(2)
    n, fade = 1500, 0.95
    t = np.arange(n)
    j = np.stack([np.sin(0.02 * t), np.sin(1.3 * t)], axis=1)
    for _ in range(200):
        e = lfilter([1.0], [1.0, -fade], rng.normal(size=n + 200))[200:]
        change = np.linalg.lstsq(j, e, rcond=None)[0]
        covariance = robust_covariance([(e - j @ change)[:, None]], [j[:, None, :]], 4, np.array([1e-9]))
        held += np.abs(change) < 1.96 * np.sqrt(np.diag(covariance))
    assert (held >= 180).all()  # as if independent: 20 % and 100 %
    assert (held <= 198).all()


def test_the_covariance_of_free_runs_is_the_sandwich_of_its_formula() -> None:
    """Two records, two outputs, a reading that is missing: sums over outputs of J' C J between inverses of J' J."""
    rng = np.random.default_rng(0)
    errors = [lfilter([1.0], [1.0, -0.8], rng.standard_normal((n, 2)), axis=0) * [1.0, 5.0] for n in (60, 45)]
    errors[1][20:25, 0] = np.nan
    jacobians = [rng.standard_normal((len(e), 2, 3)) for e in errors]
    bread, meat = np.zeros((3, 3)), np.zeros((3, 3))
    for k in range(2):
        there = [np.isfinite(e[:, k]) for e in errors]
        before = [Before.of(rows.astype(float), 1) for rows in there]
        error = fitted_error([np.nan_to_num(e[:, k]) for e in errors], before, 1, 1e-9)
        for j, rows in zip(jacobians, there, strict=True):
            lags = np.abs(np.subtract.outer(np.arange(len(j)), np.arange(len(j))))
            told = j[:, k][rows] / error.deviation
            bread += told.T @ told
            meat += told.T @ (error.coefficients[0] ** lags)[np.ix_(rows, rows)] @ told
    wanted = np.linalg.inv(bread) @ meat @ np.linalg.inv(bread)
    assert robust_covariance(errors, jacobians, 1, np.array([1e-9, 1e-9])) == pytest.approx(wanted, rel=1e-6)


def test_intervals_of_free_runs_know_that_every_record_has_its_own_initial_state() -> None:
    """A parameter is told by what none of the starts can do, through its logarithm where it was fitted so."""
    rng = np.random.default_rng(1)
    errors = [rng.standard_normal((200, 1)) for _ in range(2)]
    moves = [rng.standard_normal((200, 1, 4)) for _ in range(2)]  # three parameters and an initial state
    told = {"a": 0.1, "b": 0.0, "c": 0.1}
    values = {"a": 4.0, "b": 2.0, "c": 1.0}
    fit = a_fit(values=values, free=tuple(values), deviations=told, logarithmic=frozenset("a"))
    paths: Any = [SimpleNamespace(e=e, j=j) for e, j in zip(errors, moves, strict=True)]
    found = coloured_deviations(fit, paths, 1, np.array([1e-9])).deviations
    wide = np.zeros((400, 4))
    for number, j in enumerate(moves):
        rows = slice(200 * number, 200 * (number + 1))
        wide[rows, :2], wide[rows, 2 + number] = j[:, 0, [0, 2]], j[:, 0, 3]
    parts = [wide[:200, None], wide[200:, None]]
    covariance = robust_covariance(errors, parts, 1, np.array([1e-9]))
    a, c = np.sqrt(np.diag(covariance))[:2]
    assert (found["a"], found["b"], found["c"]) == pytest.approx((a / 4.0, 0.0, c)), "what was held stays held"
