"""The stochastic grey box through the ordinary interfaces."""

from __future__ import annotations

import numpy as np

from harness import registry
from harness.models.estimate import estimate_of
from harness.rng import Streams
from harness.rollout import run
from harness.scoring import simulation_error


def records(disturbance: float) -> tuple:
    plant = registry.create("plants", "pendulum-ode", sample_time=0.02)
    scenario = registry.create(
        "scenarios", "multisine", duration=20.0, amplitude=0.4, noise=1e-3,
        process_noise=disturbance, process_noise_bandwidth=2.0,
    )  # fmt: skip
    streams = Streams("pendulum-ode", "multisine", 5)
    return tuple(
        run(plant, scenario, streams=streams, role=role).measured() for role in ("estimation/0", "validation/0")
    )


def test_the_force_that_nobody_measured_is_estimated_and_its_parameters_hold() -> None:
    learn, _ = records(0.05)
    fitted = registry.create("identifiers", "maximum-likelihood", model="pendulum").fit(
        [learn], rng=np.random.default_rng(0)
    )
    estimate = estimate_of(fitted)
    truth = registry.create("plants", "pendulum-ode", sample_time=0.02).true_parameters
    for name, value in zip(estimate.names, estimate.values, strict=True):
        assert abs(value - truth[name]) < 4 * estimate.deviation(name)
    noise = fitted.notes["noise"]
    assert 0.5e-3 < noise["r"][0] < 2e-3
    assert 0.02 < np.hypot(noise["s"][0], noise["w"][0]) < 0.2


def test_without_a_disturbance_it_simulates_as_output_error_does() -> None:
    learn, held_out = records(0.0)
    errors = [
        simulation_error(
            registry.create("identifiers", name, model="pendulum").fit([learn], rng=np.random.default_rng(0)), held_out
        ).nrmse[0]
        for name in ("maximum-likelihood", "output-error")
    ]
    assert errors[0] < 1.02 * errors[1]
