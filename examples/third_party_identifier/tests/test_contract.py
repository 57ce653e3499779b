"""The contract of sysid-harness, check by check."""

from __future__ import annotations

import numpy as np
import pytest
from sysid_neighbours import Neighbours

from harness.conformance import Check, identifier_checks
from harness.errors import FitError, InputError
from harness.signals import Channel, PlantSpec
from harness.testing import LinearSystem, simulate_linear


@pytest.mark.parametrize("check", identifier_checks(), ids=str)
def test_contract(check: Check) -> None:
    check(Neighbours)


def test_it_learns_a_linear_system_exactly() -> None:
    spec = PlantSpec((Channel("u"),), (Channel("y"),), 1.0, (Channel("a"), Channel("b")))
    system = LinearSystem(np.array([[0.9, 0.3], [-0.3, 0.7]]), np.array([[0.0], [1.0]]), np.array([[1.0, 0.0]]), spec)
    record = simulate_linear(system, 400, rng=np.random.default_rng(1))
    model = Neighbours(lags=2).fit([record], rng=np.random.default_rng(0))
    fresh = simulate_linear(system, 50, rng=np.random.default_rng(2))
    x = model.initial_state(fresh)
    for k in range(49):
        x = model.step(model.correct(x, fresh.u[k], fresh.y[k]), fresh.u[k])
        if k > 2:
            assert model.output(x, fresh.u[k + 1]) == pytest.approx(fresh.y[k + 1], abs=1e-6)


def test_what_it_cannot_learn_from_is_refused() -> None:
    spec = PlantSpec((Channel("u"),), (Channel("y"),), 1.0, (Channel("x"),))
    system = LinearSystem(np.array([[0.5]]), np.array([[1.0]]), np.array([[1.0]]), spec)
    with pytest.raises(FitError, match="too few samples"):
        Neighbours().fit([simulate_linear(system, 20, rng=np.random.default_rng(0))], rng=np.random.default_rng(0))
    with pytest.raises(InputError, match="options of neighbours"):
        Neighbours(lags=0)
