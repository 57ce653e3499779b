"""Residual physics: functions whose centres lie in the data take what the mechanism leaves, and nothing elsewhere."""

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harness import registry
from harness.errors import FitError, InputError
from harness.rng import Streams
from harness.rollout import run
from harness.scoring import simulation_error
from identifiers.mechanics.lumped import lumped_momentum
from identifiers.mechanics.residual import ResidualModel, ResidualPhysics
from identifiers.mechanics.residual_basis import basis_of, spread_centres

HIDDEN = [("coulomb_friction", "theta", {"Fc": 0.15}), ("quadratic_drag", "theta", {"c": 0.05})]


def records(effects, seed=0):
    streams = Streams("pendulum-ode", "multisine", seed=seed)
    scenario = registry.create("scenarios", "multisine", duration=30.0, amplitude=0.6, noise=0.001)
    with registry.create("plants", "pendulum-ode", sample_time=0.01, effects=effects) as plant:
        roles = ("estimation/0", "validation/0")
        return [run(plant, scenario, streams=streams, role=role).measured() for role in roles]


@pytest.fixture(scope="module")
def hidden():
    return records(HIDDEN)


@pytest.mark.parametrize("basis", ["gaussian", "wavelet"])
@pytest.mark.parametrize("choice", ["ridge", "best-subset"])
def test_functions_take_hidden_friction_and_drag(hidden, basis, choice):
    model = ResidualPhysics("pendulum", basis=basis, choice=choice).fit(hidden[:1], rng=np.random.default_rng(0))
    errors = dict(map(tuple, model.notes["held_out"]))
    assert errors[0] == pytest.approx(1.0)  # in units of what the mechanism alone leaves
    assert min(errors.values()) < (0.62 if choice == "ridge" else 0.7)


def test_the_free_run_of_held_out_data_gets_better(hidden):
    learn, held = hidden
    plain = lumped_momentum("pendulum").fit([learn], rng=np.random.default_rng(0))
    model = ResidualPhysics("pendulum").fit([learn], rng=np.random.default_rng(0))
    before, after = (simulation_error(one, held).nrmse[0] for one in (plain, model))
    assert after < 0.7 * before


def test_lasso_and_ridge_agree_on_what_is_left_out(hidden):
    model = ResidualPhysics("pendulum", functions=8, choice="lasso").fit(hidden[:1], rng=np.random.default_rng(0))
    counts = [count for count, _ in model.notes["held_out"]]
    assert counts[0] == 0
    assert max(counts) <= 8
    assert model.notes["held_out"][-1][1] < 1.0


def test_a_mechanism_that_is_complete_keeps_its_parameters_and_needs_no_function():
    learn, held = records([])
    model = ResidualPhysics("pendulum", choice="best-subset").fit([learn], rng=np.random.default_rng(0))
    assert model.parameters["mgl"] == pytest.approx(1.0, rel=0.01)
    assert simulation_error(model, held).nrmse[0] < 0.05
    assert min(dict(map(tuple, model.notes["held_out"])).values()) > 0.9


def test_far_from_the_data_the_mechanism_alone_remains(hidden):
    model = ResidualPhysics("pendulum").fit(hidden[:1], rng=np.random.default_rng(0))
    name, basis, weights = model.recipe.forces[0]
    assert name == "theta"
    far = basis.values(np.array([[40.0]]), np.array([[300.0]]))
    assert np.abs(far @ weights).max() < 1e-12


def test_a_model_comes_back_from_its_description(hidden):
    model = ResidualPhysics("pendulum", functions=6).fit([hidden[0][:800]], rng=np.random.default_rng(0))
    again = ResidualModel.from_dict(model.to_dict())
    x = model.initial_state(hidden[1][:50])
    np.testing.assert_allclose(again.step(x, np.array([0.2])), model.step(x, np.array([0.2])), rtol=1e-12)
    assert not np.allclose(
        model.step(x, np.array([0.2])),
        lumped_momentum("pendulum").fit([hidden[0][:800]], rng=np.random.default_rng(0)).step(x, np.array([0.2])),
    )


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 3), st.integers(3, 12), st.sampled_from(["gaussian", "wavelet"]))
def test_centres_are_instants_of_the_data_and_both_ways_of_computing_agree(seed, n, count, kind):
    rng = np.random.default_rng(seed)
    path = rng.normal(size=(60, 2 * n)) * rng.uniform(0.1, 10, size=2 * n)
    columns = (0, n)
    basis = basis_of(kind, columns, path, count, 1.5)
    own = basis.centres * basis.scale + basis.middle
    assert basis.k == count
    for centre in own:
        assert np.isclose(path[:, list(columns)], centre).all(axis=1).any()
    x = ca.SX.sym("x", 2 * n)
    function = ca.Function("f", [x], [basis.symbolic(x)])
    for row in path[:5]:
        np.testing.assert_allclose(function(row).full()[:, 0], basis.values(row[None, :n], row[None, n:])[0], rtol=1e-9)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(2, 8))
def test_centres_cover_the_points_within_twice_the_best_radius(seed, count):
    points = np.random.default_rng(seed).uniform(size=(40, 2))
    chosen = spread_centres(points, count)
    assert len(np.unique(chosen, axis=0)) == count
    reach = np.linalg.norm(points[:, None] - chosen, axis=2).min(axis=1).max()
    between = np.linalg.norm(chosen[:, None] - chosen, axis=2) + 9 * np.eye(count)
    assert reach <= between.min() + 1e-12  # so no cover by count discs has a radius below half of it


def test_options_and_models_that_do_not_fit_are_refused(hidden):
    with pytest.raises(InputError, match="residual-physics"):
        ResidualPhysics(functions=0)
    with pytest.raises(InputError, match="different instants"):
        basis_of("gaussian", (0, 1), np.ones((20, 2)), 3, 1.0)
    with pytest.raises(FitError, match="every coordinate measured"):
        ResidualPhysics("cart-pole").fit(hidden[:1], rng=np.random.default_rng(0))
