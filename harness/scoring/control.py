"""What an identified model is worth for control: the cost of its design on the true plant, and the cost of learning.

The design is the LQG regulator (Kalman filter and LQR) made for the identified model; it is judged on the true plant
against the design made for the plant itself (Anderson & Moore 1990, *Optimal Control*, ch. 8).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from harness.errors import FitError, InputError
from harness.models.lqr import kalman_gain, lqr_gain, reachable, spectral_radius, stabilisable, state_observable
from harness.protocols import Identifier
from harness.signals import Channel, FloatArray, PlantSpec, Trajectory

# Variance of the sensors against what a unit disturbance at the inputs does to them within the first samples.
_SENSOR = 1e-4
_NEWTON = 6  # Steps to the inputs that hold a plant at a state.
_STILL = 1e-5  # By which a state may move within a sample where it is held: a tenth of the step of its derivatives.
# A step that costs so many times the dearest one under the first controller: the design does not hold the plant.
_FAR = 10.0


@dataclass(frozen=True, eq=False)
class LinearPlantModel:
    """``x+ = A x + B u``, ``y = C x + D u``: a plant that is known, at its sample time."""

    a_matrix: FloatArray
    b_matrix: FloatArray
    c_matrix: FloatArray
    d_matrix: FloatArray


@dataclass(frozen=True)
class ControlScore:
    """The worth of a model for control.

    Parameters
    ----------
    ratio : float
        Closed-loop cost of the model's design on the true plant over that of the plant's own design; at least 1 but for
        rounding, infinite where the design does not stabilise the plant or cannot be made.
    status : {"ok", "unstable", "no design"}
    spectral_radius : float
        Of the true plant under the model's design; NaN without one.
    order : int
        States of the model.
    controllable, observable : int
        Dimensions of the model's controllable subspace and observable quotient.
    stabilisable, detectable : bool
        True if every mode of the model outside the unit circle is reached by an input, or seen by an output.
    """

    ratio: float
    status: str
    spectral_radius: float
    order: int
    controllable: int
    observable: int
    stabilisable: bool
    detectable: bool


def control_score(
    model: Any,
    plant: Any,
    *,
    q: FloatArray | None = None,
    r: FloatArray | None = None,
    sensor: FloatArray | None = None,
) -> ControlScore:
    """Return the closed-loop cost, on the true plant, of the regulator designed on an identified model.

    Stationary cost ``E[y' q y + u' r u]`` under a disturbance of covariance I at the inputs and sensor noise; the
    regulator acts on what it knew one sample before. Coordinates of the states do not matter, nor do outputs that no
    input of the plant moves: the design is made without them.

    Parameters
    ----------
    model : object
        With ``a_matrix``, ``b_matrix``, ``c_matrix``, ``d_matrix``: what identifiers of linear models return.
    plant : object
        The true plant, the same way: :class:`LinearPlantModel`, or what :func:`linearise` returns.
    q : array (ny, ny), optional
        Weights of the outputs; by default one over the square of what a unit input pulse does to each.
    r : array (nu, nu), optional
        Weights of the inputs; the identity by default.
    sensor : array (ny, ny), optional
        Covariance of the sensor noise; by default 1e-4 of what a unit disturbance does to each output.

    Raises
    ------
    InputError
        If model and plant have other numbers of inputs or outputs, or the plant itself has no stabilising design.

    Examples
    --------
    >>> one = np.ones((1, 1))
    >>> plant = LinearPlantModel(1.1 * one, one, one, 0 * one)
    >>> control_score(plant, plant).ratio
    1.0
    >>> wrong = LinearPlantModel(1.1 * one, -one, one, 0 * one)
    >>> control_score(wrong, plant).status
    'unstable'
    """
    shape = np.shape(plant.d_matrix)
    if np.shape(model.d_matrix) != shape:
        raise InputError(
            "model and plant of a control score",
            expected=f"{shape[1]} inputs and {shape[0]} outputs",
            got=f"{np.shape(model.d_matrix)[1]} and {np.shape(model.d_matrix)[0]}",
            remedy="score a model of this plant",
        )
    size = pulse_sizes(plant)
    moved = np.flatnonzero(size > 0)
    q = np.diag(1.0 / size[moved] ** 2) if q is None else np.asarray(q, dtype=float)[np.ix_(moved, moved)]
    r = np.eye(shape[1]) if r is None else np.asarray(r, dtype=float)
    default = np.diag(_SENSOR * size[moved] ** 2)
    sensor = default if sensor is None else np.asarray(sensor, dtype=float)[np.ix_(moved, moved)]
    plant, model = (_with_outputs(system, moved) for system in (plant, model))
    own = _regulator(plant, q, r, sensor)
    best = None if own is None else _cost(plant, own, q, r, sensor)
    if best is None or not np.isfinite(best[0]):
        raise InputError(
            "the plant has no regulator",
            expected="a stabilisable and detectable plant",
            got="no stabilising solution of its Riccati equations",
            remedy="choose weights that see every unstable mode, or another plant",
        )
    a, b, c = np.asarray(model.a_matrix), np.asarray(model.b_matrix), np.asarray(model.c_matrix)
    facts = (len(a), reachable(a, b), state_observable(a, c), stabilisable(a, b), stabilisable(a.T, c.T))
    design = _regulator(model, q, r, sensor)
    if design is None:
        return ControlScore(float("inf"), "no design", float("nan"), *facts)
    cost, radius = _cost(plant, design, q, r, sensor)
    if not np.isfinite(cost):
        return ControlScore(float("inf"), "unstable", radius, *facts)
    return ControlScore(cost / best[0], "ok", radius, *facts)


def linearise(
    plant: Any,
    *,
    x0: Mapping[str, float] | None = None,
    u0: FloatArray | None = None,
    size: float = 1e-4,
) -> LinearPlantModel:
    """Return a plant that tells its true states, linearised by central differences over one sample.

    Parameters
    ----------
    plant : Plant
        With the ability ``"truth"``; it is reset several times.
    x0 : mapping, optional
        The point, by state name; zero for states not named. It should be an equilibrium under ``u0``.
    u0 : array (nu,), optional
        Zero by default.
    size : float
        Step of the differences, in each state's and input's unit.

    Raises
    ------
    InputError
        If the plant does not tell its states, or does not start where it is told.
    """
    names = [channel.name for channel in plant.spec.states]
    if "truth" not in plant.abilities or not names:
        raise InputError(
            "plant to be linearised",
            expected="the ability 'truth'",
            got=", ".join(sorted(plant.abilities)) or "none",
            remedy="use a plant that tells its states",
        )
    if hasattr(plant, "discrete") and hasattr(plant, "D"):
        return LinearPlantModel(plant.A, plant.B, plant.C, plant.D)
    centre = np.array([float((x0 or {}).get(name, 0.0)) for name in names])
    hold = np.zeros(plant.spec.nu) if u0 is None else np.asarray(u0, dtype=float)
    rng = np.random.default_rng(0)

    def moved(x: FloatArray, u: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        first = np.asarray(plant.reset(rng=rng, x0=dict(zip(names, x.tolist(), strict=True))), dtype=float)
        if not np.allclose(plant.truth(), x, rtol=1e-9, atol=1e-12):
            raise InputError(
                "plant to be linearised",
                expected="a start in the state that was asked for",
                got=f"{np.asarray(plant.truth()).tolist()} for {x.tolist()}",
                remedy="linearise within the plant's range",
            )
        direct = np.asarray(plant.output(u), dtype=float) if plant.spec.feedthrough else first
        plant.step(u)
        return direct, np.asarray(plant.truth(), dtype=float), first

    def derivatives(of_state: bool) -> tuple[FloatArray, FloatArray]:
        count = len(names) if of_state else plant.spec.nu
        states, outputs = np.empty((len(names), count)), np.empty((plant.spec.ny, count))
        for j in range(count):
            push = size * np.eye(count)[j]
            sides = [
                moved(centre + push, hold) if of_state else moved(centre, hold + push),
                moved(centre - push, hold) if of_state else moved(centre, hold - push),
            ]
            outputs[:, j] = (sides[0][0] - sides[1][0]) / (2 * size)
            states[:, j] = (sides[0][1] - sides[1][1]) / (2 * size)
        return states, outputs

    (a, c), (b, d) = derivatives(True), derivatives(False)
    return LinearPlantModel(a, b, c, d if plant.spec.feedthrough else np.zeros_like(d))


def held(plant: Any, x0: Mapping[str, float]) -> tuple[LinearPlantModel, FloatArray, FloatArray]:
    """Return a plant linearised at a state where an input holds it, and the outputs (ny,) and inputs (nu,) there.

    Parameters
    ----------
    plant : Plant
        As for :func:`linearise`.
    x0 : mapping
        The state, by name; zero for states not named.

    Raises
    ------
    InputError
        If no input within the plant's ranges holds it there, or :func:`linearise` refuses it.

    Examples
    --------
    >>> from plants.equations.ode import pendulum_ode
    >>> aside = held(pendulum_ode(sample_time=0.05), {"theta": np.pi / 2})
    >>> aside[2].round(6)  # N m, against the weight
    array([1.])
    """
    hold = np.zeros(plant.spec.nu)
    low, high = (np.array([getattr(one, side) for one in plant.spec.inputs]) for side in ("minimum", "maximum"))
    for _ in range(_NEWTON):
        around = linearise(plant, x0=x0, u0=hold)
        target = np.asarray(plant.reset(rng=np.random.default_rng(0), x0=dict(x0)), dtype=float)
        before = np.asarray(plant.truth(), dtype=float)
        plant.step(hold)
        moved = np.asarray(plant.truth(), dtype=float) - before
        better = np.clip(hold - np.linalg.lstsq(around.b_matrix, moved, rcond=1e-9)[0], low, high)
        if np.allclose(better, hold, rtol=1e-9, atol=1e-12):
            break
        hold = better
    if np.abs(moved).max(initial=0.0) <= _STILL:
        return around, target, hold
    names = [channel.name for channel in plant.spec.states]
    worst = int(np.argmax(np.abs(moved)))
    raise InputError(
        "point at which a plant is held",
        expected="an equilibrium: a state in which some input within its range keeps the plant",
        got=f"{names[worst]} moves by {moved[worst]:.2g} within a sample whatever the inputs",
        remedy="give the state where it stays, to enough digits",
    )


@dataclass(frozen=True, eq=False)
class ControlRegret:
    """Cost of controlling while learning, beyond the optimal controller's.

    Parameters
    ----------
    costs : array (T,)
        ``x' q x + u' r u`` at each step.
    best_costs : array (T,)
        The same of the optimal controller under the same disturbances: what chance adds to both takes no part.
    optimal : float
        Average cost of a step under the optimal controller.
    designs : tuple of int
        Steps at which a controller was designed anew.
    """

    costs: FloatArray
    best_costs: FloatArray
    optimal: float
    designs: tuple[int, ...]

    @property
    def cumulative(self) -> FloatArray:
        """Cost so far beyond the optimal controller's under the same disturbances (T,)."""
        return np.cumsum(self.costs - self.best_costs)

    @property
    def total(self) -> float:
        """Control regret over the whole run."""
        return float(self.cumulative[-1])


def control_regret(
    identifier: Identifier,
    plant: tuple[FloatArray, FloatArray],
    *,
    steps: int,
    rng: np.random.Generator,
    noise: float = 0.1,
    first_gain: FloatArray | None = None,
    first: int = 50,
    excitation: float = 1.0,
    q: FloatArray | None = None,
    r: FloatArray | None = None,
) -> ControlRegret:
    """Control a linear plant with the LQR of an identified model, redesigned as data come in.

    Certainty equivalence with an excitation that fades as t^(-1/4) and a new design whenever the data have doubled: the
    regret grows as sqrt(T) (Simchowitz & Foster 2020, ICML, algorithm 1). Where a design lets a
    step cost 10 times the most that any cost under the first controller, that one takes over until the next design: it
    is known to hold the plant.

    Parameters
    ----------
    identifier : Identifier
        Learns from measured states; its models have ``a_matrix``, ``b_matrix``, ``c_matrix``.
    plant : (A, B)
        The truth (nx, nx), (nx, nu); its state is measured.
    steps : int
    rng : numpy.random.Generator
    noise : float
        Standard deviation of the white disturbance of each state.
    first_gain : array (nu, nx), optional
        ``u = -K x`` before the first design; zero by default, for plants that are stable by themselves.
    first : int
        Samples before the first design.
    excitation : float
        Standard deviation of the excitation of each input at the first step.
    q, r : array (nx, nx), (nu, nu), optional
        Weights; identities by default.

    Raises
    ------
    InputError
        If the plant has no LQR.
    """
    a, b = (np.asarray(matrix, dtype=float) for matrix in plant)
    nx, nu = b.shape
    q = np.eye(nx) if q is None else q
    r = np.eye(nu) if r is None else r
    best = lqr_gain(a, b, q, r)
    if best is None:
        raise InputError("the plant has no LQR", expected="a stabilisable plant", got="none", remedy="choose another")
    from scipy.linalg import solve_discrete_are

    optimal = float(noise**2 * np.trace(solve_discrete_are(a, b, q, r)))
    spec = PlantSpec(
        tuple(Channel(f"u{i}") for i in range(nu)), tuple(Channel(f"x{i}") for i in range(nx)), sample_time=1.0
    )
    disturbances = noise * rng.normal(size=(steps, nx))
    gain = np.zeros((nu, nx)) if first_gain is None else np.asarray(first_gain, dtype=float)
    held = gain
    states, inputs, costs = np.zeros((steps + 1, nx)), np.zeros((steps, nu)), np.empty(steps)
    designs, following = [], first
    for k in range(steps):
        if k == following:
            following *= 2
            record = Trajectory(np.arange(float(k)), inputs[:k], states[:k], spec)
            try:
                model: Any = identifier.fit([record], rng=rng)
                new = lqr_gain(*in_states(model), q, r)
            except FitError:
                new = None
            if new is not None:
                gain = new
                designs.append(k)
        if k > first and costs[k - 1] > _FAR * costs[:first].max():
            gain = held
        fading = excitation * (1 + k) ** -0.25
        inputs[k] = -gain @ states[k] + fading * rng.normal(size=nu)
        costs[k] = states[k] @ q @ states[k] + inputs[k] @ r @ inputs[k]
        states[k + 1] = a @ states[k] + b @ inputs[k] + disturbances[k]
    return ControlRegret(costs, _held(a - b @ best, q + best.T @ r @ best, disturbances), optimal, tuple(designs))


def _held(loop: FloatArray, weight: FloatArray, disturbances: FloatArray) -> FloatArray:
    """Return the costs (T,) of a closed loop from rest under disturbances (T, nx)."""
    costs, x = np.zeros(len(disturbances)), np.zeros(len(loop))
    for k, pushed in enumerate(disturbances):
        costs[k] = x @ weight @ x
        x = loop @ x + pushed
    return costs


def in_states(model: Any) -> tuple[FloatArray, FloatArray]:
    """Return A and B of a model whose outputs are the states, in the coordinates of the outputs.

    Raises
    ------
    FitError
        If it has other states than those that are measured.
    """
    c = np.asarray(model.c_matrix)
    if c.shape[0] != c.shape[1]:
        raise FitError(
            "model for state feedback",
            expected="as many states as measured ones",
            got=f"{c.shape[1]} and {c.shape[0]}",
            remedy="use least-squares or dmdc without delays",
        )
    return c @ model.a_matrix @ np.linalg.inv(c), c @ model.b_matrix


def pulse_sizes(plant: Any) -> FloatArray:
    """Return what a unit pulse at all inputs does to each output within the first samples (ny,)."""
    a, move = np.asarray(plant.a_matrix), np.asarray(plant.b_matrix)
    power = np.sum(np.asarray(plant.d_matrix) ** 2, axis=1)
    for _ in range(len(a) + 1):
        power = power + np.sum((plant.c_matrix @ move) ** 2, axis=1)
        move = a @ move
    return np.asarray(np.sqrt(power), dtype=np.float64)


def _with_outputs(model: Any, rows: npt.NDArray[np.intp]) -> LinearPlantModel:
    """Return a model without its other outputs."""
    a, b, c, d = (np.asarray(getattr(model, f"{name}_matrix"), dtype=float) for name in "abcd")
    return LinearPlantModel(a, b, c[rows], d[rows])


def _regulator(model: Any, q: FloatArray, r: FloatArray, sensor: FloatArray) -> tuple[FloatArray, ...] | None:
    """Return ``x+ = F x + G y, u = -K x`` of the LQG regulator; None where it cannot be made."""
    a, b, c, d = (np.asarray(getattr(model, f"{name}_matrix"), dtype=float) for name in "abcd")
    gain = lqr_gain(a, b, c.T @ q @ c, r + d.T @ q @ d, cross=c.T @ q @ d)
    filtered = kalman_gain(a, c, b @ b.T, sensor)
    if gain is None or filtered is None or not (stabilisable(a, b) and stabilisable(a.T, c.T)):
        return None
    return a - b @ gain - filtered @ (c - d @ gain), filtered, gain


def _cost(
    plant: Any, design: tuple[FloatArray, ...], q: FloatArray, r: FloatArray, sensor: FloatArray
) -> tuple[float, float]:
    """Return the stationary cost of a regulator on the plant, inf where unstable, and the spectral radius."""
    from scipy.linalg import solve_discrete_lyapunov

    a, b, c, d = (np.asarray(getattr(plant, f"{name}_matrix"), dtype=float) for name in "abcd")
    f, g, gain = design
    loop = np.block([[a, -b @ gain], [g @ c, f - g @ d @ gain]])
    radius = spectral_radius(loop)
    if radius >= 1.0:
        return float("inf"), radius
    driven = np.block(
        [
            [b @ b.T, np.zeros((len(a), len(f)))],
            [np.zeros((len(f), len(a))), g @ sensor @ g.T],
        ]
    )
    covariance = solve_discrete_lyapunov(loop, driven)
    seen, acted = np.hstack([c, -d @ gain]), np.hstack([np.zeros((len(r), len(a))), -gain])
    weight = seen.T @ q @ seen + acted.T @ r @ acted
    return float(np.trace(weight @ covariance)), radius
