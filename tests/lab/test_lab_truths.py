"""The hand-written truths: against closed forms, the energy, our simulator without effect, and finer steps."""

from __future__ import annotations

import numpy as np
import pytest
from sysid_lab.truths.applied import actuated
from sysid_lab.truths.simulation import DT, SUBSTEPS, simulate

from harness.errors import InputError

PENDULUM = {"J": 0.1, "mgl": 2.0, "b0": 0.05}
CART = {"dof": 2.0, "mc": 1.0, "mp": 0.2, "l": 0.5, "b0": 0.4, "b1": 0.004}


@pytest.fixture(scope="module")
def command() -> np.ndarray:
    """Return a smooth force (N,)."""
    t = np.arange(1500) * DT
    return np.asarray(0.8 * np.sin(2.1 * t) + 0.6 * np.sin(5.3 * t + 1.0))


@pytest.mark.parametrize(
    ("model", "truth", "values", "scale"),
    [
        ("pendulum", PENDULUM, {"J": 0.1, "mgl": 2.0, "b": 0.05}, 1.0),
        ("cart-pole", CART, {"mc": 1.0, "mp": 0.2, "l": 0.5, "bx": 0.4, "btheta": 0.004}, 4.0),
    ],
)
def test_without_effect_the_truth_is_our_model(model, truth, values, scale, command):
    from harness.physics import load_model
    from harness.physics.compiled.simulator import Simulator

    system = load_model(model)
    start = np.zeros(2 * len(system.coordinates))
    start[len(system.coordinates) - 1] = 0.4
    ours = Simulator(system, DT, substeps=10, backend="casadi").rollout(
        system.vector(values), start, scale * command[:, None]
    )
    theirs = simulate(truth, scale * command, start=start)
    assert np.abs(ours[: len(command)] - theirs.q).max() < 1e-7


def test_a_free_swing_without_friction_keeps_its_energy():
    values = {**CART, "b0": 0.0, "b1": 0.0}
    motion = simulate(values, np.zeros(2000), start=np.array([0.0, 2.0, 0.3, 0.0]))
    (_, theta), (vx, w) = motion.q.T, motion.v.T
    kinetic = 0.5 * 1.2 * vx**2 + 0.1 * vx * w * np.cos(theta) + 0.5 * 0.05 * w**2
    energy = kinetic - 0.2 * 9.81 * 0.5 * np.cos(theta)
    assert np.ptp(energy) < 1e-8


def test_sliding_stops_where_the_closed_form_says_and_stays():
    Fc, J, speed = 0.5, 0.2, 3.0
    motion = simulate({"J": J, "Fp0": Fc, "Fm0": Fc}, np.full(800, 0.4), start=np.array([0.0, speed]))
    slowing = (Fc - 0.4) / J
    assert motion.q[-1, 0] == pytest.approx(speed**2 / (2 * slowing), rel=1e-9) or motion.v[-1, 0] > 0
    motion = simulate({"J": J, "Fp0": Fc, "Fm0": Fc}, np.zeros(800), start=np.array([0.0, speed]))
    assert motion.q[-1, 0] == pytest.approx(J * speed**2 / (2 * Fc), rel=1e-9)
    assert motion.v[-1, 0] == 0.0


def test_a_stuck_cart_is_moved_by_the_pole_only_beyond_its_friction():
    held = simulate({**CART, "Fp0": 50.0, "Fm0": 50.0}, np.zeros(500), start=np.array([0.0, 1.0, 0.0, 0.0]))
    loose = simulate({**CART, "Fp0": 0.3, "Fm0": 0.3}, np.zeros(500), start=np.array([0.0, 1.0, 0.0, 0.0]))
    assert np.ptp(held.q[:, 0]) == 0.0
    assert np.ptp(held.q[:, 1]) > 1.0
    assert np.ptp(loose.q[:, 0]) > 1e-3


@pytest.mark.parametrize(
    "law",
    [
        {"Fp0": 0.2, "Fm0": 0.1},
        {"Fss0": 0.3, "Fst0": 0.1, "vs0": 0.5},
        {"mu0": 0.05},
        {"Fpos0": 0.1, "pa0": 0.5},
        {"c0": 0.02},
        {"Fh0": 0.1, "xs0": 0.05},
        {"root0": 0.05},
    ],
    ids=lambda law: "+".join(law),
)
def test_every_friction_takes_energy_out(law):
    start = np.array([1.5, 0.0])
    free, braked = (simulate({"J": 0.1, "mgl": 2.0, **extra}, np.zeros(1500), start=start) for extra in ({}, law))
    energy = 0.05 * braked.v[:, 0] ** 2 - 2.0 * np.cos(braked.q[:, 0])
    assert np.abs(free.q).max() == pytest.approx(1.5, rel=1e-6)
    assert energy[-1] < energy[0] - 0.1


@pytest.mark.parametrize("stiffness", [10.0, 200.0])
def test_bristles_carry_their_level_at_any_speed(stiffness):
    """At 9 rad/s those of a study settled sooner than its steps followed, and braked more than their level."""
    plant = {"J": 0.1, "b0": 0.0, "mgl": 0.0, "Fss0": 0.05, "Fst0": 0.05, "vs0": 1.0, "bs0": stiffness, "bd0": 0.1}
    motion = simulate(plant, np.zeros(250), start=np.array([0.0, 20.0]))
    assert np.diff(motion.v[50:, 0]) == pytest.approx(np.full(199, -0.05 / 0.1 * 0.004), rel=1e-3)


@pytest.mark.parametrize("law", [{"Fp0": 0.1, "Fm0": 0.1}, {"gap": 0.05, "kt": 50.0, "dt": 0.5, "Jm": 0.02}])
def test_a_finer_step_changes_nothing_that_a_sensor_sees(law, command):
    coarse, fine = (simulate({**PENDULUM, **law}, command, start=np.zeros(2), substeps=n) for n in (20, 160))
    assert np.abs(coarse.q - fine.q).max() < 1e-5


def test_what_an_actuator_does_to_the_command(command):
    def passed(**law):
        return simulate({**PENDULUM, **law}, command, start=np.zeros(2)).passed

    assert np.abs(passed(limit=0.5)).max() == 0.5
    assert (passed(width=0.3)[np.abs(command) < 0.3] == 0).all()
    assert passed(delay=2 * DT)[10:] == pytest.approx(command[8:-2])
    assert np.abs(np.diff(passed(R=2.0))).max() <= 2.0 * DT * 1.0001
    lagged = passed(tau=0.05)
    assert lagged[1200] == pytest.approx(
        0.8 / np.hypot(1, 0.105) * np.sin(2.1 * 1200 * DT - np.arctan(0.105))
        + 0.6 / np.hypot(1, 0.265) * np.sin(5.3 * 1200 * DT + 1.0 - np.arctan(0.265)),
        abs=0.02,
    )


def test_a_late_sensor_shows_what_was(command):
    motion = simulate({**PENDULUM, "sdelay0": 3 * DT}, command, start=np.array([0.2, 0.0]))
    assert motion.reading[10:, 0] == pytest.approx(motion.q[7:-3, 0])


def test_the_tilted_pendulum_hangs_where_the_dictionary_says():
    motion = simulate({**PENDULUM, "tilt": 0.1}, np.zeros(8000), start=np.zeros(2))
    assert motion.q[-1, 0] == pytest.approx(-0.1, abs=1e-4)


def test_an_unknown_parameter_is_refused():
    with pytest.raises(InputError, match=r"parameter of a truth.*'typo'"):
        simulate({"typo": 1.0}, np.zeros(3), start=np.zeros(2))


# ---- what intervals are compared with -------------------------------------------------------------------------------


def test_a_heavy_rod_is_a_lighter_point_mass_farther_out(command):
    """The same motion: the model holds it, with other values than those that were drawn."""
    from sysid_lab.plan import Task
    from sysid_lab.records import _of_the_model

    drawn = {"mc": 1.0, "mp": 0.2, "l": 0.5, "bx": 0.4, "btheta": 0.004}
    task = Task("none", "cart-pole", "laws", (), "", "drawn", 0.0, 0, 0, structure="heavy-rod")
    known = _of_the_model(task, drawn)
    start = np.array([0.0, 0.5, 0.0, 0.0])
    rod = simulate(CART | {"rod": 0.03}, command, start=start).q
    point = simulate(CART | {name: known[name] for name in ("mc", "mp", "l")}, command, start=start).q
    assert np.abs(rod - point).max() < 1e-9
    assert np.abs(rod - simulate(CART, command, start=start).q).max() > 1e-3
    assert _of_the_model(Task("none", "cart-pole", "laws", (), "", "drawn", 0.0, 0, 0), drawn) == drawn


@pytest.mark.parametrize(
    ("engine", "effects", "structure", "accepted", "holds"),
    [
        ("laws", (), "", (), "yes"),
        ("laws", ("quadratic_drag@theta",), "", ("quadratic_drag@theta",), "yes"),
        ("laws", ("quadratic_drag@theta",), "", (), "no"),
        ("laws", ("coulomb_friction@theta",), "", ("stribeck_friction@theta",), "yes"),
        ("hardware", ("coulomb_friction@theta",), "", ("coulomb_friction@theta",), "no"),
        ("laws", (), "bent-scale", ("sensor_nonlinearity@theta",), "yes"),
        ("laws", (), "bent-scale", (), "no"),
        ("laws", (), "warming-damper", (), "no"),
        ("laws", (), "warming-damper", ("drifting_damping@theta",), "yes"),
        ("laws", (), "sagging-supply", ("drifting_gain@u",), "yes"),
        ("laws", (), "tiring-drive", ("drifting_gain@u",), "no"),
        ("laws", (), "uneven-damping", ("position_dependent_damping@theta",), "no"),
    ],
)
def test_parameters_have_true_values_where_the_model_has_the_truth_in_it(engine, effects, structure, accepted, holds):
    from sysid_lab.plan import Task
    from sysid_lab.records import make_records
    from sysid_lab.row import _holds

    from harness.effects import builtin
    from harness.effects.effect import Placed

    level = "nominal" if effects else ""
    task = Task("confusion" if effects else "none", "pendulum", engine, effects, level, "high", 0.0, 0, 0,
                structure=structure)  # fmt: skip
    placed = [Placed(builtin()[name], at) for name, at in (one.split("@") for one in accepted)]
    assert _holds(task, placed, make_records(task, samples=500)) is (holds == "yes")


def test_a_lag_passes_on_all_that_it_is_given_no_later_than_it_is():
    tau, u = 0.0025, np.repeat([0.0, 1.0], [1, 5])
    t = np.maximum(np.arange(6) * DT - DT, 0.0)
    moved = simulate({"J": 1.0, "tau": tau}, u, start=np.zeros(2)).v[:, 0]
    exact = t - tau * (1.0 - np.exp(-t / tau))
    assert np.abs(moved - exact).max() < 1e-12, "late by a thousandth of itself, a lag has another true value"
    passed = actuated({"tau": tau}, u).reshape(-1, SUBSTEPS).mean(axis=1).cumsum() * DT
    assert np.abs(passed[:-1] - exact[1:]).max() < 1e-12


def test_the_end_stop_of_the_dictionary_is_as_sharp_as_one_of_the_truth(command):
    from harness.effects import builtin
    from harness.effects.compose import compose
    from harness.effects.effect import Placed
    from harness.physics import load_model
    from harness.physics.compiled.simulator import Simulator

    law, start = {"stop": 0.4, "k": 40.0, "d": 0.1}, np.array([0.3, 0.0])
    system = compose(load_model("pendulum"), [Placed(builtin()["end_stop"], "theta", law)])
    values = system.vector({"J": 0.1, "mgl": 2.0, "b": 0.05})
    ours = Simulator(system, DT, substeps=40, backend="casadi").rollout(values, start, command[:, None])
    theirs = simulate({**PENDULUM, "stop0": 0.4, "ks0": 40.0, "ds0": 0.1}, command, start=start)
    assert np.abs(theirs.q).max() > 0.5
    error = np.abs(ours[: len(command)] - theirs.q).max()
    assert error < 1e-5, "from a round corner of a five-hundredth of the travel, its place is ten deviations off"
