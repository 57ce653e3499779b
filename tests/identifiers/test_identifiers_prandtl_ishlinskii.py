"""Hysteresis in linear dynamics: found again at the input and in a loop, derivatives exact, free runs bounded."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harness.errors import FitError, InputError
from harness.scoring import simulation_error
from harness.signals import Channel, FloatArray, PlantSpec, Trajectory
from identifiers.blocks import hysteresis_pass
from identifiers.blocks.hysteresis_fit import stopped
from identifiers.blocks.hysteresis_pass import HysteresisLayout
from identifiers.blocks.prandtl_ishlinskii import PrandtlIshlinskii, PrandtlIshlinskiiModel
from identifiers.linear.arx import Arx

SPEC = PlantSpec((Channel("u", "V"),), (Channel("y", "m"),), 0.1)
RADII, WEIGHTS = np.array([[0.3, 0.8, 1.6]]), np.array([0.5, 0.4, 0.3])


def driven(pole: float, seed: int, samples: int = 2000) -> Trajectory:
    """Return a first-order plant behind a hysteresis of its input."""
    rng = np.random.default_rng(seed)
    u = rng.uniform(-2.5, 2.5, (samples, 1))
    w = 0.4 * u[:, 0] + stopped(u, RADII)[:, 0] @ WEIGHTS
    y = np.zeros(samples)
    for k in range(samples - 1):
        y[k + 1] = pole * y[k] + (1.0 - pole) * w[k]
    return Trajectory(np.arange(samples) / 10.0, u, 5.0 + 2.0 * y[:, None], SPEC)


def softening(seed: int, size: float, samples: int = 2500) -> Trajectory:
    """Return an oscillator whose spring holds by stops of its own position: it sinks with the amplitude."""
    rng = np.random.default_rng(seed)
    u, y = size * rng.normal(size=samples), np.zeros(samples)
    x, v, memory = 0.0, 0.0, np.zeros(2)
    for k in range(samples):
        y[k] = x
        memory = np.clip(memory, x - np.array([0.2, 0.8]), x + np.array([0.2, 0.8]))
        v += -0.3 * x - 0.06 * v - 0.15 * float(np.sum(x - memory)) + 0.2 * u[k]
        x += v
    return Trajectory(np.arange(samples) / 10.0, u[:, None], y[:, None], SPEC)


@settings(max_examples=4)
@given(st.floats(0.2, 0.9), st.integers(0, 1000))
def test_a_hysteresis_of_the_input_is_found_again(pole: float, seed: int) -> None:
    learn, test = (driven(pole, seed + k) for k in (0, 1))
    model = PrandtlIshlinskii(order=1, stops=12, drawn_by="inputs").fit([learn], rng=np.random.default_rng(0))
    linear = Arx(order=1).fit([learn], rng=np.random.default_rng(0))
    assert model.layout.a_matrix(model.theta)[0, 0] == pytest.approx(pole, abs=0.03)
    errors = [simulation_error(one, test).nrmse[0] for one in (model, linear)]
    assert errors[0] < 0.01  # the radii are not those of the plant
    assert errors[0] < 0.05 * errors[1]


def test_a_hysteresis_in_the_loop_is_found_again_and_a_linear_model_does_not_reach_it() -> None:
    learn, test = ([softening(seed, size) for size in (0.5, 1.0, 2.0)] for seed in (0, 1))
    model = PrandtlIshlinskii(order=2).fit(learn, rng=np.random.default_rng(0))
    linear = Arx(order=2).fit(learn, rng=np.random.default_rng(0))
    errors = [[simulation_error(one, record).nrmse[0] for record in test] for one in (model, linear)]
    assert max(errors[0]) < 0.1
    assert np.mean(errors[0]) < 0.15 * np.mean(errors[1])


@given(st.integers(0, 2**32 - 1), st.integers(1, 5), st.booleans())
@settings(max_examples=10)
def test_derivatives_are_those_of_differences_compiled_or_not(seed: int, nx: int, compiled: bool) -> None:
    rng, layout = np.random.default_rng(seed), HysteresisLayout(nx, 2, 3, 2, 3)
    theta = 0.2 * rng.normal(size=layout.count)
    radii, u = np.tile([0.05, 0.2, 0.6], (2, 1)), rng.normal(size=(40, 2))
    x, memory = rng.normal(size=nx), np.zeros((2, 3))
    with pytest.MonkeyPatch.context() as patch:
        if not compiled:
            patch.setattr(hysteresis_pass, "library", lambda: None)
        run = layout.run(theta, radii, x, memory, u)
        assert run is not None
        slopes = layout.slopes(theta, u, run)
        cut = layout.moving
        for column in range(layout.count + nx):
            number = column if column < cut else column - nx
            both = []
            for by in (1e-7, -1e-7):
                moved, start = theta.copy(), x.copy()
                if cut <= column < cut + nx:
                    start[column - cut] += by
                else:
                    moved[number] += by
                again = layout.run(moved, radii, start, memory, u)
                assert again is not None
                both.append(again)
            if np.array_equal(both[0].drawn, both[1].drawn):  # else a stop met its limit in between
                difference = (both[0].y - both[1].y) / 2e-7
                assert slopes[..., column] == pytest.approx(difference, abs=1e-5 * (1 + np.abs(difference).max()))


@given(st.integers(0, 2**32 - 1), st.integers(2, 7))
def test_a_hysteresis_does_not_know_how_fast_it_is_drawn(seed: int, slower: int) -> None:
    """Samples between those of a signal that goes straight from one to the next change nothing."""
    z = np.random.default_rng(seed).normal(size=(50, 1))
    fine = np.interp(np.arange(49 * slower + 1) / slower, np.arange(50), z[:, 0])[:, None]
    assert stopped(fine, RADII)[::slower] == pytest.approx(stopped(z, RADII), abs=1e-12)


@given(st.integers(0, 2**32 - 1), st.floats(0.1, 1e3))
def test_a_stop_is_never_beyond_its_radius(seed: int, size: float) -> None:
    z = size * np.random.default_rng(seed).normal(size=(60, 1))
    assert (np.abs(stopped(z, RADII)) <= RADII * (1 + 1e-12) + 1e-12 * size).all()


def test_weights_stay_positive_where_it_is_asked_and_the_loop_loses_energy() -> None:
    model = PrandtlIshlinskii(order=1, stops=6, positive=True).fit([driven(0.5, 3)], rng=np.random.default_rng(0))
    assert np.min(model.notes["weights"]) >= 0.0
    z, w = model.hysteresis_loop()
    assert z.shape == w.shape == (400,)
    assert float(np.sum(w * np.gradient(z))) > 0.0  # the area of the loop, run through clockwise
    assert w[0] > w[200]  # at z = 0 the rising branch is above the falling one


def test_runs_are_bounded_however_large_the_input() -> None:
    model = PrandtlIshlinskii(order=2).fit([softening(0, 1.0)], rng=np.random.default_rng(0))
    gain: list[float] = []
    for size in (1e1, 1e2):
        run: FloatArray = model.free_run(model.state_mean[None], np.full((1, 3000, 1), size))[0]
        gain.append(float(np.abs(run).max()) / size)
    assert np.isfinite(gain).all()
    assert gain[1] < 2.0 * gain[0]


def test_steps_are_the_run_and_the_file_is_the_model() -> None:
    learn = softening(0, 1.0)
    model = PrandtlIshlinskii(order=2, hystereses=2).fit([learn], rng=np.random.default_rng(0))
    again = PrandtlIshlinskiiModel.from_dict(json.loads(json.dumps(model.to_dict())))
    late = learn[1000:1300]
    x = again.initial_state(late[:100])
    run = again.free_run(x[None], late.u[None])[0]
    assert np.sqrt(np.mean((run - late.y) ** 2)) < 0.1 * late.y.std()
    states = np.tile(x, (2, 1))
    for k in range(100):
        assert again.output(states, late.u[k]) == pytest.approx(np.tile(run[k], (2, 1)), abs=1e-10)
        states = again.step(states, late.u[k])


def test_an_output_of_a_plant_without_feedthrough_does_not_answer_at_once() -> None:
    model = PrandtlIshlinskii(order=2).fit([softening(0, 1.0)], rng=np.random.default_rng(0))
    x = model.state_mean
    assert model.output(x, np.array([3.0])) == pytest.approx(model.output(x, np.array([-3.0])), abs=1e-12)


def test_what_it_cannot_take_is_refused() -> None:
    with pytest.raises(InputError, match=r"stops: .*a number >= 1"):
        PrandtlIshlinskii(stops=0).fit([driven(0.5, 0)], rng=np.random.default_rng(0))
    with pytest.raises(FitError, match="too short"):
        PrandtlIshlinskii().fit([driven(0.5, 0)[:100]], rng=np.random.default_rng(0))
