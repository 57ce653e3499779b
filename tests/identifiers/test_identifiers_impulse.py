"""Kernel-regularised impulse responses: kernels, marginal likelihood, posterior bands, units, several inputs."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import multivariate_normal

from harness.errors import FitError
from harness.scoring import simulation_error
from harness.signals import Channel, PlantSpec, Trajectory
from identifiers.linear.impulse.identifier import ImpulseResponse
from identifiers.linear.impulse.kernels import KERNELS, evidence, kernel_matrix, kernel_root
from identifiers.linear.markov import markov_parameters

LAGS = 30


def record(responses, seed, noise, n=300):
    """Return a record of responses (LAGS, ny, nu) from lag 1 on to white inputs, noise of each output relative."""
    rng = np.random.default_rng(seed)
    length, ny, nu = responses.shape
    u = rng.normal(size=(n + length, nu))
    y = np.zeros((n + length, ny))
    for k in range(length):
        y[k + 1 :] += u[: len(u) - k - 1] @ responses[k].T
    y = y[length:]
    y = y + np.asarray(noise) * y.std(axis=0) * rng.normal(size=y.shape)
    spec = PlantSpec(tuple(Channel(f"u{j}") for j in range(nu)), tuple(Channel(f"y{i}") for i in range(ny)), 1.0)
    return Trajectory(np.arange(float(n)), u[length:], y, spec)


def fitted(data, **options):
    return ImpulseResponse(length=LAGS, **options).fit([data], rng=np.random.default_rng(0))


@settings(max_examples=30, deadline=None)
@given(st.sampled_from(KERNELS), st.integers(2, 40), st.floats(0.05, 0.98), st.floats(-0.95, 0.95))
def test_kernels_are_covariances_and_their_roots_are_roots(kernel, length, decay, correlation):
    matrix, root = (make(kernel, length, decay, correlation) for make in (kernel_matrix, kernel_root))
    assert np.allclose(root @ root.T, matrix, atol=1e-12)
    assert np.allclose(matrix, matrix.T)
    assert np.all(np.diff(np.diag(matrix)) <= 0.0)
    assert matrix[0, 0] == pytest.approx(1.0)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000), st.sampled_from(KERNELS))
def test_the_marginal_likelihood_is_that_of_a_normal_distribution(seed, kernel):
    rng = np.random.default_rng(seed)
    phi, root = rng.normal(size=(25, 6)), kernel_root(kernel, 6, 0.6, 0.4)
    y = phi @ root @ rng.normal(size=6) + rng.normal(size=25)
    found = evidence(phi.T @ phi, phi.T @ y, float(y @ y), 25, root)
    covariance = found.noise * (np.eye(25) + phi @ root @ root.T @ phi.T)
    wanted = -2.0 * multivariate_normal(np.zeros(25), covariance).logpdf(y)
    assert found.value == pytest.approx(wanted - 25 * (1 + np.log(2 * np.pi)), rel=1e-9)
    assert found.noise == pytest.approx(float(y @ np.linalg.solve(covariance / found.noise, y)) / 25, rel=1e-9)


@pytest.mark.parametrize("kernel", KERNELS)
def test_bands_hold_responses_that_the_kernel_expects(kernel):
    held = []
    for seed in range(24):
        rng = np.random.default_rng([seed, 1])
        responses = (kernel_root(kernel, LAGS, 0.75, 0.8) @ rng.normal(size=LAGS))[:, None, None]
        model = fitted(record(responses, seed, [0.3]), kernel=kernel)
        response, deviation = (np.array(model.notes[name]) for name in ("response", "deviation"))
        held.append(np.mean(np.abs(response - responses) <= 1.96 * deviation))
    # empirical Bayes: few lags of a smooth response tell its kernel's numbers, which are then taken for known
    assert (0.8 if kernel == "ss" else 0.9) < np.mean(held) < 0.985


def test_outputs_of_unequal_noise_and_inputs_of_unequal_speed_are_each_themselves():
    lags = np.arange(LAGS)
    responses = np.zeros((LAGS, 2, 2))
    responses[:, 0, 0], responses[:, 0, 1] = 0.5**lags, 0.3 * 0.9**lags
    responses[:, 1, 0], responses[:, 1, 1] = 0.9**lags * np.cos(0.5 * lags), 2.0 * 0.4**lags
    data = record(responses, 0, [0.02, 0.8])
    model = fitted(data)
    found = np.array(model.notes["response"])
    wrong = np.linalg.norm(found - responses, axis=0) / np.linalg.norm(responses, axis=0)
    plain = np.linalg.norm(markov_parameters([data], LAGS + 1)[0][1:] - responses, axis=0)
    assert np.all(wrong[0] < 0.1)
    assert np.all(wrong * np.linalg.norm(responses, axis=0) < plain)
    fast, slow = model.notes["kernels"][0]["time_constants"]
    assert fast < slow
    assert np.allclose(np.array(model.notes["residual_rms"]) / data.y.std(axis=0), [0.02, 0.62], rtol=0.25)


@settings(max_examples=4, deadline=None)
@given(st.integers(0, 1000), st.integers(-6, 6), st.integers(-6, 6))
def test_units_change_nothing(seed, inputs, outputs):
    data = record((0.8 ** np.arange(LAGS))[:, None, None], seed, [0.2], n=150)
    scaled = Trajectory(data.t, data.u * 10.0**inputs, data.y * 10.0**outputs, data.spec)
    one, other = fitted(data, kernel="tc"), fitted(scaled, kernel="tc")
    found, again = (np.array(model.notes["response"]) for model in (one, other))
    assert np.allclose(found, again * 10.0 ** (inputs - outputs), rtol=1e-3, atol=1e-5 * np.abs(found).max())


def test_the_model_simulates_with_its_level_and_the_direct_term():
    rng = np.random.default_rng(0)
    u = rng.normal(size=(400, 1))
    y = 5.0 + 2.0 * u
    y[1:] += 0.7 * u[:-1]
    data = Trajectory(
        np.arange(400.0), u, y + 0.01 * rng.normal(size=y.shape), record(np.zeros((2, 1, 1)), 0, 0.0).spec
    )
    model = ImpulseResponse(length=10, direct=True).fit([data], rng=rng)
    assert model.d_matrix[0, 0] == pytest.approx(2.0, abs=0.01)
    assert model.output_offset[0] == pytest.approx(5.0, abs=0.01)
    assert simulation_error(model, data).nrmse[0] < 0.02
    late = ImpulseResponse(length=10).fit([data[:-1]], rng=rng)
    assert np.all(late.d_matrix == 0.0)


def test_what_cannot_be_fitted_is_refused():
    data = record((0.5 ** np.arange(LAGS))[:, None, None], 0, [0.1])
    with pytest.raises(FitError, match="options"):
        ImpulseResponse(length=1).fit([data], rng=np.random.default_rng(0))
    with pytest.raises(FitError, match="too many unknowns"):
        ImpulseResponse(length=601).fit([data], rng=np.random.default_rng(0))


def drawn_system(seed, coloured=0.0, n=400):
    """Return a record of a random stable system of order 1 to 5 under slow inputs, and its response from lag 1 on."""
    rng = np.random.default_rng([seed, 5])
    order = int(rng.integers(1, 6))
    a = rng.normal(size=(order, order))
    a *= rng.uniform(0.5, 0.9) / np.abs(np.linalg.eigvals(a)).max()
    b, c, truth = rng.normal(size=(order, 1)), rng.normal(size=(1, order)), np.zeros((LAGS, 1, 1))
    for k in range(LAGS):
        truth[k] = c @ np.linalg.matrix_power(a, k) @ b
    truth /= np.linalg.norm(truth)
    u, e = rng.normal(size=(n + LAGS, 1)), rng.normal(size=(n, 1))
    for k in range(1, len(u)):
        u[k] += 0.6 * u[k - 1]
    for k in range(1, n):
        e[k] += coloured * e[k - 1]
    y = np.zeros((n + LAGS, 1))
    for k in range(LAGS):
        y[k + 1 :] += u[: len(u) - k - 1] @ truth[k].T
    spec = PlantSpec((Channel("u"),), (Channel("y"),), 1.0)
    return Trajectory(np.arange(float(n)), u[LAGS:], y[LAGS:] + 0.3 * e, spec), truth


def test_intervals_hold_random_systems_early_and_late():
    early, late = [], []
    for seed in range(30):
        data, truth = drawn_system(seed)
        notes = fitted(data, kernel="dc").notes
        low, high, response = (np.array(notes[name]) for name in ("low", "high", "response"))
        assert np.all((low <= response) & (response <= high))
        inside = (low <= truth) & (truth <= high)
        early.append(inside[:8].mean())
        late.append(inside[8:].mean())
    assert 0.90 < np.mean(early) < 0.99
    assert 0.90 < np.mean(late)


def test_the_estimate_has_the_intervals_where_residuals_are_white_and_else_the_reason():
    from harness.models.estimate import estimate_of

    data, _ = drawn_system(0)
    model = fitted(data)
    found = estimate_of(model)
    low, high = found.interval("y per u, lag 2")
    assert low == pytest.approx(np.array(model.notes["low"])[1, 0, 0])
    assert high == pytest.approx(np.array(model.notes["high"])[1, 0, 0])
    assert found.deviation("y per u, lag 2") == pytest.approx((high - low) / 4, rel=0.3)
    slow, _ = drawn_system(0, coloured=0.8)
    model = fitted(slow)
    assert "low" not in model.notes
    assert estimate_of(model).intervals is None
    assert "correlated in time" in estimate_of(model).method
