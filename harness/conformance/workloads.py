"""Records that identifiers are checked on: of linear and mechanical systems and finite processes, drawn at random."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from hypothesis import strategies as st

from harness.algebra import runge_kutta
from harness.errors import HarnessError
from harness.signals import Channel, FloatArray, PlantSpec, Trajectory
from harness.testing import FiniteProcess, LinearSystem, simulate_finite, simulate_linear

KINDS = (
    "linear",
    "linear, state measured",
    "pendulum",
    "pendulum, rate measured",
    "cart-pole",
    "cart-pole, rates measured",
    "finite",
)
"""Kinds of systems; an identifier need not accept all of them, but at least one."""

PLANT = "plant:"  # Prefix of a kind that records a registered plant, such as ``plant:pendulum-ode``.

SAMPLES = 240


@dataclass(frozen=True, eq=False)
class Workload:
    """Records of one system.

    ``first`` and ``second`` are two records whose seam contradicts the system; ``probe`` is a third, for predictions.
    """

    kind: str
    seed: int
    first: Trajectory
    second: Trajectory
    probe: Trajectory

    def __repr__(self) -> str:
        return f"draw_workload({self.kind!r}, {self.seed})"


@functools.lru_cache(maxsize=128)
def draw_workload(kind: str, seed: int, samples: int = SAMPLES, noise: float = 0.0) -> Workload:
    """Return the records of one system.

    - ``kind``: one of :data:`KINDS`, or ``plant:ID`` for records of a registered plant
    - ``seed``: keys the system and its records
    - ``samples``: length of each record
    - ``noise``: sensor noise, relative to the standard deviation of each output (not on finite processes)

    Examples
    --------
    >>> print(draw_workload("pendulum", 0).first.spec)
    u [N m] -> theta [rad] every 0.02 s
    """
    if kind.startswith(PLANT):
        return Workload(kind, seed, *_from_plant(kind.removeprefix(PLANT), seed, samples))
    rng = np.random.default_rng([seed, KINDS.index(kind)])
    if kind == "finite":
        records = _finite(rng, samples)
    elif kind.startswith("linear"):
        records = _linear(rng, samples, measured="state" in kind, noise=noise)
    elif kind.startswith("pendulum"):
        records = _mechanical(rng, samples, _PENDULUM, rates="rate" in kind, noise=noise)
    else:
        records = _mechanical(rng, samples, _CART_POLE, rates="rates" in kind, noise=noise)
    return Workload(kind, seed, *records)


def workloads(kinds: tuple[str, ...]) -> st.SearchStrategy[tuple[str, int, int, float]]:
    """Return a strategy of the arguments of :func:`draw_workload` (hypothesis prints them, so they stay small)."""
    noise = st.sampled_from([0.0, 0.0, 1e-2])
    return st.tuples(st.sampled_from(kinds), st.integers(0, 10_000), st.just(SAMPLES), noise)


def kinds_for(
    accepts: Callable[[Workload], object], among: tuple[str, ...] = KINDS
) -> tuple[tuple[str, ...], dict[str, str]]:
    """Return the kinds that a part accepts, and why it refuses the others."""
    found, refused = [], {}
    for kind in among:
        reasons = []
        for seed in (0, 1):
            try:
                accepts(draw_workload(kind, seed))
            except HarnessError as error:
                reasons.append(str(error))
            else:
                found.append(kind)
                break
        else:
            refused[kind] = reasons[-1]
    return tuple(found), refused


def _from_plant(id: str, seed: int, n: int) -> list[Trajectory]:
    """Return records of a registered plant under random held inputs, without truth."""
    from harness import registry
    from harness.conformance.excitation import inputs_for

    records = []
    with registry.create("plants", id) as plant:
        for number in range(3):
            inputs = inputs_for(plant.spec, n, seed=3 * seed + number)
            outputs = [plant.reset(rng=np.random.default_rng([seed, number]))]
            outputs += [plant.step(u) for u in inputs[:-1]]
            t = np.arange(n, dtype=np.float64) * plant.spec.sample_time
            records.append(Trajectory(t, inputs, np.array(outputs), plant.spec))
    return records


def _linear(rng: np.random.Generator, n: int, *, measured: bool, noise: float) -> list[Trajectory]:
    """Return records of a stable linear system; the second starts far from where the first ends."""
    nx = int(rng.integers(1, 4))
    nu = int(rng.integers(1, 3))
    ny = nx if measured else int(rng.integers(1, nx + 1))
    A = rng.normal(size=(nx, nx))
    A *= rng.uniform(0.4, 0.95) / max(float(np.abs(np.linalg.eigvals(A)).max()), 1e-6)
    C = np.eye(nx) if measured else rng.normal(size=(ny, nx))
    states = tuple(Channel(f"x{i}", "m") for i in range(nx))
    outputs = states if measured else tuple(Channel(f"y{i}", "m") for i in range(ny))
    spec = PlantSpec(tuple(Channel(f"u{i}", "V") for i in range(nu)), outputs, 0.1, states)
    system = LinearSystem(A, rng.normal(size=(nx, nu)), C, spec)
    far = 30.0 * rng.normal(size=nx)
    return [
        simulate_linear(system, n, rng=rng, noise=noise, x0=np.zeros(nx)),
        simulate_linear(system, n, rng=rng, noise=noise, x0=far),
        simulate_linear(system, n, rng=rng, noise=noise),
    ]


def _finite(rng: np.random.Generator, n: int) -> list[Trajectory]:
    """Return records of a finite process in which the seam is a transition that never happens inside a record."""
    states, actions = int(rng.integers(3, 6)), int(rng.integers(1, 4))
    P = rng.dirichlet(np.ones(states), size=(states, actions))
    for s in range(states):  # staying is impossible; the seam will stay
        P[s, :, s] = 0.0
    P /= P.sum(axis=2, keepdims=True)
    action = Channel("action", "1", 0.0, float(actions - 1), kind="category")
    state = Channel("state", "1", 0.0, float(states - 1), kind="category")
    process = FiniteProcess(P, PlantSpec((action,), (state,), 1.0, (state,)))
    records = [simulate_finite(process, 4 * n, rng=rng) for _ in range(3)]
    last = records[0].y[-1, 0]
    start = int(np.argmax(records[1].y[:, 0] == last))
    whole = records[1]
    records[1] = Trajectory(
        np.arange(len(whole) - start, dtype=np.float64), whole.u[start:], whole.y[start:], whole.spec, whole.y[start:]
    )
    return records


@dataclass(frozen=True, eq=False)
class _Mechanics:
    """A mechanical system in numbers: its channels and its acceleration."""

    inputs: tuple[Channel, ...]
    coordinates: tuple[Channel, ...]
    acceleration: Callable[[FloatArray, FloatArray, FloatArray, FloatArray], FloatArray]
    draw: Callable[[np.random.Generator], FloatArray]
    force: float


def _pendulum_acceleration(p: FloatArray, q: FloatArray, v: FloatArray, u: FloatArray) -> FloatArray:
    """Return the acceleration of a pendulum with parameters J, b, mgl; records lie along the last axis."""
    return np.asarray((u - p[1] * v - p[2] * np.sin(q)) / p[0])


def _cart_pole_acceleration(p: FloatArray, q: FloatArray, v: FloatArray, u: FloatArray) -> FloatArray:
    """Return the accelerations of a cart with a hanging pole; parameters mc, mp, l, bx, btheta."""
    mc, mp, length, bx, bt = p
    s, c = np.sin(q[1]), np.cos(q[1])
    cart, pole, both = mc + mp, mp * length**2, mp * length * c
    force, torque = u[0] - bx * v[0] + mp * length * v[1] ** 2 * s, -bt * v[1] - mp * 9.81 * length * s
    scaled = np.array([pole * force - both * torque, cart * torque - both * force])
    return np.asarray(scaled / (cart * pole - both**2))


_PENDULUM = _Mechanics(
    (Channel("u", "N m"),),
    (Channel("theta", "rad", period=2 * np.pi),),
    _pendulum_acceleration,
    lambda rng: np.array([rng.uniform(0.05, 0.2), rng.uniform(0.02, 0.1), rng.uniform(0.5, 1.5)]),
    1.0,
)
_CART_POLE = _Mechanics(
    (Channel("u", "N"),),
    (Channel("x", "m"), Channel("theta", "rad", period=2 * np.pi)),
    _cart_pole_acceleration,
    lambda rng: np.array(
        [rng.uniform(0.5, 2.0), rng.uniform(0.1, 0.4), rng.uniform(0.3, 0.7), rng.uniform(0.1, 0.4), 0.01]
    ),
    4.0,
)


def _mechanical(rng: np.random.Generator, n: int, system: _Mechanics, *, rates: bool, noise: float) -> list[Trajectory]:
    """Return records of a mechanical system under steps of force, from different initial angles."""
    p, dt, substeps = system.draw(rng), 0.02, 4
    units = [Channel(f"{c.name}_rate", f"{c.unit}/s") for c in system.coordinates]
    states = (*system.coordinates, *units)
    spec = PlantSpec(system.inputs, states if rates else system.coordinates, dt, states)
    m, angles = len(system.coordinates), (0.2, -1.4, 0.8)
    held, sensed = [], []
    for _ in angles:
        held.append(system.force * np.repeat(rng.uniform(-1, 1, size=(n // 4 + 1, 1)), 4, axis=0)[:n])
        sensed.append(rng.normal(size=(n, 2 * m if rates else m)))
    x = np.zeros((n, 2 * m, len(angles)))  # all records at once
    x[0, m - 1] = angles
    forces = np.stack(held, axis=2)
    for k, force in enumerate(forces[:-1]):

        def derivative(state: FloatArray, force: FloatArray = force) -> FloatArray:
            return np.concatenate([state[m:], system.acceleration(p, state[:m], state[m:], force)])

        x[k + 1] = x[k]
        for _ in range(substeps):
            x[k + 1] = runge_kutta(derivative, x[k + 1], dt / substeps)
    records = []
    for number, (u, normal) in enumerate(zip(held, sensed, strict=True)):
        record = np.ascontiguousarray(x[:, :, number])
        y = record if rates else record[:, :m]
        y = y + noise * y.std(axis=0) * normal
        records.append(Trajectory(np.arange(n, dtype=np.float64) * dt, u, y, spec, record))
    return records
