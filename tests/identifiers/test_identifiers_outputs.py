"""Models from inputs and outputs (subspace, prediction error, spectra, balancing), each against its truth."""

from __future__ import annotations

import numpy as np
import pytest

from harness.errors import FitError
from harness.scoring import equation_error, simulation_error
from harness.signals import Channel, PlantSpec, Trajectory
from identifiers.linear.arx import Arx
from identifiers.linear.n4sid import Subspace
from identifiers.linear.polynomials.holes import misses_of
from identifiers.linear.polynomials.model import Orders, OutputRecord, Polynomials, block_form, errors_and_gradients
from identifiers.linear.prediction_error import PredictionError
from identifiers.linear.spectral import etfe, welch

RNG = np.random.default_rng(0)
SPEC = PlantSpec((Channel("u", "V"),), (Channel("y", "m"),), 0.1)
F, B = [1.0, -1.5, 0.7], [0.0, 1.0, 0.5]
NOISE = {"oe": ([1.0], [1.0]), "armax": ([1.0, 0.6, 0.2], F), "bj": ([1.0, 0.5], [1.0, -0.9])}


def record(kind, n=2000, seed=1, *, level=3.0, sigma=0.3, pole=None):
    """Return a record of a second-order system, cut out of a longer run so that its start is not at rest."""
    from scipy.signal import lfilter

    rng = np.random.default_rng(seed)
    u, e = rng.normal(size=n + 50), sigma * rng.normal(size=n + 50)
    if pole is not None:
        u = lfilter([1.0], [1.0, -pole], u)
    y = lfilter(B, F, u) + lfilter(*NOISE[kind], e) + level
    return Trajectory(np.arange(n) * 0.1, u[50:, None], y[50:, None], SPEC)


def closed_loop(n=6000, seed=0):
    """Return an output fed back with sensor noise larger than the reference: where direct methods are biased."""
    rng = np.random.default_rng(seed)
    a, b = np.array([[0.7, 0.3], [-0.2, 0.65]]), np.array([0.0, 1.0])
    u, y, x = np.zeros((n, 1)), np.zeros((n, 1)), np.zeros(2)
    for k in range(n):
        y[k] = x[0] + rng.normal()
        u[k] = 0.3 * rng.normal() + 0.5 * y[k]
        x = a @ x + b * u[k] + 0.3 * rng.normal(size=2)
    return Trajectory(np.arange(n) * 0.1, u, y, SPEC), a


def roots(model, count=2):
    return np.sort_complex(model.eigenvalues[:count])


# ---- prediction error ----


@pytest.mark.parametrize("gaps", [((), ()), ((7, 8, 20), (29,))])
@pytest.mark.parametrize("nf", [(), (2,), (2, 1), (0, 1)])
def test_slopes_of_prediction_errors_are_their_differences(nf, gaps):
    rng = np.random.default_rng(0)
    parts = [
        OutputRecord(rng.normal(size=(n, 2)), rng.normal(size=n), holes)
        for n, holes in zip((50, 30), gaps, strict=True)
    ]
    orders = Orders(na=1, nb=(2, 1), nc=2, nd=1, nf=nf, nk=(1, 3))
    theta = np.concatenate(
        [[0.2], rng.normal(size=3), [0.3, 0.1, 0.2], [-0.6] if sum(nf) == 1 else [-1.2, 0.5, -0.6][: sum(nf)], [0.4]]
    )
    model = Polynomials.of(theta, orders)
    starts = [(rng.normal(size=orders.start_x), rng.normal(size=orders.start_z)) for _ in parts]
    vector = np.concatenate([model.vector, *(np.concatenate(pair) for pair in starts)])

    def errors(theta):
        rest = theta[model.vector.size :].reshape(2, -1)
        pairs = [(row[: orders.start_x], row[orders.start_x :]) for row in rest]
        return misses_of(Polynomials.of(theta, orders), pairs, parts)

    step = 1e-6
    # with holes the errors turn as the model moves: it is their sum of squares whose slope must be right
    numeric = [
        (errors(vector + step * d).cost - errors(vector - step * d).cost) / (2 * step) for d in np.eye(len(vector))
    ]
    now = misses_of(model, starts, parts)
    assert 2 * now.gradients.T @ now.errors == pytest.approx(np.array(numeric), rel=1e-5, abs=1e-5)
    if not gaps[0]:
        each = [errors(vector + step * d).errors - errors(vector - step * d).errors for d in np.eye(len(vector))]
        assert now.gradients == pytest.approx(np.array(each).T / (2 * step), abs=1e-7)


@pytest.mark.parametrize("nf", [(), (2,), (2, 1)])
def test_the_state_space_form_predicts_as_the_polynomials_do(nf):
    rng = np.random.default_rng(2)
    orders = Orders(na=1, nb=(2, 1), nc=2, nd=1, nf=nf, nk=(2, 0))
    theta = np.concatenate(
        [[-0.4], rng.normal(size=3), [0.3, 0.1, 0.2], [-0.6] if sum(nf) == 1 else [-1.2, 0.5, -0.6][: sum(nf)], [0.7]]
    )
    model = Polynomials.of(theta, orders)
    u, y = rng.normal(size=(80, 2)), rng.normal(size=80)
    blank = [(np.zeros(orders.start_x), np.zeros(orders.start_z))]
    errors = errors_and_gradients(model, blank, [OutputRecord(u, y)])[0]
    a, b, c, d, k, level = block_form([model])
    x = np.zeros(len(a))
    for n in range(80):
        miss = y[n] - (c @ x + d @ u[n] + level)[0]
        assert miss == pytest.approx(errors[n], abs=1e-9)
        x = a @ x + b @ u[n] + k[:, 0] * miss


@pytest.mark.parametrize("kind", ["oe", "armax", "bj"])
def test_each_structure_finds_its_own_system_within_its_standard_errors(kind):
    misses = []
    for seed in range(6):
        model = PredictionError(structure=kind, order=2).fit([record(kind, seed=seed)], rng=RNG)
        found, spread = model.notes["polynomials"][0], np.array(model.notes["standard_errors"][0])
        poles = np.array(found["f"] or found["a"])
        assert poles == pytest.approx(F[1:], abs=0.03)
        assert model.notes["residual_rms"][0] == pytest.approx(0.3, rel=0.06)
        assert model.notes["converged"]
        first = {"oe": 2, "armax": 0, "bj": 6}[kind]
        misses += list((poles - F[1:]) / spread[first : first + 2])
    assert np.sqrt(np.mean(np.square(misses))) < 1.7, "standard errors are of the right size"


def test_box_jenkins_is_the_only_one_right_under_its_noise():
    data, held = record("bj", 4000), record("bj", 1000, seed=9)
    errors = {
        kind: equation_error(PredictionError(structure=kind, order=2).fit([data], rng=RNG), held, burn_in=20).rms[0]
        for kind in ("oe", "armax", "bj")
    }
    assert errors["bj"] < 0.32
    assert errors["bj"] < 0.95 * errors["armax"] < errors["oe"]


def test_records_that_start_anywhere_have_initial_states_of_their_own():
    whole = record("oe", 1200, sigma=0.0)
    pieces = [whole[150 * i : 150 * i + 60] for i in range(8)]
    model = PredictionError(order=2).fit(pieces, rng=RNG)
    assert model.notes["polynomials"][0]["f"] == pytest.approx(F[1:], abs=1e-6)
    assert model.notes["residual_rms"][0] < 1e-6


def test_order_and_delay_are_found_and_kept():
    data = record("oe", 3000, sigma=0.5)
    assert PredictionError().fit([data], rng=RNG).notes["order"] == 2
    late = Trajectory(data.t[3:], data.u[3:], data.y[:-3], SPEC)
    model = PredictionError(order=2, delay=4).fit([late], rng=RNG)
    assert np.abs(model.impulse_response(4)).max() < 1e-12
    assert model.impulse_response(6)[4:, 0, 0] == pytest.approx([1.0, 2.0], abs=0.1)
    assert model.filter_gain == pytest.approx(0.0)


@pytest.mark.parametrize("options", [{"structure": "arma"}, {"nk": "some"}, {"order": 0}, {"delay": -1}])
def test_options_of_prediction_error_that_make_no_sense_are_refused(options):
    with pytest.raises(FitError, match="options"):
        PredictionError(**options).fit([record("oe", 100)], rng=RNG)


# ---- subspace ----


@pytest.mark.parametrize("method", ["n4sid", "moesp", "cva", "parsim"])
@pytest.mark.parametrize("pole", [None, 0.8])
def test_subspace_methods_find_the_system_also_under_coloured_input(method, pole):
    data, held = record("oe", 6000, pole=pole), record("oe", 500, seed=5, sigma=0.0, pole=pole)
    model = Subspace(order=2, method=method).fit([data], rng=RNG)
    assert roots(model) == pytest.approx(np.sort_complex(np.roots(F)), abs=0.02)
    assert simulation_error(model, held).nrmse[0] < 0.03


def test_two_inputs_and_outputs_from_several_short_records():
    rng = np.random.default_rng(0)
    a = np.array([[0.9, 0.2, 0.0], [-0.2, 0.8, 0.1], [0.0, 0.0, -0.5]])
    b, c = rng.normal(size=(3, 2)), rng.normal(size=(2, 3))
    spec = PlantSpec((Channel("u0"), Channel("u1")), (Channel("y0"), Channel("y1")), 0.1)
    records = []
    for _ in range(8):
        u, x, y = rng.normal(size=(200, 2)), rng.normal(size=3), np.zeros((200, 2))
        for k in range(200):
            y[k] = c @ x
            x = a @ x + b @ u[k]
        records.append(Trajectory(np.arange(200) * 0.1, u, y, spec))
    model = Subspace(order=3, past=6).fit(records, rng=RNG)
    assert np.sort_complex(model.eigenvalues) == pytest.approx(np.sort_complex(np.linalg.eigvals(a)), abs=1e-6)
    truth = [c @ np.linalg.matrix_power(a, k) @ b for k in range(5)]
    assert model.impulse_response(6)[1:] == pytest.approx(np.array(truth), abs=1e-6)
    assert Subspace(past=6).fit(records, rng=RNG).notes["order"] == 3


def test_feedback_biases_open_loop_methods_and_is_said_and_parsim_is_not_biased():
    wrong = {method: [] for method in ("n4sid", "parsim", "auto")}
    for seed in range(3):
        data, a = closed_loop(seed=seed)
        for method, errors in wrong.items():
            model = Subspace(order=2, method=method).fit([data], rng=RNG)
            errors.append(float(np.abs(roots(model) - np.sort_complex(np.linalg.eigvals(a))).max()))
            assert ("warning" in model.notes) == (method == "n4sid")
            if method == "auto":
                assert model.notes["method"] == "parsim"
    assert np.mean(wrong["parsim"]) < 0.6 * np.mean(wrong["n4sid"])
    assert wrong["auto"] == wrong["parsim"]


def test_the_filter_of_a_subspace_model_is_that_of_the_noise():
    data, held = record("bj", 6000), record("bj", 1000, seed=8)
    model = Subspace(method="cva").fit([data], rng=RNG)
    assert equation_error(model, held, burn_in=20).rms[0] < 0.33  # the innovation is 0.3


# ---- order ladders, spectra, balancing ----


def test_arx_of_a_system_that_arx_represents_badly_needs_many_orders():
    """Output error of order 2: the ladder falls on and on; output error of the true order is as good as its end."""
    data, held = record("oe", 3000, sigma=1.0), record("oe", 500, seed=4, sigma=0.0)
    free = {n: simulation_error(Arx(order=n).fit([data], rng=RNG), held).nrmse[0] for n in (2, 4, 8, 16)}
    assert free[2] > 1.5 * free[4] > 1.5 * free[8]
    oe = simulation_error(PredictionError(order=2).fit([data], rng=RNG), held).nrmse[0]
    assert oe < 0.05 * free[2]
    assert oe < 1.3 * min(free.values())
    chosen = Arx().fit([data], rng=RNG)
    assert chosen.notes["order"] >= 6


def test_bands_of_welch_hold_the_truth_as_often_as_they_say():
    inside = []
    for seed in range(12):
        found = welch([record("oe", 4000, seed=seed, level=0.0)], segment=200)
        z = np.exp(2j * np.pi * found.frequency * 0.1)
        truth = (1.0 / z + 0.5 / z**2) / (1 - 1.5 / z + 0.7 / z**2)
        miss = np.abs(found.response[:, 0, 0] - truth)
        smooth = slice(20, -2)  # beyond the resonance, where a segment does not smear
        inside.append((miss <= found.radius(0.95)[:, 0, 0])[smooth].mean())
    assert 0.92 < np.mean(inside) < 0.98
    assert np.median(found.coherence) > 0.5
    assert np.median(found.noise[smooth]) == pytest.approx(2 * 0.1 * 0.3**2, rel=0.1)


def test_etfe_of_whole_periods_is_exact_and_agrees_with_the_model():
    rng = np.random.default_rng(0)
    period = rng.normal(size=200)
    from scipy.signal import lfilter

    u = np.tile(period, 6)
    y = lfilter(B, F, u)
    one = Trajectory(np.arange(200) * 0.1, u[-200:, None], y[-200:, None], SPEC)
    found = etfe([one], smoothing=0)
    model = Arx(order=2, offset=False).fit([Trajectory(np.arange(1200) * 0.1, u[:, None], y[:, None], SPEC)], rng=RNG)
    assert found.response == pytest.approx(model.frequency_response(found.frequency), rel=1e-6)
    assert np.all(np.isinf(found.deviation))


def test_two_inputs_are_told_apart_in_the_frequency_domain_and_twins_are_refused():
    rng = np.random.default_rng(1)
    spec = PlantSpec((Channel("u0"), Channel("u1")), (Channel("y"),), 0.1)
    u = rng.normal(size=(4000, 2))
    y = np.vstack([np.zeros((1, 1)), (u @ np.array([[1.0], [-3.0]]))[:-1]])
    data = Trajectory(np.arange(4000) * 0.1, u, y, spec)
    assert np.abs(welch([data], segment=64).response[2:-2, 0]) == pytest.approx(np.tile([1.0, 3.0], (29, 1)), abs=0.1)
    twin = Trajectory(data.t, np.repeat(u[:, :1], 2, axis=1), y, spec)
    with pytest.raises(FitError, match="excite no frequency"):
        welch([twin], segment=64)
