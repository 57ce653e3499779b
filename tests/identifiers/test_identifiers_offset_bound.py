"""Bounds of a sensor offset: what is certified is below what simulation shows, and nothing false is proved."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harness import api
from harness.errors import InputError
from identifiers.control.invariant import Ellipsoid, Loop, certified, widened
from identifiers.control.taylor_models import bounded


def pendulum():
    """Return a pendulum on its head under feedback that reads its angle wrongly."""
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u", 1)
    return Loop(x, u, ca.vertcat(x[1], ca.sin(x[0]) + u[0]), np.array([[3.0, 2.0]]), np.array([1.0, 0.0]))


def test_a_certified_set_is_not_left_by_the_worst_offset():
    loop = pendulum()
    first = Ellipsoid(np.linalg.cholesky(np.array([[3.0, 1.0], [1.0, 1.0]]) / 0.05), np.zeros(2), -1e-3, 1e-3)
    found = widened(loop, first, moving=False, margin=0.1, within=np.full(2, 1.5), rng=np.random.default_rng(0))
    assert found.high > 0.05
    proof = certified(loop, found)
    assert proof.holds
    rng = np.random.default_rng(1)
    p = found.lower @ found.lower.T
    x = np.linalg.solve(found.lower.T, rng.normal(size=(2, 200)))
    x = x / np.sqrt(np.einsum("in,ij,jn->n", x, p, x))  # on the boundary
    for _ in range(4000):
        outwards = np.sign(-(p @ x)[1] * 3.0)
        d = found.high * outwards
        u = -3.0 * (x[0] + d) - 2.0 * x[1]
        x = x + 1e-3 * np.array([x[1], np.sin(x[0]) + u])
        assert np.einsum("in,ij,jn->n", x, p, x).max() < 1.0 + 1e-4


def test_what_can_be_left_is_not_certified():
    loop = pendulum()
    round_ = Ellipsoid(np.eye(2), np.zeros(2), -0.05, 0.05)
    assert not certified(loop, round_).holds
    first = Ellipsoid(np.linalg.cholesky(np.array([[3.0, 1.0], [1.0, 1.0]]) / 0.05), np.zeros(2), -1e-3, 1e-3)
    found = widened(loop, first, moving=False, margin=0.1, within=np.full(2, 1.5), rng=np.random.default_rng(0))
    points = np.random.default_rng(2).normal(size=(2, 5000))
    points = np.linalg.solve(found.lower.T, points / np.linalg.norm(points, axis=0))
    p, held = found.lower @ found.lower.T, []
    for factor in (1.0, 1.5, 2.0, 3.0, 6.0):
        d = factor * found.high
        rates = [np.array([points[1], np.sin(points[0]) - 3 * (points[0] + s * d) - 2 * points[1]]) for s in (-1, 1)]
        leaves = max(float(np.einsum("in,ij,jn->n", points, p, rate).max()) for rate in rates)
        held.append(certified(loop, replace(found, low=-d, high=d)).holds)
        assert leaves < 0 or not held[-1], "no proof of what a sample refutes"
    assert held[0]
    assert not held[-1]
    assert not certified(loop, found, most=1).holds, "it gives up"


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.floats(-1.5, 1.5), min_size=2, max_size=2), st.floats(1e-3, 0.3), st.integers(0, 2**31),
)  # fmt: skip
def test_a_taylor_model_is_never_exceeded(middle, half, seed):
    x = ca.SX.sym("x", 2)
    value = ca.sin(3 * x[0]) * ca.cos(x[1]) / (2 + x[1] ** 2) - ca.sqrt(4 + x[0]) * x[1] + x[0] ** 2
    f = ca.Function("f", [x], [value])
    middle, half = np.array([middle]), np.full((1, 2), half)
    most = float(bounded(f, middle, half).most()[0])
    points = middle + half * np.random.default_rng(seed).uniform(-1, 1, size=(200, 2))
    reached = float(f.map(200)(points.T).full().max())
    assert reached <= most
    near = bounded(f, middle, 1e-3 * np.ones((1, 2)))
    assert float(near.most()[0]) - float(f(middle[0])) < 0.05, "and not idle"


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_the_bounds_of_the_acrobot_stand_in_order(seed):
    found = api.analyse("offset-bound", "acrobot", options={"target": {"theta1": float(np.pi)}}, seed=seed)
    bounds = found.details["bounds"]
    assert found.details["gains"][:2] == pytest.approx([23.0, -57.5], abs=0.05)
    assert 0.006 < bounds["certified, changing"] < bounds["certified, constant"]
    assert 0.012 < bounds["certified, constant"] < bounds["posture"] < 0.033
    assert bounds["certified, changing"] < bounds["simulated, changing"] <= bounds["simulated, constant"]
    assert 0.04 <= bounds["simulated, constant"] < 0.045
    assert found.plot().axes[0].get_title() == "bounds of the offset"


def test_a_pendulum_on_its_head_bears_what_is_certified():
    found = api.analyse("offset-bound", "pendulum", options={"target": {"theta": float(np.pi)}, "duration": 5.0})
    bounds = found.details["bounds"]
    assert found.details["sets"]["certified, changing"]["holds"]
    assert 1e-3 < bounds["certified, changing"] <= bounds["simulated, changing"]
    assert bounds["certified, changing"] <= bounds["certified, constant"] <= bounds["simulated, constant"]


@pytest.mark.slow
def test_a_cart_pole_is_proved_on_few_pieces():
    found = api.analyse("offset-bound", "cart-pole", options={"target": {"theta": float(np.pi)}, "duration": 10.0})
    bounds = found.details["bounds"]
    assert 0.005 < bounds["certified, changing"] <= bounds["simulated, changing"]
    assert bounds["certified, changing"] < bounds["certified, constant"] <= bounds["simulated, constant"]
    assert max(row["cells"] for row in found.rows) < 50_000  # 262144 where every face begins with 32 cells an edge


def test_what_is_no_mechanism_or_no_state_is_refused():
    with pytest.raises(InputError, match="offset-bound"):
        api.analyse("offset-bound", "acrobot", options={"target": {"hip": 1.0}})
    with pytest.raises(InputError, match="LQR can hold"):
        api.analyse("offset-bound", "acrobot", options={"target": {"theta1": 1.0}, "q": [0.0] * 4})
