"""Asked for a stable model, every linear identifier gives one, and leaves alone what is stable by itself."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harness.models.estimate import estimate_of
from harness.registry import create
from harness.signals import Channel, PlantSpec, Trajectory
from identifiers.common.stability import RADIUS
from identifiers.linear.prediction_error import PredictionError

SPEC = PlantSpec((Channel("u"),), (Channel("a"), Channel("b")), 1.0)

METHODS = [
    ("least-squares", {"least_excitation": 0.0, "intervals": 0}),
    ("least-squares", {"least_excitation": 0.0, "method": "l1", "intervals": 0}),
    ("least-squares", {"least_excitation": 0.0, "method": "tls", "intervals": 0}),
    ("arx", {"order": 2, "least_excitation": 0.0}),
    ("dmdc", {"least_excitation": 0.0}),
    ("dmdc", {"rank": 2, "least_excitation": 0.0}),
    ("dmdc", {"delays": 2, "least_excitation": 0.0}),
    ("edmdc", {"degree": 1, "least_excitation": 0.0}),
    ("edmdc", {"degree": 2, "least_excitation": 0.0}),
    ("n4sid", {"order": 2, "past": 3, "least_excitation": 0.0}),
    ("n4sid", {"order": 2, "past": 3, "method": "parsim", "least_excitation": 0.0}),
    ("ho-kalman", {"markov": 8, "order": 2}),
    ("prediction-error", {"order": 1}),
    ("prediction-error", {"order": 2, "structure": "armax"}),
    ("prediction-error", {"order": 1, "structure": "bj"}),
]


@st.composite
def growing(draw):
    """A short noisy record of a system with poles about the unit circle, some outside."""
    radius, angle = draw(st.floats(0.9, 1.06)), draw(st.floats(0.0, 0.5))
    rng = np.random.default_rng(draw(st.integers(0, 2**31)))
    a = radius * np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    u, x = rng.normal(size=(70, 1)), rng.normal(size=(70, 2))
    for k in range(69):
        x[k + 1] = a @ x[k] + np.array([0.5, 1.0]) * u[k] + 0.1 * rng.normal(size=2)
    return Trajectory(np.arange(70.0), u, x, SPEC)


def growth(model):
    """Return the largest modulus of the poles; of a Koopman model without the one that the constant has."""
    a = model.a_matrix
    if hasattr(model, "dictionary"):
        constant = model.spec.ny
        assert a[constant].tolist() == pytest.approx(np.eye(len(a))[constant].tolist(), abs=1e-6)
        a = np.delete(np.delete(a, constant, axis=0), constant, axis=1)
    return float(np.abs(np.linalg.eigvals(a)).max())


@pytest.mark.first_of_each("case")
@pytest.mark.parametrize("case", METHODS, ids=str)
@settings(max_examples=8)
@given(growing())
def test_stable_means_stable_and_no_change_where_there_is_no_need(case, data):
    name, options = case
    plain, stable = (
        create("identifiers", name, **options, stable=s).fit([data], rng=np.random.default_rng(0))
        for s in (False, True)
    )
    if "stabilized" in stable.notes:
        assert growth(plain) >= 1.0 - 1e-9
        # outputs are fitted one by one by prediction errors: one that is stable by itself stays as it is
        assert growth(stable) < 1.0 if name == "prediction-error" else growth(stable) <= RADIUS * (1 + 1e-5)
        told = estimate_of(stable)
        assert told is None or told.intervals is None, "the spread of the fit says nothing about the nearest stable one"
    else:
        assert growth(plain) < 1.0
        assert np.array_equal(plain.a_matrix, stable.a_matrix)
        assert np.array_equal(plain.b_matrix, stable.b_matrix)


def test_prediction_errors_are_minimised_again_among_the_stable():
    """A pole barely outside the circle comes just inside it, and the fit stays one."""
    rng = np.random.default_rng(3)
    u, y = rng.normal(size=(60, 1)), np.zeros((60, 1))
    for k in range(59):
        y[k + 1] = 1.004 * y[k] + u[k]
    spec = PlantSpec((Channel("u"),), (Channel("y"),), 1.0)
    data = Trajectory(np.arange(60.0), u, y + 0.05 * rng.normal(size=y.shape), spec)
    plain, stable = (PredictionError(order=1, stable=asked).fit([data], rng=rng) for asked in (False, True))
    assert growth(plain) >= 1.0
    assert 0.99 < growth(stable) <= RADIUS
    assert stable.notes["residual_rms"][0] < 0.1 * y.std()


@settings(max_examples=25, deadline=None)
@given(growing())
def test_the_convex_program_is_stable_too_and_about_as_near(data):
    fits = {
        how: create("identifiers", "least-squares", least_excitation=0.0, intervals=0, stable=how).fit(
            [data], rng=np.random.default_rng(0)
        )
        for how in (False, True, "convex")
    }
    if growth(fits[False]) < 1.0:
        assert fits["convex"].a_matrix.tolist() == fits[False].a_matrix.tolist()
        return
    assert growth(fits["convex"]) <= RADIUS + 1e-6
    # It minimises a bound on the error: of 142 unstable fits at most 1.28 times as far as the local search, half of
    # them within 1.1 %, a quarter nearer (down to 0.49, where the search stuck).
    assert fits["convex"].notes["moved by"] <= 2.0 * fits[True].notes["moved by"] + 1e-6


@pytest.mark.parametrize(
    ("name", "options"),
    [("least-squares", {}), ("least-squares", {"stable": "convex"}), ("arx", {"order": 1}), ("dmdc", {})],
)
@pytest.mark.parametrize(("radius", "contradicts"), [(1.1, True), (1.0, False)])
def test_records_that_contradict_a_stable_model_say_so(name, options, radius, contradicts):
    """At 1.0 the fit of a short record is a little outside, or not at all: nothing to warn of."""
    rng, x = np.random.default_rng(4), np.zeros((70, 2))
    u = rng.normal(size=(70, 1))
    for k in range(69):
        x[k + 1] = radius * x[k, ::-1] * [1.0, -1.0] + np.array([0.5, 1.0]) * u[k] + 0.1 * rng.normal(size=2)
    record = Trajectory(np.arange(70.0), u, x, SPEC)
    model = create("identifiers", name, **({"stable": True} | options)).fit([record], rng=rng)
    assert growth(model) < 1.0
    assert ("stable model errs" in model.notes.get("warning", "")) is contradicts


def test_what_was_said_of_the_fit_stays_beside_what_its_stable_model_contradicts():
    rng, x = np.random.default_rng(4), np.zeros((70, 2))
    u = rng.normal(size=(70, 1))
    for k in range(69):
        x[k + 1] = 1.1 * x[k, ::-1] * [1.0, -1.0] + np.array([0.5, 1.0]) * u[k] + 0.1 * rng.normal(size=2)
    record = Trajectory(np.arange(70.0), u, x + 3.0, SPEC)
    for name in ("dmdc", "least-squares"):
        warning = create("identifiers", name, stable=True, offset=False).fit([record], rng=rng).notes["warning"]
        assert "a constant is missing" in warning
        assert "stable model errs" in warning
