"""Laws that machines have: gears, commutations, supplies, propellers, springs over levers, bases, temperatures.

Hidden in records of other people's engines and of hand-written truths; and rivals hidden, which they must not name.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
from sysid_lab.plan import Task
from sysid_lab.records import make_records, multisine
from sysid_lab.truths.simulation import DT

from harness.diagnosis import diagnose
from harness.diagnosis.diagnosis import Diagnosis
from harness.physics import load_model
from harness.physics.compiled.system import System
from harness.physics.definition.parameters import Parameter
from harness.physics.symbolic.mechanism import Mechanism
from harness.signals import Channel, Dataset, FloatArray, PlantSpec, Run, Trajectory, Use

LAWS = {
    "gear_loss",
    "torque_ripple",
    "supply_sag",
    "propeller_thrust",
    "counterbalance",
    "wobbling_base",
    "thermal_damping",
    "thermal_friction",
    "thermal_gain",
    "degressive_friction",
}
USES: tuple[Use, ...] = ("estimation", "validation")
SPEC = PlantSpec((Channel("u", "N m"),), (Channel("theta", "rad", period=2 * math.pi),), DT)
MASS, LENGTH, DAMPING, NOISE = 1.0, 0.3, 0.05, 5e-4
J, MGL = MASS * LENGTH**2, MASS * 9.81 * LENGTH
Step = Callable[[float], float]


def right_or_tied(found: Diagnosis, effect: str) -> bool:
    """Return whether an answer is one effect: this one, or one that these data do not tell from it."""
    accepted = found.outcome.accepted
    return len(accepted) == 1 and any([str(placed) for placed in group] == [effect] for group in accepted[0].tie)


def named(found: Diagnosis) -> set[str]:
    """Return the laws of this file that an answer names."""
    return {one.placed.effect.name for one in found.outcome.accepted} & LAWS


def task(plant: str, effect: str, index: int) -> Task:
    """Return records with an effect, half of them under an unknown torque of 2 %, of other seeds than were tuned on."""
    noise, unknown = ("high", "low")[index % 2], 0.02 * (index // 2 % 2)
    return Task("confusion" if effect else "none", plant, "laws", (effect,) if effect else (),
                "nominal" if effect else "", noise, unknown, index, 0)  # fmt: skip


# ---- right or tied ---------------------------------------------------------------------------------------------------


def test_a_gear_and_its_efficiency(foreign_pendulum: Callable[..., Dataset]) -> None:
    """A share of 10 % is lost of what the gear passes on, and a ninth where the load drives."""

    def gear(q: float, v: float, u: float, t: float) -> float:
        return -float(np.sign(v)) * abs(u) * (0.1 if u * v > 0 else 1 / 0.9 - 1)

    found = diagnose(foreign_pendulum(31, gear), load_model("pendulum"))
    assert [str(one.placed) for one in found.outcome.accepted] == ["gear_loss@theta"]
    assert found.final.values["gear_loss@theta.c"] == pytest.approx(0.1, rel=0.1)


@pytest.mark.slow
def test_a_ripple_is_told_from_cogging(foreign_pendulum: Callable[..., Dataset]) -> None:
    """The one in proportion to the torque, the other whatever the torque is."""
    ripple = diagnose(foreign_pendulum(32, lambda q, v, u, t: 0.12 * u * math.sin(6 * q + 1)), load_model("pendulum"))
    assert [str(one.placed) for one in ripple.outcome.accepted] == ["torque_ripple@theta"]
    assert [len(one.tie) for one in ripple.outcome.accepted] == [1]
    assert ripple.final.values["torque_ripple@theta.k"] == pytest.approx(6.0, rel=0.02)
    cogging = diagnose(foreign_pendulum(33, lambda q, v, u, t: 0.05 * math.sin(6 * q + 1)), load_model("pendulum"))
    assert [str(one.placed) for one in cogging.outcome.accepted] == ["cogging@theta"]
    assert [len(one.tie) for one in cogging.outcome.accepted] == [1]


@pytest.mark.slow
@pytest.mark.parametrize("seed", [34, 35, 36])
@pytest.mark.parametrize("turn", [0.2, 0.6])
def test_viscous_friction_that_grows_ever_less_is_one_law(
    foreign_pendulum: Callable[..., Dataset], turn: float, seed: int
) -> None:
    """A power of the speed with a Coulomb friction stood for it."""
    data = foreign_pendulum(seed, lambda q, v, u, t: -0.05 * v / (turn + abs(v)), n=2500, noise=5e-4)
    found = diagnose(data, load_model("pendulum"))
    assert right_or_tied(found, "degressive_friction@theta"), [str(one.placed) for one in found.outcome.accepted]
    assert found.final.values["degressive_friction@theta.vs"] == pytest.approx(turn, rel=0.2)


@pytest.mark.slow
@pytest.mark.parametrize("index", [20, 21, 22])
@pytest.mark.parametrize(
    ("plant", "effect"),
    [
        ("pendulum", "gear_loss@theta"),
        ("cart-pole", "gear_loss@x"),
        ("pendulum", "torque_ripple@theta"),
        ("cart-pole", "torque_ripple@x"),
        ("pendulum", "supply_sag@u"),
        ("cart-pole", "supply_sag@u"),
        ("pendulum", "counterbalance@theta"),
        ("pendulum", "wobbling_base@theta"),
        ("pendulum", "propeller_thrust@u"),
    ],
)
def test_it_is_the_answer_or_tied_with_it(plant: str, effect: str, index: int) -> None:
    records = make_records(task(plant, effect, index))
    found = diagnose(records.dataset, load_model(plant))
    assert right_or_tied(found, effect), [str(one.placed) for one in found.outcome.accepted]


# ---- not named -------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("index", [20, 21, 22, 23])
@pytest.mark.parametrize(
    ("plant", "effect"),
    [
        ("pendulum", "coulomb_friction@theta"),
        ("pendulum", "cogging@theta"),
        ("pendulum", "saturation@u"),
        ("pendulum", "elasticity@theta"),
        ("pendulum", ""),
        ("cart-pole", "coulomb_friction@x"),
        ("cart-pole", "saturation@u"),
        ("cart-pole", ""),
    ],
)
def test_a_rival_or_nothing_is_not_given_their_names(plant: str, effect: str, index: int) -> None:
    found = diagnose(make_records(task(plant, effect, index)).dataset, load_model(plant))
    assert not named(found), [str(one.placed) for one in found.outcome.accepted]


@pytest.mark.slow
@pytest.mark.parametrize("index", [20, 21, 22, 23])
def test_viscous_friction_that_a_model_lacks_is_not_given_their_names(index: int) -> None:
    plain = load_model("pendulum").with_parameters({"b": Parameter("b", "N m s/rad", 0.0, 0.0, fixed=True)})
    found = diagnose(make_records(task("pendulum", "", index)).dataset, plain)
    assert not named(found)
    assert "viscous_friction@theta" in {str(one.placed) for one in found.outcome.accepted}


# ---- by other people's engines ---------------------------------------------------------------------------------------


@cache
def command(seed: int, size: float) -> FloatArray:
    """Return a command (5000,) of this rms [N m]."""
    return size * multisine(5000, DT, np.random.default_rng(seed), (0.1, 3.0))


def recorded(simulated: Callable[[FloatArray], FloatArray], seed: int, size: float = 0.9) -> Dataset:
    """Return two records of an engine that turns a command into an angle."""
    runs = []
    for number, use in enumerate(USES):
        u = command(2 * seed + number, size)
        y = simulated(u) + NOISE * np.random.default_rng([seed, number]).standard_normal(len(u))
        runs.append(Run(Trajectory(np.arange(len(u)) * DT, u[:, None], y[:, None], SPEC), use))
    return Dataset("engine", tuple(runs))


def by_pymunk(u: FloatArray, *, spring: tuple[float, ...] | None = None, base: tuple[float, ...] | None = None,
              parts: int = 320) -> FloatArray:  # fmt: skip
    """Return the angle of a link in Chipmunk: with a spring (k, L0, arm, anchor) or a base (mass, k, d)."""
    pymunk = pytest.importorskip("pymunk")
    space = pymunk.Space()
    space.gravity, space.iterations = (0.0, -9.81), 40
    link = pymunk.Body(MASS, 1e-9)  # a point mass, its rod without one
    link.position = (0.0, -LENGTH)
    space.add(link)
    ground = space.static_body
    if base is None:
        space.add(pymunk.PivotJoint(ground, link, (0.0, 0.0), (0.0, LENGTH)))
    else:
        frame = pymunk.Body(base[0], float("inf"))
        rail = pymunk.GrooveJoint(ground, frame, (-10.0, 0.0), (10.0, 0.0), (0.0, 0.0))
        # far away, so that it pulls along the rail alone
        holder = pymunk.DampedSpring(ground, frame, (-1000.0, 0.0), (0.0, 0.0), 1000.0, base[1], base[2])
        space.add(frame, rail, holder, pymunk.PivotJoint(frame, link, (0.0, 0.0), (0.0, LENGTH)))
    if spring is not None:
        k, free, arm, anchor = spring
        space.add(pymunk.DampedSpring(ground, link, (0.0, anchor), (0.0, LENGTH - arm), free, k, 0.0))
    y, h = np.empty(len(u)), DT / parts
    for k, torque in enumerate(u.tolist()):
        # bodies are moved before they are pushed: positions lie half a step behind
        y[k] = link.angle + 0.5 * h * link.angular_velocity
        for _ in range(parts):
            link.torque = torque - DAMPING * link.angular_velocity
            space.step(h)
    return y


@pytest.mark.slow
def test_a_spring_over_a_lever_arm_in_chipmunk() -> None:
    found = diagnose(recorded(lambda u: by_pymunk(u, spring=(600.0, 0.07, 0.05, 0.12)), 3), load_model("pendulum"))
    assert right_or_tied(found, "counterbalance@theta"), [str(one.placed) for one in found.outcome.accepted]
    far = math.hypot(0.05, 0.12)
    rho = 2 * 0.05 * 0.12 / far**2
    expected = 600.0 * 0.07 * 0.05 * 0.12 / far * rho / 4
    assert found.final.values["counterbalance@theta.A"] == pytest.approx(expected, rel=0.1)


@pytest.mark.slow
def test_a_base_that_wobbles_in_chipmunk() -> None:
    omega, frame = 2 * math.pi * 4.0, 8.0
    whole = frame + MASS
    base = (frame, whole * omega**2, 2 * 0.05 * omega * whole)
    found = diagnose(recorded(lambda u: by_pymunk(u, base=base), 4), load_model("pendulum"))
    assert right_or_tied(found, "wobbling_base@theta"), [str(one.placed) for one in found.outcome.accepted]
    values = found.final.values
    assert values["wobbling_base@theta.omega"] == pytest.approx(omega, rel=0.03)
    assert values["wobbling_base@theta.mu"] == pytest.approx((MASS * LENGTH) ** 2 / whole, rel=0.1)


def by_mujoco(
    u: FloatArray, drive: Callable[[], Callable[[float, float, float], float]], parts: int = 20
) -> FloatArray:
    """Return the angle of a link in MuJoCo, its joint driven by a law of (command, angle, rate) in fine steps."""
    mujoco = pytest.importorskip("mujoco")
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><option timestep="{DT / parts}" integrator="RK4" gravity="0 0 -9.81"/><worldbody><body>'
        f'<joint name="hinge" axis="0 -1 0" damping="{DAMPING}"/>'
        f'<inertial pos="0 0 {-LENGTH}" mass="{MASS}" diaginertia="1e-9 1e-9 1e-9"/></body></worldbody>'
        '<actuator><motor joint="hinge" gear="1"/></actuator></mujoco>'
    )
    data, law, y = mujoco.MjData(model), drive(), np.empty(len(u))
    for k, torque in enumerate(u.tolist()):
        y[k] = data.qpos[0]
        for _ in range(parts):
            data.ctrl[0] = law(torque, float(data.qpos[0]), float(data.qvel[0]))
            mujoco.mj_step(model, data)
    return y


def lossy() -> Callable[[float, float, float], float]:
    return lambda u, q, v: u - math.tanh(v / 1e-3) * abs(u) * (0.1 if u * v > 0 else 1 / 0.9 - 1)


def rippling() -> Callable[[float, float, float], float]:
    return lambda u, q, v: u * (1 + 0.12 * math.sin(7 * q + 0.5))


def sagging() -> Callable[[float, float, float], float]:
    """A battery: charge that is drawn lowers the voltage, and comes back within 0.6 s."""
    drawn = 0.0

    def law(u: float, q: float, v: float) -> float:
        nonlocal drawn
        drawn += DT / 20 / 0.6 * (abs(u) - drawn)
        return u * (1 - 0.3 * drawn)

    return law


@pytest.mark.slow
@pytest.mark.parametrize(
    ("drive", "effect", "values"),
    [
        (lossy, "gear_loss@theta", {"c": 0.1}),
        (rippling, "torque_ripple@theta", {"a": 0.12, "k": 7.0}),
        (sagging, "supply_sag@u", {"c": 0.3, "tau": 0.6}),
    ],
)
def test_drives_around_mujoco(
    drive: Callable[[], Callable[[float, float, float], float]], effect: str, values: dict[str, float]
) -> None:
    found = diagnose(recorded(lambda u: by_mujoco(u, drive), 5), load_model("pendulum"))
    assert right_or_tied(found, effect), [str(one.placed) for one in found.outcome.accepted]
    for name, value in values.items():
        assert found.final.values[f"{effect}.{name}"] == pytest.approx(value, rel=0.15)


# ---- a measured temperature ------------------------------------------------------------------------------------------


def warm_model(unit: str = "K") -> System:
    """Return a pendulum with an input that is a temperature and does nothing."""
    m = Mechanism("pendulum", q="theta", u="u temperature", p="J b mgl", units={"u": "N m", "temperature": unit})
    import sympy as sp

    (theta,), (rate,), (u, _) = m.q, m.v, m.u
    inertia, b, mgl = m.p
    m.body(inertia, (sp.sin(theta), -sp.cos(theta)), weight=mgl)
    m.Q = [u - b * rate]
    m.parameters(J=("kg m^2", 0.1), b=("N m s/rad", 0.05), mgl=("N m", 1.0))
    return m.system()


def warmed(seed: int, law: Callable[[float, float, float], float], start: float = 293.15) -> Dataset:
    """Return records in which the machine warms up by 25 K and cools down; a law of (command, rate, kelvin)."""
    spec = PlantSpec((SPEC.inputs[0], Channel("temperature", "K")), SPEC.outputs, 0.01)
    runs = []
    for number, use in enumerate(USES):
        n, rng = 3000, np.random.default_rng([seed, number])
        t = np.arange(n) * 0.01
        u = 0.5 * multisine(n, 0.01, rng, (0.1, 3.0))
        heat = start + 12.5 * (1 - np.cos(2 * np.pi * t / (20.0 + 4 * number)))
        q, v, y, h = 0.0, 0.0, np.empty(n), 0.001
        for k in range(n):
            y[k] = q
            for _ in range(10):
                v += h * (law(u[k], v, heat[k]) - 0.05 * v - math.sin(q)) / 0.1
                q += h * v
        y = y - 0.5 * h * np.gradient(y, 0.01) + 5e-4 * rng.standard_normal(n)
        runs.append(Run(Trajectory(t, np.column_stack([u, heat]), y[:, None], spec), use))
    return Dataset("warm", tuple(runs))


@pytest.mark.slow
@pytest.mark.parametrize("seed", [41, 42, 43])
@pytest.mark.parametrize(
    ("effect", "law"),
    [
        ("thermal_damping@theta", lambda u, v, T: u + 0.0016 * (T - 293.15) * v),
        ("thermal_friction@theta", lambda u, v, T: u - (0.06 - 0.0018 * (T - 293.15)) * math.tanh(v / 0.005)),
        ("thermal_gain@u", lambda u, v, T: u * (1 - 0.006 * (T - 293.15))),
    ],
)
def test_what_a_measured_temperature_does(effect: str, law: Callable[[float, float, float], float], seed: int) -> None:
    found = diagnose(warmed(seed, law), warm_model())
    assert right_or_tied(found, effect), [str(one.placed) for one in found.outcome.accepted]


@pytest.mark.slow
@pytest.mark.parametrize("seed", [51, 52])
@pytest.mark.parametrize(
    "law", [lambda u, v, T: u, lambda u, v, T: u - 0.05 * math.tanh(v / 0.005), lambda u, v, T: min(max(u, -0.9), 0.9)]
)
def test_a_temperature_that_does_nothing_is_not_blamed(law: Callable[[float, float, float], float], seed: int) -> None:
    assert not named(diagnose(warmed(seed, law), warm_model()))


@pytest.mark.slow
def test_a_soft_joint_seen_from_its_motor_is_no_friction_and_no_delay() -> None:
    """A harmonic drive in front of a hanging link, its motor's angle measured: gear friction stood for it."""
    motor, link, mgl, damping, stiffness = 0.08, 0.2, 4.0, 0.2, 500.0
    runs = []
    for seed, use in enumerate(USES):
        rng, dt, n = np.random.default_rng(900 + seed), 0.002, 4000
        f, phase = np.geomspace(0.3, 40.0, 25), rng.uniform(0, 2 * np.pi, 25)
        t = np.arange(n) * dt
        u = (1.2 * np.sin(np.outer(t, 2 * np.pi * f) + phase) / np.sqrt(1 + f / 6)).sum(axis=1)
        x, y = np.zeros(4), np.zeros(n)
        for k in range(n):
            y[k] = x[0]
            for _ in range(10):  # symplectic steps of 0.2 ms
                passed = stiffness * (x[0] - x[1]) + 0.3 * (x[2] - x[3])
                x[2] += dt / 10 * (u[k] - damping * x[2] - passed) / motor
                x[3] += dt / 10 * (passed - mgl * math.sin(x[1])) / link
                x[:2] += dt / 10 * x[2:]
        spec = PlantSpec(SPEC.inputs, SPEC.outputs, dt)
        runs.append(Run(Trajectory(t, u[:, None], (y + 3e-5 * rng.normal(size=n))[:, None], spec), use))
    found = diagnose(Dataset("joint", tuple(runs)), load_model("pendulum"))
    first = found.outcome.accepted[0].placed
    assert str(first) == "elastic_load@theta"
    assert found.final.values[first.name("k")] == pytest.approx(stiffness, rel=0.03)
    assert found.final.values[first.name("J")] == pytest.approx(link, rel=0.03)
