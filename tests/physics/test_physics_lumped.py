"""Lumped parameters: names, exactness on exact data, identifiability."""

from __future__ import annotations

import numpy as np
import pytest
import sympy as sp
from hypothesis import given
from hypothesis import strategies as st

from harness.errors import FitError, InputError
from harness.physics import Mechanism, lumped, models
from harness.physics.lumps.identifiability import identifiability


def test_names_and_numbers_of_lumped_parameters():
    assert lumped(models.pendulum()).k == 3
    assert lumped(models.cart_pole(), known={"bx": 0, "btheta": 0}).names == ("mc + mp", "l**2*mp", "l*mp")
    assert lumped(models.double_pendulum(), known={"b1": 0, "b2": 0}).names == (
        "I1 + l1**2*m2 + lc1**2*m1",
        "I2 + lc2**2*m2",
        "l1*m2 + lc1*m1",
        "lc2*m2",
        "l1*lc2*m2",
    )
    assert lumped(models.acrobot()).k == 7


def test_offsets_of_the_joints_make_eight():
    m = Mechanism("double pendulum", q="a b", u="u1 u2", p="m1 m2 l1 l2 o1 o2")
    (a, b), (m1, m2, l1, l2, o1, o2) = m.q, m.p
    elbow = (l1 * sp.sin(a + o1), -l1 * sp.cos(a + o1))
    m.body(m1, elbow)
    m.body(m2, (elbow[0] + l2 * sp.sin(a + b + o1 + o2), elbow[1] - l2 * sp.cos(a + b + o1 + o2)))
    m.Q = list(m.u)
    model = lumped(m)
    assert model.k == 8
    p = {"m1": 1.1, "m2": 0.7, "l1": 0.5, "l2": 0.8, "o1": 0.05, "o2": -0.03}
    assert exact_miss(m, p) < 1e-10


def exact_miss(mechanism, p):
    """Return the relative error of the lumped parameters from exact accelerations."""
    model = lumped(mechanism)
    system = mechanism.system()
    n, nu = len(mechanism.q), len(mechanism.u)
    rng = np.random.default_rng(1)
    q, v, u = rng.normal(size=(80, n)), rng.normal(size=(80, n)), rng.normal(size=(80, nu))
    vector = [p[name] for name in system.parameter_names]
    simulator = system.simulator(0.01, substeps=1)
    a = np.array([simulator.derivative([*qk, *vk], uk, vector)[n:] for qk, vk, uk in zip(q, v, u, strict=True)])
    rows, target = model.torque_rows(np.zeros(80), q, v, a, u)
    fit = model.solve(rows, target)
    truth = model.values(p)
    return np.abs(np.array(list(fit.values.values())) - truth).max() / np.abs(truth).max()


@pytest.mark.parametrize("name", ["pendulum", "cart-pole", "double-pendulum", "acrobot", "drive", "oscillator"])
def test_exact_data_give_exact_parameters(name):
    mechanism = models.BUILT_IN[name]()
    p = {one.name: 1.3 * (one.value or 0.4) for one in mechanism.parameter_list()}
    assert exact_miss(mechanism, p) < 1e-10


@given(seed=st.integers(0, 10**6))
def test_all_three_forms_agree_with_a_simulation(seed):
    rng = np.random.default_rng(seed)
    mechanism = models.cart_pole()
    model, system = lumped(mechanism), mechanism.system()
    p = system.vector() * np.exp(0.3 * rng.normal(size=5))
    dt = 0.001
    u = np.repeat(rng.normal(size=(100, 1)) * 4, 20, axis=0)
    x = system.simulator(dt, substeps=1).states(p, rng.normal(size=4) * 0.5, u)
    q, v, t = x[:, :2], x[:, 2:], np.arange(len(u)) * dt
    truth = model.values(dict(zip(system.parameter_names, p, strict=True)))
    for rows, target in (
        model.energy_rows(t, q, v, u, samples=50),
        model.momentum_rows(t, q, v, u, samples=1),
        model.momentum_rows(t, q, v, u, samples=201),
    ):
        size = np.abs(rows * truth).max()
        assert np.abs(rows @ truth - target).max() < 2e-4 * size


def test_lumped_values_go_back_to_parameters():
    model = lumped(models.cart_pole())
    p = {"mc": 3.0, "mp": 0.4, "l": 0.7, "bx": 0.2, "btheta": 0.03}
    back = model.to_parameters(dict(zip(model.names, model.values(p), strict=True)))
    assert back == pytest.approx(p, rel=1e-6)
    arm = lumped(models.double_pendulum())
    q = {"m1": 1.0, "m2": 1.0, "l1": 1.0, "lc1": 0.4, "lc2": 0.7, "I1": 0.2, "I2": 0.4, "b1": 0.1, "b2": 0.2}
    back = arm.to_parameters(dict(zip(arm.names, arm.values(q), strict=True)))
    assert back == pytest.approx(q, rel=1e-5)  # masses and lengths that are declared fixed stay


def test_force_columns_are_fitted_beside_the_mechanism():
    mechanism = models.pendulum()
    system = mechanism.system()
    dry = system.rebuild(forces={"theta": -0.2 * np.tanh(1.0) * system.x[1] ** 3})
    model = lumped(mechanism).with_force_columns(["c3"], lambda q, v, u, t: -(v**3)[:, :, None])
    rng = np.random.default_rng(2)
    q, v, u = rng.normal(size=(60, 1)), rng.normal(size=(60, 1)), rng.normal(size=(60, 1))
    simulator = dry.simulator(0.01, substeps=1)
    a = np.array([simulator.derivative([*s, *w], z, [0.1, 0.05, 1.0])[1:] for s, w, z in zip(q, v, u, strict=True)])
    fit = model.solve(*model.torque_rows(np.zeros(60), q, v, a, u))
    assert fit.values["c3"] == pytest.approx(0.2 * np.tanh(1.0), rel=1e-9)
    assert fit.values["J"] == pytest.approx(0.1, rel=1e-9)
    bad = lumped(mechanism).with_force_columns(["c"], lambda q, v, u, t: v)
    with pytest.raises(InputError, match="force columns"):
        bad.regressor(q, v, a, u)


@given(seed=st.integers(0, 10**6), rank=st.integers(1, 6), extra=st.integers(0, 3))
def test_identifiability_finds_rank_and_combinations(seed, rank, extra):
    rng = np.random.default_rng(seed)
    independent = rng.normal(size=(60, rank))
    mixing = np.hstack([np.eye(rank), rng.normal(size=(rank, extra))])
    rows = independent @ mixing[:, rng.permutation(rank + extra)] * np.exp(3 * rng.normal(size=rank + extra))
    names = [f"p{k}" for k in range(rank + extra)]
    found = identifiability(rows, names)
    assert found.rank == rank
    assert found.gap > 1e6
    kept = rows[:, list(found.kept)]
    # What was dropped lies in the span of what was kept.
    rest = rows - kept @ np.linalg.lstsq(kept, rows, rcond=None)[0]
    assert np.abs(rest).max() < 1e-8 * np.abs(rows).max()


def test_what_cannot_be_solved_is_refused():
    model = lumped(models.pendulum())
    with pytest.raises(FitError):
        model.solve(np.zeros((9, 3)), np.zeros(9))
    with pytest.raises(FitError):
        model.solve(np.full((9, 3), np.nan), np.zeros(9))
    with pytest.raises(InputError, match="mass"):
        lumped(models.pendulum(), known={"mass": 1.0})
    with pytest.raises(InputError, match="mgl"):
        model.values({"J": 1.0, "b": 1.0})
    hidden = Mechanism("pipe", q="x", p="k")
    hidden.T = hidden.v[0] ** 2 / 2
    hidden.V = sp.exp(hidden.p[0] * hidden.q[0])
    with pytest.raises(InputError, match="k"):
        lumped(hidden)
