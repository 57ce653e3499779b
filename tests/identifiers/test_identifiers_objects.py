"""Fitted linear models as objects of the field: other sample times, fewer states, forecasts, regulators."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harness.errors import InputError
from harness.export.linear import from_state_space
from harness.fitted import FittedModel
from harness.models.regulators import regulator
from harness.models.transforms import continuous, discrete, reduction
from harness.signals import Channel, PlantSpec, Trajectory
from identifiers.linear.arx import Arx
from identifiers.linear.n4sid import Subspace

SPEC = PlantSpec((Channel("u", "V"),), (Channel("y", "m"),), 0.1)


def record(seed=0, samples=800, size=0.05, inputs=None):
    rng = np.random.default_rng(seed)
    u, y = rng.normal(size=samples) if inputs is None else inputs, np.zeros(samples)
    noise = size * rng.normal(size=samples)
    for k in range(2, samples):
        y[k] = 1.6 * y[k - 1] - 0.7 * y[k - 2] + 0.2 * u[k - 1] + 0.1 * u[k - 2] + noise[k]
    return Trajectory(np.arange(samples) * 0.1, u[:, None], y[:, None] + 2.0, SPEC)


@pytest.fixture(scope="module")
def model():
    return FittedModel(Subspace(order=2).fit([record()], rng=np.random.default_rng(0)))


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000), st.sampled_from(["zoh", "foh", "tustin"]), st.floats(0.01, 0.3))
def test_to_samples_and_back_is_the_same_system(seed, method, step):
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(3, 3)) - 2 * np.eye(3)
    made = (a, rng.normal(size=(3, 2)), rng.normal(size=(1, 3)), np.zeros((1, 2)))
    again = continuous(discrete(made, step, method), step, method)
    assert all(np.allclose(one, other, atol=1e-6) for one, other in zip(made, again, strict=True))


@pytest.mark.parametrize("method", ["zoh", "foh", "tustin", "matched"])
def test_another_sample_time_keeps_the_response_below_both(model, method):
    faster = model.resampled(0.02, method)
    f = np.array([0.05, 0.3, 0.8])
    old, new = model.frequency_response(f), faster.frequency_response(f)
    allowed = 0.35 if method in ("zoh", "matched") else 0.12  # the hold's own lag changes with the sample time
    assert np.all(np.abs(old - new) < allowed * np.abs(old))
    assert faster.spec.sample_time == 0.02
    static = [np.abs(one.frequency_response(1e-6))[0, 0, 0] for one in (model, faster)]
    assert static[1] == pytest.approx(static[0], rel=1e-6)
    _, gain, _ = faster.frequency_response(f, deviation=True)
    assert np.all((gain > 0) & (gain < 0.5 * np.abs(new)))


def test_python_control_gets_the_model_in_continuous_time(model):
    system = model.to_control(deviations=True, continuous="zoh")
    back = from_state_space(system, sample_time=0.1, units={"u": "V", "y": "m"})
    f = np.array([0.1, 1.0])
    assert system.dt == 0
    assert np.allclose(back.frequency_response(f), model.frequency_response(f))
    assert np.allclose(FittedModel(back).resampled(0.1).frequency_response(f), model.frequency_response(f))


def test_a_pole_without_a_continuous_one_is_refused_in_words():
    fitted = FittedModel(Arx(order=3).fit([record(1)], rng=np.random.default_rng(0)))
    with pytest.raises(InputError, match="no continuous pole belongs to it"):
        fitted.resampled(0.05)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 4), st.sampled_from(["balanced", "modal"]))
def test_the_error_of_a_reduction_is_within_its_bound(seed, order, method):
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(5, 5))
    a *= 0.95 / np.abs(np.linalg.eigvals(a)).max()
    made = (a, rng.normal(size=(5, 2)), rng.normal(size=(2, 5)), np.zeros((2, 2)))
    if method == "modal" and order == 1 and np.abs(np.linalg.eigvals(a).imag).min() > 0:
        return  # pairs stay together
    found = reduction(made, order, method)
    assert found.error <= found.bound * (1 + 1e-6)
    assert np.abs(np.linalg.eigvals(found.of(made)[0])).max(initial=0.0) < 1.0


def test_a_reduced_model_says_how_far_it_is_off_and_keeps_its_level():
    large = FittedModel(Arx(order=6).fit([record(2)], rng=np.random.default_rng(0)))
    small = large.reduced(2)
    f = np.linspace(0.0, 4.9, 50)
    off = np.abs(small.frequency_response(f) - large.frequency_response(f)).max()
    assert off <= small.notes["reduction"]["bound"]
    assert "nowhere off by more than" in small.notes["reduction"]["words"]
    rest = np.zeros(400)
    assert small.simulate(rest)[-1, 0] == pytest.approx(large.simulate(rest, start=record(2))[-1, 0], abs=0.05)
    with pytest.raises(InputError, match="reduction of a model"):
        small.reduced(2)


def test_bands_of_a_forecast_hold_what_comes(model):
    inside, ahead = [], 25
    for seed in range(60):
        whole = record(100 + seed, 200)
        known = whole[:150]
        found = model.forecast_bands(known, whole.u[150 : 150 + ahead])
        assert found.t[0] == pytest.approx(15.0)
        inside.append((found.low <= whole.y[150 : 150 + ahead]) & (whole.y[150 : 150 + ahead] <= found.high))
    share = np.mean(inside)
    assert 0.9 < share < 0.985
    assert found.deviation[-1, 0] > 2 * found.deviation[0, 0]  # the disturbance is carried on


def test_a_regulator_warns_where_the_data_say_nothing():
    t = 0.1 * np.arange(3000)
    slow = np.sin(2 * np.pi * 0.05 * t) + np.sin(2 * np.pi * 0.08 * t) + np.sin(2 * np.pi * 0.11 * t)
    rich, poor = (
        FittedModel(Arx(order=2, least_excitation=0.0).fit([data], rng=np.random.default_rng(0)))
        for data in (record(3, 3000), record(3, 3000, inputs=slow))
    )
    assert rich.regulator(100.0).warnings == ()
    assert "do not determine y per u" in poor.regulator(100.0).warnings[0]
    assert poor.determined["y per u"][-1][1] < 1.0
    made = rich.regulator(100.0)
    assert made.gain.shape[1] == len(rich.model.a_matrix) >= made.observable >= 2
    assert f"{made.controllable} controllable and {made.observable} observable" in str(made)


def test_a_regulator_of_a_mode_that_no_input_reaches_is_refused():
    spec = PlantSpec((Channel("u"),), (Channel("y"),), 1.0)
    a, b, c = np.diag([1.2, 0.5]), np.array([[0.0], [1.0]]), np.ones((1, 2))
    lost = SimpleNamespace(matrices=(a, b, c, np.zeros((1, 1))), spec=spec, notes={})
    with pytest.raises(InputError, match="1 of 2 states controllable, 2 observable"):
        regulator(lost)


def test_deviations_are_refused_of_a_model_that_knows_none(model):
    import control

    plain = FittedModel(from_state_space(control.ss([[0.5]], [[1.0]], [[1.0]], [[0.0]], 0.1)))
    with pytest.raises(InputError, match="standard deviations of a model"):
        plain.frequency_response([1.0], deviation=True)
    poles, deviation = model.pole_deviation()
    assert np.all((deviation > 0) & (deviation < 0.1))
    assert np.allclose(np.sort(np.abs(poles)), np.sqrt(0.7), atol=0.05)
