"""Linear systems of the textbook, each with the check that says that its method works."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from harness.errors import FitError
from harness.models.lqr import lqr_cost_ratio, reachable, state_observable
from harness.scoring import simulation_error
from harness.signals import Channel, PlantSpec, Trajectory
from identifiers.linear.ho_kalman import HoKalman
from identifiers.linear.least_squares import Arx, StateLeastSquares
from identifiers.linear.markov import markov_parameters

RNG = np.random.default_rng(0)
OSCILLATOR = np.array([[0.9, 0.3], [-0.2, 0.85]]), np.array([[0.0], [1.0]]), np.array([[1.0, 0.0]])


def spec_of(nu: int, ny: int, dt: float = 0.1) -> PlantSpec:
    return PlantSpec(
        tuple(Channel(f"u{i}", "V") for i in range(nu)), tuple(Channel(f"y{i}", "m") for i in range(ny)), dt
    )


def simulate(a, b, c, n, *, rng, noise=0.0, x0=None, amplitude=1.0):
    """Return a record under white input, sensor noise relative to each output's standard deviation."""
    u = amplitude * rng.normal(size=(n, b.shape[1]))
    x = np.zeros((n, a.shape[0]))
    x[0] = 0.0 if x0 is None else x0
    for k in range(n - 1):
        x[k + 1] = a @ x[k] + b @ u[k]
    y = x @ c.T
    y = y + noise * y.std(axis=0) * rng.normal(size=y.shape)
    return Trajectory(np.arange(n) * 0.1, u, y, spec_of(b.shape[1], c.shape[0]))


def impulse_response(model, n):
    """Return C A^k B of a linear model (n, ny, nu)."""
    rows, x = [], model.b_matrix
    for _ in range(n):
        rows.append(model.c_matrix @ x)
        x = model.a_matrix @ x
    return np.array(rows)


def truth(a, b, c, n):
    rows, x = [], b
    for _ in range(n):
        rows.append(c @ x)
        x = a @ x
    return np.array(rows)


def relative(found, wanted):
    return float(np.linalg.norm(found - wanted) / np.linalg.norm(wanted))


def test_simulation_error_beats_equation_error_twentyfold_under_output_noise():
    """Item 1: a second-order system, 10 % output noise, N = 600; error of the impulse response."""
    from identifiers.mechanics.grey_box import OutputError

    a, b, c = OSCILLATOR
    wanted = truth(a, b, c, 60)
    ratios = []
    for seed in range(3):
        data = simulate(a, b, c, 600, rng=np.random.default_rng(seed), noise=0.1)
        arx = Arx(order=2, offset=False).fit([data], rng=RNG)
        oe = OutputError(model="linear", options={"order": 2, "time_scale": 0.5}, horizon="record").fit([data], rng=RNG)
        simulator = oe.simulator
        p = oe.system().vector(oe.parameters)
        u = np.zeros((61, 1))
        still = simulator.rollout(p, np.zeros(2), u)
        u[0] = 1.0
        response = (simulator.rollout(p, np.zeros(2), u) - still)[1:]
        ratios.append(relative(impulse_response(arx, 60), wanted) / relative(response[:, :, None], wanted))
    assert np.median(ratios) >= 20.0, ratios


@pytest.mark.parametrize("method", ["iv", "tls"])
def test_noise_on_the_states_biases_least_squares_at_any_length_and_the_remedies_do_not(method):
    """Item 4."""
    a, b, _ = OSCILLATOR
    bias, rest = [], []
    for n in (2000, 20000):
        data = simulate(a, b, np.eye(2), n, rng=np.random.default_rng(5), noise=0.5)
        plain = StateLeastSquares(least_excitation=0.0).fit([data], rng=RNG)
        better = StateLeastSquares(method=method, least_excitation=0.0).fit([data], rng=RNG)
        bias.append(float(np.abs(plain.a_matrix - a).max()))
        rest.append(float(np.abs(better.a_matrix - a).max()))
    assert min(bias) > 0.15
    assert bias[1] > 0.9 * bias[0]
    assert rest[1] < 0.02


def test_outliers_hurt_least_squares_and_not_least_absolute_deviations():
    """Item 21: 5 % outliers."""
    a, b, _ = OSCILLATOR
    clean = simulate(a, b, np.eye(2), 400, rng=np.random.default_rng(3))
    rng = np.random.default_rng(4)
    y = clean.y + 1e-3 * rng.normal(size=clean.y.shape)
    y[rng.random(400) < 0.05] += 3.0
    data = Trajectory(clean.t, clean.u, y, clean.spec)
    errors = {}
    for method in ("ls", "l1", "linf"):
        model = StateLeastSquares(method=method, least_excitation=0.0).fit([data], rng=RNG)
        errors[method] = float(np.abs(model.a_matrix - a).max())
    assert errors["l1"] < 5e-3
    assert errors["ls"] > 20 * errors["l1"]


def test_each_criterion_minimises_its_own_cost():
    """Item 21: least squares, least sum of absolute errors, least sum of the largest component of each sample."""
    a, b, _ = OSCILLATOR
    data = simulate(a, b, np.eye(2), 150, rng=np.random.default_rng(3), noise=0.05)
    costs = {
        "ls": lambda miss: float(np.sum(miss**2)),
        "l1": lambda miss: float(np.sum(np.abs(miss))),
        "linf": lambda miss: float(np.sum(np.abs(miss).max(axis=1))),
    }
    theta, miss = {}, {}
    rows = np.hstack([data.y[:-1], data.u[:-1]])
    for method in costs:
        model = StateLeastSquares(method=method, least_excitation=0.0).fit([data], rng=RNG)
        theta[method] = np.vstack([model.a_matrix.T, model.b_matrix.T])
        miss[method] = data.y[1:] - rows @ theta[method]
    rng = np.random.default_rng(0)
    for method, cost in costs.items():
        own = cost(miss[method])
        assert all(own <= cost(other) * (1 + 1e-9) for other in miss.values())
        for size in (1e-4, 1e-2):  # convex: no neighbour is better, so no point is
            near = [theta[method] + size * rng.normal(size=(3, 2)) for _ in range(50)]
            assert all(own <= cost(data.y[1:] - rows @ one) * (1 + 1e-9) for one in near), method


def test_the_largest_components_equal_a_program_written_anew():
    """Item 21: the same optimum from cvxpy's own formulation."""
    cvxpy = pytest.importorskip("cvxpy", reason="the peer solver is not installed")
    a, b, _ = OSCILLATOR
    data = simulate(a, b, np.eye(2), 80, rng=np.random.default_rng(7), noise=0.2)
    model = StateLeastSquares(method="linf", least_excitation=0.0).fit([data], rng=RNG)
    own = float(np.abs(data.y[1:] - data.y[:-1] @ model.a_matrix.T - data.u[:-1] @ model.b_matrix.T).max(axis=1).sum())
    big_a, big_b = cvxpy.Variable((2, 2)), cvxpy.Variable((2, 1))
    wrong = data.y[1:] - data.y[:-1] @ big_a.T - data.u[:-1] @ big_b.T
    best = cvxpy.Problem(cvxpy.Minimize(cvxpy.sum(cvxpy.max(cvxpy.abs(wrong), axis=1)))).solve(solver="CLARABEL")
    assert own == pytest.approx(best, rel=1e-6)


def test_the_exercise_on_objectives_comes_out_as_published():
    """Item 21: ch. 18 of Underactuated Robotics; errors of 1e-5 beside inputs of 1: the solver stopped 8e-5 above."""
    a = np.array([[0.8, -0.1, 0.0, 0.0], [0.0, 0.2, 0.0, 0.1], [0.0, -0.1, 1.0001, 0.0], [0.0, 0.2, 0.0, 0.1]])
    b = np.array([[0.0], [-0.02], [0.01], [-0.02]])
    t = np.arange(1000) * 0.1
    u, x = np.sin(0.1 * t)[:, None], np.zeros((1000, 4))
    for k in range(999):
        x[k + 1] = a @ x[k] + b @ u[k]
    np.random.seed(0)  # noqa: NPY002 - the exercise's own noise
    x += 1e-5 * np.random.normal(size=(4, 1000)).T  # noqa: NPY002
    spec = PlantSpec((Channel("u"),), tuple(Channel(f"x{i}") for i in range(4)), 0.1)
    for method, cost, published in (
        ("ls", lambda miss: np.sum(miss**2), 5.313e-7),
        ("linf", lambda miss: np.sum(np.abs(miss).max(axis=1)), 0.016846),
        ("l1", lambda miss: np.sum(np.abs(miss)), 0.036672),
    ):
        model = StateLeastSquares(method=method, least_excitation=0.0).fit([Trajectory(t, u, x, spec)], rng=RNG)
        assert cost(x[1:] - x[:-1] @ model.a_matrix.T - u[:-1] @ model.b_matrix.T) == pytest.approx(published, rel=4e-5)


def balance(folder: Path, name: str, noise: float = 0.0):
    content = np.load(folder / "textbook" / f"cartpole_balance_wrongLQR_{name}.npz")
    spec = PlantSpec(
        (Channel("u", "N"),),
        tuple(Channel(n, u) for n, u in (("x", "m"), ("theta", "rad"), ("v", "m/s"), ("w", "rad/s"))),
        0.1,
    )
    rng = np.random.default_rng(0)
    runs = [
        Trajectory(np.arange(81) * 0.1, u.T, x.T + noise * rng.normal(size=(81, 4)), spec)
        for x, u in zip(content["X"], content["U"], strict=True)
    ]
    return runs, content


@pytest.mark.parametrize("noise", [0.0, 1e-6])
def test_balancing_under_pure_state_feedback_is_refused(recordings_folder, noise):
    """Item 20: rank 4 of 5, also where noise makes the numeric rank 5: the controller is named."""
    runs, _ = balance(recordings_folder, "pure", noise)
    with pytest.raises(FitError, match=r"u = -137\.4 theta - 22\.\d+ w \+ 4\.8\d+ v"):
        StateLeastSquares().fit(runs, rng=RNG)


def test_balancing_with_a_little_excitation_gives_a_controller_as_good_as_the_true_one(recordings_folder):
    """Items 20 and 5: A to 1.3e-4, LQR cost ratio 1 + 7e-9."""
    runs, content = balance(recordings_folder, "excited")
    model = StateLeastSquares().fit(runs, rng=RNG)
    assert relative(model.a_matrix, content["A"]) < 2e-4
    found = lqr_cost_ratio((model.a_matrix, model.b_matrix), (content["A"], content["B"]))
    assert found.status == "ok"
    assert 1.0 - 1e-9 <= found.ratio < 1.0 + 1e-7
    assert reachable(model.a_matrix, model.b_matrix) == 4
    assert state_observable(model.a_matrix, model.c_matrix) == 4


def test_a_design_that_does_not_stabilise_costs_infinity():
    plant = np.array([[1.1]]), np.array([[1.0]])
    assert lqr_cost_ratio(plant, plant).ratio == pytest.approx(1.0, abs=1e-12)
    assert lqr_cost_ratio((np.array([[0.1]]), np.array([[1.0]])), plant).ratio == np.inf
    assert lqr_cost_ratio((np.array([[1.1]]), np.array([[0.0]])), plant).status == "no design"


def test_many_markov_parameters_by_conjugate_gradients_equal_the_dense_solution(monkeypatch):
    import identifiers.linear.markov as room

    rng = np.random.default_rng(0)
    a, b = np.array([[0.8, 0.2], [-0.3, 0.7]]), rng.normal(size=(2, 2))
    runs = [simulate(a, b, rng.normal(size=(3, 2)), n, rng=rng, noise=0.1) for n in (700, 420)]
    fast = markov_parameters(runs, 60)
    monkeypatch.setattr(room, "_DENSE", 10_000)
    dense = markov_parameters(runs, 60)
    for one, two in zip(fast, dense, strict=True):
        assert np.abs(one - two).max() < 1e-9


def test_an_input_that_does_not_excite_all_lags_is_refused():
    a, b, c = OSCILLATOR
    t = np.arange(500)
    u = np.sin(0.3 * t)[:, None]
    x = np.zeros((500, 2))
    for k in range(499):
        x[k + 1] = a @ x[k] + b @ u[k]
    data = Trajectory(t * 0.1, u, x @ c.T, spec_of(1, 1))
    with pytest.raises(FitError, match="does not excite all lags"):
        HoKalman(markov=100).fit([data], rng=RNG)


def test_fitted_models_simulate_held_out_data():
    a, b, c = OSCILLATOR
    data = simulate(a, b, c, 4000, rng=np.random.default_rng(0), noise=0.1)
    test = simulate(a, b, c, 1000, rng=np.random.default_rng(1))
    for identifier in (HoKalman(order=2), HoKalman(order=2, observer=12), Arx(order=20)):
        assert simulation_error(identifier.fit([data], rng=RNG), test).nrmse[0] < 0.02, identifier
