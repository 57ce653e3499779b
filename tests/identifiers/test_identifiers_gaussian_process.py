"""Gaussian processes: slopes, the exact posterior as a limit of the sparse one, bands that hold what they promise."""

from __future__ import annotations

import functools

import numpy as np
import pytest
from scipy.optimize import approx_fprime

from harness.errors import FitError
from harness.registry import create
from harness.rng import Streams
from harness.rollout import run
from harness.scoring import equation_error, simulation_error
from harness.scoring.predictive import probability_score
from identifiers.learned.gaussian_process import GaussianProcess, Kernel, _evidence, _exact, _inducing, _sparse
from identifiers.linear.least_squares import Arx


@functools.cache
def pendulum(samples: int, noise: float):
    plant = create("plants", "pendulum-ode", sample_time=0.05, outputs=[["theta", 0], ["theta", 1]])
    options = dict(samples=samples, amplitude=1.0, band=[0.05, 3.0], noise=noise)
    scenario, streams = create("scenarios", "multisine", **options), Streams("pendulum-ode", "multisine", 0)
    first, second = (run(plant, scenario, streams=streams, role=f"{role}/0") for role in ("estimation", "validation"))
    return first.measured(), second.measured()


def sample(n: int = 40) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    x = rng.normal(size=(n, 3))
    return x, np.sin(x[:, 0]) + 0.1 * rng.normal(size=n)


def test_the_slope_of_the_evidence_is_that_of_differences():
    x, y = sample()
    logs = np.log([1.0, 2.0, 0.7, 1.2, 0.5, 0.2])
    value, slope = _evidence(logs, x, y)
    assert slope == pytest.approx(approx_fprime(logs, lambda a: _evidence(a, x, y)[0], 1e-6), rel=1e-3, abs=1e-3)
    matrix = Kernel.of(logs)(x, x) + 0.2**2 * np.eye(40)
    sign, log = np.linalg.slogdet(matrix)
    assert sign == 1
    assert value == pytest.approx(0.5 * (y @ np.linalg.solve(matrix, y) + log + 40 * np.log(2 * np.pi)), rel=1e-6)


def test_inducing_points_everywhere_are_the_exact_process():
    x, y = sample()
    kernel = Kernel(np.array([1.0, 2.0, 3.0]), 1.2, 0.5, 0.1)
    order = _inducing(kernel, x, 40)
    assert sorted(order) == list(range(40))
    sparse = _sparse(kernel, x[order], x, y)
    exact = _exact(sparse.kernel, x, y)
    at = np.random.default_rng(1).normal(size=(15, 3))
    for ours, theirs in zip(sparse(at), exact(at), strict=True):
        assert ours == pytest.approx(theirs, abs=1e-4)


def test_far_from_the_data_it_knows_that_it_knows_nothing():
    x, y = sample()
    posterior = _exact(Kernel(np.ones(3), 1.0, 0.1, 0.1), x, y)
    near, far = posterior(x[:5])[1], posterior(x[:5] + 20.0)[1]
    assert (far > 10 * near).all()
    mean, variance = posterior(x)
    assert (np.abs(mean - y) < 4 * np.sqrt(variance)).all()


def test_three_hundred_samples_of_a_pendulum():
    learn, held = pendulum(300, 0.0)
    model = GaussianProcess().fit([learn], rng=np.random.default_rng(0))
    assert (equation_error(model, held).nrmse < [0.003, 0.007]).all()
    assert (simulation_error(model, held).nrmse < 0.02).all()


def test_bands_hold_what_they_promise():
    learn, held = pendulum(300, 0.01)
    model = GaussianProcess().fit([learn], rng=np.random.default_rng(0))
    score = probability_score(model, held)
    assert score.coverage[2] == pytest.approx([0.9, 0.9], abs=0.06)
    assert (
        equation_error(model, held).nrmse <= 1.02 * equation_error(Arx(order=1).fit([learn], rng=None), held).nrmse
    ).all()
    assert (score.skill > 1).all()


def test_more_samples_through_inducing_points_and_the_same_answer_every_time():
    learn, held = pendulum(1500, 0.01)
    fits = [GaussianProcess(exact=150, inducing=60).fit([learn], rng=np.random.default_rng(3)) for _ in range(2)]
    assert all(4 <= count <= 60 for count in fits[0].notes["points"]), "fewer where they say all there is"
    few = GaussianProcess(exact=150).fit([learn[:151]], rng=np.random.default_rng(3))
    scores = [probability_score(one, held).log_score.sum() for one in (fits[0], few)]
    assert scores[0] > scores[1] - 0.01
    assert probability_score(fits[0], held).coverage[2] == pytest.approx([0.9, 0.9], abs=0.04)
    assert np.array_equal(fits[0].posteriors[0].target, fits[1].posteriors[0].target)


def test_too_few_samples_are_refused():
    with pytest.raises(FitError, match="too few"):
        GaussianProcess(order=2).fit([pendulum(300, 0.0)[0][:7]], rng=np.random.default_rng(0))
