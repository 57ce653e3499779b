"""Transfer functions in continuous time: from frequency responses, from records, and what they are sampled."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import signal

from harness import api
from harness.command import main
from harness.errors import FitError, InputError
from harness.frequency import FrequencyResponse, read_response, write_response
from harness.models.estimate import estimate_of
from harness.models.spread import gain_and_phase_deviation, gains, quantile, response_covariance
from harness.parts.stored import read_model
from harness.scoring import simulation_error
from harness.signals import Channel, PlantSpec, Trajectory
from identifiers.linear.continuous.identifier import ContinuousTransferFunction
from identifiers.linear.continuous.model import TransferFunction
from identifiers.linear.continuous.rational import Rational, sampled

F = np.geomspace(0.02, 5.0, 50)
SPEC = PlantSpec((Channel("u", "V"),), (Channel("y", "mm"),), 0.1)
TRUE = Rational(np.array([0.3, 1.0]), np.array([[1.5]]), np.array([0.27]), 2.0)


def motor(f, late=0.13):
    s = 2j * np.pi * f
    return 3.0 / ((s**2 + 0.6 * s + 4) * (0.5 * s + 1)) * np.exp(-late * s)


def measured(seed, f=F):
    rng, g = np.random.default_rng(seed), motor(f)
    deviation = 0.02 * np.abs(g) + 0.001
    noise = rng.normal(size=f.size) + 1j * rng.normal(size=f.size)
    return FrequencyResponse(f, g + deviation / np.sqrt(2) * noise, deviation**2)


def record(seed, samples=800, hold="zoh", model=TRUE, size=0.1):
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.choice([-1.0, 1.0], samples // 4), 4)
    u = u if hold == "zoh" else signal.lfilter([0.3], [1, -0.7], u)
    y = signal.dlsim((*sampled(model, 0.1, hold), 0.1), u)[1]
    return Trajectory(np.arange(samples) * 0.1, u[:, None], y + size * rng.normal(size=y.shape), SPEC)


@settings(max_examples=25, deadline=None)
@given(
    st.floats(0.05, 0.95), st.floats(0.3, 6.0), st.floats(0.0, 0.5), st.sampled_from(["zoh", "foh"]), st.integers(0, 99)
)
def test_sampling_is_exact_for_any_dead_time(damping, rate, late, hold, seed):
    model = Rational(np.array([2 * damping, 1.0]), np.array([[0.5, 1.0]]), np.array([late]), rate)
    fine, u = 400, np.concatenate([[0.0], np.random.default_rng(seed).normal(size=20)])
    late = round(late / 0.1 * fine) / fine * 0.1  # whole fine samples, so that the reference is exact as well
    model = Rational(model.a, model.b, np.array([late]), rate)
    t = np.arange(21 * fine) * 0.1 / fine
    times = np.arange(21) * 0.1
    moved = t - late + 0.05 / fine
    held = np.where(moved < 0, 0.0, u[np.clip((moved / 0.1).astype(int), 0, 20)])
    v = held if hold == "zoh" else np.interp(moved, times, u, left=0.0)
    parts = signal.cont2discrete(signal.tf2ss(model.numerators[0], model.denominator), 0.1 / fine)
    truth = signal.dlsim((*parts[:4], 0.1 / fine), v)[1][::fine, 0]
    found = signal.dlsim((*sampled(model, 0.1, hold), 0.1), u)[1][:, 0]
    assert np.abs(found - truth).max() < 2e-4 * max(np.abs(truth).max(), 1.0)


def test_a_frequency_response_gives_order_dead_time_and_intervals_that_hold():
    inside, misfits = [], []
    for seed in range(12):
        found = ContinuousTransferFunction(order=3, zeros=0).fit_response(measured(seed))
        low, high = found.estimate.interval("y per u, dead time")
        static = found.estimate.interval("y per u, static")
        inside += [low < 0.13 < high, static[0] < 0.75 < static[1]]
        misfits += found.notes["misfit"]
    assert np.mean(inside) >= 0.8  # 24 of 95 %
    assert 0.8 < np.mean(misfits) < 1.25
    chosen = ContinuousTransferFunction(delay=0.13, zeros=0).fit_response(measured(0))
    assert chosen.rows[0].a.size == 3


def test_points_of_much_noise_count_less():
    data = measured(3)
    variance, response = data.variance.copy(), data.response.copy()
    variance[10:15] *= 1e4
    response[10:15] *= 3.0
    found = ContinuousTransferFunction(order=3, zeros=0, delay=0.13).fit_response(
        FrequencyResponse(F, response, variance)
    )
    assert abs(found.estimate.value("y per u, static") - 0.75) < 0.02


def test_a_file_of_decibels_is_that_of_complex_numbers(tmp_path):
    data, file = measured(1), tmp_path / "frf.csv"
    g = data.response.ravel()
    columns = np.c_[F, 20 * np.log10(np.abs(g)), np.degrees(np.angle(g)), np.sqrt(data.variance.ravel())]
    np.savetxt(file, columns, delimiter=",", header="frequency [Hz],magnitude [dB],phase [deg],deviation", comments="")
    again = read_response(write_response(read_response(file), tmp_path / "again.csv"))
    assert np.allclose(again.response, data.response, rtol=1e-9)
    assert np.allclose(again.variance, data.variance, rtol=1e-9)
    turns = np.c_[2 * np.pi * F, g.real, g.imag]
    np.savetxt(file, turns, delimiter=";", header="omega [rad/s];pos/force real;pos/force imag", comments="")
    other = read_response(file, units={"pos": "mm"})
    assert np.allclose(other.frequency, F)
    assert [str(c) for c in (*other.inputs, *other.outputs)] == ["force [1]", "pos [mm]"]
    assert other.variance is None


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("frequency [Hz],magnitude,phase\n1,2,3\n", "unit of the phase"),
        ("frequency [Hz],real,imag\n1,nan,2\n", "1 Hz"),
        ("frequency [Hz],real\n1,2\n", "real and imag"),
        ("frequency [Hz],real,imag\n1,x,2\n", "row 2"),
        ("frequency [Hz],real,imag\n1,1,2\n1,1,2\n", "1 Hz twice"),
        ("frequency [parsec],real,imag\n1,1,2\n", "unit of the frequency"),
        ("frequency [Hz],real,imag\n", "empty table"),
    ],
)
def test_files_that_are_wrong_are_refused_by_name(text, said, tmp_path):
    file = tmp_path / "bad.csv"
    file.write_text(text)
    with pytest.raises(InputError, match=said):
        read_response(file)


def test_the_command_fits_a_file_and_stores_a_model(tmp_path, sysid):
    write_response(measured(2), tmp_path / "frf.csv")
    arguments = ["identify", str(tmp_path / "frf.csv"), "--option", "order=3", "--option", "zeros=0"]
    text = sysid(*arguments, "-o", tmp_path / "tf.json").out
    assert "nothing but noise is left" in text
    assert "dead time" in text
    found = read_model(tmp_path / "tf.json")
    assert np.allclose(found.frequency_response(F)[:, 0, 0], motor(F), atol=0.02)
    with pytest.raises(SystemExit):
        main([*arguments, "--sample-time", "0.05", "-o", str(tmp_path / "sampled.json")])
    between = read_model(tmp_path / "sampled.json")
    assert between.spec.sample_time == 0.05
    assert between.spread is not None
    sysid(*arguments, "--identifier", "arx", status=2)


def test_records_give_a_model_in_seconds_and_its_dead_time():
    model = ContinuousTransferFunction(order=2, zeros=0).fit([record(0)], rng=np.random.default_rng(0))
    estimate = estimate_of(model)
    for name, truth in (("y: denominator s^1", 0.6), ("y per u, static", 1.5), ("y per u, dead time", 0.27)):
        low, high = estimate.interval(name)
        middle = 0.5 * (low + high)
        assert abs(middle - truth) < 1.5 * (high - middle)
        assert high - low < 0.2 * truth
    clean = record(50, size=0.0)
    assert simulation_error(model, clean).nrmse[0] < 0.05
    f = np.array([0.05, 0.3, 1.0])
    right = gains(sampled(TRUE, 0.1), f, 0.1)[:, 0, 0]
    found = gains(model.matrices, f, 0.1)[:, 0, 0]
    deviation, _ = gain_and_phase_deviation(found, response_covariance(model, f)[:, 0, 0])
    assert np.all(np.abs(np.abs(found) - np.abs(right)) < 2 * quantile(model.spread) * deviation)


def test_the_hold_that_is_declared_counts():
    data = record(1, hold="foh", size=0.01)
    right, wrong = (
        ContinuousTransferFunction(order=2, zeros=0, hold=hold).fit([data], rng=np.random.default_rng(0))
        for hold in ("foh", "zoh")
    )
    late = [estimate_of(model).value("y per u, dead time") for model in (right, wrong)]
    assert abs(late[0] - 0.27) < 0.01 < abs(late[1] - 0.27)  # half a sample


def test_a_spectrum_of_records_is_data_too():
    records = [record(seed, 3000) for seed in range(2)]
    found = api.identify_response(
        FrequencyResponse.of_spectrum(api.spectrum(records)).between(0.02, 2.0), options={"order": 2, "zeros": 0}
    )
    assert isinstance(found.model, TransferFunction)
    assert abs(found.model.estimate.value("y per u, static") - 1.5) < 0.15
    assert "TransferFunction" not in str(found.model)
    json.dumps(found.to_dict())


def test_control_takes_it_with_a_pade_approximation():
    model = ContinuousTransferFunction(order=3, zeros=0).fit_response(measured(0))
    other = model.to_control(pade=4)
    point = 2j * np.pi * 0.3
    assert abs(complex(other(point)) - model.frequency_response(np.array([0.3]))[0, 0, 0]) < 1e-3


def test_options_that_make_no_sense_are_refused():
    for options in ({"order": 0}, {"order": 2, "zeros": 2}, {"delay": -1.0}, {"hold": "half"}):
        with pytest.raises(FitError, match="options"):
            ContinuousTransferFunction(**options).fit([record(0)], rng=np.random.default_rng(0))
