"""How much a law changes of a motion, and a plant without the motor that its nominal fit holds."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harness.diagnosis.directions.changed import changed_share
from harness.diagnosis.directions.lightened import lightened
from harness.diagnosis.directions.trace import Trace
from harness.effects import builtin
from harness.effects.compose import compose
from harness.effects.effect import Placed
from harness.physics import load_model
from harness.physics.compiled.kalman_pass import KalmanPass
from harness.physics.compiled.latent import without_latent_forces
from harness.signals import Channel, PlantSpec, Trajectory

DT = 0.002
PENDULUM = {"J": 0.25, "b": 0.05, "mgl": 4.9}
RATE = [load_model("pendulum").states[1].name]


def trace_of(system: Any, values: dict[str, float], x: np.ndarray, u: np.ndarray) -> Trace:
    """Return states (n, nx) of a system as if they had been smoothed."""
    spec = PlantSpec((Channel("u", "N m"),), (Channel("theta", "rad"),), DT)
    record = Trajectory(np.arange(len(u)) * DT, u[:, None], x[:, :1], spec)
    return Trace(record, x, KalmanPass(without_latent_forces(system), DT), system.vector(values), ("theta",))


def some_motion(seed: int, n: int = 400) -> tuple[np.ndarray, np.ndarray]:
    """Return angles, rates and torques that need not follow from each other: shares are of single samples."""
    rng = np.random.default_rng(seed)
    return rng.normal(size=(n, 2)) * [0.5, 2.0], rng.normal(size=n)


# ---- what an effect changes ------------------------------------------------------------------------------------------


@settings(max_examples=6, deadline=None)
@given(seed=st.integers(0, 1000), size=st.floats(-6, -1))
def test_the_share_of_a_force_is_its_rms_over_that_of_all_forces(seed: int, size: float) -> None:
    nominal = load_model("pendulum")
    law = Placed(builtin()["force_bias"], "theta")
    whole = compose(nominal, [law])
    values = {**PENDULUM, law.main(): 10.0**size}
    x, u = some_motion(seed)
    found = changed_share([trace_of(whole, values, x, u)], whole, nominal, RATE)
    held = u[:-1]
    force = held - PENDULUM["b"] * x[:-1, 1] - PENDULUM["mgl"] * np.sin(x[:-1, 0]) + values[law.main()]
    assert found == pytest.approx(10.0**size / np.sqrt(np.mean(force**2)), rel=0.02)


def test_the_share_of_a_sensor_is_that_of_its_readings_and_of_a_delay_that_of_late_inputs() -> None:
    nominal, (x, u) = load_model("pendulum"), some_motion(1)
    gain = Placed(builtin()["sensor_gain"], "theta")
    whole = compose(nominal, [gain])
    free = [one for one in gain.effect.parameters if not one.fixed]
    values = {**PENDULUM, gain.name(free[0].name): 1.002}
    read = 1.002 * x[:, 0]
    expected = np.sqrt(np.mean((0.002 * x[:, 0]) ** 2)) / (read - read.mean()).std()
    assert changed_share([trace_of(whole, values, x, u)], whole, nominal, RATE) == pytest.approx(expected, rel=0.01)
    delay = Placed(builtin()["input_delay"], "u")
    whole = compose(nominal, [delay])
    shares = []
    for late in (1e-6, 1e-4):
        shares.append(
            changed_share([trace_of(whole, {**PENDULUM, delay.main(): late}, x, u)], whole, nominal, RATE)  # type: ignore[dict-item]
        )
    assert shares[1] / shares[0] == pytest.approx(100.0, rel=0.05)


def test_what_drives_a_motor_changes_its_speed_before_the_joint_moves() -> None:
    """Within one sample a torque behind an elastic joint moves the motor alone: the joint's rate would not show it."""
    nominal, (x, u) = load_model("pendulum"), some_motion(5)
    joint, gain = Placed(builtin()["elasticity"], "theta"), Placed(builtin()["input_gain"], "u")
    less, whole = compose(nominal, [joint]), compose(nominal, [joint, gain])
    motor = joint.name("w")
    own = {joint.name("k"): 40.0, joint.name("Jm"): 0.03, joint.name("d"): 0.05}
    states = np.column_stack([x, np.zeros((len(x), 2))])
    trace = trace_of(whole, {**PENDULUM, **own, gain.main(): 0.97}, states, u)  # type: ignore[dict-item]
    seen, unseen = (changed_share([trace], whole, less, names) for names in ([*RATE, motor], RATE))
    assert seen > 0.01
    assert unseen < 0.01 * seen
    assert changed_share([trace], whole, nominal, [*RATE, motor]) > 0.1, "a state that one of them lacks is left out"


def test_a_law_of_size_zero_changes_nothing() -> None:
    nominal, (x, u) = load_model("pendulum"), some_motion(2)
    law = Placed(builtin()["coulomb_friction"], "theta")
    whole = compose(nominal, [law])
    values = {**PENDULUM, **{law.name(one.name): 0.1 for one in law.effect.parameters}, law.main(): 0.0}
    assert changed_share([trace_of(whole, values, x, u)], whole, nominal, RATE) < 1e-9


def test_what_other_parameters_do_as_well_is_no_change() -> None:
    """A second viscous friction beside the nominal's own: with that one moved along, nothing is left of it."""
    nominal, (x, u) = load_model("pendulum"), some_motion(3)
    law = Placed(builtin()["viscous_friction"], "theta")
    whole = compose(nominal, [law])
    trace = trace_of(whole, {**PENDULUM, "b": 0.04, law.main(): 0.01}, x, u)  # type: ignore[dict-item]
    assert changed_share([trace], whole, nominal, RATE) > 1e-3
    moved, wrong = (trace_of(nominal, {**PENDULUM, "b": b}, x, u) for b in (0.05, 0.06))
    assert changed_share([trace], whole, nominal, RATE, [moved]) < 1e-9
    assert changed_share([trace], whole, nominal, RATE, [wrong]) > 1e-3


@pytest.mark.parametrize(("relaxation", "other"), [(1e6, False), (1.0, True)])
def test_a_maxwell_element_that_never_relaxes_is_the_spring_and_one_that_does_is_not(
    relaxation: float, other: bool
) -> None:
    """In one sample either is nearly a spring; what was lost in the samples before stands in the hidden strain."""
    nominal = load_model("pendulum")
    spring, maxwell = (Placed(builtin()[name], "theta") for name in ("linear_spring", "maxwell_element"))
    less, whole = compose(nominal, [spring]), compose(nominal, [maxwell])
    t = np.arange(2000) * DT
    x, u = np.column_stack([np.sin(3 * t), 3 * np.cos(3 * t)]), np.cos(t)
    strain = np.zeros(len(t))
    for k in range(len(t) - 1):
        strain[k + 1] = strain[k] + DT * (x[k, 1] - strain[k] / relaxation)
    mine = trace_of(
        whole, {**PENDULUM, maxwell.name("k"): 0.5, maxwell.name("tau"): relaxation}, np.column_stack([x, strain]), u
    )
    theirs = trace_of(less, {**PENDULUM, spring.name("k"): 0.5}, x, u)
    share = changed_share([mine], whole, less, RATE, [theirs])
    assert share > 0.01 if other else share < 1e-3


def test_a_law_differs_by_its_own_values_and_hidden_states() -> None:
    nominal, (x, u) = load_model("pendulum"), some_motion(4)
    plain, refined = (
        Placed(builtin()[name], "theta") for name in ("lugre_coulomb_friction", "lugre_asymmetric_friction")
    )
    less, whole = compose(nominal, [plain]), compose(nominal, [refined])
    bristles = {"xs": 0.3, "tau": 0.01, "T": 0.001}
    bent = 0.2 * np.tanh(x[:, 1])
    own = {plain.name(key): size for key, size in {**bristles, "Fc": 0.2}.items()}
    shares = []
    for forwards, backwards, hidden in ((0.2, 0.2, 1.0), (0.3, 0.1, 1.0), (0.2, 0.2, 0.5)):
        sizes = {**bristles, "Fp": forwards, "Fm": backwards}
        mine = trace_of(whole, {**PENDULUM, **{refined.name(key): size for key, size in sizes.items()}},
                        np.column_stack([x, bent]), u)  # fmt: skip
        theirs = trace_of(less, {**PENDULUM, **own}, np.column_stack([x, hidden * bent]), u)
        shares.append(changed_share([mine], whole, less, RATE, [theirs]))
    assert shares[0] < 1e-9, "the same levels, the same bristles"
    assert shares[1] > 0.001, "other levels"
    assert shares[2] > 0.001, "other bristles"


# ---- without the motor -----------------------------------------------------------------------------------------------


@settings(max_examples=6, deadline=None)
@given(seed=st.integers(0, 1000), share=st.floats(0.01, 0.7))
def test_a_plant_without_its_motor_is_lighter_by_it_and_alike_otherwise(seed: int, share: float) -> None:
    nominal, (x, u) = load_model("pendulum"), some_motion(seed)
    trace = trace_of(nominal, PENDULUM, x, u)
    found = lightened([trace], nominal, PENDULUM, list(PENDULUM), "theta", share * PENDULUM["J"])
    assert found == pytest.approx({**PENDULUM, "J": (1 - share) * PENDULUM["J"]})


def test_a_motor_heavier_than_the_plant_leaves_something_of_the_plant() -> None:
    nominal, (x, u) = load_model("pendulum"), some_motion(0)
    found = lightened([trace_of(nominal, PENDULUM, x, u)], nominal, PENDULUM, ["J"], "theta", 3 * PENDULUM["J"])
    assert 0.0 < found["J"] < PENDULUM["J"]


@pytest.mark.parametrize("inertia", [0.05, 0.15])
def test_only_what_is_free_moves(inertia: float) -> None:
    nominal, (x, u) = load_model("pendulum"), some_motion(3)
    trace = trace_of(nominal, PENDULUM, x, u)
    both = [trace, replace(trace, x=trace.x[::-1].copy())]
    assert set(lightened(both, nominal, PENDULUM, ["J"], "theta", inertia)) == {"J"}
