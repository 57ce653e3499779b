"""Composed systems: finite, neutral where they should be, differentiable, and what physics says."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from harness.effects import Placed, builtin, column_blocks, compose, place_all, recommended_substeps
from harness.effects.columns import Signals
from harness.errors import InputError
from harness.physics import fit_output_error
from harness.physics.models import BUILT_IN, drive, oscillator, pendulum, two_tanks
from harness.signals import PlantSpec, Trajectory

MODELS = {name: make().system() for name, make in BUILT_IN.items()}
PENDULUM, DRIVE, OSCILLATOR, TANKS = (make().system() for make in (pendulum, drive, oscillator, two_tanks))


def put(name, at, **values):
    return Placed(builtin()[name], at, values)


def excitation(system, n=150, seed=0):
    rng = np.random.default_rng(seed)
    t = np.arange(n)[:, None]
    u = sum(np.sin(2 * np.pi * f * t / n + rng.uniform(0, 6, (1, system.nu))) for f in (2, 5, 9)) * 0.6
    return u + (3.0 if system.process else 0.0)


def start(system, simulator, u, p=None, x0=None):
    """A moving start, the hidden states where they begin."""
    n = system.nx - system.hidden_count
    x = np.zeros(system.nx)
    x[:n] = (4.0 if system.process else 0.15) if x0 is None else x0
    if system.hidden_count:
        x[n:] = simulator.hidden_start(x, u[0], system.vector() if p is None else p)
    return x


def simulate(system, u, dt, *, x0=None, values=None, substeps=None):
    p = system.vector(values)
    simulator = system.simulator(dt, backend="casadi", substeps=substeps)
    return simulator.rollout(p, start(system, simulator, u, p, x0), u)


@pytest.mark.parametrize("model", sorted(MODELS))
def test_every_effect_composes_where_it_fits_and_vanishes_where_it_should(model):
    system = MODELS[model]
    dt = 4.0 if system.process else 0.01
    u = excitation(system)
    placed = place_all(system)
    assert placed
    for one in placed:
        if (model, str(one)) == ("planar-quadrotor", "quadratic_spring@theta"):
            continue  # nothing holds the attitude: beyond one angle this force drives it away for ever
        composed = compose(system, [one], sizes={"": {"dt": dt, "T": len(u) * dt}})
        substeps = max(recommended_substeps(composed, None, dt), 4)
        y = simulate(composed, u, dt, substeps=substeps)
        assert np.isfinite(y).all(), f"{one} on {model} diverges"
        neutral = one.effect.neutral()
        if neutral is not None:
            still = simulate(
                composed, u, dt, substeps=substeps, values={one.name(key): value for key, value in neutral.items()}
            )
            nominal = simulate(system, u, dt, substeps=substeps)
            assert np.abs(still - nominal).max() < 1e-9, f"{one} on {model} is not neutral at {neutral}"


ON_PENDULUM = [one for one in place_all(PENDULUM) if one.effect.parameters and one.effect.sampled != "quantise"]
ON_TANKS = [one for one in place_all(TANKS) if one.effect.kinds == ("process",)]


@pytest.mark.parametrize(("system", "one"), [(PENDULUM, o) for o in ON_PENDULUM] + [(TANKS, o) for o in ON_TANKS],
                         ids=str)  # fmt: skip
def test_sensitivities_agree_with_finite_differences(system, one):
    dt = 2.0 if system is TANKS else 0.01
    n = 120
    u = excitation(system, n)
    sizes = {"": {"dt": dt, "T": n * dt, "u": 1.0, "q": 0.3, "v": 1.0, "y": 0.3, "x": 3.0, "F": 1.0, "a": 10.0}}
    composed = compose(system, [one], sizes=sizes)
    if one.effect.sampled:  # whole samples are corners
        name = one.main()
        composed = composed.with_parameters({name: composed.parameter(name).value * 1.15})
    simulator = composed.simulator(dt, backend="casadi", substeps=max(4, recommended_substeps(composed, None, dt)))
    p = composed.vector()
    x0 = start(composed, simulator, u)
    _, slope, _ = simulator.sensitivities(p, x0, u)
    for column in range(system.np, composed.np):
        step = 2e-6 * max(abs(p[column]), 1e-2)
        up, down = p.copy(), p.copy()
        up[column] += step
        down[column] -= step
        numeric = (simulator.rollout(up, x0, u) - simulator.rollout(down, x0, u)) / (2 * step)
        error = np.abs(slope[..., column] - numeric).max()
        assert error <= 2e-4 * np.abs(numeric).max() + 1e-7, composed.parameter_names[column]


def test_coulomb_friction_sticks_below_its_level_and_slides_above():
    sticky = compose(DRIVE, [put("coulomb_friction", "q", Fc=2.0, w=1e-3)])
    held = simulate(sticky, np.full((400, 1), 1.9), 0.005, x0=0.0, substeps=8)
    assert np.abs(held).max() < 0.01  # creeps at most at the smoothed speed w atanh(0.95)
    pushed = simulate(sticky, np.full((400, 1), 3.0), 0.005, x0=0.0, substeps=8)
    # M v' = 3 - 2 - Fv v: a first-order rise to 1 m/s with the time constant M/Fv = 1 s
    t = np.arange(400) * 0.005
    assert np.abs(pushed[:, 0] - (t - 1 + np.exp(-t))).max() < 5e-3


def test_constant_forces_shift_the_rest_position_by_force_over_stiffness():
    u = np.zeros((4000, 1))
    damped = OSCILLATOR.with_parameters({"c": 2.0})
    biased = compose(damped, [put("force_bias", "q", F0=0.3)])
    assert simulate(biased, u, 0.01, x0=0.0)[-1, 0] == pytest.approx(0.3, abs=1e-6)
    sprung = compose(damped, [put("force_bias", "q", F0=0.3), put("linear_spring", "q", k=2.0)])
    assert simulate(sprung, u, 0.01, x0=0.0)[-1, 0] == pytest.approx(0.1, abs=1e-6)
    hard = compose(damped, [put("force_bias", "q", F0=2.0), put("cubic_spring", "q", k3=1.0)])
    assert simulate(hard, u, 0.01, x0=0.0)[-1, 0] == pytest.approx(1.0, abs=1e-6)  # q + q^3 = 2
    unequal = compose(damped, [put("force_bias", "q", F0=2.0), put("quadratic_spring", "q", k2=1.0)])
    assert simulate(unequal, u, 0.01, x0=0.0)[-1, 0] == pytest.approx(1.0, abs=1e-6)  # q + q^2 = 2


def test_a_tilted_base_moves_the_rest_position_as_an_encoder_offset_does():
    strong = PENDULUM.with_parameters({"b": 0.6})
    u = np.zeros((2000, 1))
    tilted = simulate(compose(strong, [put("gravity_tilt", "base", alpha=0.2)]), u, 0.01, x0=0.0)
    assert tilted[-1, 0] == pytest.approx(-0.2, abs=1e-6)
    # the same motion, told by an encoder that reads 0.2 too little: an exact confusion
    offset = simulate(compose(strong, [put("sensor_offset", "theta", offset=-0.2)]), u, 0.01, x0=[0.2, 0.0])
    assert np.abs(offset - tilted).max() < 1e-9
    # and by a load beside the line: mgl sin(theta) + A cos(theta), A = mgl' tan(0.2)
    load = compose(strong.with_parameters({"mgl": np.cos(0.2)}), [put("eccentric_load", "theta", A=float(np.sin(0.2)))])
    assert np.abs(simulate(load, u, 0.01, x0=0.0) - tilted).max() < 1e-9


def test_drag_and_viscous_friction_reach_their_terminal_speeds():
    u = np.full((3000, 1), 4.0)
    base = DRIVE.with_parameters({"Fv": 1e-9})
    drag = simulate(compose(base, [put("quadratic_drag", "q", c=1.0)]), u, 0.01, x0=0.0)
    assert (drag[-1, 0] - drag[-2, 0]) / 0.01 == pytest.approx(2.0, rel=1e-6)
    viscous = simulate(compose(base, [put("viscous_friction", "q", b=2.0)]), u, 0.01, x0=0.0)
    assert (viscous[-1, 0] - viscous[-2, 0]) / 0.01 == pytest.approx(2.0, rel=1e-6)


def test_nested_members_are_reached_exactly():
    u = excitation(PENDULUM, 300)

    def run(*placed):
        return simulate(compose(PENDULUM, list(placed)), u, 0.01, substeps=4)

    coulomb = run(put("coulomb_friction", "theta", Fc=0.1, w=0.02))
    assert np.abs(run(put("stribeck_friction", "theta", Fs=0.1, Fc=0.1, vs=0.3, w=0.02)) - coulomb).max() < 1e-12
    assert np.abs(run(put("asymmetric_friction", "theta", Fp=0.1, Fm=0.1, w=0.02)) - coulomb).max() < 1e-12
    assert (
        np.abs(run(put("position_dependent_friction", "theta", Fc=0.1, a=0.0, phi=0.3, w=0.02)) - coulomb).max() < 1e-12
    )
    assert np.abs(run(put("yield_friction", "theta", Fr=0.0, a=0.5, Fc=0.1, w=0.02)) - coulomb).max() < 1e-12
    grease = run(put("sublinear_friction", "theta", Fr=0.1, a=0.5, w=0.02))
    assert np.abs(run(put("yield_friction", "theta", Fr=0.1, a=0.5, Fc=0.0, w=0.02)) - grease).max() < 1e-12
    asymmetric = run(put("asymmetric_friction", "theta", Fp=0.12, Fm=0.08, w=0.02))
    both = run(put("coulomb_friction", "theta", Fc=0.1, w=0.02), put("force_bias", "theta", F0=-0.02))
    assert np.abs(asymmetric - both).max() < 1e-12
    elastic = run(put("elasticity", "theta", k=60.0, Jm=0.01, d=0.02))
    play = run(put("backlash", "theta", gap=0.0, k=60.0, Jm=0.01, d=0.02))
    assert np.abs(play - elastic).max() < 1e-10
    lag = run(put("actuator_lag", "u", tau=0.05))
    assert np.abs(run(put("rate_limit", "u", R=1e6, tau=0.05)) - lag).max() < 1e-8


def test_a_stiff_transmission_is_rigid_with_the_sum_of_the_inertias():
    u = excitation(PENDULUM, 300)
    stiff = compose(PENDULUM, [put("elasticity", "theta", k=3e4, Jm=0.02, d=20.0)])
    substeps = recommended_substeps(stiff, None, 0.01)
    assert substeps > 5
    whole = simulate(PENDULUM.with_parameters({"J": 0.12}), u, 0.01, x0=[0.15, 0.15])
    assert np.abs(simulate(stiff, u, 0.01, x0=[0.15, 0.15], substeps=substeps) - whole).max() < 1e-3


def test_a_sign_is_followed_by_the_finer_steps_about_its_zero_and_no_others():
    """Friction as sharp as fits make it took 64 steps for every sample, each near zero in eight again."""
    u = excitation(PENDULUM, 600)
    dry = compose(PENDULUM, [put("coulomb_friction", "theta", Fc=0.1, w=1e-4)])
    substeps = recommended_substeps(dry, None, 0.01)
    assert substeps <= 10
    near, far = (simulate(dry, u, 0.01, x0=[0.15, 0.15], substeps=many) for many in (substeps, 50 * substeps))
    assert np.abs(near - far).max() < 1e-4 * np.abs(far).max()


def test_the_width_of_a_sign_stays_within_the_motion():
    sizes = {"theta": {"v": 0.4, "q": 0.3, "a": 1.0, "F": 1.0, "dt": 0.01, "T": 10.0}}
    for name in ("coulomb_friction", "stribeck_friction", "load_dependent_friction"):
        system = compose(PENDULUM, [Placed(builtin()[name], "theta")], sizes=sizes)
        assert _bounds(system, f"{name}@theta.w")[1] == pytest.approx(0.4), "a wider one is viscous friction"


def test_backlash_lets_the_motor_turn_alone_within_the_gap():
    loose = compose(DRIVE, [put("backlash", "q", gap=0.1, k=500.0, Jm=0.1, d=1.0)])
    simulator = loose.simulator(0.001, backend="casadi")
    x = simulator.states(loose.vector(), np.zeros(4), np.full((300, 1), 0.5))
    lead = x[:, 2]
    touch = int(np.argmax(lead > 0.09))
    # Jm w' = u: the motor alone covers the gap in sqrt(2 gap Jm / u) = 0.2 s
    assert touch * 0.001 == pytest.approx(np.sqrt(2 * 0.09 * 0.1 / 0.5), rel=0.02)
    assert abs(x[touch - 20, 0]) < 1e-4  # the load has not moved
    assert x[-1, 0] > 1e-3
    assert recommended_substeps(loose, None, 0.01) >= recommended_substeps(DRIVE, None, 0.01)


def test_flanks_come_into_contact_over_a_corner():
    backlash = builtin()["backlash"]

    def force(e, c):
        values = {"gap": 0.1, "k": 500.0, "Jm": 0.1, "d": 0.0, "c": c}
        return backlash.evaluate(0.0, (e, 0.0), values, 0.0, 0.0)[0]

    assert force(0.3, 0.5) == pytest.approx(500 * 0.2, rel=0.01)  # far beyond it, whatever the corner
    assert force(0.3, 0.01) == pytest.approx(500 * 0.2, rel=1e-6)
    assert abs(force(0.09, 0.01)) < 0.01
    assert force(0.09, 0.5) > 10
    corner = backlash.parameter("c")
    assert not corner.fixed
    assert corner.start({}) == corner.minimum  # sharp where nobody says otherwise
    assert min(corner.starts({})) >= 10 * corner.minimum  # a fit begins round and may end sharp


def test_inputs_act_in_the_order_given():
    u = excitation(PENDULUM, 200)
    first = simulate(compose(PENDULUM, [put("input_gain", "u", gain=2.0), put("saturation", "u", limit=0.5)]), u, 0.01)
    assert np.abs(first - simulate(compose(compose(PENDULUM, [put("input_gain", "u", gain=2.0)]),
                                           [put("saturation", "u", limit=0.5)]), u, 0.01)).max() < 1e-12  # fmt: skip
    second = simulate(compose(PENDULUM, [put("saturation", "u", limit=0.5), put("input_gain", "u", gain=2.0)]), u, 0.01)
    clipped = simulate(compose(PENDULUM, [put("saturation", "u", limit=0.5)]), 2 * u, 0.01)
    assert np.abs(first - clipped).max() < 1e-12  # gain before the limit
    assert np.abs(second - first).max() > 1e-2


def test_the_dead_zone_passes_nothing_small_and_shifts_the_rest():
    moved = compose(DRIVE.with_parameters({"Fv": 0.5}), [put("dead_zone", "u", width=1.0)])
    assert np.abs(simulate(moved, np.full((200, 1), 0.8), 0.01, x0=0.0)).max() < 1e-4
    u = np.full((200, 1), 3.0)
    assert np.abs(simulate(moved, u, 0.01, x0=0.0) - simulate(DRIVE.with_parameters({"Fv": 0.5}), u - 1.0, 0.01,
                                                              x0=0.0)).max() < 1e-6  # fmt: skip


def test_an_input_delay_of_whole_samples_shifts_the_response_exactly():
    u = excitation(PENDULUM, 200)
    u[:20] = u[0] * 0.0
    late = simulate(compose(PENDULUM, [put("input_delay", "u", tau=0.05)]), u, 0.01, x0=0.0)
    now = simulate(PENDULUM, u, 0.01, x0=0.0, substeps=4)  # as many as where an input may arrive within a sample
    assert np.abs(late[5:] - now[:-5]).max() < 1e-12
    read = simulate(compose(PENDULUM, [put("sensor_delay", "theta", tau=0.05)]), u, 0.01, x0=0.0, substeps=4)
    assert np.abs(read - late).max() < 1e-12  # an exact confusion from rest in open loop


def test_rate_limit_and_lag_answer_a_step_as_they_should():
    u = np.ones((100, 1))
    u[:10] = 0.0
    free = OSCILLATOR.with_parameters({"m": 1e3})
    ramp = compose(free, [put("rate_limit", "u", R=2.0, tau=1e-3)])
    z = ramp.simulator(0.01, backend="casadi", substeps=20).states(ramp.vector(), np.zeros(3), u)[:, 2]
    assert z[35] == pytest.approx(0.5, abs=0.01)  # 25 samples of 10 ms at 2 per second
    assert z[80] == pytest.approx(1.0, abs=1e-3)
    lag = compose(free, [put("actuator_lag", "u", tau=0.1)])
    z = lag.simulator(0.01, backend="casadi").states(lag.vector(), np.zeros(3), u)[:, 2]
    assert z[20] == pytest.approx(1 - np.exp(-1.0), abs=1e-6)


def test_the_rest_of_the_sensors():
    u = excitation(PENDULUM, 200) * 3
    true = simulate(PENDULUM, u, 0.01)
    assert (
        np.abs(simulate(compose(PENDULUM, [put("sensor_rectification", "theta")]), u, 0.01) - abs(true)).max() < 1e-15
    )
    step = simulate(compose(PENDULUM, [put("sensor_quantisation", "theta", step=0.1)]), u, 0.01)
    assert np.abs(step - 0.1 * np.round(true / 0.1)).max() < 1e-12
    cut = simulate(compose(PENDULUM, [put("sensor_saturation", "theta", limit=0.2)]), u, 0.01)
    assert np.abs(cut - np.clip(true, -0.2, 0.2)).max() < 0.002
    assert (
        np.abs(simulate(compose(PENDULUM, [put("sensor_gain", "theta", gain=1.3)]), u, 0.01) - 1.3 * true).max() < 1e-12
    )


def test_hysteresis_is_a_spring_first_and_dry_friction_later():
    small, large = 1e-4, 1.0
    block = builtin()["hysteresis"]
    force, z = 0.0, 0.0
    values = {"Fh": 2.0, "xs": 0.01, "beta": 0.5, "T": 0.0}
    for _ in range(100):
        force, (rate,) = block.evaluate(0.0, [z], values, 0.0, 1.0)
        z += rate * small / 100
    assert force == pytest.approx(-2.0 * small / 0.01, rel=0.02)  # -Fh q / xs
    for _ in range(1000):
        force, (rate,) = block.evaluate(0.0, [z], values, 0.0, 1.0)
        z += rate * large / 1000
    assert force == pytest.approx(-2.0, rel=1e-3)  # -Fh


def test_hysteresis_comes_back_from_any_deflection():
    """A loop that gave energy would run away from a start beyond its level, as a fitted one may be."""
    block = builtin()["hysteresis"]
    (shape,) = (parameter for parameter in block.parameters if parameter.name == "beta")
    for beta in np.linspace(shape.minimum, shape.maximum, 6):
        for speed in (1.0, -1.0):
            for z in (-5.0, -1.5, 1.5, 5.0):
                _, (rate,) = block.evaluate(0.0, [z], {"Fh": 2.0, "xs": 0.01, "beta": beta, "T": 0.0}, 0.0, speed)
                assert rate * z < 0.0


def test_a_payload_adds_its_inertia_and_weight_from_its_instant():
    u = excitation(PENDULUM, 400)
    loaded = compose(PENDULUM, [put("payload_step", "theta", dJ=0.05, dG=0.4, t0=0.0, w=1e-6)])
    # the first half sample of a step that rises at t = 0 does not count
    heavy = simulate(PENDULUM.with_parameters({"J": 0.15, "mgl": 1.4}), u, 0.01, substeps=4)
    assert np.abs(simulate(loaded, u, 0.01, substeps=4) - heavy).max() < 1e-2
    later = compose(PENDULUM, [put("payload_step", "theta", dJ=0.05, dG=0.4, t0=2.0, w=1e-3)])
    y, nominal = simulate(later, u, 0.01, substeps=4), simulate(PENDULUM, u, 0.01, substeps=4)
    assert np.abs(y[:199] - nominal[:199]).max() < 1e-9
    assert np.abs(y[220:] - nominal[220:]).max() > 1e-2
    on_cart = compose(DRIVE, [put("payload_step", "q", dJ=0.5)])
    assert on_cart.parameter("payload_step@q.dG").fixed  # gravity has no part in it there


def test_the_end_stop_keeps_the_coordinate_in():
    stopped = compose(OSCILLATOR, [put("end_stop", "q", stop=0.2, k=500.0, d=5.0)])
    u = np.full((600, 1), 1.0)
    y = simulate(stopped, u, 0.01, x0=0.0, substeps=4)
    assert y.max() < 0.28
    # pressed hard, at rest k q + 500 (q - stop) = 20
    rest = simulate(stopped, np.full((1500, 1), 20.0), 0.01, x0=0.0, substeps=8)[-1, 0]
    assert rest == pytest.approx((20 + 500 * 0.2) / 501, abs=1e-4)


def test_tanks_spill_into_the_next_one_and_lose_what_leaks():
    u = np.full((1500, 1), 8.0)
    nominal = simulate(TANKS, u, 4.0, x0=4.0)
    # steady: k_lower sqrt(h) = k_pump u
    assert nominal[-1, 0] == pytest.approx((0.02 * 8 / 0.03) ** 2, rel=0.01)
    low = compose(TANKS, [put("overflow", "upper", h=10.0, share=0.0, w=0.05)])
    lost = compose(TANKS, [put("level_saturation", "upper", limit=10.0, w=0.05)])
    kept = compose(TANKS, [put("overflow", "upper", h=10.0, share=1.0, w=0.05)])
    y_low, y_lost, y_kept = (simulate(one, u, 4.0, x0=4.0, substeps=8) for one in (low, lost, kept))
    assert np.abs(y_low - y_lost).max() < 1e-9
    assert y_low[-1, 0] == pytest.approx(10.0, rel=0.05)  # the upper one cannot give more than its rim's outflow
    # nothing is lost on the way: the lower tank ends where the nominal one does
    assert y_kept[-1, 0] == pytest.approx(nominal[-1, 0], rel=0.02)
    full = compose(TANKS, [put("overflow", "upper", h=10.0, share=1.0, w=0.05), put("level_saturation", "lower",
                                                                                      limit=12.0, w=0.05)])  # fmt: skip
    assert simulate(full, u, 4.0, x0=4.0, substeps=8).max() < 12.6
    leaking = simulate(compose(TANKS, [put("leak", "lower", c=0.01)]), u, 4.0, x0=4.0)
    assert leaking[-1, 0] < nominal[-1, 0]


def test_load_dependent_friction_grows_with_the_load():
    light, heavy = PENDULUM.with_parameters({"mgl": 0.5}), PENDULUM.with_parameters({"mgl": 2.0})
    u = np.zeros((500, 1))
    for system in (light, heavy):
        rub = compose(system, [put("load_dependent_friction", "theta", mu=0.1, w=0.02)])
        equal = 0.1 * system.values()["mgl"]  # near hanging the load is the weight
        dry = compose(system, [put("coulomb_friction", "theta", Fc=equal, w=0.02)])
        y, z = simulate(rub, u, 0.01, x0=[0.2, 0.0]), simulate(dry, u, 0.01, x0=[0.2, 0.0])
        assert np.abs(y - z).max() < 0.02 * 0.2
    geared = compose(DRIVE, [put("load_dependent_friction", "q", mu=0.2, w=1e-3)])
    pushed = simulate(geared, np.full((200, 1), 5.0), 0.01, x0=0.0, substeps=8)
    assert np.abs(pushed - simulate(DRIVE, np.full((200, 1), 4.0), 0.01, x0=0.0, substeps=8)).max() < 5e-3


def test_lines_and_cogging_are_what_their_formulas_say():
    t = np.arange(300) * 0.01
    line = compose(OSCILLATOR, [put("periodic_disturbance", "q", A=0.5, omega=3.0, phi=0.4)])
    y = simulate(line, np.zeros((300, 1)), 0.01, x0=0.0, substeps=4)
    fine = simulate(OSCILLATOR, 0.5 * np.sin(3.0 * np.arange(3000)[:, None] * 0.001 + 0.4 + 0.0015), 0.001, x0=0.0)
    assert np.abs(y[:, 0] - fine[::10, 0]).max() < 1e-5
    assert t[-1] < 3.0
    force, _ = builtin()["cogging"].evaluate(0.0, [], {"A": 2.0, "k": 4.0, "phi": 0.3}, 0.7, 0.0)
    assert force == pytest.approx(2.0 * np.sin(4.0 * 0.7 + 0.3))


def test_effects_added_later_join_those_that_are_there():
    once = compose(PENDULUM, [put("actuator_lag", "u", tau=0.05), put("elasticity", "theta", k=50.0, Jm=0.01, d=0.02),
                              put("load_dependent_friction", "theta", mu=0.1)])  # fmt: skip
    lagging = compose(PENDULUM, [put("actuator_lag", "u", tau=0.01)])
    lagging = lagging.with_parameters({"actuator_lag@u.tau": 0.05, "b": 0.07})
    steps = compose(compose(lagging, [put("elasticity", "theta", k=50.0, Jm=0.01, d=0.02)]),
                    [put("load_dependent_friction", "theta", mu=0.1)])  # fmt: skip
    assert [str(one) for one in steps.effects] == [str(one) for one in once.effects]
    assert steps.values()["b"] == 0.07  # what was set before stays
    u = excitation(PENDULUM)
    y = simulate(steps, u, 0.01, substeps=8)
    z = simulate(once.with_parameters({"b": 0.07}), u, 0.01, substeps=8)
    assert np.abs(y - z).max() < 1e-12


def test_a_transmission_needs_a_drive():
    with pytest.raises(InputError, match="no input drives this coordinate"):
        compose(MODELS["cart-pole"], [put("backlash", "theta")])


def test_a_composed_system_travels_and_can_still_be_extended():
    lagging = compose(PENDULUM, [put("actuator_lag", "u", tau=0.05), put("coulomb_friction", "theta", Fc=0.1)])
    arrived = pickle.loads(pickle.dumps(lagging))
    more = compose(arrived, [put("sensor_offset", "theta", offset=0.1)])
    u = excitation(PENDULUM)
    assert np.abs(simulate(more, u, 0.01, substeps=4) - simulate(lagging, u, 0.01, substeps=4) - 0.1).max() < 1e-12


def test_smoothing_widths_are_kept_where_the_step_can_follow():
    sized = compose(PENDULUM, [put("coulomb_friction", "theta")], sizes={"theta": {"v": 2.0, "F": 1.0}})
    width = sized.parameter("coulomb_friction@theta.w")
    assert width.minimum == pytest.approx(0.0002 * 2.0)
    assert width.value == pytest.approx(0.02 * 2.0)
    curve = compose(PENDULUM, [put("stribeck_friction", "theta")], sizes={"theta": {"v": 2.0, "F": 1.0}})
    assert curve.parameter("stribeck_friction@theta.vs").minimum == pytest.approx(
        0.015 * 2.0
    )  # what sticks creeps below it
    given = compose(PENDULUM, [put("coulomb_friction", "theta", w=1e-4)], sizes={"theta": {"v": 2.0, "F": 1.0}})
    assert given.parameter("coulomb_friction@theta.w").minimum == pytest.approx(1e-4)  # what is given is taken


@pytest.mark.parametrize(("fast", "steps"), [(1.3, 1), (1.5, 2), (2.9, 3)])
def test_what_is_followed_takes_half_of_what_the_method_endures(fast: float, steps: int) -> None:
    lagging = compose(PENDULUM, [put("actuator_lag", "u", tau=0.01 / fast)])
    assert recommended_substeps(lagging, None, 0.01) == steps


@pytest.mark.parametrize(("fast", "steps"), [(2.4, 1), (2.6, 2), (5.1, 3)])
def test_what_slips_at_speed_is_stable(fast: float, steps: int) -> None:
    """Runge and Kutta's method of order 4 endures an eigenvalue times a step of 2.78."""
    bristles = compose(PENDULUM, [put("lugre_coulomb_friction", "theta", Fc=1e-9, xs=1e-3, tau=0.0, T=0.0)])
    assert recommended_substeps(bristles, None, 0.01, x=np.array([0.0, 0.1 * fast, 1e-3])) == steps


def test_a_lag_is_never_so_short_that_it_costs_many_steps() -> None:
    """A fit that had no use for one followed it to a hundredth of a sample, in 55 steps each."""
    lagging = compose(PENDULUM, [put("actuator_lag", "u")], sizes={"u": {"u": 1.0, "dt": 0.01}})
    shortest = lagging.parameter("actuator_lag@u.tau").minimum
    assert shortest == pytest.approx(8.3e-4)
    assert recommended_substeps(lagging, {"actuator_lag@u.tau": shortest}, 0.01) <= 10


@pytest.mark.parametrize(
    "hidden",
    [
        put("coulomb_friction", "theta", Fc=0.05, w=0.01),
        put("dead_zone", "u", width=0.08),
        put("input_delay", "u", tau=0.033),
        put("actuator_lag", "u", tau=0.05),
        put("hysteresis", "theta", Fh=0.06, xs=0.1),
        put("sensor_offset", "theta", offset=0.05),
    ],
    ids=str,
)
def test_a_refit_from_the_hinted_start_finds_what_was_hidden(hidden):
    dt, n = 0.01, 1200
    rng = np.random.default_rng(4)
    t = np.arange(n) * dt
    u = sum(0.2 * np.sin(2 * np.pi * f * t + rng.uniform(0, 6)) for f in (0.2, 0.4, 0.9, 1.6, 3.1))[:, None]
    truth = compose(PENDULUM, [hidden])
    y = simulate(truth, u, dt, x0=0.0, substeps=8) + 1e-3 * rng.standard_normal((n, 1))
    record = Trajectory(t, u, y, PlantSpec(PENDULUM.inputs, PENDULUM.outputs, dt))
    sizes = {"": {"F": 0.4, "q": 0.3, "v": 1.0, "u": 0.3, "y": 0.3, "dt": dt, "T": n * dt}}
    candidate = compose(PENDULUM, [Placed(hidden.effect, hidden.at)], sizes=sizes)
    fit = fit_output_error(candidate, [record], noise={"theta": 1e-3}, continuation=(1.0, None), substeps=4)
    assert fit.chi2 < 1.3
    main = hidden.main()
    assert fit.parameters[main] == pytest.approx(truth.values()[main], rel=0.05)


@pytest.mark.parametrize(
    ("name", "at", "fast"),
    [("backlash", "theta", {"k": 5e3, "Jm": 0.05, "d": 1e6}), ("rate_limit", "u", {"tau": 1e-8})],
)
def test_what_is_faster_than_the_samples_is_as_good_as_at_once(name, at, fast):
    """Fits went to such values, and took 64 steps of the solver for every sample there."""
    sizes = {at: {"dt": 0.01, "F": 1.0, "q": 1.0, "v": 3.0, "a": 10.0, "u": 1.0}}
    system = compose(pendulum().system(), [Placed(builtin()[name], at)], sizes=sizes)
    bounded = {
        f"{name}@{at}.{key}": float(np.clip(value, *_bounds(system, f"{name}@{at}.{key}")))
        for key, value in fast.items()
    }
    assert recommended_substeps(system, bounded, 0.01) <= 8
    loose = compose(pendulum().system(), [Placed(builtin()[name], at, fast)], sizes=sizes)
    assert recommended_substeps(loose, None, 0.01) > 30, "what a user gives stays as it is"


def _bounds(system, name):
    one = system.parameter(name)
    return one.minimum, one.maximum


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_what_cuts_a_reading_off_comes_after_what_bends_it(order):
    """A sensor cannot read beyond its limit, in whichever order its errors were found."""
    errors = [put("sensor_saturation", "theta", limit=0.2), put("sensor_nonlinearity", "theta", b=0.5)]
    composed = compose(PENDULUM, [errors[k] for k in order])
    y = simulate(composed, 3.0 * excitation(PENDULUM), 0.02)
    assert y.max() == pytest.approx(0.2, rel=1e-3)
    assert y.min() == pytest.approx(-0.2, rel=1e-3)
    assert [str(effect) for effect in composed.effects] == [str(errors[k]) for k in order]


def test_where_nothing_turns_no_weight_is_lifted():
    """A load on a cart has no gravity along its rail: held at 0, and no column of a score test."""
    places = {one.at: one for one in place_all(MODELS["cart-pole"]) if one.effect.name == "payload_step"}
    assert places["x"].effect.parameter("dG").fixed
    assert not places["theta"].effect.parameter("dG").fixed
    assert places["x"].effect.parameter("dG").start({"F": 5.0}) == 0.0
    t = np.arange(40) * 0.1
    turning = Signals(t, np.ones((40, 1)), np.ones((40, 2)), np.ones((40, 2)), np.ones((40, 2)))
    columns = {
        at: {block.names for block in column_blocks(MODELS["cart-pole"], one, turning)} for at, one in places.items()
    }
    assert columns == {"x": {("dJ",)}, "theta": {("dJ", "dG")}}
