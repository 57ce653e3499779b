"""Networks fitted by simulation error: exact derivatives, a hidden saturating state, calibrated bands, resuming."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harness.errors import FitError, InputError
from harness.scoring import simulation_error
from harness.scoring.predictive import probability_score
from harness.signals import Channel, PlantSpec, Trajectory
from identifiers.learned import recurrent
from identifiers.learned.recurrent import NeuralOutputError, RecurrentEnsemble
from identifiers.learned.recurrent_pass import Integrating, RecurrentLayout, library
from identifiers.linear.least_squares import Arx

SPEC = PlantSpec((Channel("u", "V"),), (Channel("y", "V"),), 1.0)


def cascade(samples: int, seed: int, noise: float = 0.01) -> Trajectory:
    """Two tanks that empty by Torricelli's law; the upper one, which nobody measures, is full at 1."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(0.1, 1.0, samples // 20 + 1), 20)[:samples]
    upper, lower, y = 0.3, 0.3, np.empty(samples)
    for k in range(samples):
        y[k] = lower
        out = np.sqrt(max(upper, 0.0))
        lower += 0.1 * out - 0.1 * np.sqrt(max(lower, 0.0))
        upper = min(upper + 0.15 * u[k] - 0.1 * out, 1.0)
    return Trajectory(np.arange(float(samples)), u[:, None], (y + noise * rng.normal(size=samples))[:, None], SPEC)


def test_a_free_run_beyond_the_data_is_held_and_stays_finite():
    records = [cascade(200, seed) for seed in range(2)]
    options = dict(order=2, hidden=2, outside=1, starts=2, members=1, iterations=15, held_out=0.4)
    model = NeuralOutputError(**options).fit(records, rng=np.random.default_rng(0))
    (member,) = model.members
    assert member.edges is not None
    x = member.initial_state(records[0])
    wild = np.full((1, 3000, 1), 30.0)
    run = member.free_run(x[None], wild)
    assert np.isfinite(run).all()
    stepped = x
    for _ in range(2000):
        stepped = member.step(stepped, wild[0, 0])
    nx = member.layout.nx
    assert (stepped[:nx] >= member.edges[0]).all()
    assert (stepped[:nx] <= member.edges[1]).all()
    assert not member.within(stepped)
    read = RecurrentEnsemble.from_dict(json.loads(json.dumps(model.to_dict())))
    assert np.array_equal(read.members[0].free_run(x[None], wild), run)
    usual = records[0].u[None]
    plain = [member.layout.run(member.theta, x[:nx], (usual[0] - member.u_mean) / member.u_std, sensitivities=False)[0]]
    assert member.free_run(x[None], usual)[0] == pytest.approx(member.y_mean + member.y_std * plain[0], abs=1e-12)


@settings(max_examples=25, deadline=None)
@given(
    st.integers(1, 3), st.integers(0, 2), st.integers(1, 2), st.integers(1, 3), st.integers(0, 2), st.booleans(),
    st.integers(0, 999),
)  # fmt: skip
def test_derivatives_are_those_of_differences(nx, nu, ny, hidden, outside, summed, seed):
    network, rng = RecurrentLayout(nx, nu, ny, hidden, outside), np.random.default_rng(seed)
    layout = Integrating(network, (0.3, 2.0)[:ny]) if summed else network
    theta, start, u = 0.2 * rng.normal(size=layout.count), rng.normal(size=layout.nx), rng.normal(size=(12, nu))
    y, slopes = layout.run(theta, start, u, sensitivities=True)
    assert slopes is not None
    joint = np.concatenate([theta, start])
    way = rng.normal(size=joint.size)

    def moved(by: float) -> np.ndarray:
        z = joint + by * way
        return layout.run(z[: layout.count], z[layout.count :], u, sensitivities=False)[0]

    assert slopes @ way == pytest.approx((moved(1e-5) - moved(-1e-5)) / 2e-5, rel=1e-4, abs=1e-6)
    x, stepped, states = start, [], layout.states(theta, start, u)
    for value, state in zip(u, states, strict=True):
        assert state == pytest.approx(x, abs=1e-9)
        stepped.append(layout.output(theta, x, value))
        by_x, out_by_x = layout.jacobians(theta, x, value)
        ways = 1e-6 * np.eye(layout.nx)
        steps = layout.step(theta, x + ways, value) - layout.step(theta, x - ways, value)
        outputs = layout.output(theta, x + ways, value) - layout.output(theta, x - ways, value)
        assert by_x == pytest.approx(steps.T / 2e-6, abs=1e-5)
        assert out_by_x == pytest.approx(outputs.T / 2e-6, abs=1e-5)
        x = layout.step(theta, x, value)
    assert np.array(stepped) == pytest.approx(y, abs=1e-9)


def sledge(samples: int, seed: int) -> Trajectory:
    """A mass with dry friction whose place nothing restores, seen with a noise of a thousandth of its travel."""
    rng = np.random.default_rng(seed)
    u, v, q, y = np.repeat(rng.uniform(-2.0, 2.0, samples // 25 + 1), 25)[:samples], 0.0, 3.0, np.empty(samples)
    for k in range(samples):
        y[k] = q
        q += 0.1 * v
        v += 0.1 * (u[k] - 0.4 * v - 0.5 * np.tanh(v / 0.05))
    return Trajectory(np.arange(float(samples)), u[:, None], (y + 2e-3 * rng.normal(size=samples))[:, None], SPEC)


def test_sums_of_what_a_network_says_hold_where_the_plant_has_never_been():
    options = dict(order=1, hidden=3, starts=4, members=2, iterations=60, ridge=1e-2)
    rng, there = np.random.default_rng(0), sledge(600, 1)
    shifted = Trajectory(there.t, there.u, there.y + 100.0, SPEC)
    model = NeuralOutputError(integrated=True, outside=0, **options).fit([sledge(800, 0)], rng=rng)
    error = simulation_error(model, there).rms[0]
    assert error < 0.1 * there.y.std()
    assert simulation_error(model, shifted).rms[0] == pytest.approx(error, rel=0.2)
    plain = NeuralOutputError(**options).fit([sledge(800, 0)], rng=rng)
    assert simulation_error(plain, shifted).rms[0] > 20 * error
    read = RecurrentEnsemble.from_dict(json.loads(json.dumps(model.to_dict())))
    x = model.initial_state(shifted)
    assert np.array_equal(read.free_run(x[None], there.u[None]), model.free_run(x[None], there.u[None]))


def test_compiled_and_numpy_runs_agree_also_where_they_diverge():
    if library() is None:
        pytest.skip("no C compiler: install gcc")
    layout, rng = RecurrentLayout(2, 1, 2, 3, 2), np.random.default_rng(0)
    u = rng.normal(size=(60, 1))
    for size in (0.2, 3.0):  # the second grows beyond all bounds
        theta, start = size * rng.normal(size=layout.count), rng.normal(size=2)
        fast, slow = (layout.run(theta, start, u, sensitivities=True, native=native) for native in (True, False))
        assert np.array_equal(np.isnan(fast[0]), np.isnan(slow[0]))
        ends = int(np.isfinite(slow[0]).all(axis=1).sum())
        assert fast[0][:ends] == pytest.approx(slow[0][:ends], rel=1e-9, abs=1e-9)
        assert fast[1][:ends] == pytest.approx(slow[1][:ends], rel=1e-6, abs=1e-9)
    assert ends < 60


def test_it_learns_a_full_tank_that_nobody_measures_and_knows_how_well():
    learn, held = cascade(800, 0), cascade(800, 1)
    model = NeuralOutputError(order=2, starts=12, members=4, ridge=0.1).fit([learn], rng=np.random.default_rng(0))
    arx = Arx(order=2).fit([learn], rng=np.random.default_rng(0))
    ours, theirs = simulation_error(model, held).rms[0], simulation_error(arx, held).rms[0]
    assert ours < 0.4 * theirs
    score = probability_score(model, held)
    assert 0.8 < score.coverage[2, 0] < 0.98  # of the 90 % bands
    assert score.skill[0] > 1.0


@pytest.mark.slow
def test_records_of_different_length_have_initial_states_of_their_own():
    parts = [cascade(500, seed)[low:] for seed, low in ((0, 0), (1, 137))]
    model = NeuralOutputError(order=2, starts=6, members=2, ridge=0.1).fit(parts, rng=np.random.default_rng(0))
    turned = NeuralOutputError(order=2, starts=6, members=2, ridge=0.1).fit(parts[::-1], rng=np.random.default_rng(0))
    assert json.dumps(model.to_dict()) == json.dumps(turned.to_dict())
    assert simulation_error(model, cascade(400, 2)).nrmse[0] < 0.15


def test_a_fit_that_was_interrupted_goes_on_and_ends_where_a_whole_one_does(tmp_path, monkeypatch):
    learn, options = cascade(200, 0), dict(order=1, starts=4, members=2, iterations=10)
    whole = NeuralOutputError(**options).fit([learn], rng=np.random.default_rng(3))
    kept = NeuralOutputError(checkpoint=str(tmp_path / "fit.npz"), **options)
    descend, calls = recurrent.descend, []

    def stop(*args, **more):
        calls.append(1)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return descend(*args, **more)

    monkeypatch.setattr(recurrent, "descend", stop)
    with pytest.raises(KeyboardInterrupt):
        kept.fit([learn], rng=np.random.default_rng(3))
    resumed = kept.fit([learn], rng=np.random.default_rng(3))
    assert len(calls) == 5, "two starts were kept, two are made"
    assert json.dumps(resumed.to_dict()) == json.dumps(whole.to_dict())
    other = kept.fit([learn], rng=np.random.default_rng(4))
    assert json.dumps(other.to_dict()) != json.dumps(whole.to_dict()), "another fit is not continued"


def test_the_model_comes_back_from_its_file():
    learn = cascade(200, 0)
    model = NeuralOutputError(order=1, starts=2, members=2, iterations=10).fit([learn], rng=np.random.default_rng(0))
    read = RecurrentEnsemble.from_dict(json.loads(json.dumps(model.to_dict())))
    assert np.array_equal(simulation_error(read, learn).rms, simulation_error(model, learn).rms)
    assert np.array_equal(probability_score(read, learn).log_score, probability_score(model, learn).log_score)


def test_options_that_make_no_sense_and_unstable_plants_are_refused_in_words():
    with pytest.raises(InputError, match="starts: option of neural-output-error: expected a number >= 3"):
        NeuralOutputError(starts=2, members=3).fit([cascade(200, 0)], rng=np.random.default_rng(0))
    with pytest.raises(FitError, match="records too short"):
        NeuralOutputError().fit([cascade(20, 0)], rng=np.random.default_rng(0))
