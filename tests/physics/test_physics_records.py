"""Functions and smoothed signals of whole records."""

from __future__ import annotations

import pickle

import casadi as ca
import numpy as np
import pytest

from harness.effects import compose, place_all
from harness.effects.along import arguments, down
from harness.physics import load_model
from harness.physics.arms.vectorised import OnRecords
from harness.physics.fitting.smoothing import smooth


def test_array_operations_give_what_casadi_gives() -> None:
    nominal = load_model("cart-pole")
    placed = next(one for one in place_all(nominal) if str(one) == "stribeck_friction@x")
    system = compose(nominal, [placed])
    a = ca.SX.sym("a", 2)
    left = down(system, ca.mtimes(system.mass_matrix, a) - system.generalized_forces)
    function = ca.Function("r", [*arguments(system), a], [left, ca.jacobian(left, system.p)])
    rng = np.random.default_rng(0)
    x, u, accelerations = rng.standard_normal((40, 4)), rng.standard_normal((40, 1)), rng.standard_normal((40, 2))
    p, t = system.vector(), np.arange(40.0)[:, None]
    value, slope = pickle.loads(pickle.dumps(OnRecords(function)))(x, u, p, t, accelerations)
    for k in range(40):
        wanted = function(x[k], u[k], p, t[k], accelerations[k])
        assert value[k] == pytest.approx(wanted[0].full().ravel(), rel=1e-12, abs=1e-13)
        assert slope[k] == pytest.approx(wanted[1].full().ravel(order="F"), rel=1e-12, abs=1e-13)


def test_a_signal_is_smoothed_once_and_nobody_can_change_the_answer() -> None:
    t = np.arange(300) * 0.01
    y = np.sin(3 * t) + 1e-3 * np.random.default_rng(1).standard_normal(300)
    first = smooth(y, 0.01)
    assert smooth(y.copy(), 0.01) is first
    assert np.abs(first.rate - 3 * np.cos(3 * t))[10:-10].max() < 0.1
    with pytest.raises(ValueError, match="read-only"):
        first.value[0] = 1.0
    assert smooth(y, 0.02).rate == pytest.approx(0.5 * first.rate)
