"""Learning by repetition: a wrong model along the trajectory is enough, one that stands still is not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from harness.errors import InputError
from harness.scoring.rounds import interleaved
from harness.signals import Channel, PlantSpec, Trajectory
from identifiers.linear.iterative import learn_input, linearised_along
from identifiers.linear.least_squares import StateLeastSquares

DT, N = 0.05, 80
SPEC = PlantSpec((Channel("u", "N m"),), (Channel("theta", "rad"),), DT)


@dataclass(frozen=True)
class Pendulum:
    """A pendulum of given mass, length and damping, stepped by Runge and Kutta."""

    m: float = 1.0
    l: float = 1.0  # noqa: E741
    b: float = 0.1
    spec: PlantSpec = SPEC
    burn_in: int = 0

    def output(self, x, u):
        return x[..., :1]

    def step(self, x, u):
        def slope(x):
            torque = u[..., 0] - self.b * x[..., 1] - self.m * 9.81 * self.l * np.sin(x[..., 0])
            return np.stack([x[..., 1], torque / (self.m * self.l**2)], axis=-1)

        a = slope(x)
        b = slope(x + DT / 2 * a)
        c = slope(x + DT / 2 * b)
        d = slope(x + DT * c)
        return x + DT / 6 * (a + 2 * b + 2 * c + d)

    def run(self, u):
        x, y = np.zeros(2), np.empty((len(u), 1))
        for k in range(len(u)):
            y[k] = x[:1]
            x = self.step(x, u[k])
        return y


def swing():
    """Return an angle that goes from hanging to 2 rad and back, where the pendulum pulls the other way."""
    return (2.0 * np.sin(np.pi * np.clip(np.arange(N) * DT / 3.5, 0, 1)) ** 2)[:, None]


TRUE, WRONG = Pendulum(), Pendulum(m=1.3, l=1.0, b=0.3)


def test_a_wrong_model_along_the_trajectory_learns_and_one_that_stands_still_diverges():
    """Item 22: a pendulum 30 % too heavy in the model; 14 repetitions; below 0.0245 rad, time-invariant diverges."""
    reference, still = swing(), np.zeros((N, 1))
    # the input of the wrong model for the reference: learned on the model itself
    own = learn_input(WRONG.run, reference, still, lambda u: linearised_along(WRONG, np.zeros(2), u), repetitions=20)
    assert own.errors[-1] < 0.005
    along = linearised_along(WRONG, np.zeros(2), own.inputs)
    learned = learn_input(TRUE.run, reference, own.inputs, along, repetitions=14)
    assert learned.errors[0] > 1.94  # measured 17: it goes over the top
    assert learned.errors[-1] < 0.0245  # measured 0.007
    assert np.sqrt(np.mean((TRUE.run(learned.inputs) - reference) ** 2)) == pytest.approx(min(learned.errors))
    frozen = learn_input(TRUE.run, reference, own.inputs, along.frozen(), repetitions=14)
    assert frozen.errors[-1] > 100 * frozen.errors[0]


def test_the_lifted_map_is_the_slope_of_the_run():
    u = 2.0 * np.sin(np.arange(N) * DT)[:, None]
    gain = linearised_along(TRUE, np.zeros(2), u).lifted()
    for k in (0, 20, 60):
        push = np.zeros((N, 1))
        push[k] = 1e-5
        slope = (TRUE.run(u + push) - TRUE.run(u - push)) / 2e-5
        assert gain[:, k] == pytest.approx(slope[:, 0], abs=1e-5)


def test_a_run_that_diverges_cannot_be_linearised():
    with pytest.raises(InputError, match="finite run"):
        linearised_along(TRUE, np.zeros(2), np.full((N, 1), np.nan))


def test_in_turns_the_cost_falls_and_the_coverage_grows_and_pure_feedback_is_refused():
    """Item 33."""
    a, b = np.array([[1.0, 0.1], [0.15, 1.0]]), np.array([[0.0], [0.1]])
    spec = PlantSpec((Channel("u"),), (Channel("x"), Channel("v")), 0.1)

    def collector(excitation):
        def collect(gain, number):
            rng = np.random.default_rng([number, 7])
            x, u = np.zeros((60, 2)), np.zeros((60, 1))
            x[0] = [1.0, 0.0]
            for k in range(60):
                u[k] = -gain @ x[k] + excitation * rng.normal()
                if k < 59:
                    x[k + 1] = a @ x[k] + b @ u[k] + 0.01 * rng.normal(size=2)
            return Trajectory(np.arange(60) * 0.1, u, x, spec)

        return collect

    first = np.array([[4.0, 6.0]])
    identifier = StateLeastSquares()
    costs, coverage = [], []
    found = interleaved(identifier, collector(0.3), (a, b), first, rounds=6, rng=np.random.default_rng(0))
    costs = [one.cost.ratio for one in found]
    coverage = [one.coverage for one in found]
    assert all(one.refused == "" for one in found)
    assert costs[-1] < 1.01
    assert costs[-1] - 1.0 < 0.5 * (costs[0] - 1.0)
    assert min(coverage) > 0.02
    pure = interleaved(identifier, collector(0.0), (a, b), first, rounds=1, rng=np.random.default_rng(0))
    assert "do not determine" in pure[0].refused
    assert pure[0].coverage < 1e-10
