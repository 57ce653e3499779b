"""The least error to be expected on a linear plant: exact where it is known, reached by efficient estimators."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from harness.rng import Streams
from harness.rollout import perform
from harness.scoring import LeastErrors, LinearTruth, equation_error, least_errors, linear_truth, simulation_error
from harness.signals import Trajectory
from harness.testing import LinearSystem, linear_systems, simulate_linear
from identifiers.linear.arx import Arx
from identifiers.linear.dmd import Dmdc
from identifiers.linear.n4sid import Subspace
from identifiers.linear.prediction_error import PredictionError
from identifiers.online.baselines import HoldLast
from plants.equations.linear import LinearPlant
from plants.equations.ode import pendulum_ode
from scenarios.open_loop import Prbs

SYSTEM = {"A": [[0.7, 0.4], [-0.4, 0.7]], "B": [[0.0], [1.0]], "C": [[1.0, 0.0]], "sample_time": 0.1}
ESTIMATORS = {
    "oe": PredictionError(structure="oe", order=2, offset=False),
    "armax": PredictionError(structure="armax", order=2, offset=False),
    "arx": Arx(order=2),
    "dmdc": Dmdc(delays=3),
    "n4sid": Subspace(order=2),
    "hold": HoldLast(),
}


def records(scenario: Any, seed: int, **noise: Any) -> tuple[LinearPlant, list[Trajectory], list[Any]]:
    """Return a plant, a record to fit, one to judge by, and what disturbed them."""
    plant, streams = LinearPlant(**SYSTEM, **noise), Streams("plant", "scenario", seed)
    runs, disturbances = [], []
    for role in ("estimation/0", "validation/0"):
        experiment = scenario.prepare(plant.spec, streams=streams, role=role)
        runs.append(perform(plant, experiment, rng=streams(f"{role}/plant")))
        disturbances.append(experiment.disturbance)
    return plant, runs, disturbances


def least(scenario: Any, seed: int, **noise: Any) -> tuple[LeastErrors, list[Trajectory]]:
    """Return the bound of a pair of records."""
    plant, runs, disturbances = records(scenario, seed, **noise)
    truth = linear_truth(plant, runs, disturbances)
    assert truth is not None
    found = least_errors(truth, runs[:1], runs[1:])
    assert found is not None
    return found, runs


def ratios(name: str, scenario: Any, seeds: int, **noise: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and standard error of squared errors over the squared bound: free run, one step ahead."""
    squares = []
    for seed in range(seeds):
        found, runs = least(scenario, seed, **noise)
        model = ESTIMATORS[name].fit([runs[0].measured()], rng=np.random.default_rng(0))
        free, ahead = (score(model, runs[1].measured()).nrmse[0] for score in (simulation_error, equation_error))
        squares.append([(free / found.simulation) ** 2, (ahead / found.equation) ** 2])
    return np.mean(squares, axis=0), np.std(squares, axis=0) / np.sqrt(seeds)


@settings(max_examples=40, deadline=None)
@given(linear_systems(max_states=3), st.integers(0, 99))
def test_on_the_record_that_was_fitted_every_parameter_costs_one_sample_of_noise(
    system: LinearSystem, seed: int
) -> None:
    record = simulate_linear(system, 300, rng=np.random.default_rng(seed), noise=0.1)
    (nx, nu), ny = system.B.shape, len(system.C)
    seen = np.vstack([system.C @ np.linalg.matrix_power(system.A, k) for k in range(nx)])
    driven = np.hstack([np.linalg.matrix_power(system.A, k) @ system.B for k in range(nx)])
    assume(max(np.linalg.cond(seen), np.linalg.cond(driven)) < 1e3)  # a minimal system, not nearly a smaller one
    level = np.diag((0.1 * record.y.std(axis=0)) ** 2)
    none = np.zeros((nx, nx))
    truth = LinearTruth(system.A, system.B, system.C, np.zeros((ny, nu)), none, level, nx, none)
    found = least_errors(truth, [record], [record])
    assert found is not None
    excess = (found.simulation**2 - found.known_simulation**2) / 0.1**2 * record.y.size
    assert excess == pytest.approx(nx * (nu + ny), rel=1e-4)
    assert found.equation == pytest.approx(found.simulation)  # without process noise the filter has nothing to learn
    assert found.known_simulation <= np.sqrt(np.mean((record.y - record.x @ system.C.T) ** 2 / record.y.var(axis=0)))


@pytest.mark.slow
def test_an_efficient_estimator_reaches_the_bound() -> None:
    mean, deviation = ratios("oe", Prbs(samples=400, noise=0.1), 60)
    assert abs(mean - 1.0).max() < 4 * deviation.max() < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("noise", [{}, {"Q": [[0.05, 0.0], [0.0, 0.05]]}], ids=["disturbance", "noise of the plant"])
def test_process_noise_counts(noise: dict[str, Any]) -> None:
    scenario = Prbs(samples=300, noise=0.1, process_noise=None if noise else 0.3)
    mean, deviation = ratios("armax", scenario, 60, **noise)
    assert (abs(mean - 1.0) < 4 * deviation + 0.01).all()  # 1 %: its bias in so short a record
    found, runs = least(scenario, 0, **noise)
    sensor = 0.1 / runs[1].y.std()
    assert found.simulation > 1.5 * sensor
    assert sensor < found.equation < 0.95 * found.simulation


@pytest.mark.slow
@pytest.mark.parametrize("name", ["arx", "dmdc", "n4sid", "hold"])
def test_nobody_comes_below_by_more_than_chance(name: str) -> None:
    for scenario in (Prbs(samples=200, noise=0.1), Prbs(samples=200, noise=0.1, process_noise=0.3)):
        mean, deviation = ratios(name, scenario, 30)
        assert (mean > 1.0 - 4 * deviation).all()


def test_coloured_disturbance_gets_a_state() -> None:
    scenario = Prbs(samples=4000, noise=0.1, process_noise=0.3, process_noise_bandwidth=0.5)
    plant, runs, disturbances = records(scenario, 0)
    truth = linear_truth(plant, runs, disturbances)
    assert truth is not None
    assert truth.a.shape == (3, 3)
    assert truth.a[2, 2] == pytest.approx(np.exp(-2 * np.pi * 0.5 * 0.1), abs=0.02)
    found = least_errors(truth, runs[:1], runs[1:])
    white = least(Prbs(samples=4000, noise=0.1, process_noise=0.3), 0)[0]
    assert found is not None
    assert found.equation / found.simulation < white.equation / white.simulation  # colour can be foretold


def test_what_is_not_linear_unstable_or_without_noise_has_no_bound() -> None:
    quiet, runs, disturbances = records(Prbs(samples=200), 0)
    truth = linear_truth(quiet, runs, disturbances)
    assert truth is not None
    assert least_errors(truth, runs[:1], runs[1:]) is None
    unstable = LinearTruth(*(np.array([[v]]) for v in (1.1, 1.0, 1.0, 0.0, 0.0, 0.1)), own=1, start=np.zeros((1, 1)))
    assert least_errors(unstable, runs[:1], runs[1:]) is None
    with pendulum_ode(sample_time=0.02) as pendulum:
        streams = Streams("p", "s", 0)
        swung = perform(pendulum, Prbs(samples=500, noise=0.001).prepare(pendulum.spec, streams=streams, role="a"),
                        rng=streams("plant"))  # fmt: skip
        assert linear_truth(pendulum, [swung], [None]) is None
