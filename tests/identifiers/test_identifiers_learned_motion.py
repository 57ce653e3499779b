"""A motion learned by repetition: cheaper than feedback and feed-forward, near the best input, within limits."""

from __future__ import annotations

import numpy as np
import pytest

from harness import api
from harness.errors import InputError
from identifiers.control.planning import Limits, Moves, QuadraticCost, limited_change, riccati, within
from identifiers.linear.iterative import TimeVarying

PLANT = {"sample_time": 0.1, "outputs": ["x", "theta", "xdot", "thetadot"]}
ASKED = {
    "believed": {"parameters": {"rho": 400.0, "Cw": 0.0}},
    "start": {"theta": float(np.pi), "wake": 2.0},
    "q": [30.0, 10.0, 1.0, 0.1],
    "r": 1.0,
    "order": 3,
    "excitation": 0.2,
}


@pytest.fixture(scope="module")
def water():
    """Return what is found on the cart-pole in water, three corrections."""
    return api.analyse(
        "learned-motion", "hydro-cart-pole-ode", subject_options=PLANT, options={**ASKED, "repetitions": 3}
    )


def test_the_model_along_the_motion_ends_below_feedback_and_feed_forward_and_near_the_best(water):
    costs, best = water.details["costs"], water.details["best"]
    assert costs["LTI feed-forward"][0] < 0.8 * costs["LQR alone"][0]
    for name in ("LTV ILC", "iLQR", "ADMM-ILC"):
        assert min(costs[name]) < 0.95 * costs["LTI feed-forward"][0], name
        assert best < min(costs[name]) < 1.03 * best, name
    assert min(costs["LTI ILC"]) > 1.05 * min(costs["LTV ILC"])


def test_regret_is_the_sum_over_repetitions_of_what_the_best_input_would_have_saved(water):
    costs, best = water.details["costs"], water.details["best"]
    for name, regret in water.details["regrets"].items():
        assert regret == pytest.approx(sum(costs[name]) - best * len(costs[name]))
    assert water.details["regrets"]["LTV ILC"] < water.details["regrets"]["LTI ILC"]
    errors = [row["rms of x [m]"] for row in water.rows if row["method"] == "LTV ILC"]
    assert min(errors[1:]) < 0.9 * errors[0]


def test_the_picture_shows_response_input_and_cost(water):
    assert [axes.get_title() for axes in water.plot().axes] == [
        "response, best repetition", "input", "cost by repetition"
    ]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_within_limits_the_splitting_keeps_them_and_ends_below_what_ignores_them(seed):
    asked = {**ASKED, "noise": 3e-4, "change": 0.12, "limit": 0.3, "excitation": 0.05}
    found = api.analyse("learned-motion", "hydro-cart-pole-ode", subject_options=PLANT, options=asked, seed=seed)
    for row in found.rows:
        if row["method"] == "ADMM-ILC":
            assert row["largest input"] <= 0.3 + 1e-12
            assert row["largest change"] <= 0.12 + 1e-12
    costs = found.details["costs"]
    assert min(costs["ADMM-ILC"]) < 1.2 * found.details["best"]
    assert min(costs["ADMM-ILC"]) < min(min(costs["LTV ILC"]), costs["LTI feed-forward"][0])
    assert np.abs(found.details["inputs"]["LTV ILC"]).max() <= 0.3 + 1e-12, "the actuator clips"


def test_a_stable_plant_needs_no_belief_and_its_plans_keep_the_limits():
    found = api.analyse(
        "learned-motion", "pendulum-ode", subject_options={"sample_time": 0.05},
        options={"height": 1.5, "duration": 3.0, "limit": 1.25, "change": 0.4, "q": 10.0, "r": 0.01, "shape": "glide",
                 "order": 2, "repetitions": 4},
    )  # fmt: skip
    costs = found.details["costs"]
    assert min(costs["ADMM-ILC"]) < 0.5 * costs["LQR alone"][0]
    plans = [row for row in found.rows if row["method"] == "ADMM-ILC"]
    assert all(row["largest input"] <= 1.25 + 1e-12 and row["largest change"] <= 0.4 + 1e-12 for row in plans)
    assert max(row["largest input"] for row in found.rows if row["method"] == "LTI feed-forward") > 1.25


def test_options_that_make_no_motion_are_refused():
    with pytest.raises(InputError, match=r"trials: .*a number >= 3"):
        api.analyse("learned-motion", "pendulum-ode", options={"trials": 1})
    with pytest.raises(InputError, match="samples of motion"):
        api.analyse("learned-motion", "pendulum-ode", options={"duration": 0.1})


def model(n=40, seed=0):
    """Return an unstable time-varying model, a feedback that holds it, and a cost."""
    rng = np.random.default_rng(seed)
    a = np.array([[1.0, 0.1], [0.3, 1.0]]) + 0.01 * rng.normal(size=(n, 2, 2))
    b = np.repeat(np.array([[[0.0], [0.1]]]), n, axis=0)
    c = np.repeat(np.eye(2)[None, :1], n, axis=0)
    gains = np.repeat(np.array([[[12.0, 7.0]]]), n, axis=0)
    return (
        TimeVarying(a, b, c, np.zeros((n, 1, 1))),
        gains,
        QuadraticCost(np.ones((n, 1)), np.ones(1), np.full(1, 0.01)),
    )


def played(varying, u):
    """Return the outputs of a model from rest."""
    x, y = np.zeros(2), []
    for k in range(len(u)):
        y.append(varying.c_matrices[k] @ x)
        x = varying.a_matrices[k] @ x + varying.b_matrices[k] @ u[k]
    return np.array(y)


def test_recursion_and_lifted_solution_find_the_same_inputs():
    varying, gains, cost = model()
    zero = np.zeros((40, 1))
    moves = Moves.of(varying, gains)
    h, g = cost.normal(moves, zero, zero, 0.0)
    lifted = (moves.inputs @ np.linalg.solve(h, g)).reshape(40, 1)
    passed, x, u = riccati(varying, cost, zero, zero, 0.0), np.zeros(2), zero.copy()
    for k in range(40):
        u[k] = passed.forward[k] - passed.gains[k] @ x
        x = varying.a_matrices[k] @ x + varying.b_matrices[k] @ u[k]
    assert u == pytest.approx(lifted, abs=1e-8)
    assert played(varying, u).ravel() == pytest.approx(moves.outputs @ np.linalg.solve(h, g), abs=1e-8)
    nudged = cost.cost(played(varying, u + 1e-3 * np.sin(np.arange(40.0))[:, None]), u)
    assert cost.cost(played(varying, u), u) < nudged


def test_splitting_keeps_limits_and_is_the_solution_of_a_quadratic_program():
    import cvxpy

    varying, gains, cost = model()
    zero, limits = np.zeros((40, 1)), Limits(np.array([-1.5]), np.array([2.0]), np.array([0.8]))
    moves = Moves.of(varying, gains)
    h, g = cost.normal(moves, zero, zero, 1e-9)
    v, done = limited_change(h, g, moves.inputs, zero, limits)
    u = moves.inputs @ v
    assert done < 4000
    assert np.abs(within(u[:, None], limits)[:, 0] - u).max() < 1e-5
    free = cvxpy.Variable(40)
    w = moves.inputs @ free
    steps = w - cvxpy.hstack([0.0, w[:-1]])
    asked = [w <= 2.0, w >= -1.5, cvxpy.abs(steps) <= 0.8]
    program = cvxpy.Problem(cvxpy.Minimize(0.5 * cvxpy.quad_form(free, cvxpy.psd_wrap(h)) - g @ free), asked)
    program.solve(solver="CLARABEL")
    assert u == pytest.approx(moves.inputs @ free.value, abs=1e-3)
