"""Columns for screens: regression on them gives back what was hidden."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from harness.effects import (
    Placed,
    Signals,
    builtin,
    column_blocks,
    compose,
    motion_sizes,
    place_all,
)
from harness.effects.along import along, residual_function
from harness.effects.claimed import ClaimedForce, claimable
from harness.errors import InputError
from harness.physics.models import cart_pole, pendulum, two_tanks

DT = 0.005
PENDULUM, CART = pendulum().system(), cart_pole().system()
NO_FORCE = {"backlash", "unilateral_backlash", "elastic_load", "elasticity", "hardening_elasticity"} | {
    f"sensor_{one}"
    for one in (
        "cyclic_error",
        "drift",
        "filter",
        "hum",
        "lag",
        "nonlinearity",
        "quantisation",
        "rectification",
        "saturation",
    )
}


def put(name, at, **values):
    return Placed(builtin()[name], at, values)


def motion(system, placed, n=3000):
    """Simulate with the effects hidden; return the exact motion and the residual of the nominal."""
    hidden = compose(system, placed)
    simulator = hidden.simulator(DT, backend="casadi", substeps=4)
    t = np.arange(n) * DT
    u = np.tile((1.5 * np.sin(2 * t) + 0.8 * np.sin(7.3 * t + 1))[:, None], (1, system.nu))
    x = np.zeros(hidden.nx)
    x[0] = 0.3
    p = hidden.vector()
    states = simulator.states(p, x, u, t0=0.0)
    slopes = np.array([simulator.derivative(states[k], u[k], p, t[k]) for k in range(n)])
    k = len(system.coordinates)
    signals = Signals(t, u, states[:, :k], states[:, k : 2 * k], slopes[:, k : 2 * k])
    nominal = system.simulator(DT, backend="casadi")
    v = np.hstack([signals.q, signals.v])
    import casadi as ca

    matrix = ca.Function("M", [system.x, system.p], [system.mass_matrix])
    model = np.array([nominal.derivative(v[i], u[i], system.vector(), t[i])[k:] for i in range(n)])
    force = np.array([matrix(v[i], system.vector()).full() @ (signals.a[i] - model[i]) for i in range(n)])
    return signals, force  # M (a - a_nominal): the force that the nominal lacks


@pytest.mark.parametrize(
    ("hidden", "size"),
    [
        (put("coulomb_friction", "theta", Fc=0.1, w=0.05), 0.1),
        (put("viscous_friction", "theta", b=0.02), 0.02),
        (put("quadratic_drag", "theta", c=0.01), 0.01),
        (put("cubic_spring", "theta", k3=0.2), 0.2),
        (put("force_bias", "theta", F0=0.07), 0.07),
        (put("eccentric_load", "theta", A=-0.1), -0.1),
        (put("input_gain", "u", gain=1.2), 0.2),
        (put("load_dependent_friction", "theta", mu=0.1, w=0.05), 0.1),
        (put("cogging", "theta", A=0.05, k=6.0, phi=0.5), 0.05),
        (put("dead_zone", "u", width=0.2), 1.0),
        (put("saturation", "u", limit=1.4), 1.0),
        (put("periodic_disturbance", "theta", A=0.1, omega=5.0, phi=0.2), 0.1),
    ],
    ids=lambda value: str(value),
)
def test_the_column_of_the_hidden_effect_explains_the_residual(hidden, size):
    signals, force = motion(PENDULUM, [hidden])
    linear = {one.name for one in hidden.effect.parameters if one.linear}
    known = Placed(hidden.effect, hidden.at, {k: v for k, v in hidden.values.items() if k not in linear})
    (block,) = column_blocks(PENDULUM, known, signals)
    assert len(block.names) == 1
    columns = block.columns
    coefficient, *_ = np.linalg.lstsq(columns[:, 0, :], force[:, 0], rcond=None)
    assert coefficient[0] == pytest.approx(size, rel=1e-6)
    assert np.abs(force[:, 0] - columns[:, 0] @ coefficient).max() < 1e-7


def test_hidden_states_are_simulated_along_the_motion():
    lag = put("actuator_lag", "u", tau=0.08)
    signals, force = motion(PENDULUM, [lag])
    (block,) = column_blocks(PENDULUM, lag, signals)
    settled = slice(200, None)
    assert np.abs(block.columns[settled, 0, 0] - force[settled, 0]).max() < 0.01 * np.abs(force).max()
    rope = put("hysteresis", "theta", Fh=0.1, xs=0.05)
    signals, force = motion(PENDULUM, [rope])
    (block,) = column_blocks(PENDULUM, Placed(rope.effect, "theta", {"xs": 0.05}), signals)
    assert np.abs(0.1 * block.columns[settled, 0, 0] - force[settled, 0]).max() < 0.02 * np.abs(force).max()


def test_gravity_tilt_and_sensor_offset_show_in_the_same_direction():
    tilt = put("gravity_tilt", "base", alpha=0.01)
    signals, force = motion(PENDULUM, [tilt])
    (block,) = column_blocks(PENDULUM, tilt, signals)
    assert np.abs(block.columns[..., 0] - force).max() < 1e-6
    (offset,) = column_blocks(PENDULUM, put("sensor_offset", "theta"), signals)
    cosine = np.vdot(offset.columns, block.columns) / np.linalg.norm(offset.columns) / np.linalg.norm(block.columns)
    assert abs(cosine) > 0.99


def test_delays_shift_the_signals():
    late = put("input_delay", "u", tau=0.02)
    signals, force = motion(PENDULUM, [])
    moved = Signals(signals.t, np.roll(signals.u, -4, axis=0), signals.q, signals.v, signals.a)
    (block,) = column_blocks(PENDULUM, late, moved)
    assert np.abs(block.columns[4:-4, 0, 0] - (signals.u - moved.u)[4:-4, 0]).max() < 1e-9
    assert np.abs(force).max() < 1e-9
    (sensor,) = column_blocks(PENDULUM, put("sensor_delay", "theta"), signals)
    assert np.isfinite(sensor.columns).all()


def test_on_a_cart_pole_each_column_stays_on_its_coordinate():
    signals, force = motion(CART, [put("coulomb_friction", "theta", Fc=0.02, w=0.05)], n=1500)
    assert np.abs(force[:, 0]).max() < 1e-9
    blocks = [
        block
        for port in ("theta", "x")
        for block in column_blocks(CART, put("coulomb_friction", port, w=0.05), signals)
    ]
    assert [(str(block.placed), block.names) for block in blocks] == [
        ("coulomb_friction@theta", ("Fc",)),
        ("coulomb_friction@x", ("Fc",)),
    ]
    columns = np.concatenate([block.columns for block in blocks], axis=2)
    both, *_ = np.linalg.lstsq(columns.reshape(-1, 2), force.reshape(-1), rcond=None)
    assert both == pytest.approx([0.02, 0.0], abs=1e-9)


def test_every_effect_gives_finite_columns_or_none():
    signals, _ = motion(PENDULUM, [], n=400)
    sizes = motion_sizes(PENDULUM, signals)
    assert sizes["theta"]["F"] > 0
    assert sizes["u"]["u"] == pytest.approx(np.sqrt(np.mean(signals.u**2)))
    silent = set()
    for placed in place_all(PENDULUM):
        blocks = column_blocks(PENDULUM, placed, signals, sizes=sizes)
        silent |= set() if blocks else {placed.effect.name}
        for block in blocks:
            assert block.columns.shape == (400, 1, len(block.names))
            assert np.isfinite(block.columns).all()
    assert silent == NO_FORCE
    tanks = two_tanks().system()
    still = Signals(signals.t, signals.u, np.zeros((400, 0)), np.zeros((400, 0)), np.zeros((400, 0)))
    assert column_blocks(tanks, put("leak", "lower"), still) == []


def test_signals_of_another_length_are_refused():
    with pytest.raises(InputError, match="signal v of a motion"):
        Signals(np.arange(3.0), np.zeros((3, 1)), np.zeros((3, 1)), np.zeros((2, 1)), np.zeros((3, 1)))


# ---- claimed forces: any size, not only small ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("hidden", "error"),
    [
        (put("coulomb_friction", "theta", Fc=0.1, w=0.05), 1e-9),
        (put("input_gain", "u", gain=1.1), 1e-9),
        (put("actuator_lag", "u", tau=0.05), 1e-4),
        (put("rate_limit", "u", R=5.0), 1e-3),
        (put("hysteresis", "theta", Fh=0.1, xs=0.05), 2e-3),
    ],
    ids=lambda value: str(value),
)
def test_a_claimed_force_is_the_force_that_was_hidden(hidden, error):
    signals, force = motion(PENDULUM, [hidden])
    claimed = ClaimedForce(PENDULUM, hidden, {})(signals, hidden.values)
    settled = slice(200, None)  # hidden states start from rest
    assert np.abs((claimed - force)[settled]).max() < error * np.abs(force[settled]).max()


def test_a_claimed_delay_holds_the_command_back():
    signals, _ = motion(PENDULUM, [])
    late = ClaimedForce(PENDULUM, put("input_delay", "u"), {})(signals, {"tau": 4 * DT})
    held = np.concatenate([np.repeat(signals.u[:1], 4, axis=0), signals.u[:-4]])
    assert np.abs(late[:, 0] - (held - signals.u)[:, 0]).max() < 1e-9


@pytest.mark.parametrize(("name", "value"), [("sensor_gain", 0.8), ("sensor_gain", 1.3), ("sensor_offset", 0.2)])
def test_a_wrong_reading_is_undone_whatever_its_size(name, value):
    signals, _ = motion(PENDULUM, [])
    if name == "sensor_gain":
        read = replace(signals, q=value * signals.q, v=value * signals.v, a=value * signals.a)
    else:
        read = replace(signals, q=signals.q + value)
    parameter = builtin()[name].parameters[0].name
    claimed = ClaimedForce(PENDULUM, put(name, "theta"), {})(read, {parameter: value})
    left = along(residual_function(PENDULUM), PENDULUM, read, PENDULUM.vector(), None, read.a)
    assert np.abs(left).max() > 0.05
    assert np.abs(left - claimed).max() < 1e-9 * np.abs(left).max()


def test_a_reading_that_is_right_claims_nothing():
    signals, _ = motion(PENDULUM, [])
    for name, value in (("sensor_gain", 1.0), ("sensor_offset", 0.0), ("sensor_delay", 0.0)):
        parameter = builtin()[name].parameters[0].name
        claimed = ClaimedForce(PENDULUM, put(name, "theta"), {})(signals, {parameter: value})
        assert np.abs(claimed).max() == 0.0


def test_inputs_that_run_straight_are_followed_without_delay():
    lag = put("actuator_lag", "u")
    t = np.arange(400) * DT
    u = np.sin(2 * t)[:, None]
    still = np.zeros((400, 1))
    quick = {"tau": 1e-6}
    held = ClaimedForce(PENDULUM, lag, {})(Signals(t, u, still, still, still), quick)
    straight = ClaimedForce(PENDULUM, lag, {})(Signals(t, u, still, still, still, ramps=True), quick)
    assert np.abs(held[1:, 0]).max() == pytest.approx(2 * DT, rel=0.1)  # a sample late
    assert np.abs(straight).max() < 0.1 * np.abs(held).max()  # a twentieth of a sample


def test_what_leaves_no_force_on_the_measured_motion_is_not_claimable():
    names = [one for one in place_all(PENDULUM, builtin().values()) if not claimable(PENDULUM, one)]
    assert {one.effect.name for one in names} == NO_FORCE
