"""Sparse regression: the right terms, in any units, also with noise and nearly dependent functions."""

from __future__ import annotations

import numpy as np
import pytest

from harness.errors import FitError, InputError
from harness.models.estimate import estimate_of
from harness.scoring import simulation_error
from harness.signals import Channel, FloatArray, PlantSpec, Trajectory
from identifiers.common.library import Library
from identifiers.common.normal import NormalEquations
from identifiers.sparse.selection import best_subset, ensemble, lasso, lasso_path
from identifiers.sparse.stlsq import Stlsq, eliminate, stlsq

RNG = np.random.default_rng(0)
LORENZ = PlantSpec((), tuple(Channel(name) for name in "xyz"), 0.005)
TERMS = (("x", "y"), ("x", "y", "x z"), ("z", "x y"))


def lorenz(x: FloatArray) -> FloatArray:
    return np.array([10 * (x[1] - x[0]), x[0] * (28 - x[2]) - x[1], x[0] * x[1] - 8 / 3 * x[2]])


def lorenz_run(samples: int = 2000, noise: float = 0.0, x0: tuple[float, ...] = (-8.0, 7.0, 27.0)) -> Trajectory:
    x, h, states = np.array(x0), 0.005, []
    for _ in range(samples):
        states.append(x)
        a = lorenz(x)
        b = lorenz(x + h / 2 * a)
        c = lorenz(x + h / 2 * b)
        x = x + h / 6 * (a + 2 * b + 2 * c + lorenz(x + h * c))
    y = np.array(states) + noise * np.random.default_rng(1).normal(size=(samples, 3))
    return Trajectory(np.arange(samples) * h, np.zeros((samples, 0)), y, LORENZ)


@pytest.mark.parametrize("rule", [stlsq, eliminate])
@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_five_of_twenty_functions_exactly(rule, noise):
    for seed in range(10):
        rng = np.random.default_rng(seed)
        phi, true = rng.normal(size=(20, 400)), np.zeros(20)
        chosen = rng.choice(20, 5, replace=False)
        true[chosen] = rng.choice([-1, 1], 5) * rng.uniform(0.5, 2, 5)
        target = (true @ phi + noise * rng.normal(size=400))[None]
        equations = NormalEquations.of([(phi[:, :150], target[:, :150]), (phi[:, 150:], target[:, 150:])], 20, 1)
        found, support = rule(equations, 0.08)
        assert set(np.flatnonzero(support[:, 0])) == set(chosen)
        assert found[:, 0] == pytest.approx(true, abs=4 * noise / np.sqrt(400) + 1e-10)


@pytest.mark.parametrize("rule", [stlsq, eliminate])
def test_units_do_not_change_what_is_found(rule):
    rng = np.random.default_rng(2)
    phi, units = rng.normal(size=(8, 300)), 10.0 ** rng.integers(-6, 6, size=8)
    target = (3 * phi[1] - 0.5 * phi[6])[None]
    plain = rule(NormalEquations.of([(phi, target)], 8, 1), 0.05)
    scaled = rule(NormalEquations.of([(phi * units[:, None], 1e4 * target)], 8, 1), 0.05)
    assert np.array_equal(plain[1], scaled[1])
    assert scaled[0][:, 0] * units / 1e4 == pytest.approx(plain[0][:, 0], rel=1e-9)


def test_a_target_of_zero_has_no_terms():
    phi = RNG.normal(size=(4, 100))
    for rule in (stlsq, eliminate):
        found, support = rule(NormalEquations.of([(phi, np.zeros((1, 100)))], 4, 1), 0.05)
        assert not support.any()
        assert not found.any()


@pytest.mark.parametrize("noise", [0.0, 0.01, 0.1])
def test_the_lorenz_equations_with_and_without_noise(noise):
    model = Stlsq(degree=3, order=1).fit([lorenz_run(noise=noise)], rng=RNG)
    assert model.support == TERMS
    found = dict(zip(model.library.names, model.coefficients[1], strict=True))
    assert found["x"] == pytest.approx(28.0, rel=2e-5 if noise == 0.0 else 2e-3)


def test_the_classical_rule_with_a_threshold_that_suits_it():
    model = Stlsq(degree=2, order=1, rule="threshold", threshold=0.05).fit([lorenz_run()], rng=RNG)
    assert model.support == TERMS


def test_a_free_run_that_leaves_the_data_far_behind_is_infinite_and_no_exception():
    spec = PlantSpec((), (Channel("x"),), 0.01)
    t = np.arange(90) * 0.01
    escape = Trajectory(t, np.zeros((90, 0)), (1 / (1 - t))[:, None], spec)  # x' = x^2
    model = Stlsq(degree=2, order=1).fit([escape], rng=RNG)
    assert model.support == (("x^2",),)
    longer = Trajectory(np.arange(300) * 0.01, np.zeros((300, 0)), np.full((300, 1), 1.0), spec)
    assert simulation_error(model, longer).rms[0] == np.inf


def test_discrete_maps_need_no_derivative():
    x = [0.3]
    for _ in range(200):
        x.append(3.7 * x[-1] * (1 - x[-1]))
    spec = PlantSpec((), (Channel("x"),), 1.0)
    model = Stlsq(time="discrete", degree=3).fit(
        [Trajectory(np.arange(201.0), np.zeros((201, 0)), np.array(x)[:, None], spec)], rng=RNG
    )
    assert model.equations == ("x[k+1] = 3.7 x - 3.7 x^2",)


def test_positions_alone_give_second_order_equations():
    t = np.arange(800) * 0.02
    spec = PlantSpec((), (Channel("q", "m"),), 0.02)
    swing = Trajectory(t, np.zeros((800, 0)), (np.exp(-0.1 * t) * np.cos(2 * t))[:, None], spec)
    model = Stlsq(degree=2).fit([swing], rng=RNG)
    assert model.order == 2
    assert model.support == (("q", "q'"),)
    found = dict(zip(model.library.names, model.coefficients[0], strict=True))
    assert (found["q"], found["q'"]) == pytest.approx((-4.01, -0.2), rel=1e-3)


@pytest.mark.parametrize(
    "options",
    [{"degree": 0}, {"threshold": 1.0}, {"order": 3}, {"time": "discrete", "order": 2}, {"rule": "best"}, {"half": 1}],
)
def test_options_that_make_no_sense_are_refused(options):
    with pytest.raises(InputError, match="option of stlsq"):
        Stlsq(**options).fit([lorenz_run(50)], rng=RNG)


def test_short_and_still_records_are_refused_in_words():
    with pytest.raises(FitError, match=r"too short|fewer equations"):
        Stlsq(degree=5, order=1).fit([lorenz_run(20)], rng=RNG)
    still = Trajectory(np.arange(90) * 0.005, np.zeros((90, 0)), np.ones((90, 3)), LORENZ)
    with pytest.raises(FitError, match="never move"):
        Stlsq().fit([still], rng=RNG)


def test_the_model_refuses_other_data_and_bad_matrices():
    model = Stlsq(degree=2, order=1).fit([lorenz_run(400)], rng=RNG)
    other = PlantSpec((), tuple(Channel(name) for name in "abc"), 0.005)
    with pytest.raises(InputError, match="outputs of the data"):
        model.initial_state(Trajectory(np.arange(9) * 0.005, np.zeros((9, 0)), np.zeros((9, 3)), other))


def test_library_names_values_and_source_agree():
    library = Library(("q", "w", "u"), degree=2, angles=(0,), harmonics=2)
    values = RNG.normal(size=(7, 3))
    rows = library(values)
    assert rows.shape == (7, len(library.names)) == (7, len(library))
    by_name = dict(zip(library.names, rows.T, strict=True))
    assert by_name["sin(2 q) w"] == pytest.approx(np.sin(2 * values[:, 0]) * values[:, 1])
    assert by_name["w u"] == pytest.approx(values[:, 1] * values[:, 2])
    assert "sin(q) cos(q)" not in by_name, "a product of one angle is a harmonic"
    coefficients = RNG.normal(size=(2, len(library)))
    names: dict = {}
    exec(library.source(coefficients), names)
    assert np.array(names["value"](np.sin, np.cos, *values.T)).T == pytest.approx(rows @ coefficients.T)


# ---- LASSO, best subset, ensembles ----


def planted(seed: int, *, p: int = 20, n: int = 400, noise: float = 0.1):
    """Return five of twenty correlated columns plus noise, and the columns."""
    rng = np.random.default_rng(seed)
    phi = rng.normal(size=(p, n))
    phi[1:] += 0.5 * phi[:-1]
    true = np.zeros(p)
    true[[2, 5, 7, 11, 18]] = [1.0, -2.0, 0.5, 1.5, -1.0]
    return phi, true @ phi + noise * rng.normal(size=n), true


@pytest.mark.parametrize(
    "rule", [lasso, best_subset, lambda e: eliminate(e, 0.05)], ids=["lasso", "subset", "eliminate"]
)
def test_every_rule_finds_five_of_twenty(rule):
    """Item 16: exact support 5 of 20."""
    exact = 0
    for seed in range(10):
        phi, y, true = planted(seed)
        coefficients, support = rule(NormalEquations.of([(phi, y[None])], 20, 1))
        exact += bool(np.array_equal(support[:, 0], true != 0))
        assert np.abs(coefficients[:, 0] - true).max() < 0.06
    assert exact >= 8


def test_the_lasso_path_satisfies_its_optimality_conditions():
    phi, y, _ = planted(0)
    length = np.linalg.norm(phi, axis=1)
    scaled = phi / length[:, None]
    gram, right = scaled @ scaled.T, scaled @ y
    penalties = np.abs(right).max() * np.array([1.0, 0.5, 0.1, 0.01])
    for penalty, own in zip(penalties, lasso_path(gram, right, penalties), strict=True):
        slope = right - gram @ own
        assert np.all(np.abs(slope) <= penalty * (1 + 1e-5))
        assert slope[own != 0] == pytest.approx(penalty * np.sign(own[own != 0]), rel=1e-5)


def test_best_subset_is_the_best_of_all(monkeypatch):
    from itertools import combinations
    from math import comb

    import identifiers.sparse.selection as room

    phi, y, _ = planted(3, n=60, noise=2.0)
    phi = phi[:9]
    equations = NormalEquations.of([(phi, y[None])], 9, 1)

    def bic(keep):
        rows = phi[list(keep)]
        lost = np.sum((y - np.linalg.lstsq(rows.T, y)[0] @ rows) ** 2) if keep else np.sum(y**2)
        return 60 * np.log(lost) + len(keep) * np.log(60) + 2 * np.log(comb(9, len(keep)))

    best = min((keep for k in range(10) for keep in combinations(range(9), k)), key=bic)
    assert np.flatnonzero(best_subset(equations)[1][:, 0]).tolist() == list(best)
    monkeypatch.setattr(room, "_EXHAUSTIVE", 0)
    exchanged = np.flatnonzero(best_subset(equations)[1][:, 0]).tolist()
    assert bic(exchanged) <= bic(best) + 2.0


def test_an_ensemble_says_how_sure_each_term_is():
    phi, y, true = planted(1, n=600, noise=1.5)
    pieces = NormalEquations.in_pieces([(phi, y[None])], 20, 1)
    whole = NormalEquations.of([(phi, y[None])], 20, 1)
    again = NormalEquations.sum(pieces, np.ones(len(pieces), dtype=int))
    assert again.gram == pytest.approx(whole.gram)
    assert again.rows == whole.rows == 600
    found = ensemble(pieces, best_subset, 40, np.random.default_rng(0))
    share = found.inclusion[:, 0]
    assert share[[2, 5, 11, 18]].min() > 0.9
    assert share[true == 0].mean() < 0.3
    assert np.array_equal(found.support[:, 0], share >= 0.5)


@pytest.mark.parametrize("rule", ["lasso", "subset"])
def test_a_swing_is_identified_by_every_rule_with_inclusion_probabilities(rule):
    rng = np.random.default_rng(0)
    u, x = np.repeat(rng.normal(size=(80, 1)), 5, axis=0), np.zeros((400, 2))
    for k in range(399):
        x[k + 1] = x[k] + 0.1 * np.array([x[k, 1], -x[k, 0] - 0.2 * x[k, 1] + u[k, 0] - 0.3 * x[k, 0] ** 3])
    spec = PlantSpec((Channel("u"),), (Channel("q"), Channel("v")), 0.1)
    data = Trajectory(np.arange(400) * 0.1, u, x + 1e-4 * rng.normal(size=x.shape), spec)
    model = Stlsq(time="discrete", degree=3, rule=rule, ensemble=10).fit([data], rng=np.random.default_rng(1))
    assert set(model.support[1]) == {"q", "v", "u", "q^3"}
    assert model.notes["inclusion"][1]["q^3"] == 1.0
    assert simulation_error(model, data).nrmse.max() < 0.02


@pytest.mark.parametrize("rule", ["eliminate", "threshold", "lasso", "subset"])
@pytest.mark.parametrize("pole", [0.5, 0.99, 0.999])
def test_a_slow_plant_in_discrete_time_keeps_its_input_and_no_term_of_rounding(rule, pole):
    u = np.tile(np.r_[np.zeros(400), np.ones(600)], 2)
    x = np.zeros(2000)
    for k in range(1999):
        x[k + 1] = pole * x[k] + (1 - pole) * u[k]
    record = Trajectory(np.arange(2000) * 0.1, u[:, None], x[:, None], PlantSpec((Channel("u"),), (Channel("x"),), 0.1))
    model = Stlsq(time="discrete", degree=1, rule=rule).fit([record], rng=np.random.default_rng(0))
    assert model.coefficients.ravel() == pytest.approx([0.0, pole, 1 - pole], abs=1e-9)
    assert model.support == (("x", "u"),)


@pytest.mark.parametrize(("noise", "said"), [(0.0, False), (1e-2, True)])
def test_an_input_that_falls_out_of_a_discrete_model_is_said(noise: float, said: bool) -> None:
    """A slow plant: in one sample the input does less than the noise of the outputs."""
    rng = np.random.default_rng(0)
    u, x = np.repeat(rng.choice([0.0, 1.0], 30), 100), np.zeros(3000)
    for k in range(2999):
        x[k + 1] = 0.99 * x[k] + 0.01 * u[k]
    spec = PlantSpec((Channel("heat"),), (Channel("x"),), 0.1)
    data = Trajectory(np.arange(3000) * 0.1, u[:, None], (x + noise * rng.standard_normal(3000))[:, None], spec)
    model = Stlsq(time="discrete").fit([data], rng=rng)
    assert ("heat is in no equation" in model.notes.get("warning", "")) == said
    assert any("heat" in term for chosen in model.support for term in chosen) != said


def test_intervals_in_discrete_time_hold_and_none_is_claimed_of_noisy_outputs():
    truth, spec, held = [0.7, 0.5, -0.2], PlantSpec((Channel("u"),), (Channel("y"),), 0.1), []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        u, y = rng.uniform(-2, 2, size=(300, 1)), np.zeros((300, 1))
        for k in range(299):
            y[k + 1] = 0.7 * y[k] + 0.5 * u[k] - 0.2 * y[k] ** 3 + 0.02 * rng.normal()
        model = Stlsq(degree=3, time="discrete").fit([Trajectory(0.1 * np.arange(300), u, y, spec)], rng=rng)
        found = estimate_of(model)
        assert found is not None
        assert model.support == (("y", "u", "y^3"),)
        if found.intervals is not None:
            held.append((found.intervals[:, 0] <= truth) & (truth <= found.intervals[:, 1]))
    assert len(held) == 8
    assert 0.8 <= np.mean(held) < 1.0
    noisy = Trajectory(0.1 * np.arange(300), u, y + 0.1 * rng.normal(size=y.shape), spec)
    found = estimate_of(Stlsq(degree=3, time="discrete").fit([noisy], rng=rng))
    assert found is not None
    assert found.intervals is None
    assert "correlated in time" in found.method
