"""What happens once in a record is found at its instant, where it was fitted and where it is judged."""

from __future__ import annotations

import numpy as np
import pytest

from harness.diagnosis.algorithm import diagnose
from harness.diagnosis.kinds import EquationsKind
from harness.effects import builtin
from harness.effects.effect import Placed
from harness.physics import load_model
from harness.signals import Channel, Dataset, PlantSpec, Run, Trajectory

from .conftest import multisine

pytestmark = pytest.mark.slow  # whole loops

DT, N, NOISE = 0.01, 2000, 1e-3
J, B, MGL, MORE_J, MORE_G = 0.1, 0.05, 1.0, 0.01, 0.15
LAW = Placed(builtin()["payload_step"], "theta")


def record(seed: int, instant: float, *, moving: bool = False, force: float = 0.0, until: float = np.inf) -> Trajectory:
    """Return a pendulum that picks up a load, or that a force pushes from an instant on, by Heun's method.

    It is pushed from time to time, or all the time.
    """
    heavier = 0.0 if force else 1.0
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.normal(size=N // 100), 100) * np.tile([1.0, 0.0], N // 200).repeat(100) * 0.4
    if moving:
        u = multisine(N, DT, rng, 0.7)

    def rates(x: np.ndarray, torque: float, t: float) -> np.ndarray:
        loaded = heavier * (t >= instant)
        total = torque - B * x[1] - (MGL + MORE_G * loaded) * np.sin(x[0]) + force * (instant <= t < until)
        return np.array([x[1], total / (J + MORE_J * loaded)])

    x, angles, fine = np.array([0.3, 0.0]), [], 5
    for k in range(N):
        angles.append(x[0])
        for part in range(fine):
            t, h = k * DT + part * DT / fine, DT / fine
            first = rates(x, u[k], t)
            x = x + 0.5 * h * (first + rates(x + h * first, u[k], t + h))
    y = np.array(angles)[:, None] + NOISE * rng.normal(size=(N, 1))
    spec = PlantSpec((Channel("u", "N m"),), (Channel("theta", "rad", period=2 * np.pi),), DT)
    return Trajectory(np.arange(N) * DT, u[:, None], y, spec)


@pytest.mark.parametrize(("fitted", "judged", "begun"), [(7.3, 13.9, 7.0), (13.9, 5.6, 11.5)])
def test_a_load_is_found_when_it_was_picked_up(fitted: float, judged: float, begun: float) -> None:
    """Along the instant the likelihood is a staircase: steps stop on the tread that they begin on."""
    runs = Run(record(0, fitted), "estimation"), Run(record(1, judged), "validation")
    form = EquationsKind().form(load_model("pendulum"), Dataset("load", runs))
    nominal = form.fit((), form.first_starts(), None)
    assert nominal is not None
    start = {LAW.name("dJ"): MORE_J, LAW.name("dG"): MORE_G, LAW.name("t0"): begun}
    fit = form.fit([LAW], [{**nominal.values, **start}], nominal)
    assert fit is not None
    assert fit.values[LAW.name("t0")] == pytest.approx(fitted, abs=0.1)
    assert fit.own[LAW.name("t0")] == pytest.approx(judged, abs=0.1)
    assert fit.values[LAW.name("dG")] == pytest.approx(MORE_G, rel=0.1)


def test_a_free_run_has_the_load_when_the_validation_record_picked_it_up() -> None:
    """A free run fitted from a grid of instants ended two seconds off, and erred by 0.15 rad with all else right."""
    runs = Run(record(4, 6.0, moving=True), "estimation"), Run(record(5, 10.0, moving=True), "validation")
    found = diagnose(Dataset("load", runs), load_model("pendulum"), dictionary=[LAW.effect])
    assert [str(accepted.placed) for accepted in found.outcome.accepted] == [str(LAW)]
    after = found.runs.after
    assert after is not None
    assert after.refitted[LAW.name("t0")] == pytest.approx(10.0, abs=0.05)
    errors = after.validation[0] * found.runs.output.weights
    assert np.sqrt(np.mean(errors**2)) < 1.1 * NOISE


@pytest.mark.parametrize(("first", "second"), [(7.31, 12.87), (13.13, 4.49)])
def test_a_force_that_sets_in_is_named_with_its_instants(first: float, second: float) -> None:
    """A force that remembers takes a step up: beside it nothing was said to be missing, five times of five."""
    runs = [Run(record(6, first, moving=True, force=0.08), "estimation")]
    runs += [Run(record(7, second, moving=True, force=0.08), "validation")]
    found = diagnose(Dataset("load", tuple(runs)), load_model("pendulum"))
    assert [str(accepted.placed) for accepted in found.outcome.accepted] == ["force_step@theta"]
    assert found.grade == "explained"
    assert found.final.values["force_step@theta.F"] == pytest.approx(0.08, rel=0.05)
    assert found.final.values["force_step@theta.t0"] == pytest.approx(first, abs=0.05)
    assert not found.jumps


def test_a_force_that_comes_and_goes_is_no_step_and_not_nothing() -> None:
    runs = [Run(record(8, 8.0, moving=True, force=0.1, until=12.0), "estimation")]
    runs += [Run(record(9, 6.0, moving=True, force=0.1, until=11.0), "validation")]
    found = diagnose(Dataset("load", tuple(runs)), load_model("pendulum"))
    assert found.verdict == "unexplained"
    for use, times in (("estimation", (8.0, 12.0)), ("validation", (6.0, 11.0))):
        told = sorted(jump.time for jump in found.jumps if jump.use == use)
        assert told == pytest.approx(times, abs=0.1)


def loaded_cart(seed: int, instant: float, *, more: float) -> Trajectory:
    """Return a cart-pole whose pole picks up a load at its tip, by Heun's method in fine steps."""
    rng = np.random.default_rng(seed)
    u = multisine(N, DT, rng, 3.0)
    cart, tip, length = 1.0, 0.3, 0.5

    def rates(x: np.ndarray, force: float, t: float) -> np.ndarray:
        m = tip + more * (t >= instant)
        sine, cosine = np.sin(x[1]), np.cos(x[1])
        matrix = np.array([[cart + m, m * length * cosine], [m * length * cosine, m * length**2]])
        pushes = [force - 0.5 * x[2] + m * length * x[3] ** 2 * sine, -0.01 * x[3] - m * 9.81 * length * sine]
        return np.concatenate([x[2:], np.linalg.solve(matrix, pushes)])

    x, places, fine = np.zeros(4), [], 4
    for k in range(N):
        places.append(x[:2])
        for part in range(fine):
            t, h = k * DT + part * DT / fine, DT / fine
            first = rates(x, u[k], t)
            x = x + 0.5 * h * (first + rates(x + h * first, u[k], t + h))
    y = np.array(places) + NOISE * rng.normal(size=(N, 2))
    system = load_model("cart-pole")
    return Trajectory(np.arange(N) * DT, u[:, None], y, PlantSpec(system.inputs, system.outputs, DT))


def test_a_load_on_a_body_that_several_coordinates_move_is_named_with_its_mass() -> None:
    """It is no force on one of them: called a damping that drifts, three times of three, before it had a law."""
    runs = Run(loaded_cart(1, 7.3, more=0.1), "estimation"), Run(loaded_cart(2, 12.1, more=0.1), "validation")
    found = diagnose(Dataset("load", runs), load_model("cart-pole"))
    assert [str(accepted.placed) for accepted in found.outcome.accepted] == ["mass_step@mp"]
    assert found.grade == "explained"
    assert found.final.values["mass_step@mp.dm"] == pytest.approx(0.1, rel=0.05)
    assert found.final.values["mass_step@mp.t0"] == pytest.approx(7.3, abs=0.1)
