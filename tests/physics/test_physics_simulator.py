"""Simulation: backends agree to the bit, sensitivities are derivatives, delays, divergence, the compile cache."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from harness.effects import builtin, compose
from harness.effects.effect import Placed
from harness.errors import InputError
from harness.fmi.build import compiler
from harness.physics import Parameter, SampledBlock, models
from harness.physics.compiled import ccode
from harness.physics.compiled.sampled import delayed
from harness.physics.compiled.simulator import default_substeps

needs_compiler = pytest.mark.skipif(compiler() is None, reason="no C compiler: install gcc")
NAMES = ["pendulum", "cart-pole", "acrobot", "two-tanks", "linear"]


def delayed_cart():
    """Return a cart-pole with a late input and a late angle sensor."""
    late, sensor = ca.SX.sym("late"), ca.SX.sym("sensor")
    return (
        models.cart_pole()
        .system()
        .rebuild(
            parameters=[(Parameter("input_delay@u.tau", "s", 0.011), late), (Parameter("lag", "s", 0.007), sensor)],
            sampled=[SampledBlock("input_delay", 0, "input_delay@u.tau"), SampledBlock("output_delay", 1, "lag")],
        )
    )


def excitation(system, count, seed=0):
    rng = np.random.default_rng(seed)
    return rng.normal(size=(count, system.nu)) * 0.3, np.abs(rng.normal(size=system.nx)) * 0.3


@pytest.mark.parametrize("intersample", ["zoh", "foh", "smooth"])
def test_windows_with_a_late_input_are_run_alike_with_and_without_sensitivities(intersample):
    system = delayed_cart()
    u, x0 = excitation(system, 60)
    p = system.vector()[None]
    for backend in ("c", "casadi") if compiler() else ("casadi",):
        simulator = system.simulator(0.01, substeps=2, intersample=intersample, backend=backend)
        late, by_delays = simulator.seen(u[None], p, True)
        given = p, x0[None], late, by_delays, np.zeros(1)
        with_them, without = (simulator.windows(*given, sensitivities=wanted) for wanted in (True, False))
        assert with_them[2] is not None
        assert without[2] is None
        assert np.array_equal(with_them[1], without[1])


@needs_compiler
@pytest.mark.parametrize("intersample", ["zoh", "foh", "smooth"])
@pytest.mark.parametrize("name", [*NAMES, "delayed"])
def test_compiled_code_and_virtual_machine_give_the_same_bits(name, intersample):
    system = delayed_cart() if name == "delayed" else models.load_model(name)
    u, x0 = excitation(system, 300)
    p = system.vector()
    found = [
        system.simulator(0.01, substeps=3, intersample=intersample, backend=backend).sensitivities(p, x0, u, t0=0.3)
        for backend in ("c", "casadi")
    ]
    for one, other in zip(*found, strict=True):
        assert np.array_equal(one, other)
    plain = system.simulator(0.01, substeps=3, intersample=intersample, backend="c").rollout(p, x0, u, t0=0.3)
    assert np.array_equal(plain, found[0][0])


@given(seed=st.integers(0, 10**6), name=st.sampled_from([*NAMES, "delayed"]))
def test_sensitivities_are_the_derivatives_of_the_rollout(seed, name):
    system = delayed_cart() if name == "delayed" else models.load_model(name)
    u, x0 = excitation(system, 40, seed)
    x0 = x0 + 0.1  # away from an empty tank
    simulator = system.simulator(0.02, substeps=2, backend="casadi")
    p = system.vector() * np.exp(0.3 * np.random.default_rng(seed).normal(size=system.np))
    _, by_p, by_x = simulator.sensitivities(p, x0, u)
    for column in range(system.np):
        step = np.zeros(system.np)
        step[column] = 1e-6 * max(abs(p[column]), 1e-3)
        slope = (simulator.rollout(p + step, x0, u) - simulator.rollout(p - step, x0, u)) / (2 * step[column])
        assert by_p[..., column] == pytest.approx(
            slope, rel=2e-5, abs=2e-5 * np.abs(slope).max() + 1e-15 / np.max(step)
        )
    for column in range(system.nx):
        step = np.zeros(system.nx)
        step[column] = 1e-6
        slope = (simulator.rollout(p, x0 + step, u) - simulator.rollout(p, x0 - step, u)) / 2e-6
        assert by_x[..., column] == pytest.approx(
            slope, rel=2e-5, abs=2e-5 * np.abs(slope).max() + 1e-15 / np.max(step)
        )


def test_a_batch_is_its_windows_one_by_one():
    system = models.cart_pole().system()
    rng = np.random.default_rng(1)
    u, x0 = rng.normal(size=(5, 60, 1)), rng.normal(size=(5, 4)) * 0.2
    p = system.vector() * np.exp(0.1 * rng.normal(size=(5, 5)))
    simulator = system.simulator(0.01)
    together = simulator.sensitivities(p, x0, u, t0=np.arange(5.0))
    for row in range(5):
        alone = simulator.sensitivities(p[row], x0[row], u[row], t0=float(row))
        for one, other in zip(alone, together, strict=True):
            assert np.array_equal(one, other[row])


def test_steps_repeat_the_rollout():
    system = models.pendulum().system()
    u, x0 = excitation(system, 20)
    simulator = system.simulator(0.05, substeps=2)
    p = system.vector()
    x = simulator.states(p, x0, u)
    for k in range(19):
        assert np.array_equal(simulator.step(x[k], u[k], p), x[k + 1])
        assert simulator.output(x[k], u[k], p).tolist() == [x[k, 0]]


def test_rollout_converges_to_an_independent_integrator():
    system = models.cart_pole().system()
    p = system.vector()
    u = np.random.default_rng(2).normal(size=(40, 1)) * 3
    x, dt = np.array([0.1, 0.5, 0.0, 0.0]), 0.05
    exact = [x]
    simulator = system.simulator(dt)
    for k in range(39):
        held = u[k]
        found = solve_ivp(lambda t, y, h=held: simulator.derivative(y, h, p, t), (0, dt), x, rtol=1e-12, atol=1e-13)
        x = found.y[:, -1]
        exact.append(x)
    errors = [np.abs(system.simulator(dt, substeps=s).states(p, exact[0], u) - exact).max() for s in (2, 4, 8)]
    assert errors[0] / errors[1] > 11
    assert errors[1] / errors[2] > 11
    assert errors[2] < 1e-5


def test_an_oscillation_beyond_the_readings_needs_to_be_stable_only():
    """A hidden resonance of five times half the sampling frequency took 45 steps, and readings lose its phase."""
    mechanism = models.oscillator().system()
    names = mechanism.parameter_names
    for turn, whole, stable in ((1.0, 3, 3), (3.0, 9, 9), (15.0, 43, 11)):  # radians within a sample of 10 ms
        p = mechanism.vector({"m": 1.0, "k": (turn / 0.01) ** 2, **{name: 0.0 for name in names if name == "c"}})
        assert default_substeps(mechanism, 0.01, p) == whole
        steps = default_substeps(mechanism, 0.01, p, followed=np.pi)
        assert steps == stable
        free = mechanism.simulator(0.01, substeps=steps).rollout(p, [1e-3, 0.0], np.zeros((2000, mechanism.nu)))
        assert np.abs(free).max() <= 1.001e-3


@given(st.floats(-1.0, 2.0), st.integers(0, 99))
def test_a_lag_of_any_speed_is_followed(exponent, seed):
    """Of a lag that is over within a sample fewer steps are taken: what all of them leave is as little."""
    speed = 10.0**exponent  # time constants in a sample
    lag = models.linear(1, offsets=False).system()
    p = lag.vector({"a1_1": speed, "b1_1": speed})
    u = np.random.default_rng(seed).choice([-1.0, 1.0], (40, 1))
    y = lag.simulator(1.0, substeps=default_substeps(lag, 1.0, p)).rollout(p, [0.0], u)[:, 0]
    exact = np.zeros(40)
    for k in range(1, 40):
        exact[k] = u[k - 1, 0] + np.exp(-speed) * (exact[k - 1] - u[k - 1, 0])
    np.testing.assert_allclose(y, exact, atol=2.5e-3)  # of jumps by 2; the worst speed, 1.4, leaves 2.43e-3


def test_a_smooth_input_is_followed_between_the_samples():
    system = models.oscillator().system()
    dt, p = 0.1, [1.0, 0.4, 9.0]
    t = np.arange(200) * dt
    u = np.sin(5.0 * t)[:, None]
    exact = solve_ivp(lambda s, x: [x[1], np.sin(5.0 * s) - 0.4 * x[1] - 9.0 * x[0]], (0, t[-1]), [0, 0], t_eval=t,
                      rtol=1e-10, atol=1e-12).y[0]  # fmt: skip
    error = {
        kind: np.abs(system.simulator(dt, intersample=kind, substeps=8).rollout(p, [0, 0], u)[:, 0] - exact).max()
        for kind in ("zoh", "foh", "smooth")
    }
    assert error["smooth"] < error["foh"] / 10
    assert error["foh"] < error["zoh"] / 5
    by_x = system.simulator(dt, intersample="smooth").sensitivities(p, [0.1, 0.0], u)[2]
    assert by_x.shape == (200, 1, 2)


@pytest.mark.parametrize("share", [0.1, 0.2, 0.3])
def test_a_smooth_input_keeps_its_size_near_half_the_sampling_frequency(share):
    system = models.oscillator().system()
    dt, p = 0.1, np.array([1.0, 5.0, 9.0])
    omega, t = 2 * np.pi * share / dt, np.arange(400) * dt
    y = system.simulator(dt, intersample="smooth", substeps=4).rollout(p, [0, 0], np.sin(omega * t)[:, None])[:, 0]
    exact = np.imag(np.exp(1j * omega * t) / (p[2] - omega**2 + 1j * omega * p[1]))
    settled = slice(200, 380)
    assert np.std(y[settled] - exact[settled]) < 0.01 * np.std(exact[settled])


def test_a_diverged_rollout_is_nan_from_there_on():
    system = models.oscillator().system()
    for backend in ("c", "casadi") if compiler() else ("casadi",):
        simulator = system.simulator(0.01, substeps=1, backend=backend)
        y, by_p, _ = simulator.sensitivities([1.0, -300.0, 1.0], [1.0, 0.0], np.zeros((3000, 1)))
        first = int(np.argmax(np.isnan(y[:, 0])))
        assert 10 < first < 1000
        assert np.isnan(y[first:]).all()
        assert np.isfinite(y[:first]).all()
        assert np.isnan(by_p[first:]).all()


def test_a_system_without_inputs_swings_freely():
    system = models.pendulum()
    system.u, system.Q = (), [-system.p[1] * system.v[0]]
    y = system.system().simulator(0.01).rollout([1.0, 0.0, 1.0], [1e-3, 0.0], np.zeros((629, 0)))
    assert y[628, 0] == pytest.approx(1e-3, rel=1e-5)


@given(delay=st.floats(0, 0.5), seed=st.integers(0, 1000))
def test_delay_blends_neighbours_and_knows_its_slope(delay, seed):
    signal = np.random.default_rng(seed).normal(size=30)
    late, slope = delayed(signal, delay, 0.1)
    samples = np.arange(30) - delay / 0.1
    wanted = np.interp(samples, np.arange(30), signal)
    assert late == pytest.approx(wanted, abs=1e-9)
    if 1e-5 < (delay / 0.1) % 1 < 1 - 1e-5:
        numeric = (delayed(signal, delay + 1e-8, 0.1)[0] - delayed(signal, delay - 1e-8, 0.1)[0]) / 2e-8
        assert slope == pytest.approx(numeric, abs=1e-5)


def test_shapes_and_options_are_checked():
    simulator = models.pendulum().system().simulator(0.01)
    p, x0, u = [0.1, 0.1, 1.0], [0.0, 0.0], np.zeros((5, 1))
    for bad in ((p[:2], x0, u), (p, [0.0], u), (p, x0, np.zeros(5)), (p, x0, np.zeros((5, 2)))):
        with pytest.raises(InputError):
            simulator.rollout(*bad)
    with pytest.raises(InputError):
        models.pendulum().system().simulator(0.01, intersample="linear")
    with pytest.raises(InputError):
        models.pendulum().system().simulator(0.01, substeps=0)


def test_without_a_compiler_everything_works_but_c(monkeypatch):
    monkeypatch.setenv("SYSID_HARNESS_NO_COMPILER", "1")
    system = models.pendulum().system()
    y = system.simulator(0.01).rollout(system.vector(), [0.1, 0.0], np.zeros((20000, 1)))
    assert np.isfinite(y).all()
    with pytest.raises(InputError, match="compiler"):
        system.simulator(0.01, backend="c")


_ROLL = """
import numpy as np
from harness.physics import models
system = models.cart_pole().system()
print(system.simulator(0.013, backend="c").rollout(system.vector(), [0, 0.3, 0, 0], np.zeros((50, 1)))[-1].tolist())
"""


@needs_compiler
def test_processes_share_the_cache_of_compiled_code(tmp_path):
    environment = {**os.environ, "SYSID_HARNESS_CACHE": str(tmp_path)}
    started = [
        subprocess.Popen([sys.executable, "-c", _ROLL], env=environment, stdout=subprocess.PIPE, text=True)
        for _ in range(4)
    ]
    found = [process.communicate(timeout=120)[0] for process in started]
    assert found[0].startswith("[")
    assert all(one == found[0] for one in found)
    assert [file.suffix for file in tmp_path.iterdir()] == [".so"]


@needs_compiler
def test_c_source_is_static_and_needs_only_math(tmp_path):
    source = ccode.system_source(models.cart_pole().system(), "cart")
    functions = [line for line in source.splitlines() if line.endswith("{") and not line.startswith(" ")]
    assert functions
    assert all(line.startswith(("static void cart_", "static int cart_")) for line in functions)
    assert [line for line in source.splitlines() if line.startswith("#include")] == ["#include <math.h>"]


@needs_compiler
def test_the_exported_step_is_the_simulators_step(tmp_path):
    import ctypes

    system = models.cart_pole().system()
    source = ccode.system_source(system) + (
        "void go(double *x, const double *u, const double *p, double t, double h) { model_step(x, u, p, t, h); }\n"
        "void *keep[] = {model_output, model_initial};\n"
    )
    library = tmp_path / "m.so"
    subprocess.run(
        [*(compiler() or ()), "-O2", "-ffp-contract=off", "-shared", "-fPIC", "-x", "c", "-", "-o", library, "-lm"],
        input=source.encode(), check=True,
    )  # fmt: skip
    x, u, p = np.array([0.1, 0.4, 0.0, 0.2]), np.array([0.7]), system.vector()
    wanted = system.simulator(0.01, substeps=1).step(x, u, p)
    pointer = [one.ctypes.data_as(ctypes.c_void_p) for one in (x, u, p)]
    ctypes.CDLL(str(library)).go(*pointer, ctypes.c_double(0.0), ctypes.c_double(0.01))
    assert np.array_equal(x, wanted)


def test_simulators_of_a_pickled_system_agree():
    system = delayed_cart()
    again = pickle.loads(pickle.dumps(system))
    u, x0 = excitation(system, 50)
    p = system.vector()
    one, other = (s.simulator(0.01, substeps=2, backend="casadi").rollout(p, x0, u) for s in (system, again))
    assert np.array_equal(one, other)


@needs_compiler
@pytest.mark.parametrize("width", [0.05, 0.005, 0.001])
def test_dry_friction_reverses_within_a_step_without_losing_accuracy(width):
    from harness.effects import compose, place_all

    nominal = models.pendulum().system()
    rubbing = compose(nominal, [one for one in place_all(nominal) if str(one) == "coulomb_friction@theta"])
    p = rubbing.vector({"coulomb_friction@theta.Fc": 0.1, "coulomb_friction@theta.w": width})
    t = np.arange(2000) * 0.004
    u = (0.4 * np.sin(3 * t) + 0.3 * np.sin(7.1 * t + 1))[:, None]
    fine = rubbing.simulator(0.004, substeps=64).rollout(p, [0.3, 0.0], u)
    plain = rubbing.simulator(0.004, substeps=1).rollout(p, [0.3, 0.0], u)
    slow = rubbing.simulator(0.004, substeps=1, backend="casadi").rollout(p, [0.3, 0.0], u)
    assert np.abs(plain - fine).max() < 1e-4
    assert np.array_equal(plain, slow)


@given(parts=st.integers(0, 600), seed=st.integers(0, 1000))
def test_a_held_input_that_arrives_within_a_sample_moves_a_mass_as_one_that_does(parts: int, seed: int) -> None:
    """The mean over the sample put a light joint 0.3 mrad aside at every step of its command, a spring's work."""
    system, fine = models.cart_pole().system(), 200  # parts of a sample, each of which holds its input
    delay = 0.01 * parts / fine
    late = compose(system, [Placed(builtin()["input_delay"], "u", {"tau": delay})])
    u, x0 = excitation(system, 40, seed)
    u *= 10.0
    found = late.simulator(0.01, backend="casadi").rollout(late.vector(), x0, u)
    held = np.repeat(u, fine, axis=0)
    moved = np.concatenate([np.repeat(held[:1], parts, axis=0), held])[: (len(u) - 1) * fine + 1]
    truth = system.simulator(0.01 / fine, backend="casadi", substeps=1).rollout(system.vector(), x0, moved)[::fine]
    mean = system.simulator(0.01, backend="casadi").rollout(
        system.vector(), x0, delayed(u[:, 0], delay, 0.01)[0][:, None]
    )
    assert np.sqrt(np.mean((found - truth) ** 2)) <= 0.3 * np.sqrt(np.mean((mean - truth) ** 2)) + 1e-7
