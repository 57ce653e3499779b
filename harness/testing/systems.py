"""Strategies of systems: channels, plant specs, trajectories, linear systems, Markov processes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from harness.signals import Channel, FloatArray, PlantSpec, Trajectory

UNITS = ("1", "N m", "N", "rad", "rad/s", "m", "m/s", "V", "K")


@st.composite
def channels(draw: Any, name: str = "y") -> Channel:
    """Draw a real channel of this name, with or without limits and period.

    Examples
    --------
    >>> channels("u").example().name  # doctest: +SKIP
    'u'
    """
    unit = draw(st.sampled_from(UNITS))
    limit = draw(st.sampled_from([np.inf, 1.0, 10.0, 123.5]))
    period = draw(st.sampled_from([None, 2 * np.pi])) if unit == "rad" else None
    return Channel(name, unit, -limit, limit, period=period)


@st.composite
def plant_specs(draw: Any, max_inputs: int = 2, max_outputs: int = 3, with_states: bool = False) -> PlantSpec:
    """Draw a plant spec with up to so many inputs (none among them) and outputs."""
    inputs = tuple(draw(channels(f"u{i}")) for i in range(draw(st.integers(0, max_inputs))))
    outputs = tuple(draw(channels(f"y{i}")) for i in range(draw(st.integers(1, max_outputs))))
    states = tuple(draw(channels(f"x{i}")) for i in range(draw(st.integers(1, 3)))) if with_states else ()
    dt = draw(st.sampled_from([1e-3, 0.002, 0.01, 0.1, 1.0, 1 / 3]))
    return PlantSpec(inputs, outputs, dt, states)


@st.composite
def trajectories(
    draw: Any,
    spec: PlantSpec | None = None,
    min_samples: int = 2,
    max_samples: int = 30,
    with_truth: bool = False,
) -> Trajectory:
    """Draw a record of any finite numbers, tiny and huge ones among them.

    Parameters
    ----------
    spec : PlantSpec, optional
        What is recorded; drawn too if not given.
    min_samples, max_samples : int
        Length of the record.
    with_truth : bool
        Let some records carry true states.
    """
    spec = spec if spec is not None else draw(plant_specs(with_states=with_truth))
    n = draw(st.integers(min_samples, max_samples))
    numbers = st.floats(allow_nan=False, allow_infinity=False)

    def block(columns: int) -> FloatArray:
        return np.asarray(draw(arrays(np.float64, (n, columns), elements=numbers)), dtype=np.float64)

    t = np.arange(n) * spec.sample_time
    x = block(len(spec.states)) if with_truth and spec.states and draw(st.booleans()) else None
    return Trajectory(t, block(spec.nu), block(spec.ny), spec, x)


@dataclass(frozen=True, eq=False)
class LinearSystem:
    """A stable discrete-time system ``x+ = A x + B u``, ``y = C x``.

    Parameters
    ----------
    A, B, C : array (nx, nx), (nx, nu), (ny, nx)
    spec : PlantSpec
        With the states x0, x1, ...
    """

    A: FloatArray
    B: FloatArray
    C: FloatArray
    spec: PlantSpec


@st.composite
def linear_systems(
    draw: Any,
    max_states: int = 4,
    max_inputs: int = 2,
    max_outputs: int = 3,
    measured_state: bool = False,
) -> LinearSystem:
    """Draw a stable linear system with spectral radius 0.3 to 0.97.

    Parameters
    ----------
    max_states, max_inputs, max_outputs : int
        Largest sizes; there is at least one of each.
    measured_state : bool
        Make the outputs the states (C = I).
    """
    nx, nu = draw(st.integers(1, max_states)), draw(st.integers(1, max_inputs))
    ny = nx if measured_state else draw(st.integers(1, min(max_outputs, nx)))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    A = rng.normal(size=(nx, nx))
    A *= draw(st.floats(0.3, 0.97)) / max(float(np.abs(np.linalg.eigvals(A)).max()), 1e-6)
    C = np.eye(nx) if measured_state else rng.normal(size=(ny, nx))
    spec = PlantSpec(
        tuple(Channel(f"u{i}", "V") for i in range(nu)),
        tuple(Channel(f"{'x' if measured_state else 'y'}{i}", "m") for i in range(ny)),
        draw(st.sampled_from([0.01, 0.1, 1.0])),
        tuple(Channel(f"x{i}", "m") for i in range(nx)),
    )
    return LinearSystem(A, rng.normal(size=(nx, nu)), C, spec)


def simulate_linear(
    system: LinearSystem,
    samples: int,
    *,
    rng: np.random.Generator,
    noise: float = 0.0,
    x0: FloatArray | None = None,
) -> Trajectory:
    """Return a record of a linear system under white input.

    Parameters
    ----------
    system : LinearSystem
    samples : int
    rng : numpy.random.Generator
    noise : float
        Standard deviation of white sensor noise, relative to that of each output.
    x0 : array (nx,), optional
        Initial state; drawn if not given.

    Examples
    --------
    >>> spec = PlantSpec((Channel("u"),), (Channel("y"),), 1.0, (Channel("x"),))
    >>> one = LinearSystem(np.array([[0.5]]), np.array([[1.0]]), np.array([[1.0]]), spec)
    >>> record = simulate_linear(one, 5, rng=np.random.default_rng(0))
    >>> bool(np.allclose(record.y[1:], 0.5 * record.y[:-1] + record.u[:-1]))
    True
    """
    u = rng.normal(size=(samples, system.spec.nu))
    x = np.empty((samples, system.A.shape[0]))
    x[0] = rng.normal(size=system.A.shape[0]) if x0 is None else x0
    for k in range(samples - 1):
        x[k + 1] = system.A @ x[k] + system.B @ u[k]
    y = x @ system.C.T
    y = y + noise * y.std(axis=0) * rng.normal(size=y.shape)
    return Trajectory(np.arange(samples, dtype=np.float64) * system.spec.sample_time, u, y, system.spec, x)


TEMPERS = ("stable", "unstable", "stiff", "slow", "lightly damped", "non-minimal", "delayed")


@st.composite
def tempered_systems(
    draw: Any, *, measured_state: bool = False, tempers: tuple[str, ...] = TEMPERS, max_inputs: int = 2
) -> LinearSystem:
    """Draw a linear system with a temper: stable, unstable, stiff, slow, lightly damped, non-minimal or delayed.

    Two or three states, all excited and seen but for the hidden state of a non-minimal one. Simulate unstable ones over
    some hundred samples at most.

    Parameters
    ----------
    measured_state : bool
        Make the outputs the states (C = I).
    tempers : tuple of str
        Draw among these.
    max_inputs : int
    """
    temper = draw(st.sampled_from(tempers))
    nu = draw(st.integers(1, max_inputs))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    radius = {"unstable": 1.05, "slow": 0.998, "lightly damped": 0.995}.get(temper, 0.85)
    if temper in ("slow", "stiff"):
        poles = [radius, {"slow": 0.99, "stiff": 0.01}[temper]]
        a = np.diag(poles)
    else:
        angle = 0.5 + rng.random()
        a = radius * np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    if temper == "delayed":
        a = np.block([[a, rng.normal(size=(2, 1))], [np.zeros((1, 3))]])
    turn = np.linalg.qr(rng.normal(size=a.shape))[0] @ np.diag(rng.uniform(0.7, 1.4, len(a)))
    a = turn @ a @ np.linalg.inv(turn)
    nx = len(a)
    b = rng.normal(size=(nx, nu)) + np.sign(rng.normal(size=(nx, nu)))
    if measured_state:
        c = np.eye(nx)
    else:
        ny = draw(st.integers(1, 2))
        c = rng.normal(size=(ny, nx)) + np.sign(rng.normal(size=(ny, nx)))
    if temper == "non-minimal":  # a state that no output sees
        hidden = 0.5 * rng.normal(size=(1, nx))
        a = np.block([[a, np.zeros((nx, 1))], [hidden, np.array([[0.6]])]])
        b = np.vstack([b, rng.normal(size=(1, nu))])
        c = np.hstack([c, np.zeros((c.shape[0], 1))]) if not measured_state else np.eye(nx + 1)
    spec = PlantSpec(
        tuple(Channel(f"u{i}", "V") for i in range(nu)),
        tuple(Channel(f"y{i}", "m") for i in range(c.shape[0])),
        0.1,
    )
    return LinearSystem(a, b, c, spec)


@dataclass(frozen=True, eq=False)
class FiniteProcess:
    """A finite Markov decision process whose state is measured.

    Parameters
    ----------
    P : array (S, A, S)
        Probability of the next state, given state and action.
    spec : PlantSpec
        One category input ``action`` and one category output ``state``.
    """

    P: FloatArray
    spec: PlantSpec


@st.composite
def finite_processes(draw: Any, max_states: int = 5, max_actions: int = 3) -> FiniteProcess:
    """Draw a finite Markov decision process in which every transition has a positive probability."""
    states, actions = draw(st.integers(2, max_states)), draw(st.integers(1, max_actions))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    P = rng.dirichlet(np.ones(states), size=(states, actions)) * 0.9 + 0.1 / states
    spec = PlantSpec(
        (Channel("action", "1", 0.0, float(actions - 1), kind="category"),),
        (Channel("state", "1", 0.0, float(states - 1), kind="category"),),
        1.0,
        (Channel("state", "1", 0.0, float(states - 1), kind="category"),),
    )
    return FiniteProcess(P, spec)


def simulate_finite(process: FiniteProcess, samples: int, *, rng: np.random.Generator) -> Trajectory:
    """Return a record of a finite process under random actions."""
    states, actions, _ = process.P.shape
    u = rng.integers(actions, size=(samples, 1))
    x = np.empty((samples, 1), dtype=int)
    x[0] = rng.integers(states)
    for k in range(samples - 1):
        x[k + 1] = rng.choice(states, p=process.P[x[k, 0], u[k, 0]])
    return Trajectory(np.arange(samples, dtype=float), u.astype(float), x.astype(float), process.spec, x.astype(float))
