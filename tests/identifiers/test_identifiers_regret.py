"""Online identifiers with a regret bound: what their theorems say, measured on the streams they say it of."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harness import api
from harness.errors import FitError, InputError
from harness.registry import create
from harness.rng import Streams
from harness.rollout import run
from harness.scoring.regret import regret
from harness.signals import Channel, PlantSpec, Trajectory
from identifiers.online.gradient_descent import GradientDescent, acquiescent
from identifiers.online.leader import FollowTheLeader
from identifiers.online.recursive_polynomial import RecursivePolynomial
from identifiers.online.rls import RecursiveLeastSquares
from identifiers.online.spectral_filtering import SpectralFiltering, wave_filters

SPEC = PlantSpec((Channel("u", "V"),), (Channel("y", "m"),), 1.0)


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def stream(poles: list[float], samples: int, noise: float, seed: int = 0) -> Trajectory:
    """Return a record of a system with these poles, all with gain 1, under white noise."""
    draw, h, y = rng(seed), np.zeros(len(poles)), np.zeros((samples, 1))
    u = draw.normal(size=(samples, 1))
    for k in range(samples - 1):
        h = np.array(poles) * h + u[k]
        y[k + 1] = h.sum() + noise * draw.normal()
    return Trajectory(np.arange(samples, dtype=float), u, y, SPEC)


def test_the_spectrum_falls_as_the_paper_says():
    """Lemma E.2: sigma_j < 235200 c^-(2 j / ln T), c = e^(pi^2 / 4)."""
    for window in (100, 500):
        values, filters = wave_filters(window, 20)
        bound = 235200.0 * np.exp(-(np.pi**2 / 4) * 2 * np.arange(1, 21) / np.log(window))
        assert (values <= bound).all()
        assert filters @ filters.T == pytest.approx(np.eye(20), abs=1e-9)


@settings(max_examples=25, deadline=None)
@given(st.floats(0.0, 1.0))
def test_a_few_filters_hold_every_slow_response(pole):
    _, filters = wave_filters(200, 15)
    response = (pole - 1.0) * pole ** np.arange(200.0)
    assert np.linalg.norm(response - filters.T @ (filters @ response)) < 1e-3


@pytest.mark.parametrize("by", ["newton", "gradient"])
def test_spectral_filtering_learns_a_slow_system_that_gradient_descent_cannot(by):
    data = stream([0.999, 0.5], 1500, 0.3)
    online = SpectralFiltering(update_by=by)
    early, late = (regret(online, [data[:n]], rng=rng(), points=0, scaled=False).average for n in (400, 1500))
    assert late < early
    descent = regret(GradientDescent(), [data], rng=rng(), points=0, scaled=False).total
    assert regret(online, [data], rng=rng(), points=0, scaled=False).total < 0.1 * descent


def test_newton_steps_end_as_near_to_the_batch_minimiser_as_its_prior_lets_them():
    data, online = stream([0.9, 0.3], 1200, 0.2), SpectralFiltering(filters=8, window=60)
    found = regret(online, [data], rng=rng(), points=0, scaled=False)
    best = float(found.losses.sum() - found.total)
    assert found.exact
    assert found.losses[800:].mean() < 1.3 * best / len(found.losses)


def test_more_order_than_the_system_has_helps_gradient_descent():
    """Theorem 5.1: poles outside the cone for their own order are learned by a longer denominator."""
    data = stream([0.8, 0.5], 3000, 0.1)
    two, six = (regret(GradientDescent(order=n), [data], rng=rng(), points=0).losses[2000:].mean() for n in (2, 6))
    assert six < two


@settings(max_examples=50, deadline=None)
@given(st.lists(st.floats(-3, 3), min_size=1, max_size=6))
def test_the_denominator_stays_stable_whatever_the_step(a):
    held = acquiescent(np.array(a))
    assert np.abs(np.roots(np.concatenate([[1.0], held]))).max() < 1.0
    assert acquiescent(held) == pytest.approx(held, abs=1e-12)
    middle = acquiescent(0.5 * held)
    assert middle == pytest.approx(0.5 * held, abs=1e-12), "convex, and 0 is in it"


def test_they_say_what_they_need():
    data = stream([0.5], 15, 0.1)
    with pytest.raises(FitError, match="nothing predicted"):
        SpectralFiltering().hindsight([data])
    with pytest.raises(InputError, match=r"filters: option of .*<= 5"):
        SpectralFiltering(filters=10, window=5).init(SPEC, rng=rng())
    with pytest.raises(FitError, match="options"):
        GradientDescent(block=2).init(SPEC, rng=rng())


@pytest.mark.parametrize(
    ("online", "law", "samples"),
    [
        (RecursiveLeastSquares(order=1), "log", 3000),
        (RecursiveLeastSquares(order=1, forgetting=0.97), "linear", 3000),
        (RecursivePolynomial(structure="arx", order=1), "log", 1000),
        (RecursivePolynomial(structure="arx", order=1, forgetting=0.97), "linear", 1000),
        pytest.param(FollowTheLeader("arx", {"order": 1}), "log", 1000, marks=pytest.mark.slow),
    ],
    ids=str,
)
def test_least_squares_pays_what_theory_says(online, law, samples):
    """d n sigma^2 ln T, and the misadjustment of forgetting, within the scatter of a median of five streams."""
    rises = []
    for seed in range(5):
        draw, y = rng(seed), np.zeros((samples, 1))
        u = draw.normal(size=(samples, 1))
        for k in range(samples - 1):
            y[k + 1] = 0.7 * y[k] + u[k] + 0.1 * draw.normal()
        found = regret(online, [Trajectory(np.arange(float(samples)), u, y, SPEC)], rng=rng(), points=16)
        assert found.growth.law == law
        rises.append(found.over_theory)
        late = found.steps > 60
        assert np.abs(found.theory - found.curve)[late].max() < 0.5 * np.ptp(found.curve[late]) + 0.02
    assert 0.7 < np.median(rises) < 1.5


def test_where_theory_gives_a_shape_alone_none_is_held_against_it():
    found = regret(SpectralFiltering(update_by="gradient"), [stream([0.9], 600, 0.3)], rng=rng(), points=12)
    assert (found.growth.law, found.growth.factor, found.over_theory) == ("root", None, None)
    assert np.isfinite(found.theory).all()
    pendulum = create("plants", "pendulum-ode", sample_time=0.05)
    push = create("scenarios", "multisine", duration=10.0, amplitude=0.5, noise=0.001)
    swing = run(pendulum, push, streams=Streams("p", "s", 0), role="estimation/0").measured()
    filtered = regret(create("identifiers", "ekf", model="pendulum"), [swing], rng=rng(), points=4)
    assert filtered.growth is None
    assert np.isnan(filtered.theory).all()


def test_the_command_says_and_draws_regret_beside_theory(tmp_path):
    data = tmp_path / "stream.csv"
    one = stream([0.7], 900, 0.1)
    np.savetxt(data, np.column_stack([one.t, one.u, one.y]), delimiter=",", header="t [s],u [V],y [m]", comments="")
    found = api.analyse("regret", data, input=["u"], output=["y"])
    assert found.rows[-1]["samples"] == 599, "two thirds of a file are its estimation record"
    assert "times as fast as theory says, as ln n" in found.words[1]
    (axis,) = found.plot().axes
    assert [line.get_label() for line in axis.lines][1] == "theory: ln n"
    with pytest.raises(InputError, match="follow-the-leader"):
        api.analyse("regret", data, input=["u"], output=["y"], options={"identifier": "arx"})
