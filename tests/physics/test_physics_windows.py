"""Windows of records: the sums of the compiled roll-out are those of the full sensitivities."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from harness.effects import compose, place_all
from harness.fmi.build import compiler
from harness.physics import Parameter, SampledBlock, models
from harness.physics.compiled import compilation
from harness.physics.compiled.windows import Windows
from harness.physics.fitting.levenberg import eliminated, minimise, minimise_states
from harness.signals import PlantSpec, Trajectory

needs_compiler = pytest.mark.skipif(compiler() is None, reason="no C compiler: install gcc")
SIGMA = np.array([2e-3, 5e-3])


def late_input():
    """Return a cart-pole with a late input, its sensors on time."""
    system = models.cart_pole().system()
    return compose(system, [one for one in place_all(system) if str(one) == "input_delay@u"])


def rubbing():
    """Return a cart-pole whose pole rubs: finer steps where it turns."""
    system = models.cart_pole().system()
    return compose(system, [one for one in place_all(system) if str(one) == "coulomb_friction@theta"])


def late_sensor():
    """Return a cart-pole whose angle comes late: that acts on the samples, after the roll-out."""
    lag = ca.SX.sym("lag")
    blocks = [SampledBlock("output_delay", 1, "lag")]
    return models.cart_pole().system().rebuild(parameters=[(Parameter("lag", "s", 0.007), lag)], sampled=blocks)


def records(system, counts=(230, 170), seed=0, dt=0.01):
    """Return noisy runs of a system that turn over, so that the angle wraps."""
    rng = np.random.default_rng(seed)
    spec = PlantSpec(system.inputs, system.outputs, dt, system.states, system.feedthrough)
    found = []
    for count in counts:
        u = 12 * np.cumsum(rng.normal(size=(count, 1)), axis=0) / np.sqrt(count)
        x0 = np.zeros(system.nx)
        x0[:4] = [0.1, 2.5, 0.2, 3.0]
        simulator = system.simulator(dt, substeps=2, backend="casadi")
        y = simulator.rollout(system.vector(), x0, u) + SIGMA * rng.normal(size=(count, 2))
        y[:, 1] = (y[:, 1] + np.pi) % (2 * np.pi) - np.pi
        found.append(Trajectory(np.arange(count) * dt, u, y, spec))
    return found


def made(system, intersample="zoh", backend="auto", horizon=0.5):
    """Return windows of two lengths, start states near the motion, and parameters off the nominal ones."""
    runs = records(system)
    windows = Windows(
        system.simulator(0.01, substeps=2, intersample=intersample, backend=backend), runs, horizon, SIGMA
    )
    assert len(windows.groups) > 1
    rng = np.random.default_rng(1)
    x0 = 0.3 * rng.normal(size=(len(windows), system.nx))
    x0[:, 1] += [runs[number].y[first, 1] for number, first, _ in windows.places]
    return windows, system.vector() * np.exp(0.1 * rng.normal(size=system.np)), x0


def reference(windows, p, x0):
    """Return costs, squares, gram, gradient, residuals and states by window from the full sensitivities."""
    simulator = windows.simulator
    rows = []
    for row, (number, first, last) in enumerate(windows.places):
        run = windows.trajectories[number]
        u, input_jacobian = simulator.seen(run.u[None], p[None], True)
        part = slice(first * simulator.pieces, (last - 1) * simulator.pieces + 1)
        cut = None if input_jacobian is None else input_jacobian[:, part]
        x, y, s = simulator.windows(p[None], x0[row][None], u[:, part], cut, run.t[first : first + 1])
        r = run.y[first:last] - y[0]
        for column, channel in enumerate(simulator.spec.outputs):
            if channel.period is not None:
                r[:, column] -= channel.period * np.round(r[:, column] / channel.period)
        weighted = (r / SIGMA).ravel()
        j = (s[0] / SIGMA[:, None]).reshape(len(weighted), -1)
        rows.append((0.5 * weighted @ weighted, (r**2).sum(axis=0), j.T @ j, j.T @ weighted, r, x[0]))
    return rows


@needs_compiler
@pytest.mark.parametrize("intersample", ["zoh", "foh", "smooth"])
@pytest.mark.parametrize("make", [lambda: models.cart_pole().system(), late_input, rubbing, late_sensor])
def test_sums_of_the_rollout_are_those_of_the_sensitivities(make, intersample):
    windows, p, x0 = made(make(), intersample)
    found = windows.evaluate(p, x0, keep=True, jacobian=True)
    wanted = reference(windows, p, x0)
    assert windows.simulator.spec.outputs[1].period == pytest.approx(2 * np.pi)
    for row, (cost, _, gram, gradient, r, x) in enumerate(wanted):
        assert found.costs[row] == pytest.approx(cost, rel=1e-12)
        size = np.sqrt(np.diag(gram))
        assert np.abs(found.gram[row] - gram).max(initial=0.0, where=gram == 0) == 0
        assert found.gram[row] == pytest.approx(gram, rel=1e-12, abs=1e-12 * np.outer(size, size).max())
        assert found.gradient[row] == pytest.approx(gradient, rel=1e-12, abs=1e-12 * np.sqrt(2 * cost) * size.max())
        assert found.residuals[row] == pytest.approx(r, rel=0, abs=1e-12)
        assert np.array_equal(found.states[row], x)
    assert found.squares == pytest.approx(sum(one[1] for one in wanted), rel=1e-12)
    assert found.cost == pytest.approx(sum(one[0] for one in wanted), rel=1e-12)
    assert found.jacobian == pytest.approx(windows.jacobian(p, x0), rel=1e-9, abs=1e-9)


@needs_compiler
def test_virtual_machine_and_compiled_sums_agree():
    windows, p, x0 = made(rubbing())
    slow, _, _ = made(rubbing(), backend="casadi")
    one, other = windows.evaluate(p, x0, keep=True), slow.evaluate(p, x0, keep=True)
    assert one.costs == pytest.approx(other.costs, rel=1e-12)
    assert one.gram == pytest.approx(other.gram, rel=1e-11, abs=1e-12 * np.abs(other.gram).max())
    assert all(np.array_equal(a, b) for a, b in zip(one.states, other.states, strict=True))


@needs_compiler
def test_chosen_columns_are_those_of_the_whole():
    windows, p, x0 = made(late_input())
    whole = windows.evaluate(p, x0)
    ns = whole.gram.shape[1]
    for columns in ([0, 3, ns - 1], list(range(windows.simulator.np, ns)), list(range(ns))):
        some = windows.trial(p, x0, columns=np.array(columns))
        place = np.ix_(range(len(windows)), columns, columns)
        assert np.array_equal(some.gram[place], whole.gram[place])
        assert np.array_equal(some.gradient[:, columns], whole.gradient[:, columns])
        assert np.array_equal(some.costs, whole.costs)
        rest = np.setdiff1d(np.arange(ns), columns)
        assert not some.gram[:, rest].any()


@needs_compiler
def test_windows_over_their_limit_are_given_up():
    windows, p, x0 = made(models.cart_pole().system())
    whole = windows.evaluate(p, x0)
    limits = whole.costs * np.where(np.arange(len(windows)) % 3 == 0, 0.9, 1.1)
    limits[1] = -1.0
    some = windows.trial(p, x0, limits=limits)
    over = limits < whole.costs
    assert over.any()
    assert not over.all()
    assert np.isinf(some.costs[over]).all()
    assert np.array_equal(some.costs[~over], whole.costs[~over])
    assert np.array_equal(some.gram[~over], whole.gram[~over])
    assert windows.trial(p, x0, budget=whole.cost * (1 + 1e-9)).cost == whole.cost
    assert windows.trial(p, x0, budget=whole.cost * 0.99).cost == np.inf


def test_a_diverging_window_costs_infinitely_much_and_spares_the_others():
    windows, p, x0 = made(models.cart_pole().system(), backend="auto" if compiler() else "casadi")
    whole = windows.evaluate(p, x0)
    x0 = x0.copy()
    x0[2, 3] = 1e200
    found = windows.evaluate(p, x0, keep=True, jacobian=True)
    assert np.isinf(found.costs[2])
    assert found.cost == np.inf
    assert found.jacobian is None
    assert np.isnan(found.residuals[2]).any()
    rest = np.arange(len(windows)) != 2
    assert np.array_equal(found.costs[rest], whole.costs[rest])
    assert np.array_equal(found.gram[rest], whole.gram[rest])


def test_sums_of_squares_beyond_all_numbers_end_in_no_step_and_no_warning():
    gram = np.full((2, 3, 3), 1e308)
    gram[:, 0, 0] = np.inf
    matrix, _, _ = eliminated(gram, np.full((2, 3), 1e300), 1, 1e-3, True)
    assert not np.isfinite(matrix).any()


@needs_compiler
@pytest.mark.parametrize("make", [lambda: models.cart_pole().system(), late_input])
def test_fits_end_where_those_of_the_virtual_machine_end(make):
    ends = []
    for backend in ("auto", "casadi"):
        windows, p, x0 = made(make(), backend=backend)
        free = np.arange(len(p)) != 1
        start = minimise_states(windows, p, x0, 8)
        ends.append((start, minimise(windows, p, start, free, 12)))
    (start, fast), (other, slow) = ends
    assert start == pytest.approx(other, rel=1e-7, abs=1e-9)
    assert fast.message == slow.message
    assert fast.p == pytest.approx(slow.p, rel=1e-6)
    assert fast.p[1] == slow.p[1]
    assert fast.evaluation.cost == pytest.approx(slow.evaluation.cost, rel=1e-9)


def test_code_for_another_processor_is_another_file(monkeypatch):
    known = {}
    for flags in ((), ("-mavx2",)):
        monkeypatch.setattr(compilation, "_machine_flags", lambda flags=flags: flags)
        known[flags] = compilation.Compilation("int one(void) { return 1; }").path
    assert known[()] != known["-mavx2",]
