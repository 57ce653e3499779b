"""Polynomial models with orders by channel, delays from the data, and records with missing readings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import lfilter

from harness.errors import FitError
from harness.models.arx_orders import arx_order_grid, input_delays
from harness.registry import create
from harness.signals import Channel, PlantSpec, Trajectory
from identifiers.linear.polynomials.holes import misses_of
from identifiers.linear.polynomials.model import Orders, OutputRecord, Polynomials, block_form
from identifiers.linear.prediction_error import PredictionError

RNG = np.random.default_rng(0)
TWO = PlantSpec((Channel("u", "V"), Channel("v", "A")), (Channel("y", "m"),), 0.1)


def two_inputs(seed: int, n: int = 1200, noise: float = 0.1) -> Trajectory:
    """Return y = q^-2 / (1 - 1.5 q^-1 + .7 q^-2) u + .5 q^-4 / (1 - .6 q^-1) v + white noise."""
    rng = np.random.default_rng(seed)
    u = rng.normal(size=(n, 2))
    y = lfilter([0, 0, 1.0, 0.5], [1, -1.5, 0.7], u[:, 0]) + lfilter([0, 0, 0, 0, 0.5], [1, -0.6], u[:, 1])
    return Trajectory(np.arange(n) * 0.1, u, (y + noise * rng.normal(size=n))[:, None], TWO)


def holed(record: Trajectory, share: float, seed: int, garbage: float) -> Trajectory:
    """Return the record with readings missing at random, and numbers of no meaning in their place."""
    rng = np.random.default_rng(seed)
    gone = rng.random(record.y.shape) < share
    return replace(record, y=np.where(gone, garbage * rng.normal(size=record.y.shape), record.y), missing=gone)


# ---- orders by channel ----


@pytest.mark.parametrize("nk", [[2, 4], "auto"])
def test_every_input_has_a_denominator_and_a_delay_of_its_own(nk):
    model = PredictionError(structure="oe", nb=[2, 1], nf=[2, 1], nk=nk).fit([two_inputs(0)], rng=RNG)
    (found,) = model.notes["polynomials"]
    assert found["nk"] == [2, 4]
    assert found["f"][0] == pytest.approx([-1.5, 0.7], abs=0.01)
    assert found["f"][1] == pytest.approx([-0.6], abs=0.03)
    assert found["b"][1] == pytest.approx([0.5], abs=0.03)
    names = model.notes["estimate"]["names"]
    assert {"y: f1 of u", "y: f1 of v", "y: b4 of v"} <= set(names)
    assert model.notes["estimate"]["intervals"] is not None
    for name, low_high in zip(names, model.notes["estimate"]["intervals"], strict=True):
        if name in (true := {"y: f1 of u": -1.5, "y: f1 of v": -0.6, "y: b4 of v": 0.5, "y: b2 of u": 1.0}):
            middle, half = np.mean(low_high), np.ptp(low_high) / 2
            assert abs(true[name] - middle) < 2 * half  # four standard deviations
    assert model.notes["residual_rms"][0] == pytest.approx(0.1, rel=0.1)
    if nk == "auto":
        assert model.notes["delays"]["y from v"]["interval"] == [4, 4]


def test_the_letters_that_are_given_are_kept_and_the_others_are_chosen():
    found = PredictionError(structure="armax", na=2, nc=0, nk=[2, 4]).fit([two_inputs(1, 600)], rng=RNG)
    (polynomials,) = found.notes["polynomials"]
    assert (len(polynomials["a"]), len(polynomials["c"])) == (2, 0)
    assert str(len(polynomials["b"][0])) in found.notes["order_error"]


def test_without_c_armax_is_the_least_squares_arx():
    data = two_inputs(2, 400)
    theta = PredictionError(structure="arx", na=2, nb=[1, 2], nk=[1, 3], offset=False).fit([data], rng=RNG)
    (found,) = theta.notes["polynomials"]
    k = np.arange(4, 400)
    y, u = data.y[:, 0], data.u
    rows = np.column_stack([-y[k - 1], -y[k - 2], u[k - 1, 0], u[k - 3, 1], u[k - 4, 1]])
    wanted = np.linalg.lstsq(rows, y[k], rcond=None)[0]
    # the first rows, whose past is not known, are fitted by free starts: they say nothing
    assert [*found["a"], *found["b"][0], *found["b"][1]] == pytest.approx(wanted, abs=1e-6)


@pytest.mark.parametrize(
    "options",
    [{"na": 2}, {"nf": [1, 2, 3]}, {"nk": [[1], [2]]}, {"nb": -1}, {"structure": "armax", "nf": 1}],
    ids=str,
)
def test_orders_that_do_not_fit_are_refused_in_words(options):
    with pytest.raises(FitError, match="prediction-error"):
        PredictionError(**{"order": 1, **options}).fit([two_inputs(0, 200)], rng=RNG)


# ---- missing readings ----


def test_the_sum_of_squares_with_holes_is_the_likelihood_of_a_kalman_filter():
    rng = np.random.default_rng(3)
    orders = Orders(na=1, nb=(2,), nc=1, nd=1, nf=(1,), nk=(1,))
    n, gone = 60, (4, 5, 6, 20, 41, 59)
    costs, likelihoods = [], []
    for theta in ([-0.7, 1.0, 0.3, 0.4, 0.2, -0.5, 0.1], [-0.6, 0.8, 0.1, -0.3, 0.4, -0.2, 0.0]):
        model = Polynomials.of(np.array(theta), orders)
        u, y = rng.normal(size=(n, 1)), rng.normal(size=n)
        start = (np.zeros(orders.start_x), np.zeros(orders.start_z))
        found = misses_of(model, [start], [OutputRecord(u, np.where(np.isin(np.arange(n), gone), 99.0, y), gone)])
        a, b, c, d, k, level = block_form([model])
        x, p, squares, volume = np.zeros(len(a)), np.zeros((len(a),) * 2), 0.0, 0.0
        for i in range(n):
            ahead, spread = a @ x + b @ u[i], a @ p @ a.T + k @ k.T
            if i not in gone:
                miss = y[i] - (c @ x + d @ u[i] + level)[0]
                s = (c @ p @ c.T)[0, 0] + 1.0
                gain = (a @ p @ c.T + k)[:, 0] / s
                ahead, spread = ahead + gain * miss, spread - s * np.outer(gain, gain)
                squares, volume = squares + miss**2 / s, volume + np.log(s)
            x, p = ahead, spread
        assert found.errors @ found.errors / found.scale**2 == pytest.approx(squares, rel=1e-9)
        costs.append(found.rows * np.log(found.cost))
        likelihoods.append(found.rows * np.log(squares) + volume)
    assert costs[1] - costs[0] == pytest.approx(likelihoods[1] - likelihoods[0], rel=1e-9)


@settings(max_examples=5, deadline=None)
@given(
    structure=st.sampled_from(["arx", "armax", "oe", "bj"]), share=st.sampled_from([0.02, 0.2]), seed=st.integers(0, 99)
)
def test_what_stands_where_nothing_was_read_decides_nothing(structure, share, seed):
    whole = two_inputs(seed, 300)
    first, second = (holed(whole, share, seed, garbage) for garbage in (0.0, 1e3))
    options = {"structure": structure, "order": 1, "nk": [2, 4]}
    models = [PredictionError(**options).fit([one], rng=RNG) for one in (first, second)]
    assert models[0].notes["missing"]["readings"] == int(first.missing.sum())
    assert np.array_equal(models[0].a_matrix, models[1].a_matrix)
    assert np.array_equal(models[0].b_matrix, models[1].b_matrix)


def test_every_other_reading_of_an_autoregression_is_enough():
    misses = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        u = rng.normal(size=600)
        y = lfilter([0.0, 1.0], [1.0, -0.8], u) + lfilter([1.0, 0.4], [1.0, -0.8], 0.5 * rng.normal(size=600))
        spec = PlantSpec((Channel("u"),), (Channel("y"),), 1.0)
        gone = (rng.random((600, 1)) < 0.5) & (np.arange(600)[:, None] > 0)
        data = Trajectory(np.arange(600.0), u[:, None], np.where(gone, 0.0, y[:, None]), spec, missing=gone)
        model = PredictionError(structure="armax", order=1, offset=False).fit([data], rng=RNG)
        (found,) = model.notes["polynomials"]
        wrong = np.array([found["a"][0] + 0.8, found["b"][0][0] - 1.0, found["c"][0] - 0.4])
        misses.append(wrong / np.array(model.notes["standard_errors"][0])[:3])
        assert model.notes["residual_rms"][0] == pytest.approx(0.5, rel=0.15)
    assert np.sqrt(np.mean(np.square(misses))) < 1.5
    assert np.abs(np.mean(misses, axis=0)).max() < 3.5 / np.sqrt(8)


# ---- the grid of orders and delays ----


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 999), share=st.sampled_from([0.0, 0.05]), records=st.integers(1, 3))
def test_the_grid_of_one_factorisation_is_that_of_separate_fits(seed, share, records):
    rng = np.random.default_rng(seed)
    spec = PlantSpec((Channel("u"), Channel("v")), (Channel("y"), Channel("z")), 1.0)
    data, held = ([_random(rng, spec, share) for _ in range(records)] for _ in range(2))
    na, nb, nk = (0, 1, 3), (0, 1, 2, 4), (0, 1, 3)
    grid = arx_order_grid(data, na, nb, nk, held_out=held)
    reach = max(na[-1], nk[-1] + nb[-1] - 1)
    for a, i in enumerate(na):
        for b, j in enumerate(nb):
            for c, d in enumerate(nk):
                blocks = [_regression(one, i, j, d, reach, max(na)) for one in (data, held)]
                theta = np.linalg.lstsq(*blocks[0], rcond=None)[0]
                for (x, y), losses in zip(blocks, (grid.losses, grid.held_out), strict=True):
                    assert losses[a, b, c] == pytest.approx(np.sum((y - x @ theta) ** 2, axis=0), rel=1e-9)
                assert grid.parameters[a, b, c] == blocks[0][0].shape[1]


def _random(rng, spec, share):
    n = int(rng.integers(40, 90))
    gone = rng.random((n, 2)) < share
    return Trajectory(np.arange(float(n)), rng.normal(size=(n, 2)), rng.normal(size=(n, 2)), spec, missing=gone)


def _regression(records, na, nb, nk, reach, memory):
    rows, targets = [], []
    for record in records:
        for k in range(reach, len(record)):
            if record.missing is not None and record.missing[k - memory : k + 1].any():
                continue
            past = [record.y[k - j] for j in range(1, na + 1)] + [record.u[k - nk - j] for j in range(nb)]
            rows.append(np.concatenate([[1.0], *past]))
            targets.append(record.y[k])
    return np.array(rows), np.array(targets)


@pytest.mark.parametrize("noise", ["white", "equation"])
def test_delays_are_as_sure_as_they_say(noise):
    inside, sharp = [], 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        true = rng.integers(1, 9, size=2)
        u, e, f = rng.normal(size=(400, 2)), 1.5 * rng.normal(size=400), [1.0, -1.2, 0.5]
        y = sum(lfilter(np.r_[np.zeros(d), 0.4], f, u[:, i]) for i, d in enumerate(true))
        y = y + (lfilter([1.0], f, e) if noise == "equation" else e)
        data = Trajectory(np.arange(400) * 0.1, u, y[:, None], TWO)
        for d, found in zip(true, input_delays([data]), strict=True):
            inside.append(found.low <= d <= found.high)
            sharp += found.samples == d
    assert np.mean(inside) >= 0.9
    assert sharp >= 0.7 * len(inside)


def test_delays_of_short_records_are_refused():
    with pytest.raises(FitError, match="delays"):
        input_delays([two_inputs(0, 60)])


# ---- arx by channel ----

MIMO = PlantSpec((Channel("u", "V"), Channel("v", "A")), (Channel("y", "m"), Channel("z", "rad")), 0.1)


def coupled(seed: int, n: int = 800, noise: float = 0.2) -> Trajectory:
    """Return y+ = .8 y + u(k-1), z+ = .5 z + .3 y - .2 z(k-2) + 2 v(k-3), noise in the equations."""
    rng = np.random.default_rng(seed)
    u, y, z, e = rng.normal(size=(n, 2)), np.zeros(n), np.zeros(n), noise * rng.normal(size=(n, 2))
    for k in range(4, n):
        y[k] = 0.8 * y[k - 1] + u[k - 2, 0] + e[k, 0]
        z[k] = 0.5 * z[k - 1] + 0.3 * y[k - 1] - 0.2 * z[k - 2] + 2.0 * u[k - 4, 1] + e[k, 1]
    return Trajectory(np.arange(n) * 0.1, u, np.column_stack([y, z]), MIMO)


def test_arx_keeps_to_the_orders_of_every_pair():
    options = {"na": [[1, 0], [1, 2]], "nb": [[1, 0], [0, 1]], "nk": [[2, 1], [1, 4]]}
    wrong = []
    for seed in range(30):
        model = create("identifiers", "arx", offset=False, **options).fit([coupled(seed)], rng=RNG)
        found = model.notes["estimate"]
        values = dict(zip(found["names"], found["values"], strict=True))
        true = {
            "y on y[k]": 0.8,
            "y on u[k-1]": 1.0,
            "z on y[k]": 0.3,
            "z on z[k]": 0.5,
            "z on z[k-1]": -0.2,
            "z on v[k-3]": 2.0,
        }
        assert values.keys() == true.keys()
        low, high = np.array(found["intervals"]).T
        wanted = np.array([true[name] for name in found["names"]])
        wrong.append((wanted < low) | (wanted > high))
    assert 0.01 < np.mean(wrong) < 0.12
    assert model.spread is not None
    assert model.impulse_response(6)[4, 1, 1] == pytest.approx(2.0, abs=0.05)
    assert model.impulse_response(6)[:4, 1, 1] == pytest.approx(0.0, abs=1e-12)


def test_arx_of_one_order_is_the_same_with_it_for_every_pair():
    data = coupled(1, 300)
    plain = create("identifiers", "arx", order=2).fit([data], rng=RNG)
    pairs = create("identifiers", "arx", na=2, nb=2).fit([data], rng=RNG)
    for one, other in zip(plain.matrices, pairs.matrices, strict=True):
        assert one == pytest.approx(other, abs=1e-10)
    assert plain.spread.a == pytest.approx(pairs.spread.a, abs=1e-9)
    assert plain.notes["estimate"]["values"] == pytest.approx(pairs.notes["estimate"]["values"], abs=1e-10)


def test_arx_finds_the_delays_and_what_is_not_given():
    model = create("identifiers", "arx", nk="auto").fit([coupled(2, 1500)], rng=RNG)
    assert model.notes["delays"]["z from v"]["samples"] == 4
    assert model.notes["delays"]["y from u"]["interval"] == [2, 2]
    assert model.notes["na"][0][0] >= 1


def test_arx_by_channel_refuses_what_makes_no_sense():
    for options in ({"nk": 0}, {"na": [1, 2, 3]}, {"nb": [[1, 2]]}):
        with pytest.raises(FitError, match="arx"):
            create("identifiers", "arx", **{"order": 1, **options}).fit([coupled(0, 100)], rng=RNG)
