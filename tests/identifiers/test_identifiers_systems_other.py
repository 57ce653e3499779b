"""DMD, Koopman, finite processes and online identifiers: each with the check that says that its method works."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from harness.errors import FitError
from harness.scoring import predict, regret, simulation_error
from harness.signals import Channel, PlantSpec, Trajectory
from harness.testing import FiniteProcess, simulate_finite
from identifiers.finite.mdp import MdpCounting, MdpModel, OnlineCounting, count_transitions, weissman_bound
from identifiers.koopman.koopman import Dictionary, Edmdc, KoopmanModel
from identifiers.linear.dmd import Dmdc
from identifiers.online.rls import RecursiveLeastSquares

RNG = np.random.default_rng(0)


def many_outputs(noise, seed=0, n=200, ny=400):
    """Return 400 outputs that six oscillating modes move, autonomous."""
    rng = np.random.default_rng(seed)
    angles, radii = np.array([0.2, 0.5, 0.9]), np.array([0.999, 0.997, 0.995])
    a = np.zeros((6, 6))
    for i, (w, r) in enumerate(zip(angles, radii, strict=True)):
        a[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = r * np.array([[np.cos(w), -np.sin(w)], [np.sin(w), np.cos(w)]])
    modes = np.linalg.qr(rng.normal(size=(ny, 6)))[0] * np.sqrt(ny)
    x = np.zeros((n, 6))
    x[0] = [1, 0, 1, 0, 1, 0]
    for k in range(n - 1):
        x[k + 1] = a @ x[k]
    y = x @ modes.T
    y = y + noise * y.std() * rng.normal(size=y.shape)
    spec = PlantSpec((), tuple(Channel(f"y{i}") for i in range(ny)), 1.0)
    return Trajectory(np.arange(n) * 1.0, np.zeros((n, 0)), y, spec), np.linalg.eigvals(a)


def eigenvalue_error(model, wanted):
    """Return the largest distance from a wanted eigenvalue to the nearest found."""
    return float(max(np.abs(model.eigenvalues - w).min() for w in wanted))


def test_dmd_of_four_hundred_outputs_of_rank_six():
    """Item 23: noise .01; 1.6e-3 for plain DMD, less for total DMD."""
    plain, total = [], []
    for seed in range(5):
        data, wanted = many_outputs(0.3, seed)
        plain.append(eigenvalue_error(Dmdc(rank=6).fit([data], rng=RNG), wanted))
        total.append(eigenvalue_error(Dmdc(rank=6, total=True).fit([data], rng=RNG), wanted))
    data, wanted = many_outputs(0.01)
    assert eigenvalue_error(Dmdc(rank=6).fit([data], rng=RNG), wanted) < 1.6e-3
    assert eigenvalue_error(Dmdc(rank=6, total=True).fit([data], rng=RNG), wanted) < 2.8e-4
    assert np.median(total) < 0.8 * np.median(plain)


def linear(n, seed, x0=(1.0, -1.0)):
    rng = np.random.default_rng(seed)
    a, b = np.array([[0.9, 0.2], [-0.1, 0.8]]), np.array([[0.0], [1.0]])
    u = rng.normal(size=(n, 1))
    x = np.zeros((n, 2))
    x[0] = x0
    for k in range(n - 1):
        x[k + 1] = a @ x[k] + b @ u[k]
    spec = PlantSpec((Channel("u", "V"),), (Channel("y0", "m"), Channel("y1", "m")), 0.1)
    return Trajectory(np.arange(n) * 0.1, u, x, spec)


def test_dmd_with_control_predicts_new_inputs_from_several_records():
    """Item 23: what PyDMD's DMD with control cannot do."""
    model = Dmdc().fit([linear(60, 0), linear(60, 1, (20.0, 5.0))], rng=RNG)
    assert simulation_error(model, linear(200, 9)).nrmse.max() < 1e-10


def test_delays_stand_in_for_what_is_not_measured():
    data, test = linear(300, 0), linear(300, 1)
    spec = PlantSpec(data.spec.inputs, data.spec.outputs[:1], 0.1)
    seen = [Trajectory(d.t, d.u, d.y[:, :1], spec) for d in (data, test)]
    assert simulation_error(Dmdc(delays=2).fit(seen[:1], rng=RNG), seen[1]).nrmse[0] < 1e-8
    assert simulation_error(Dmdc().fit(seen[:1], rng=RNG), seen[1]).nrmse[0] > 0.05


def koopman_data(seed, n=120, dt=0.05):
    """Return x1' = -.05 x1, x2' = -(x2 - x1^2), sampled exactly: a quadratic dictionary is closed under it."""
    rng = np.random.default_rng(seed)
    a, b = rng.uniform(0.5, 2.0, size=2)
    t = np.arange(n) * dt
    x1 = a * np.exp(-0.05 * t)
    share = a**2 / (1 - 0.1)
    x2 = share * np.exp(-0.1 * t) + (b - share) * np.exp(-t)
    spec = PlantSpec((), (Channel("x1"), Channel("x2")), dt)
    return Trajectory(t, np.zeros((n, 0)), np.column_stack([x1, x2]), spec)


def test_a_closed_basis_gives_the_koopman_eigenvalues():
    """Item 24: -1, -.1, -.05 exactly, on the functions x1, x2, x1^2."""
    runs = [koopman_data(seed) for seed in range(4)]
    dictionary = Dictionary(degree=2, scale=(1.0, 1.0))
    before = np.concatenate([dictionary.lift(r.y[:-1])[:, [0, 1, 3]] for r in runs])
    after = np.concatenate([dictionary.lift(r.y[1:])[:, [0, 1, 3]] for r in runs])
    step = np.linalg.lstsq(before, after, rcond=None)[0]
    found = np.sort(np.log(np.linalg.eigvals(step).real) / 0.05)
    assert found == pytest.approx([-1.0, -0.1, -0.05], abs=1e-10)


def test_extended_dmd_has_these_eigenvalues_among_its_own_and_predicts_freely():
    runs = [koopman_data(seed) for seed in range(6)]
    model = Edmdc(degree=2, ridge=0.0).fit(runs, rng=RNG)
    values = np.log(np.abs(np.linalg.eigvals(model.a_matrix)) + 1e-300) / 0.05
    for wanted in (-1.0, -0.1, -0.05):
        assert np.abs(values - wanted).min() < 1e-6
    assert simulation_error(model, koopman_data(50)).nrmse.max() < 1e-6
    worse = Edmdc(degree=1).fit(runs, rng=RNG)
    assert simulation_error(worse, koopman_data(50)).nrmse.max() > 1e-3


def test_more_functions_are_not_always_better():
    """Item 24: the error is not monotone in the degree."""
    rng = np.random.default_rng(0)

    def record(seed):
        u = np.repeat(np.random.default_rng(seed).uniform(-1, 1, size=(40, 1)), 8, axis=0)
        x = np.zeros((320, 2))
        for k in range(319):
            x[k + 1] = x[k] + 0.05 * np.array([x[k, 1], -np.sin(3 * x[k, 0]) - 0.3 * x[k, 1] + 2 * u[k, 0]])
        y = x + 0.01 * x.std(axis=0) * rng.normal(size=x.shape)
        spec = PlantSpec((Channel("u"),), (Channel("q"), Channel("v")), 0.05)
        return Trajectory(np.arange(320) * 0.05, u, y, spec)

    runs, test = [record(0), record(1)], record(2)
    errors = [simulation_error(Edmdc(degree=d).fit(runs, rng=RNG), test).nrmse.mean() for d in (1, 2, 3, 5, 7)]
    assert not all(a >= b for a, b in itertools.pairwise(errors)), errors


def test_a_lifted_model_starts_with_the_outputs_themselves():
    model = Edmdc(degree=3, delays=2, trigonometric=True, radial=3).fit([linear(300, 0)], rng=RNG)
    assert isinstance(model, KoopmanModel)
    x = model.initial_state(linear(300, 0))
    assert model.output(x, np.zeros(1)) == pytest.approx([1.0, -1.0])
    assert predict(model, linear(300, 0), 1)[1:].shape == (299, 2)


# ---- finite processes ------------------------------------------------------------------------------------------------


def process(states, actions, seed=0, zero=False):
    rng = np.random.default_rng(seed)
    p = rng.dirichlet(np.ones(states), size=(states, actions))
    spec = PlantSpec(
        (Channel("a", minimum=0, maximum=actions - 1, kind="category"),),
        (Channel("s", minimum=0, maximum=states - 1, kind="category"),),
        1.0,
        (Channel("s", minimum=0, maximum=states - 1, kind="category"),),
    )
    return FiniteProcess(p, spec)


def test_counting_error_falls_with_the_root_of_the_samples_below_its_bound():
    """Item 28."""
    one = process(4, 2)
    scaled = []
    for n in (2000, 8000, 32000):
        errors = []
        for seed in range(3):
            model = MdpCounting().fit([simulate_finite(one, n, rng=np.random.default_rng(seed))], rng=RNG)
            miss = np.abs(model.transition - one.P).sum(axis=2)
            assert (miss <= model.bound).all()
            errors.append(np.sqrt(np.mean(miss**2)))
        scaled.append(np.mean(errors) * np.sqrt(n))
    assert max(scaled) / min(scaled) < 1.35, scaled


def test_the_bound_holds_as_often_as_it_says():
    rng = np.random.default_rng(0)
    p = np.array([0.5, 0.3, 0.2])
    counts = rng.multinomial(200, p, size=2000)
    beyond = np.abs(counts / 200 - p).sum(axis=1) > weissman_bound(np.array(200.0), 3)
    assert beyond.mean() <= 0.05


def test_counting_equals_a_loop_and_crosses_no_seam():
    one = process(5, 3, seed=1)
    runs = [simulate_finite(one, n, rng=np.random.default_rng(n)) for n in (40, 90)]
    wanted = np.zeros((5, 3, 5))
    for run in runs:
        for k in range(len(run) - 1):
            wanted[int(run.y[k, 0]), int(run.u[k, 0]), int(run.y[k + 1, 0])] += 1
    assert np.array_equal(count_transitions(runs), wanted)
    assert wanted.sum() == 39 + 89


def test_what_was_never_visited_is_flagged_and_uniform_and_a_prior_fills_it():
    spec = process(3, 2).spec
    y = np.array([[0.0], [1.0], [0.0], [1.0], [0.0]])
    data = Trajectory(np.arange(5.0), np.zeros((5, 1)), y, spec)
    model = MdpCounting().fit([data], rng=RNG)
    assert (2, 0) in model.unvisited
    assert (0, 1) in model.unvisited
    assert model.bound[2, 0] == np.inf
    assert model.transition[2, 0].tolist() == pytest.approx([1 / 3] * 3)
    assert model.transition[0, 0].tolist() == [0.0, 1.0, 0.0]
    smooth = MdpCounting(prior=1.0).fit([data], rng=RNG)
    assert smooth.transition[0, 0].tolist() == pytest.approx([0.2, 0.6, 0.2])


@pytest.mark.parametrize(
    ("p", "ergodic"),
    [
        ([[0.5, 0.5], [0.5, 0.5]], True),
        ([[0.0, 1.0], [1.0, 0.0]], False),
        ([[1.0, 0.0], [0.5, 0.5]], False),
        ([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.5, 0.5, 0.0]], True),
    ],
)
def test_ergodicity_needs_one_class_without_a_cycle(p, ergodic):
    matrix = np.array(p)[:, None, :]
    spec = PlantSpec((), (Channel("s", minimum=0, maximum=len(p) - 1, kind="category"),), 1.0)
    assert MdpModel(spec, matrix, np.ones((len(p), 1))).ergodic() is ergodic


def test_real_signals_are_no_finite_process():
    with pytest.raises(FitError, match="finite process"):
        MdpCounting().fit([linear(20, 0)], rng=RNG)


# ---- regret ----------------------------------------------------------------------------------------------------------


def scalar_stream(n, sigma, seed):
    """Return y[k+1] = 0.5 y[k] + u[k] + noise: two parameters, noise in the equation."""
    rng = np.random.default_rng(seed)
    u = rng.normal(size=(n, 1))
    e = sigma * rng.normal(size=n)
    y = np.zeros((n, 1))
    for k in range(n - 1):
        y[k + 1] = 0.5 * y[k] + u[k] + e[k]
    return Trajectory(np.arange(n) * 1.0, u, y, PlantSpec((Channel("u"),), (Channel("y"),), 1.0))


def test_recursive_least_squares_equals_batch_to_rounding():
    """Item 18."""
    data = scalar_stream(2000, 0.1, 0)
    online = RecursiveLeastSquares(order=2, offset=True, prior=1e-6)
    state = online.start(online.init(data.spec, rng=RNG), data.y[0])
    for k in range(len(data) - 1):
        state = online.update(state, data.u[k], data.y[k + 1])
    batch = np.array(online.hindsight([data]).details["coefficients"])
    assert np.abs(state.coefficients - batch).max() < 1e-12


@pytest.mark.slow
def test_regret_grows_as_d_sigma_squared_log_t():
    """Item 3: slope against ln T within 10 % of d n sigma^2, d = 2 parameters, n = 1 output.

    The loss is (e + miss)^2. Its parts e^2 (also the rival's) and 2 e miss (mean zero, since the prediction is made
    before e is drawn) only blur the mean over streams, so that the slope is taken of the summed miss^2.
    """
    sigma, n, streams = 0.5, 300, 150
    online = RecursiveLeastSquares(order=1, offset=False, prior=1e-3)
    squares = np.zeros(n - 1)
    for seed in range(streams):
        data = scalar_stream(n, sigma, seed)
        state = online.start(online.init(data.spec, rng=RNG), data.y[0])
        guesses = np.empty(n - 1)
        for k in range(n - 1):
            guesses[k] = online.predict(state, data.u[k])[0]
            state = online.update(state, data.u[k], data.y[k + 1])
        best = 0.5 * data.y[:-1, 0] + data.u[:-1, 0]
        squares += (guesses - best) ** 2 / streams
        if seed == 0:
            found = regret(online, [data], rng=RNG, scaled=False)
            assert np.allclose(found.losses, (guesses - data.y[1:, 0]) ** 2, rtol=1e-12)
    curve, late = np.cumsum(squares), np.arange(15, n - 1)
    slope = np.polyfit(np.log(late), curve[late], 1)[0]
    assert slope == pytest.approx(2 * sigma**2, rel=0.1)
    assert squares[-50:].mean() < 0.01


def test_the_average_regret_of_counting_goes_to_zero_and_its_rival_is_the_best_table():
    one = process(4, 2, seed=3)
    data = simulate_finite(one, 4000, rng=np.random.default_rng(0))
    found = regret(OnlineCounting(), [data], rng=RNG)
    assert found.exact
    assert 0.0 <= found.average < 0.05
    assert found.average < found.cumulative[199] / 200
    rng = np.random.default_rng(1)
    s, a, after = (data.y[:-1, 0].astype(int), data.u[:-1, 0].astype(int), data.y[1:, 0].astype(int))
    best = found.hindsight.sum()
    for _ in range(50):
        table = rng.integers(4, size=(4, 2))
        assert best <= np.sum(table[s, a] != after)
