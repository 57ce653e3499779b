"""Pure feedback is refused by every method and named; what a controller adds, noise or open loop are no reason to."""

from __future__ import annotations

import re

import numpy as np
import pytest

from harness.errors import FitError
from harness.judgement import feedback_of
from harness.registry import create
from harness.signals import Channel, PlantSpec, Trajectory

A = np.array([[0.9, 0.2], [-0.1, 0.8]])
B = np.array([[0.0], [1.0]])
GAIN = np.array([[-0.3, -0.5]])
STATES = PlantSpec((Channel("u", "N"),), (Channel("q", "m"), Channel("v", "m/s")), 0.1)
METHODS = [
    *(("least-squares", {"method": method}) for method in ("ls", "iv", "tls", "l1", "linf")),
    ("arx", {"order": 1}),
    ("dmdc", {}),
    ("dmdc", {"rank": 2}),
    ("edmdc", {"degree": 1}),
    ("stlsq", {"time": "discrete", "degree": 1}),
    ("stlsq", {"order": 1, "degree": 1}),
]


def record(n=120, seed=0, *, noise=0.0, process=0.0, dither=None, gain=GAIN, start=1.0):
    """Return a record under ``u = gain x + dither`` (dither of this size; None: none at all)."""
    rng = np.random.default_rng(seed)
    u, x = np.zeros((n, 1)), np.zeros((n, 2))
    x[0] = start * rng.normal(size=2)
    for k in range(n):
        u[k] = gain @ x[k] + (0.0 if dither is None else dither * rng.normal())
        if k + 1 < n:
            x[k + 1] = A @ x[k] + B @ u[k] + process * rng.normal(size=2)
    return Trajectory(np.arange(n) * 0.1, u, x + noise * rng.normal(size=x.shape), STATES)


@pytest.mark.parametrize("case", METHODS, ids=str)
@pytest.mark.parametrize("noise", [0.0, 1e-8, 1e-6, 1e-4, 1e-2])
def test_pure_feedback_is_refused_by_every_method_however_clean_the_sensor(case, noise):
    data = [record(60, seed, noise=noise) for seed in range(8)]
    with pytest.raises(FitError, match="do not determine the model") as caught:
        create("identifiers", case[0], **case[1]).fit(data, rng=np.random.default_rng(0))
    if noise in (0.0, 1e-6) and case[0] in ("least-squares", "arx"):
        law = re.search(r"u(?:\[k\])? = (-?[\d.]+) v(?:\[k\])? - ([\d.]+) q", str(caught.value))
        assert law is not None, str(caught.value)
        assert float(law[1]) == pytest.approx(-0.5, rel=0.02)
        assert float(law[2]) == pytest.approx(0.3, rel=0.02)


@pytest.mark.parametrize("case", METHODS, ids=str)
def test_what_the_controller_adds_beyond_the_noise_is_enough(case):
    data = [record(200, seed, noise=1e-4, dither=0.1) for seed in range(3)]
    model = create("identifiers", case[0], **case[1]).fit(data, rng=np.random.default_rng(0))
    if hasattr(model, "b_matrix") and case[0] != "edmdc" and "rank" not in case[1]:
        assert np.abs(model.a_matrix[:2, :2] - A).max() < 0.02
        assert np.abs(model.b_matrix[:2] - B).max() < 0.02


@pytest.mark.first_of_each("case", "loud")
@pytest.mark.parametrize("case", METHODS, ids=str)
@pytest.mark.parametrize("loud", [0.3, 3.0])
def test_open_loop_is_never_refused_whatever_the_noise(case, loud):
    """White input, process noise up to ten times its effect: least squares is consistent."""
    if case[0] == "stlsq" and case[1].get("order") == 1:
        pytest.skip("a derivative of such a noisy state is no data")
    data = record(4000, 3, dither=0.3, process=loud, gain=0 * GAIN)
    model = create("identifiers", case[0], **case[1]).fit([data], rng=np.random.default_rng(0))
    if case[0] == "least-squares" and case[1].get("method") != "tls":  # which takes all noise for the sensor's
        assert np.abs(model.a_matrix - A).max() < (0.1 if case[1].get("method") != "iv" else 0.2)


def test_states_of_which_one_is_noise_are_refused_with_the_dependence():
    rng = np.random.default_rng(0)
    data = record(400, 1, dither=1.0, gain=0 * GAIN)
    y = data.y[:, :1] * np.array([[1.0, 2.0]]) + 1e-4 * rng.normal(size=(400, 2))
    twice = Trajectory(data.t, data.u, y, STATES)
    with pytest.raises(FitError, match=r"rank 2 of 3: v = 2(\.0*)? q"):
        create("identifiers", "least-squares").fit([twice], rng=np.random.default_rng(0))


@pytest.mark.parametrize("case", [*METHODS, ("arx", {}), ("edmdc", {}), ("ho-kalman", {"markov": 10})], ids=str)
@pytest.mark.parametrize("level", [0.0, 2.5])
def test_an_input_that_never_moves_is_refused(case, level):
    data = record(100, 2, gain=0 * GAIN, process=0.1)
    still = Trajectory(data.t, np.full((100, 1), level), data.y, STATES)
    with pytest.raises(FitError, match=r"an input never moves.*constant u"):
        create("identifiers", case[0], **case[1]).fit([still], rng=np.random.default_rng(0))


def test_feedback_is_told_from_open_loop():
    wrong = sum(feedback_of([record(400, s, dither=1.0, process=0.3, gain=0 * GAIN)]).found for s in range(40))
    assert wrong <= 1  # 1 in 1000 each
    for seed in range(10):
        closed = feedback_of([record(400, seed, dither=0.3, process=0.3)])
        assert closed.found
        assert closed.share > 0.1


@pytest.mark.parametrize("case", [*(("arx", {"order": n}) for n in (None, 1, 2, 4)), ("n4sid", {})], ids=str)
@pytest.mark.parametrize("process", [0.001, 0.01, 0.1])
@pytest.mark.parametrize("noise", [0.0, 1e-8, 1e-6, 1e-5])
def test_a_plant_kept_moving_by_its_own_noise_hides_no_feedback(case, process, noise):
    for seed in range(6):
        data = [record(400, seed, noise=noise, process=process)]
        with pytest.raises(FitError, match="do not determine the model"):
            create("identifiers", case[0], **case[1]).fit(data, rng=np.random.default_rng(0))


@pytest.mark.parametrize("delay", [2, 3])
def test_feedback_is_named_whatever_delay_a_fit_assumes(delay):
    data = [record(400, 0, noise=1e-6, process=0.01)]
    with pytest.raises(FitError, match=r"u = -0\.5 v - 0\.3 q"):
        create("identifiers", "arx", order=4, delay=delay).fit(data, rng=np.random.default_rng(0))
