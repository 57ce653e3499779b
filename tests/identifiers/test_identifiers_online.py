"""Recursive least squares and online counting: equal to the batch, and their regret grows as theory says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from harness.errors import FitError, InputError
from harness.models.estimate import estimate_of
from harness.registry import create
from harness.scoring import predict, regret, simulation_error
from harness.signals import Channel, PlantSpec, Trajectory
from identifiers.linear.least_squares import Arx
from identifiers.online.along import along
from identifiers.online.leader import FollowTheLeader
from identifiers.online.rls import RecursiveLeastSquares
from identifiers.online.rls_pass import run

from .conftest import passed

RNG = np.random.default_rng(0)
SPEC = PlantSpec((Channel("u"),), (Channel("y"),), 1.0)


def stream(samples: int, seed: int, sigma: float = 0.1) -> Trajectory:
    rng = np.random.default_rng(seed)
    u, y = rng.normal(size=(samples, 1)), np.zeros((samples, 1))
    for k in range(samples - 1):
        y[k + 1] = 0.7 * y[k] + u[k] + sigma * rng.normal()
    return Trajectory(np.arange(samples) * 1.0, u, y, SPEC)


def test_recursive_equals_batch_to_rounding():
    records = [stream(150, 1), stream(90, 2)]
    online = RecursiveLeastSquares(order=3, prior=1e-12)
    theta = passed(online, records).coefficients.T
    batch = Arx(order=3).fit(records, rng=RNG)
    assert theta[0, :3] == pytest.approx(batch.a_matrix[0, :3], abs=1e-11)
    assert theta[0, 3] == pytest.approx(batch.b_matrix[0, 0], abs=1e-11)
    assert theta[0, 6] == pytest.approx(batch.state_offset[0], abs=1e-11)
    assert np.array(online.hindsight(records).details["coefficients"])[:, 0] == pytest.approx(theta[0], abs=1e-11)


def test_no_fixed_predictor_beats_the_hindsight():
    record = stream(300, 4)
    online = RecursiveLeastSquares(order=1, offset=False)
    found = online.hindsight([record])
    late = slice(found.details["burn_in"], None)
    for theta in np.array([0.7, 1.0]) + 0.05 * np.random.default_rng(0).normal(size=(50, 2)):
        losses = (record.y[1:, 0] - theta[0] * record.y[:-1, 0] - theta[1] * record.u[:-1, 0]) ** 2
        assert losses[late].sum() >= found.losses[late].sum()
    held = (record.y[1:, 0] - record.y[:-1, 0]) ** 2
    assert found.losses[: late.start] == pytest.approx(held[: late.start])


def test_regret_grows_with_the_logarithm_as_theory_says_in_any_unit():
    """Item 3: slope d n sigma^2 / ln T within 10 %, by the product's own score, mean of ten streams."""
    sigma = np.array([0.1, 0.02])
    a, b = np.array([[0.7, 0.2], [-0.1, 0.6]]), np.array([[1.0], [0.5]])
    spec = PlantSpec((Channel("u"),), (Channel("a"), Channel("b")), 1.0)
    ratios, late = [], []
    for seed in range(10):
        rng = np.random.default_rng(seed)
        u, y = rng.normal(size=(2500, 1)), np.zeros((2500, 2))
        for k in range(2499):
            y[k + 1] = a @ y[k] + b @ u[k] + sigma * rng.normal(size=2)
        found = [
            regret(
                RecursiveLeastSquares(order=1, offset=False),
                [Trajectory(np.arange(2500.0), u * unit, y * np.array([unit, 1.0]), spec)],
                rng=RNG,
                points=30 if unit == 1.0 else 0,
            )
            for unit in (1.0, 1e3)[: 2 if seed == 0 else 1]
        ]
        if seed == 0:
            assert found[1].total == pytest.approx(found[0].total, rel=1e-6)
        theory = 3 * float(np.sum((sigma / found[0].scale) ** 2))  # d parameters for each output, sigma^2 scaled
        ratios.append(found[0].slope(50) / theory)
        early = found[0].curve[found[0].steps >= 20][0]
        late.append(1.0 - early / found[0].curve[-1])
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.1)
    assert np.mean(late) > 0.4, "the regret is no burst of the first samples"


def test_the_curve_is_against_the_best_model_of_the_first_samples():
    record = stream(400, 3)
    found = regret(RecursiveLeastSquares(order=1), [record], rng=RNG, points=12)
    for n, value in zip(found.steps.astype(int), found.curve, strict=True):
        if n < 20:
            continue
        alone = regret(RecursiveLeastSquares(order=1), [record[: n + 1]], rng=RNG, points=0, scaled=False)
        assert value == pytest.approx(alone.total / found.scale[0] ** 2, rel=1e-9)
    assert found.curve[-1] == pytest.approx(found.total)
    assert np.all(np.diff(found.curve[found.steps >= 20]) > 0), "least squares only ever loses"


@pytest.mark.slow
def test_any_batch_identifier_follows_the_leader():
    record = stream(1500, 0)
    recursive = regret(RecursiveLeastSquares(order=1, offset=False), [record], rng=RNG)
    led = regret(FollowTheLeader("arx", {"order": 1, "offset": False}, burn_in=10), [record], rng=RNG)
    assert led.details["burn_in"] == 10
    assert led.slope(100) == pytest.approx(recursive.slope(100), rel=0.35)
    for name, options in (("dmdc", {}), ("edmdc", {}), ("ho-kalman", {"markov": 15, "order": 1})):
        found = regret(FollowTheLeader(name, options, burn_in=60), [record[:700], record[700:]], rng=RNG, points=8)
        assert not found.exact
        assert 0.0 < found.average < 0.01, name


def test_a_leader_that_cannot_be_is_refused_by_name():
    for name in ("no-such-thing", "rls"):
        with pytest.raises(InputError, match=name):
            FollowTheLeader(name, {}).init(SPEC, rng=RNG)
    with pytest.raises(FitError, match="growth"):
        FollowTheLeader(growth=0.5).init(SPEC, rng=RNG)


def test_forgetting_follows_a_plant_that_changes():
    rng = np.random.default_rng(3)
    u, y = rng.normal(size=(600, 1)), np.zeros((600, 1))
    for k in range(599):
        y[k + 1] = (0.8 if k < 300 else -0.4) * y[k] + u[k]
    record = Trajectory(np.arange(600.0), u, y, SPEC)
    found = [passed(RecursiveLeastSquares(order=1, forgetting=f), [record]).coefficients[0, 0] for f in (1.0, 0.95)]
    assert found[1] == pytest.approx(-0.4, abs=1e-3)
    assert abs(found[0] + 0.4) > 0.1


@pytest.mark.parametrize(
    "options", [{"order": 0}, {"forgetting": 0.0}, {"forgetting": 1.5}, {"prior": 0.0}, {"burn_in": 0}]
)
def test_options_that_make_no_sense_are_refused(options):
    with pytest.raises(FitError, match="options"):
        RecursiveLeastSquares(**options).init(SPEC, rng=RNG)


def test_records_shorter_than_the_order_are_refused_in_words():
    online = RecursiveLeastSquares(order=5)
    with pytest.raises(FitError, match="too short"):
        regret(online, [stream(4, 0)], rng=RNG)


@pytest.mark.parametrize(("ny", "nu", "order", "offset", "forgetting"), [(1, 1, 2, True, 1.0), (3, 2, 1, False, 0.97)])
@pytest.mark.parametrize("native", [True, False])
def test_a_stretch_at_once_is_sample_by_sample_compiled_or_not(ny, nu, order, offset, forgetting, native):
    rng = np.random.default_rng(0)
    spec = PlantSpec(tuple(Channel(f"u{i}") for i in range(nu)), tuple(Channel(f"y{i}") for i in range(ny)), 1.0)
    online = RecursiveLeastSquares(order=order, offset=offset, forgetting=forgetting)
    u, y = rng.normal(size=(200, nu)), rng.normal(size=(200, ny))
    first = state = online.start(online.init(spec, rng=rng), y[0])
    steps = []
    for k in range(199):
        steps.append(online.predict(state, u[k]))
        state = online.update(state, u[k], y[k + 1])
    guesses, memory = np.empty((199, ny)), first.memory.copy()
    run(first.layout, memory, u[:-1], y[1:], guesses, native=native)
    assert guesses == pytest.approx(np.array(steps), abs=1e-12)
    assert online.track(first, u[:-1], y[1:])[1].coefficients == pytest.approx(state.coefficients, abs=1e-12)
    rows = [
        np.concatenate([y[k - order + 1 : k + 1][::-1].ravel(), u[k - order + 1 : k + 1][::-1].ravel(), [1.0] * offset])
        for k in range(order - 1, 199)
    ]
    weight = forgetting ** (0.5 * np.arange(len(rows))[::-1])[:, None]
    batch = np.linalg.lstsq(weight * rows, weight * y[order:], rcond=None)[0]
    assert state.coefficients == pytest.approx(batch, abs=1e-6)


# ---- fitted in one pass, as a model like any other -------------------------------------------------------------------


def second_order(samples: int, seed: int, noise: float) -> Trajectory:
    """Return y = 0.3 q^-2 / (1 - 1.5 q^-1 + 0.7 q^-2) u + 2 + noise on the output."""
    rng = np.random.default_rng(seed)
    u, y = 1.0 + rng.normal(size=(samples, 1)), np.zeros(samples)
    for k in range(2, samples):
        y[k] = 1.5 * y[k - 1] - 0.7 * y[k - 2] + 0.3 * u[k - 2, 0]
    return Trajectory(np.arange(samples) * 1.0, u, (y + 2.0 + noise * rng.normal(size=samples))[:, None], SPEC)


def test_one_pass_of_recursive_least_squares_is_the_batch():
    records = [stream(150, 1), stream(90, 2)]
    online, batch = (
        create("identifiers", name, order=3).fit(records, rng=RNG).impulse_response(20) for name in ("rls", "arx")
    )
    assert online == pytest.approx(batch, abs=1e-6)
    with pytest.raises(FitError, match="at least 7 samples"):
        RecursiveLeastSquares(order=3).fit([records[0][:6]], rng=RNG)


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("rls", {"order": 2}),
        ("recursive-polynomial", {"structure": "arx"}),
        ("spectral-filtering", {"filters": 4, "window": 30}),
        ("gradient-descent", {"order": 3}),
    ],
)
def test_the_model_of_a_pass_predicts_as_the_identifier_would(name, options):
    """From what was learned, over a record from rest: the state forgets its start, so the last sample is compared."""
    record, held = second_order(300, 0, 0.05), second_order(220, 1, 0.0)
    online = create("identifiers", name, **options)
    model = online.fit([record], rng=np.random.default_rng(0))
    state = online.init(SPEC, rng=np.random.default_rng(0))
    for one in (record, held[:1]):
        state = along(online, state, [one])
    assert type(model).from_dict(model.to_dict()).eigenvalues == pytest.approx(model.eigenvalues)
    ahead = predict(model, held, 1)
    frozen = with_state(online, state, held)
    assert ahead[-1] == pytest.approx(frozen, rel=1e-6)


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("rls", {}),
        ("recursive-polynomial", {}),
        ("follow-the-leader", {}),
        ("spectral-filtering", {"filters": 4, "window": 30}),
        ("spectral-filtering", {"filters": 4, "window": 30, "update_by": "gradient"}),
        ("gradient-descent", {"order": 3}),
    ],
)
def test_the_level_of_signals_does_not_decide_what_is_learned(name, options):
    record = second_order(300, 0, 0.05)
    warm = replace(record, u=record.u + 20.0, y=record.y + 300.0)
    online = create("identifiers", name, **options)
    ahead, above = (predict(online.fit([one], rng=np.random.default_rng(0)), one, 1) for one in (record, warm))
    late = slice(100, None)
    assert above[late] - 300.0 == pytest.approx(ahead[late], abs=0.01 * record.y.std())


def with_state(online, state, record):
    """Return the prediction of the last output of a record by what is known at its start alone."""
    for k in range(len(record) - 2):
        new = online.update(state, record.u[k], record.y[k + 1])
        if hasattr(state, "theta"):  # gradient descent: the filter goes on, the parameters stay
            w = state.inputs.relative(record.u[k])
            a = state.theta[: online.order]
            state = state._replace(w=np.vstack([w - a @ state.w, state.w[:-1]]))
        elif hasattr(state, "weights"):
            state = new._replace(weights=state.weights, curvature=state.curvature)
        elif hasattr(state, "layout"):
            theta = state.layout.theta(state.memory).copy()
            state = new
            state.layout.theta(state.memory)[:] = theta
            run(state.layout, state.memory, np.empty((0, 1)), np.empty((0, 1)), np.empty((0, 1)))
        else:
            filters = tuple(
                replace(after, theta=before.theta) for before, after in zip(state.filters, new.filters, strict=True)
            )
            state = replace(new, filters=filters)
    return online.predict(state, record.u[len(record) - 2])


@pytest.mark.parametrize("structure", ["oe", "armax"])
def test_one_pass_of_a_recursive_model_bears_noise_on_the_output(structure):
    record, clean = second_order(3000, 0, 0.3), second_order(400, 1, 0.0)
    model = create("identifiers", "recursive-polynomial", structure=structure).fit([record], rng=RNG)
    biased = create("identifiers", "rls").fit([record], rng=RNG)
    error, worse = (simulation_error(one, clean).nrmse[0] for one in (model, biased))
    assert error < 0.05  # measured 0.012 and 0.016
    assert worse > 5 * error
    assert estimate_of(model).deviation("y: b2 of u") < 0.02


def test_a_pass_under_pure_feedback_is_refused():
    rng = np.random.default_rng(0)
    y, u = np.zeros((400, 1)), np.zeros((400, 1))
    y[0] = 1.0
    for k in range(399):
        u[k] = -0.5 * y[k]
        y[k + 1] = 1.1 * y[k] + u[k] + 1e-3 * rng.normal()
    u[-1] = -0.5 * y[-1]
    record = Trajectory(np.arange(400.0), u, y, SPEC)
    for name in ("rls", "recursive-polynomial", "spectral-filtering", "gradient-descent"):
        with pytest.raises(FitError, match="inputs that something beside the controller moves"):
            create("identifiers", name).fit([record], rng=RNG)
