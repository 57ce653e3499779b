"""State-space models of largest likelihood: slopes, orders, dead times, noise of any colour, holes, loops."""

from __future__ import annotations

import runpy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import lfilter

from harness.errors import FitError
from harness.scoring import equation_error, simulation_error
from harness.signals import Channel, FloatArray, PlantSpec, Trajectory
from identifiers.linear.prediction_error import PredictionError
from identifiers.linear.statespace.ladder import Rung, finished, ladder
from identifiers.linear.statespace.model import Piece, StateSpace, coordinates, errors_of, gradients_of
from identifiers.linear.statespace.search import Freedom, search, settled_starts
from identifiers.linear.statespace.starts import reduced

RNG = np.random.default_rng(0)
OSCILLATOR = np.poly([0.9 * np.exp(0.5j), 0.9 * np.exp(-0.5j)]).real


def spec_of(nu: int = 1, ny: int = 1) -> PlantSpec:
    inputs = tuple(Channel(f"u{j}", "V") for j in range(nu))
    return PlantSpec(inputs, tuple(Channel(f"y{i}", "m") for i in range(ny)), 0.1)


def oscillator(seed: int, n: int = 800, noise: float = 0.1, colour: float = 0.0, late: int = 0) -> Trajectory:
    """A plant of two states in white inputs, seen through noise of one pole."""
    rng = np.random.default_rng(seed)
    u = rng.normal(size=n + 200)
    x = lfilter([0.0, *np.zeros(late), 1.0, 0.5], OSCILLATOR, u)
    v = lfilter([1.0], [1.0, -colour], rng.normal(size=n + 200))
    y = x + noise * x.std() * v / v.std()
    return Trajectory(0.1 * np.arange(n), u[200:, None], y[200:, None], spec_of())


def drawn(seed: int, order: int = 3, nu: int = 2, ny: int = 2, lags: int = 2) -> StateSpace:
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(order, order))
    a *= 0.8 / np.abs(np.linalg.eigvals(a)).max()
    noise = rng.uniform(-0.4, 0.4, size=(ny, lags))
    parts = (rng.normal(size=(order, nu)), rng.normal(size=(ny, order)), rng.normal(size=(ny, nu)))
    return StateSpace(a, *parts, rng.normal(size=ny), noise)


def stepped(model: StateSpace, start: FloatArray, piece: Piece) -> FloatArray:
    """Innovations by their definition, sample by sample."""
    x, left = start, []
    for u, y in zip(piece.u, piece.y, strict=True):
        left.append(y - model.c @ x - model.d @ u - model.level)
        x = model.a @ x + model.b @ u
    v = np.array(left)
    found = v.copy()
    for j in range(1, model.noise.shape[1] + 1):
        found[j:] += v[:-j] * model.noise[:, j - 1]
    return found


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 4), st.integers(0, 2))
def test_innovations_are_those_of_the_recursion_and_slopes_those_of_differences(seed, order, lags):
    rng, model = np.random.default_rng(seed), drawn(seed, order=order, lags=lags)
    piece = Piece(rng.normal(size=(40, 2)), rng.normal(size=(40, 2)))
    start = rng.normal(size=order)
    own = errors_of(model, start[None], [piece])[0]
    assert own.innovations[lags:] == pytest.approx(stepped(model, start, piece)[lags:], abs=1e-9)
    assert not own.innovations[:lags].any()
    directions = coordinates(model)
    slopes, starts = gradients_of(model, own, piece, directions, direct=2, offset=True)
    q, step = directions.shape[1], 1e-6
    assert q == order * 4
    for column in range(slopes.shape[2]):
        change = np.zeros(slopes.shape[2])
        change[column] = step
        moved = model.moved(np.concatenate([directions @ change[:q], change[q:]]))
        found = (stepped(moved, start, piece) - stepped(model, start, piece))[lags:] / step
        assert slopes[lags:, :, column] == pytest.approx(found, abs=1e-4 * max(1.0, np.abs(found).max()))
    for state in range(order):
        found = stepped(model, start + step * np.eye(order)[state], piece) - stepped(model, start, piece)
        assert starts[lags:, :, state] == pytest.approx(found[lags:] / step, abs=1e-5 * max(1.0, np.abs(found).max()))


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 4))
def test_no_direction_of_the_search_is_a_change_of_coordinates(seed, order):
    model = drawn(seed, order=order)
    directions, rng = coordinates(model), np.random.default_rng(seed)
    turn = rng.normal(size=(order, order))
    change = [turn @ model.a - model.a @ turn, turn @ model.b, -model.c @ turn]
    assert directions.T @ np.concatenate([part.ravel() for part in change]) == pytest.approx(0.0, abs=1e-9)


def test_a_search_from_the_truth_only_gains_and_ends_where_one_from_elsewhere_does():
    data = oscillator(1)
    pieces = [Piece(data.u, data.y)]
    truth = StateSpace(
        np.array([[-OSCILLATOR[1], 1.0], [-OSCILLATOR[2], 0.0]]),
        np.array([[1.0], [0.5]]),
        np.array([[1.0, 0.0]]),
        np.zeros((1, 1)),
        np.zeros(1),
        np.zeros((1, 0)),
    )
    first = settled_starts(truth, pieces, Freedom())
    end = search(first, pieces, Freedom(), gain=1e-9)
    assert end.arrived
    assert end.loss < first.loss
    climbed = ladder(pieces, Freedom(), [2])[2].end
    assert climbed.loss == pytest.approx(end.loss, abs=0.05)
    assert np.sort_complex(np.linalg.eigvals(climbed.model.a)) == pytest.approx(
        np.sort_complex(np.linalg.eigvals(end.model.a)), abs=1e-3
    )


def test_a_search_without_hope_of_what_is_asked_ends_early_and_one_with_hope_where_any_does():
    data = oscillator(1)
    pieces = [Piece(data.u, data.y)]
    near = np.array([[-OSCILLATOR[1], 0.8], [-OSCILLATOR[2], 0.1]])
    parts = (near, np.array([[1.0], [0.3]]), np.array([[1.0, 0.2]]), np.zeros((1, 1)), np.zeros(1), np.zeros((1, 0)))
    first = settled_starts(StateSpace(*parts), pieces, Freedom())
    whole = search(first, pieces, Freedom(), gain=1e-6)
    asked = search(first, pieces, Freedom(), gain=1e-6, beat=whole.loss + 1.0)
    assert (whole.arrived, asked.loss) == (True, whole.loss)
    given_up = search(first, pieces, Freedom(), gain=1e-6, beat=whole.loss - 1e4)
    assert not given_up.arrived
    assert whole.loss < given_up.loss < first.loss


def test_orders_that_cannot_win_are_not_searched_again_and_the_one_that_wins_is(monkeypatch):
    again: list[int] = []

    def told(model: StateSpace, pieces: Any, direct: bool, lags: int) -> None:
        again.append(lags)

    monkeypatch.setattr("identifiers.linear.statespace.ladder.filtered_model", told)
    data = oscillator(2, noise=0.2, colour=0.9)
    pieces = [Piece(data.u / data.u.std(), data.y / data.y.std())]
    rungs = ladder(pieces, Freedom(), list(range(1, 9)))
    assert min(rungs, key=lambda n: rungs[n].judged) == 2
    assert 2 in again
    assert len(rungs) >= 6
    assert max(again) < max(rungs)


@pytest.mark.parametrize("number", [6, 27])
def test_no_order_is_less_likely_than_where_a_search_from_the_plant_ends(number):
    """Reductions by size kept modes of the noise here and left modes of the plant out: 8 and 6 less likely."""
    file = Path(__file__).parents[2] / "benchmarks" / "linear_against_peers.py"
    made: dict[str, Any] = runpy.run_path(str(file))
    case = made["case_of"](number, 2000)
    pieces, free = [Piece(case.u / case.u.std(), case.y / case.y.std())], Freedom()
    plant = case.plant
    colour = -made["POLE"] if case.kind in made["REMEMBERED"] else None
    noise = np.full((1, 0 if colour is None else 1), colour or 0.0)
    parts = (plant.a, plant.b * case.u.std(), plant.c / case.y.std(), np.zeros((1, 1)), np.zeros(1), noise)
    truth = Rung(search(settled_starts(StateSpace(*parts), pieces, free), pieces, free), np.inf)
    climbed = ladder(pieces, free, list(range(1, 11)))
    best = min(climbed.values(), key=lambda rung: rung.judged)
    assert best.judged <= finished(truth, pieces, free).judged + 0.1


def test_the_inputs_of_a_start_are_solved_for_at_once():
    model, rng = drawn(5, lags=0), np.random.default_rng(5)
    u = rng.normal(size=(300, 2))
    zeros = np.zeros_like(model.b)
    y = -errors_of(model, np.zeros((1, 3)), [Piece(u, np.zeros((300, 2)))])[0].left
    found = settled_starts(replace(model, b=zeros, d=np.zeros((2, 2))), [Piece(u, y)], Freedom(direct=2)).model
    assert found.b == pytest.approx(model.b, abs=1e-8)
    assert found.d == pytest.approx(model.d, abs=1e-8)


def test_a_reduction_to_all_states_keeps_the_response():
    model = drawn(3, order=4, lags=0)
    same = reduced(model, [4])[4]
    for k in range(6):
        one, other = (m.c @ np.linalg.matrix_power(m.a, k) @ m.b for m in (model, same))
        assert one == pytest.approx(other, abs=1e-8)


@pytest.mark.parametrize(("colour", "lags"), [(0.0, 0), (0.9, 1)])
def test_order_and_noise_are_those_of_the_plant(colour, lags):
    model = PredictionError().fit([oscillator(2, noise=0.2, colour=colour)], rng=RNG)
    assert (model.notes["structure"], model.notes["order"], model.notes["noise_order"]) == ("state-space", 2, lags)
    estimate = model.notes["estimate"]
    low, high = np.array(estimate["intervals"]).T
    truth = np.array([0.9, 0.5, 1.5 / OSCILLATOR.sum()])
    assert np.all((low < truth) & (truth < high))
    fresh = oscillator(99, noise=0.0)
    assert simulation_error(model, fresh).nrmse[0] < 0.1
    assert bool(model.filter_gain.any()) == bool(lags)


def test_dead_times_are_found_and_cost_no_states_of_the_plant():
    model = PredictionError().fit([oscillator(3, late=6)], rng=RNG)
    assert model.notes["delays"] == [7]
    assert model.notes["order"] == 2
    response = model.impulse_response(12)[:, 0, 0]
    assert np.abs(response[:7]).max() < 1e-9
    assert response[7] == pytest.approx(1.0, abs=0.1)
    given_one = PredictionError(structure="state-space", order=2, delay=7).fit([oscillator(3, late=6)], rng=RNG)
    assert given_one.impulse_response(12) == pytest.approx(model.impulse_response(12), abs=1e-3)


def test_exact_data_give_the_plant_to_rounding():
    model = PredictionError().fit([oscillator(4, noise=0.0)], rng=RNG)
    assert model.notes["order"] == 2
    assert np.sort_complex(model.eigenvalues[:2]) == pytest.approx(0.9 * np.exp([-0.5j, 0.5j]), abs=1e-6)


@pytest.mark.parametrize("colour", [0.0, 0.8])
def test_missing_readings_are_passed_over(colour):
    whole = oscillator(5, colour=colour)
    gone = np.zeros(whole.y.shape, dtype=bool)
    gone[np.random.default_rng(1).choice(len(whole), 60, replace=False)] = True
    spoiled = replace(whole, y=np.where(gone, 1e3, whole.y), missing=gone)
    model = PredictionError().fit([spoiled], rng=RNG)
    assert model.notes["order"] == 2
    assert simulation_error(model, oscillator(98, noise=0.0)).nrmse[0] < 0.06


def test_records_of_any_length_have_starts_of_their_own():
    whole = oscillator(6, n=600)
    pieces = [whole[low : low + 60] for low in range(0, 600, 60)]
    for number, piece in enumerate(pieces):  # free motions that no input explains
        free = 3.0 * number * np.cumprod(np.full(60, 0.9)) * np.cos(0.5 * np.arange(60))
        pieces[number] = replace(piece, y=piece.y + free[:, None])
    model = PredictionError().fit(pieces, rng=RNG)
    assert model.notes["order"] == 2
    assert simulation_error(model, oscillator(97, noise=0.0)).nrmse[0] < 0.05


def looped(seed: int, gain: float = 0.2, n: int = 1500) -> Trajectory:
    """The same plant under ``u = r - gain y``, loaded by a disturbance that remembers."""
    rng = np.random.default_rng(seed)
    r, load = rng.normal(size=n), lfilter([1.0], [1.0, -0.9], 0.5 * rng.normal(size=n))
    x, u, y = np.zeros(n), np.zeros(n), np.zeros(n)
    for k in range(n):
        if k >= 2:
            x[k] = -OSCILLATOR[1] * x[k - 1] - OSCILLATOR[2] * x[k - 2] + u[k - 1] + 0.5 * u[k - 2]
        y[k] = x[k] + load[k]
        u[k] = r[k] - gain * y[k]
    return Trajectory(0.1 * np.arange(n), u[:, None], y[:, None], spec_of())


def test_a_loop_under_coloured_load_does_not_bias():
    model = PredictionError().fit([looped(7)], rng=RNG)
    assert model.notes["noise_order"] >= 1
    assert "warning" not in model.notes
    assert simulation_error(model, oscillator(96, noise=0.0)).nrmse[0] < 0.1


def pushed(seed: int, unstable: bool, n: int = 1200) -> Trajectory:
    """Two states that a load moves, seen through one; the unstable plant is held by a law of its states, and moved."""
    rng = np.random.default_rng(seed)
    a = np.array([[1.05, 0.2], [0.0, 0.9]]) if unstable else np.array([[0.98, 0.1], [-0.3, 0.95]])
    b = np.array([0.0, 1.0]) if unstable else np.array([0.005, 0.1])
    x, u, y = np.zeros(2), np.zeros((n, 1)), np.zeros((n, 1))
    for k in range(n):
        y[k] = 3.0 + x[0] + 0.02 * rng.normal()
        u[k] = 2.0 * rng.normal() - (x @ [1.2, 0.9] if unstable else 0.0)
        x = a @ x + b * u[k] + 0.05 * rng.normal(size=2)
    return Trajectory(0.1 * np.arange(n), u, y, spec_of())


@pytest.mark.parametrize(
    ("unstable", "poles"), [(False, [0.981, 0.981]), pytest.param(True, [0.9, 1.05], marks=pytest.mark.slow)]
)
def test_a_load_that_moves_the_states_asks_for_innovations_and_holds_unstable_plants(unstable, poles):
    data = pushed(1, unstable)
    model = PredictionError().fit([data], rng=RNG)
    assert (model.notes["noise"], model.notes["order"]) == ("innovations", 2)
    assert np.sort(np.abs(model.eigenvalues[:2])) == pytest.approx(poles, abs=0.02)  # then inputs on their way
    assert model.filter_gain.any()
    fresh, rms = pushed(2, unstable), float(np.array(model.notes["residual_rms"])[0])
    assert equation_error(model, fresh, burn_in=50).rms[0] < 1.15 * rms
    worse = PredictionError(structure="oe", order=2).fit([data], rng=RNG)
    assert equation_error(worse, fresh, burn_in=50).rms[0] > 1.5 * rms


@settings(max_examples=5, deadline=None)
@given(st.integers(0, 1000), st.floats(1e-3, 1e3), st.floats(1e-3, 1e3))
def test_units_of_channels_decide_nothing(seed, volt, metre):
    data = oscillator(seed, n=300)
    other = replace(data, u=data.u * volt, y=data.y * metre)
    one, two = (PredictionError().fit([record], rng=RNG) for record in (data, other))
    assert one.notes["order"] == two.notes["order"]
    scaled = two.impulse_response(20) * volt / metre
    assert scaled == pytest.approx(one.impulse_response(20), abs=2e-3)


def test_two_inputs_and_outputs_share_the_states():
    truth, rng = drawn(11, order=3, lags=0), np.random.default_rng(3)
    truth = replace(truth, d=np.zeros((2, 2)))
    u = rng.normal(size=(1500, 2))
    y = -stepped(truth, np.zeros(3), Piece(u, np.zeros((1500, 2))))
    noisy = y + 0.1 * y.std(axis=0) * rng.normal(size=y.shape)
    model = PredictionError().fit([Trajectory(0.1 * np.arange(1500), u, noisy, spec_of(2, 2))], rng=RNG)
    assert model.notes["order"] == 3
    for k in range(5):
        own = truth.c @ np.linalg.matrix_power(truth.a, k) @ truth.b
        assert model.impulse_response(6)[k + 1] == pytest.approx(own, abs=0.1)


def test_an_unstable_end_is_searched_again_where_a_stable_one_is_asked_for():
    k = np.arange(200)
    u = np.random.default_rng(5).normal(size=200)
    y = np.cumsum(np.concatenate([[0.0], u[:-1]])) + 0.01 * np.random.default_rng(6).normal(size=200)
    data = Trajectory(0.1 * k, u[:, None], y[:, None], spec_of())
    model = PredictionError(stable=True).fit([data], rng=RNG)
    assert np.abs(model.eigenvalues).max() < 1.0


@pytest.mark.parametrize("options", [{"structure": "state-space", "nf": 2}, {"structure": "none"}, {"delay": -1}])
def test_options_that_mean_nothing_are_refused(options: dict[str, Any]):
    with pytest.raises(FitError, match="options"):
        PredictionError(**options).fit([oscillator(0, n=100)], rng=RNG)


def test_what_auto_takes_follows_from_the_options():
    data = oscillator(8, n=300)
    assert PredictionError(order=2).fit([data], rng=RNG).notes["structure"] == "oe"
    assert PredictionError(nk=1).fit([data], rng=RNG).notes["structure"] == "oe"
    assert PredictionError(structure="state-space", order=2).fit([data], rng=RNG).notes["order"] == 2
