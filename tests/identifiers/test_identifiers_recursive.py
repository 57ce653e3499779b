"""Recursive ARX, ARMAX and output error: convergence, bands, forgetting, the guard, regret, and their picture."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import lfilter

from harness import api
from harness.errors import InputError
from harness.scoring import regret
from harness.signals import Channel, Dataset, PlantSpec, Run, Trajectory
from identifiers.online.parameter_trajectory import ParameterTrajectory, recursion_along
from identifiers.online.recursive_polynomial import PRIOR, RecursivePolynomial

RNG = np.random.default_rng(0)
SPEC = PlantSpec((Channel("u", "V"),), (Channel("y", "m"),), 0.1)
A, C = [1.0, -1.5, 0.7], [1.0, -0.6, 0.3]
TRUE = {"arx": [*A[1:], 1.0, 0.5], "armax": [*A[1:], 1.0, 0.5, *C[1:]], "oe": [*A[1:], 1.0, 0.5]}


def record(kind: str, seed: int, n: int = 1200, sizes: tuple[float, float] = (1.0, 1.0)) -> Trajectory:
    rng = np.random.default_rng(seed)
    u, e = rng.normal(size=n), 0.5 * rng.normal(size=n)
    y = lfilter([0.0, 1.0, 0.5], A, u)
    y = y + {"arx": lfilter([1.0], A, e), "armax": lfilter(C, A, e), "oe": e}[kind]
    return Trajectory(np.arange(n) * 0.1, sizes[0] * u[:, None], sizes[1] * (y[:, None] + 5.0), SPEC)


def learned(online: RecursivePolynomial, data: Trajectory):
    state = online.start(online.init(data.spec, rng=RNG), data.y[0])
    for k in range(len(data) - 1):
        state = online.update(state, data.u[k], data.y[k + 1])
    return state


@pytest.mark.parametrize("forgetting", [1.0, 0.99])
@pytest.mark.parametrize("kind", ["arx", "armax", "oe"])
def test_each_finds_its_own_system_and_says_how_well(kind, forgetting):
    wrong = []
    for seed in range(8):
        values, spread = learned(RecursivePolynomial(kind, forgetting=forgetting), record(kind, seed)).coefficients
        wrong.append((values - TRUE[kind]) / spread)
        if forgetting == 1.0:
            assert values == pytest.approx(TRUE[kind], abs=0.12)
    assert 0.5 < np.sqrt(np.mean(np.square(wrong))) < 1.35
    assert np.mean(np.abs(wrong) < 1.96) > 0.88


@settings(max_examples=5, deadline=None)
@given(seed=st.integers(0, 999), u=st.sampled_from([1e-4, 1.0, 1e3]), y=st.sampled_from([1e-3, 1.0, 1e5]))
def test_no_unit_decides(seed, u, y):
    online = RecursivePolynomial("armax", order=1)
    plain, other = (
        learned(online, record("armax", seed, 120, sizes)).coefficients[0] for sizes in ((1.0, 1.0), (u, y))
    )
    assert other * [1.0, u / y, 1.0] == pytest.approx(plain, rel=1e-6, abs=1e-9)


@settings(max_examples=5, deadline=None)
@given(seed=st.integers(0, 999), forgetting=st.sampled_from([1.0, 0.97]))
def test_recursive_arx_is_weighted_least_squares(seed, forgetting):
    data = record("arx", seed, 150)
    found = learned(RecursivePolynomial("arx", order=2, forgetting=forgetting), data)
    u, y = ((part - c) / s for part, c, s in zip((data.u, data.y), found.centre, found.size, strict=True))
    k = np.arange(2, 150)
    rows = np.column_stack([-y[k - 1], -y[k - 2], u[k - 1], u[k - 2], np.ones(k.size)])
    weights = np.sqrt(forgetting ** (149.0 - k))
    # the guard keeps the prior while nothing is known: by a few samples more or less, which its weight hardly shows
    prior = np.eye(5) * np.sqrt(forgetting ** (k.size - 1.0) / PRIOR)
    wanted = np.linalg.lstsq(
        np.vstack([rows * weights[:, None], prior]), np.r_[y[k, 0] * weights, np.zeros(5)], rcond=None
    )[0]
    assert found.filters[0].theta == pytest.approx(wanted, rel=1e-4, abs=1e-5)


def test_the_guard_holds_the_covariance_where_nothing_excites():
    data = record("arx", 1, 2400)
    u = data.u.copy()
    u[600:2200] = 0.0
    rng = np.random.default_rng(2)
    y = lfilter([0.0, 1.0, 0.5], A, u[:, 0]) + lfilter([1.0], A, 1e-6 * rng.normal(size=2400))
    still = replace(data, u=u, y=y[:, None])
    found = recursion_along(RecursivePolynomial("arx", forgetting=0.95), [still])
    assert found.trace.max() <= 1.0 / 0.95
    assert found.guarded[1500:2100].any()
    assert not found.guarded[100:590].any()
    assert np.isfinite(found.values[30:]).all()
    assert found.values[-1] == pytest.approx(TRUE["arx"], abs=1e-3)


def test_what_changes_is_followed_and_drawn(tmp_path):
    first, second = record("armax", 3, 800), record("armax", 4, 800)
    data = Dataset("changed", (Run(first), Run(replace(second, y=2 * second.y))))
    found = ParameterTrajectory(forgetting=0.98).of(data, rng=RNG)
    moved = {row["coefficient"]: row for row in found.rows}
    assert moved["y: b1 of u"]["last"] == pytest.approx(2.0, abs=0.35)
    assert moved["y: b1 of u"]["moved"]
    assert not moved["y: a1"]["moved"]
    figure = found.plot()
    assert len(figure.axes) == len(found.rows) + 1
    assert found.details["values"].shape == (2 * 799, 6)


def test_the_analysis_on_the_command_line(tmp_path):
    data = record("oe", 5, 300)
    table = np.column_stack([data.t, data.u, data.y])
    np.savetxt(tmp_path / "run.csv", table, delimiter=",", header="time [s],u [V],y [m]", comments="", fmt="%.17g")
    found = api.analyse(
        "parameter-trajectory",
        tmp_path / "run.csv",
        options={"structure": "oe", "forgetting": 1.0},
        out=tmp_path / "way.svg",
        input="u",
        output="y",
    )
    assert [row["coefficient"] for row in found.rows] == ["y: f1", "y: f2", "y: b1 of u", "y: b2 of u"]
    assert (tmp_path / "way.svg").read_text().startswith("<?xml")


@pytest.mark.parametrize("kind", ["arx", "armax", "oe"])
def test_regret_grows_slowly(kind):
    found = regret(RecursivePolynomial(kind), [record(kind, 7)], rng=RNG, points=0)
    variance = float(found.hindsight.mean())
    assert found.total < 60 * variance * len(TRUE[kind]) * np.log(1200)
    assert found.cumulative[-1] - found.cumulative[600] < 0.1 * 600 * variance


@pytest.mark.parametrize(
    "options", [{"forgetting": 0.0}, {"order": 0}, {"nk": 0}, {"structure": "bj"}, {"nf": 2}], ids=str
)
def test_options_that_make_no_sense_are_refused(options):
    with pytest.raises(InputError, match="recursive-polynomial"):
        RecursivePolynomial(**options).init(SPEC, rng=RNG)
