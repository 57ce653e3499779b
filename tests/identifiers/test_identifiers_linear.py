"""Linear identifiers: exact on exact data, honest about data that do not determine a model."""

from __future__ import annotations

import numpy as np
import pytest

from harness.errors import FitError, InputError
from harness.scoring import equation_error, predict, simulation_error
from harness.signals import Channel, FloatArray, PlantSpec, Trajectory
from identifiers.common.regression import solve
from identifiers.linear.least_squares import Arx, LinearModel, StateLeastSquares

A = np.array([[0.9, 0.2], [-0.1, 0.8]])
B = np.array([[0.0], [1.0]])
RNG = np.random.default_rng(0)
STATES = PlantSpec((Channel("u", "N"),), (Channel("q", "m"), Channel("v", "m/s")), 0.1)
ONE = PlantSpec((Channel("u", "N"),), (Channel("q", "m"),), 0.1)


def run(
    n: int = 200,
    seed: int = 0,
    *,
    noise: float = 0.0,
    process: float = 0.0,
    spec: PlantSpec = STATES,
    a: FloatArray = A,
    offset: FloatArray | float = 0.0,
    gain: FloatArray | None = None,
) -> Trajectory:
    """Return a record of x+ = A x + B u + offset; the input is white, or gain @ x."""
    rng = np.random.default_rng(seed)
    u, x = rng.normal(size=(n, 1)), np.zeros((n, 2))
    x[0] = rng.normal(size=2)
    for k in range(n):
        if gain is not None:
            u[k] = gain @ x[k]
        if k + 1 < n:
            x[k + 1] = a @ x[k] + B @ u[k] + offset + process * rng.normal(size=2)
    y = x + noise * x.std(axis=0) * rng.normal(size=x.shape)
    return Trajectory(np.arange(n) * 0.1, u, y[:, : spec.ny], spec)


def test_least_squares_is_exact_on_exact_states():
    model = StateLeastSquares(offset=True).fit([run(offset=0.3)], rng=RNG)
    assert model.a_matrix == pytest.approx(A, abs=1e-12)
    assert model.b_matrix == pytest.approx(B, abs=1e-12)
    assert model.state_offset == pytest.approx([0.3, 0.3], abs=1e-12)
    assert simulation_error(model, run(seed=1, offset=0.3)).rms.max() < 1e-12


def test_several_short_records_are_as_good_as_one_long():
    model = StateLeastSquares().fit([run(4, seed) for seed in range(5)], rng=RNG)
    assert model.a_matrix == pytest.approx(A, abs=1e-10)


def test_a_seam_between_two_records_is_not_an_equation():
    one, two = run(30, 1), run(30, 2)
    joined = Trajectory(np.arange(60) * 0.1, np.vstack([one.u, two.u]), np.vstack([one.y, two.y]), STATES)
    apart, across = (StateLeastSquares(least_excitation=0.0).fit(data, rng=RNG) for data in ([one, two], [joined]))
    assert apart.a_matrix == pytest.approx(A, abs=1e-11)
    assert np.abs(across.a_matrix - A).max() > 1e-2, "the test would see a crossed seam"


@pytest.mark.parametrize("noise", [0.0, 1e-8, 1e-6, 1e-4])
def test_pure_state_feedback_is_refused_however_clean_the_sensor(noise):
    gain = np.array([[-0.3, -0.5]])
    rng = np.random.default_rng(5)
    records = [run(60, seed, gain=gain) for seed in range(5)]
    noisy = [Trajectory(o.t, o.u, o.y + noise * rng.normal(size=o.y.shape), STATES) for o in records]
    with pytest.raises(FitError, match=r"do not determine the model.*u = -0\.[45]\d* v - 0\.[23]\d* q"):
        StateLeastSquares().fit(noisy, rng=RNG)


@pytest.mark.parametrize("kind", ["process", "sensor"])
def test_ordinary_noise_is_no_reason_to_refuse(kind):
    data = run(2000, process=0.1) if kind == "process" else run(2000, noise=0.05)
    model = StateLeastSquares().fit([data], rng=RNG)
    assert model.a_matrix == pytest.approx(A, abs=0.1)


@pytest.mark.parametrize("make", [StateLeastSquares, Arx, lambda: Arx(order=3)])
@pytest.mark.parametrize(
    ("n", "words"), [(1, "too short|fewer equations"), (3, "too short|fewer equations|do not determine")]
)
def test_short_records_are_refused_in_words(make, n, words):
    with pytest.raises(FitError, match=words):
        make().fit([run(n)], rng=RNG)


@pytest.mark.parametrize("make", [StateLeastSquares, Arx])
def test_outputs_that_never_move_are_refused(make):
    still = Trajectory(np.arange(50) * 0.1, RNG.normal(size=(50, 1)), np.ones((50, 2)), STATES)
    with pytest.raises(FitError, match="never move"):
        make().fit([still], rng=RNG)


def test_an_input_that_never_moves_is_refused_by_name():
    data = run(50)
    with pytest.raises(FitError, match="constant u"):
        StateLeastSquares().fit([Trajectory(data.t, np.ones((50, 1)), data.y, STATES)], rng=RNG)


def test_records_of_two_plants_are_refused():
    with pytest.raises(FitError, match="another language"):
        StateLeastSquares().fit([run(), run(spec=ONE)], rng=RNG)


def test_arx_is_exact_from_one_output_of_two_states():
    model = Arx(order=2).fit([run(spec=ONE)], rng=RNG)
    found = np.sort_complex(model.eigenvalues)[-2:]
    assert found == pytest.approx(np.sort_complex(np.linalg.eigvals(A))[-2:], abs=1e-10)
    held_out = run(seed=9, spec=ONE)
    assert equation_error(model, held_out).rms[0] < 1e-11
    assert simulation_error(model, held_out).rms[0] < 1e-9


def test_arx_state_space_equals_its_difference_equation():
    data = run(300, noise=0.02, spec=ONE)
    model = Arx(order=3).fit([data], rng=RNG)
    held = run(80, 4, spec=ONE)
    rows = [np.r_[held.y[k : k - 3 : -1, 0] if k > 2 else held.y[2::-1, 0], 0] for k in range(2, 79)]
    phi = np.array([[*r[:3], held.u[k, 0], held.u[k - 1, 0], held.u[k - 2, 0], 1.0] for k, r in enumerate(rows, 2)])
    fit = np.array([[*data.y[k : k - 3 : -1, 0], *data.u[k : k - 3 : -1, 0], 1.0] for k in range(3, 299)])
    theta = np.linalg.lstsq(fit, data.y[4:, 0], rcond=None)[0]
    # rows k >= 3 only: the first ones depend on the state before the record
    mine = predict(model, held, 1)[4:, 0]
    assert mine == pytest.approx((phi @ theta)[1:], abs=2e-2)
    assert np.abs(mine[5:] - (phi @ theta)[6:]).max() < 2e-2


def test_arx_order_ladder_stops_at_the_true_order():
    rng = np.random.default_rng(3)
    y, u = np.zeros(3000), rng.normal(size=3000)
    for k in range(4, 3000):
        y[k] = 1.2 * y[k - 1] - 0.8 * y[k - 2] + 0.3 * y[k - 3] - 0.3 * y[k - 4] + u[k - 1] + 0.05 * rng.normal()
    data = Trajectory(np.arange(3000) * 0.1, u[:, None], y[:, None], ONE)
    model = Arx().fit([data], rng=RNG)
    assert model.notes["order"] == 4
    errors = [Arx(order=n).fit([data], rng=RNG).notes["residual_rms"][0] for n in (1, 2, 3, 4, 6)]
    assert errors[0] > errors[1] > errors[2] > 1.02 * errors[3]
    assert errors[3] == pytest.approx(0.05, rel=0.05)
    assert errors[4] > 0.97 * errors[3], "more order buys nothing"


def test_a_ridge_answers_where_the_records_do_not_excite_all_lags():
    t = np.arange(200) * 0.1
    wave = Trajectory(t, np.sin(t)[:, None], np.sin(t - 0.4)[:, None], ONE)
    with pytest.raises(FitError, match="do not determine"):
        Arx(order=6).fit([wave], rng=RNG)
    model = Arx(order=6, ridge=1e-8).fit([wave], rng=RNG)
    assert equation_error(model, wave).rms[0] < 1e-2


def test_the_initial_state_is_that_of_the_free_run():
    model = StateLeastSquares().fit([run()], rng=RNG)
    held = run(seed=3)
    assert model.initial_state(held) == pytest.approx(held.y[0], abs=1e-9)
    unstable = LinearModel(STATES, 2.0 * np.eye(2), B, np.eye(2), np.zeros((2, 1)), np.eye(2), np.zeros(2), np.zeros(2))
    x0 = np.array([0.1, -0.2])
    u = np.zeros((200, 1))
    y = unstable.free_run(x0[None], u[None])[0]
    data = Trajectory(np.arange(200) * 0.1, u, y, STATES)
    assert unstable.initial_state(data) == pytest.approx(x0, rel=1e-6)


def test_matrices_of_two_sizes_are_refused_by_name():
    with pytest.raises(InputError, match="b_matrix"):
        LinearModel(STATES, A, np.zeros((3, 1)), np.eye(2), np.zeros((2, 1)), np.eye(2), np.zeros(2), np.zeros(2))


def test_other_channels_are_refused_by_the_model():
    model = StateLeastSquares().fit([run()], rng=RNG)
    with pytest.raises(InputError, match="outputs of the data"):
        model.initial_state(run(spec=ONE))


# ---- the regression behind them -------------------------------------------------------------------------------------


def blocks_of(phi: FloatArray, y: FloatArray, size: int = 37):
    return lambda: [(phi[k : k + size], y[k : k + size]) for k in range(0, len(phi), size)]


def test_blocks_make_no_difference_and_the_answer_is_that_of_lstsq():
    phi, y = RNG.normal(size=(500, 6)), RNG.normal(size=(500, 2))
    found = solve(blocks_of(phi, y), "test")
    expected, residues, _, _ = np.linalg.lstsq(phi, y, rcond=None)
    assert found.coefficients == pytest.approx(expected, abs=1e-12)
    assert found.residual_rms == pytest.approx(np.sqrt(residues / 500))
    assert (found.rows, found.method) == (500, "normal equations")


@pytest.mark.parametrize(("gap", "tolerance"), [(1e-6, 1e-8), (1e-8, 1e-6), (1e-9, 1e-5)])
def test_nearly_dependent_columns_fall_back_to_qr(gap, tolerance):
    phi = RNG.normal(size=(400, 4))
    phi[:, 3] = phi[:, 0] + gap * phi[:, 3]
    truth = np.array([[1.0], [2.0], [3.0], [-1.0]])
    found = solve(blocks_of(phi, phi @ truth), "test")
    assert found.method.startswith("QR")
    assert found.coefficients == pytest.approx(truth, abs=tolerance)


def test_dependent_columns_are_refused_and_ridge_answers():
    phi = RNG.normal(size=(400, 3))
    phi[:, 2] = phi[:, 0] - phi[:, 1]
    with pytest.raises(FitError, match="rank 2"):
        solve(blocks_of(phi, phi[:, :1]), "test")
    found = solve(blocks_of(phi, phi[:, :1]), "test", ridge=1e-9)
    assert phi @ found.coefficients == pytest.approx(phi[:, :1], abs=1e-6)


def test_the_residual_of_a_perfect_fit_is_read_off_the_data():
    phi = RNG.normal(size=(300, 3))
    found = solve(blocks_of(phi, 1e6 * phi[:, :1]), "test")
    assert found.residual_rms[0] < 1e-8


@pytest.mark.parametrize("name", ["least-squares", "dmdc"])
def test_a_constant_that_is_missed_is_said_and_none_where_there_is_none(name):
    from scipy.signal import lfilter

    from harness.registry import create

    rng = np.random.default_rng(0)
    spec, u = PlantSpec((Channel("u"),), (Channel("y"),), 1.0), rng.normal(size=(1500, 1))
    y = lfilter([0.0, 1.0], [1.0, -0.8], u[:, 0] + 0.05 * rng.normal(size=1500))[:, None]
    for level, missed in ((0.0, False), (100.0, True)):
        data = Trajectory(np.arange(1500.0), u, y + level, spec)
        plain, whole = (create("identifiers", name, offset=offset).fit([data], rng=rng) for offset in (False, True))
        assert ("offset = true" in plain.notes.get("warning", "")) == missed
        assert "warning" not in whole.notes
        assert whole.a_matrix[0, 0] == pytest.approx(0.8, abs=0.01)
