"""Directions of the score test: the force, or sensor error, that each effect would add along the smoothed motion."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache
from typing import Any

import casadi as ca
import numpy as np

from harness.algebra import advanced
from harness.diagnosis.directions.jumps import instants
from harness.diagnosis.directions.lines import frequencies, short_waves, waves
from harness.diagnosis.directions.trace import Along, Trace
from harness.diagnosis.effort import EFFORT
from harness.diagnosis.search.fit import WAVE, ColumnKind
from harness.diagnosis.systems import AnySystem
from harness.effects.along import Signals
from harness.effects.columns import ColumnBlock, column_blocks
from harness.effects.compose import compose
from harness.effects.effect import EffectParameter, Placed
from harness.effects.places import port_of
from harness.effects.sampled import delay
from harness.errors import HarnessError
from harness.physics.compiled.system import System
from harness.signals import FloatArray

Lines = Callable[[], Sequence[float]]
"""Finds the strongest lines over time, when they are asked for."""
_PARTS = 4
"""Of a sample, in which hidden states of a sensor are advanced."""


@dataclass(frozen=True, eq=False)
class Direction:
    """Forces (K, ports, k) and readings (K, ny, k) by use and record, for a column of the score test."""

    placed: Placed | None
    given: dict[str, float]
    names: tuple[str, ...]
    forces: dict[str, list[FloatArray]]
    readings: dict[str, list[FloatArray]]
    kind: ColumnKind = "linear"


@dataclass(frozen=True, eq=False)
class _Around:
    """What directions are taken about: the smoothed motion of the records under a nominal model with its values."""

    traces: Mapping[str, Sequence[Trace]]
    nominal: System
    values: Mapping[str, float]
    sizes: Mapping[str, Mapping[str, float]]

    @cached_property
    def signals(self) -> dict[str, list[Signals]]:
        """The motion of a mechanical system by use and record."""
        nominal = self.nominal
        return {
            use: [signals_of(one, nominal) for one in parts if nominal.coordinates]
            for use, parts in self.traces.items()
        }

    @cached_property
    def known(self) -> dict[str, float]:
        """Parameters of the nominal model."""
        return {name: self.values[name] for name in self.nominal.parameter_names}

    @cached_property
    def lines(self) -> list[float]:
        """The strongest lines over time."""
        return frequencies(self.traces["estimation"], self.nominal)


def directions(
    traces: Mapping[str, Sequence[Trace]],
    nominal: System,
    values: Mapping[str, float],
    candidates: Sequence[Placed],
    sizes: Mapping[str, Mapping[str, float]],
) -> list[Direction]:
    """Return the directions of candidates, several for one whose parameters are not all linear."""
    around = _Around(traces, nominal, values, sizes)
    possible: list[Direction] = []
    for placed in candidates:
        kind = port_of(nominal, placed).kind
        try:
            if kind == "output":
                possible += reading_directions(
                    traces, nominal, placed, sizes, ports=_ports(traces), lines=lambda: around.lines
                )
            elif nominal.coordinates and traces["estimation"][0].passes.nl:
                possible += _forces(around, placed)
            else:
                possible += _rates(around, placed)
        except (HarnessError, ArithmeticError, np.linalg.LinAlgError):
            continue
    return [direction for direction in possible if _finite(direction)]


def line_directions(
    traces: Mapping[str, Sequence[Trace]],
    nominal: System,
    values: Mapping[str, float],
    line: Placed,
    sizes: Mapping[str, Mapping[str, float]],
) -> list[Direction]:
    """Return the sine and the cosine of an effect with a phase whose other values are given."""
    if port_of(nominal, line).kind == "output":
        given = list(line.values.values())
        return reading_directions(traces, nominal, line, sizes, ports=_ports(traces), lines=lambda: given)
    return _blocks(_Around(traces, nominal, values, sizes), line, line.effect.parameter_of("phase"))


def _finite(direction: Direction) -> bool:
    parts = [part for side in (direction.forces, direction.readings) for use in side.values() for part in use]
    return all(np.isfinite(part).all() for part in parts)


def signals_of(trace: Trace, nominal: System) -> Signals:
    """Return the smoothed motion of a mechanical system; accelerations with the latent force in them."""
    q = trace.x[:, [c.q for c in nominal.coordinates]]
    v = trace.x[:, [c.v for c in nominal.coordinates]]
    a = _rate(trace)[:, [c.v for c in nominal.coordinates]]
    return Signals(trace.record.t, trace.record.u, q, v, a, others=trace.x[0, 2 * q.shape[1] : nominal.nx])


def _rate(trace: Trace) -> FloatArray:
    """Return dx/dt along the smoothed motion (K, nx)."""
    function = trace.passes.simulator.functions.derivative
    n = len(trace.record)
    many = function.map(n)
    return np.asarray(many(trace.x.T, trace.record.u.T, np.tile(trace.p[:, None], n), trace.record.t).full().T)


def _ports(traces: Mapping[str, Sequence[Trace]]) -> int:
    return len(traces["estimation"][0].ports)


def _nothing(traces: Mapping[str, Sequence[Along]], width: int, k: int) -> dict[str, list[FloatArray]]:
    """Return zeros (K, width, k) by use and record."""
    return {use: [np.zeros((len(trace.record), width, k)) for trace in parts] for use, parts in traces.items()}


def _forces(around: _Around, placed: Placed) -> list[Direction]:
    """Return the directions of an effect whose force follows from the motion."""
    records, nominal = around.traces["estimation"], around.nominal
    frequency, wave_number = (placed.effect.parameter_of(role) for role in ("frequency", "wave number"))
    phase, instant = (placed.effect.parameter_of(role) for role in ("phase", "instant"))
    waves_of_it: list[Placed] = []
    if frequency is not None:
        waves_of_it = [placed.with_values({frequency.name: omega}) for omega in around.lines]
    elif wave_number is not None:
        row = next(k for k, coordinate in enumerate(nominal.coordinates) if coordinate.name == placed.at)
        angle = np.concatenate([motion.q[:, row] for motion in around.signals["estimation"]])
        numbers = waves(angle, wave_number)
        numbers += short_waves(records, nominal, row, beyond=max(numbers, default=0.0))
        waves_of_it = [placed.with_values({wave_number.name: k}) for k in numbers if k <= wave_number.maximum]
    else:
        if instant is not None and instant.name not in placed.values:
            found = instants(records, placed.at)
            waves_of_it = [placed.with_values({instant.name: t0}) for t0 in found]
        waves_of_it.append(placed)
    return [direction for wave in waves_of_it for direction in _blocks(around, wave, phase)]


def _blocks(around: _Around, placed: Placed, phase: EffectParameter | None) -> list[Direction]:
    """Return one direction for each block of columns; of a law with a phase, sine and cosine together."""
    nominal, signals = around.nominal, around.signals
    turns = () if phase is None else (0.0, 0.5 * np.pi)
    choices = [placed.with_values({phase.name: angle}) for angle in turns if phase is not None] or [placed]
    made: list[dict[str, list[list[ColumnBlock]]]] = []
    for choice in choices:
        made.append(
            {
                use: [
                    column_blocks(nominal, choice, motion, parameters=around.known, sizes=around.sizes)
                    for motion in parts
                ]
                for use, parts in signals.items()
            }
        )
    directions = []
    for number, block in enumerate(made[0]["estimation"][0] if made[0]["estimation"] else []):
        forces = {
            use: [
                np.concatenate([m[use][record][number].columns for m in made], axis=2)
                for record in range(len(signals[use]))
            ]
            for use in signals
        }
        given, names = {**block.given, **placed.values}, tuple(block.names)
        kind: ColumnKind = "linear" if phase is None else "wave"
        if phase is not None:  # sin(a + phi) = cos(phi) sin(a) + sin(phi) cos(a)
            names = WAVE
            given.pop(phase.name, None)
        k = len(names)
        if forces["estimation"][0].shape[2] == k:
            nothing = _nothing(around.traces, nominal.ny, k)
            directions.append(Direction(placed, given, names, forces, nothing, kind))
    return directions


def choices(
    placed: Placed, at: Mapping[str, float], known: Mapping[str, float] | None = None
) -> list[tuple[dict[str, float], tuple[str, ...]]]:
    """Return choices of the nonlinear parameters, known ones as they are, with the names of the linear ones."""
    known = known or {}
    linear = tuple(parameter.name for parameter in placed.effect.parameters if parameter.linear and not parameter.fixed)
    nonlinear = [
        parameter for parameter in placed.effect.parameters if parameter.name not in linear and not parameter.fixed
    ]
    grids = [
        [known[parameter.name]] if parameter.name in known else list(parameter.starts(at)) for parameter in nonlinear
    ]
    return [
        (dict(zip((parameter.name for parameter in nonlinear), choice, strict=True)), linear)
        for choice in itertools.islice(itertools.product(*grids), EFFORT.choices)
    ]


def reading_directions(
    traces: Mapping[str, Sequence[Along]],
    nominal: AnySystem,
    placed: Placed,
    sizes: Mapping[str, Mapping[str, float]],
    *,
    ports: int,
    lines: Lines,
) -> list[Direction]:
    """Return the directions of a sensor's error: what it changes in the readings that the model expects.

    ``lines`` gives the angular frequencies [rad/s] at which one that repeats in time is looked for.
    """
    row = [channel.name for channel in nominal.outputs].index(placed.at)
    if placed.effect.sampled == "quantise" or not placed.effect.parameters:
        return []
    at = sizes.get(placed.at, {})
    wave_number, frequency = (placed.effect.parameter_of(role) for role in ("wave number", "frequency"))
    if wave_number is not None:
        angle = np.concatenate([trace.expected[:, row] for trace in traces["estimation"]])
        return _waves_of_readings(traces, nominal, placed, {wave_number.name: waves(angle, wave_number)}, row, ports)
    if frequency is not None:
        return _waves_of_readings(traces, nominal, placed, {frequency.name: lines()}, row, ports)
    directions = []
    for given, linear in choices(placed, at):
        names = linear or ("effect",)
        readings: dict[str, list[FloatArray]] = {}
        for use, parts in traces.items():
            readings[use] = []
            for trace in parts:
                y = trace.expected[:, row]
                column = np.zeros((len(y), nominal.ny, len(names)))
                complete = placed.effect.complete(given, at)
                if placed.effect.sampled == "output_delay":
                    column[:, row, 0] = delay(y, given[placed.effect.parameters[0].name], trace.dt) - y
                elif linear:
                    nothing = {**complete, **{n: placed.effect.parameter(n).neutral or 0.0 for n in linear}}
                    before = _sensor(placed, trace, y, nothing)
                    for k, name in enumerate(linear):
                        column[:, row, k] = _sensor(placed, trace, y, {**nothing, name: nothing[name] + 1.0}) - before
                else:
                    column[:, row, 0] = _sensor(placed, trace, y, complete) - y
                readings[use].append(column)
        directions.append(Direction(placed, given, names, _nothing(traces, ports, len(names)), readings))
    return directions


def _waves_of_readings(
    traces: Mapping[str, Sequence[Along]],
    nominal: AnySystem,
    placed: Placed,
    tried: Mapping[str, Sequence[float]],
    row: int,
    ports: int,
) -> list[Direction]:
    """Return the directions of an error that repeats, along the reading or in time: sine and cosine of each wave."""
    main, turn = placed.effect.main, placed.effect.parameter_of("phase")
    directions: list[Direction] = []
    if main is None or turn is None:
        return directions
    for given in ({name: value} for name, values in tried.items() for value in values):
        readings: dict[str, list[FloatArray]] = {}
        for use, parts in traces.items():
            readings[use] = []
            for trace in parts:
                y = trace.expected[:, row]
                column = np.zeros((len(y), nominal.ny, 2))
                for number, phase in enumerate((0.0, 0.5 * np.pi)):
                    at = {**given, turn.name: phase, main.name: 1.0}
                    column[:, row, number] = _sensor(placed, trace, y, at) - y
                readings[use].append(column)
        directions.append(Direction(placed, given, WAVE, _nothing(traces, ports, 2), readings, "wave"))
    return directions


def _sensor(placed: Placed, trace: Along, y: FloatArray, values: Mapping[str, float]) -> FloatArray:
    """Return what a sensor reads along a record."""
    states = _sensor_states(placed, trace, y, values)
    value, _ = placed.effect.evaluate(y, states, values, y, 0.0, t=trace.record.t, a=0.0, load=0.0)
    return np.asarray(value) * np.ones_like(y)


def _sensor_states(placed: Placed, trace: Along, y: FloatArray, values: Mapping[str, float]) -> list[FloatArray]:
    """Return the hidden states of a sensor (K,) along readings, which are straight from row to row."""
    if not placed.effect.states:
        return []
    begun = np.array([y[0] if name in placed.effect.initial else 0.0 for name in placed.effect.states])
    step = _sensor_step(placed, tuple(values.items()), trace.dt)
    run = step.mapaccum(len(y) - 1)(begun, y[None, :-1], y[None, 1:], trace.record.t[None, :-1])
    return list(np.column_stack([begun, run.full()]))


@lru_cache(maxsize=8)
def _sensor_step(placed: Placed, values: tuple[tuple[str, float], ...], dt: float) -> ca.Function:
    """Return the hidden states of a sensor a sample later: the same for every record."""
    effect = placed.effect
    z, here, there, t = ca.SX.sym("z", len(effect.states)), *map(ca.SX.sym, ("here", "there", "t"))

    def derivative(now: Any, share: float) -> Any:
        read, time = here + share * (there - here), t + share * dt
        return ca.vertcat(
            *effect.evaluate(read, ca.vertsplit(now), dict(values), read, 0.0, t=time, a=0.0, load=0.0)[1]
        )

    return ca.Function("step", [z, here, there, t], [advanced(derivative, z, dt, _PARTS)])


def _rates(around: _Around, placed: Placed) -> list[Direction]:
    """Return the directions of an effect in a system of plain rates: what it changes in them."""
    at = around.sizes.get(placed.at, {})
    change = _rate_changes(around.nominal, around.known, placed, at)
    frequency, phase = (placed.effect.parameter_of(role) for role in ("frequency", "phase"))
    settled = [{frequency.name: omega} for omega in around.lines] if frequency is not None else [{}]
    turns = [{}] if phase is None else [{phase.name: angle} for angle in (0.0, 0.5 * np.pi)]
    directions = []
    for wave in settled:
        for given, linear in choices(placed, at, {**wave, **turns[0]}):
            forces = {}
            for use, parts in around.traces.items():
                sides = [change(parts, {**given, **turn}, linear) for turn in turns]
                forces[use] = [np.concatenate(side, axis=2) for side in zip(*sides, strict=True)]
            names = linear or ("effect",)
            kind: ColumnKind = "linear"
            if phase is not None:  # sin(a + phi) = cos(phi) sin(a) + sin(phi) cos(a)
                given.pop(phase.name)
                names, kind = WAVE, "wave"
            directions.append(
                Direction(placed, given, names, forces, _nothing(around.traces, around.nominal.ny, len(names)), kind)
            )
    return directions


def _rate_changes(
    nominal: System, known: Mapping[str, float], placed: Placed, at: Mapping[str, float]
) -> Callable[[Sequence[Trace], Mapping[str, float], Sequence[str]], list[FloatArray]]:
    """Return what an effect adds to the rates along records (K, nx, k), by its linear parameters or as a whole.

    Rates follow from the instant: all records of a use, which may be many short ones, are asked at once.
    """
    base = ca.Function("f", [nominal.x, nominal.u, nominal.p, nominal.t], [nominal.f])
    whole = None if port_of(nominal, placed).kind == "input" else compose(nominal, [placed], sizes={"": at})
    made = None if whole is None else ca.Function("g", [whole.x, whole.u, whole.p, whole.t], [whole.f[: nominal.nx]])

    @cache
    def along(function: ca.Function, n: int) -> ca.Function:
        return function.map(n)

    @cache
    def motion(traces: tuple[Trace, ...], hidden: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        states = np.concatenate([trace.x[:, : nominal.nx] for trace in traces])
        inputs, times = (np.concatenate([getattr(trace.record, name) for trace in traces]) for name in ("u", "t"))
        return np.hstack([states, np.zeros((len(states), hidden))]).T, inputs, times

    def plain(traces: tuple[Trace, ...], u: FloatArray | None = None) -> FloatArray:
        x, inputs, t = motion(traces, 0)
        p = np.tile(nominal.vector(known)[:, None], len(t))
        return np.asarray(along(base, len(t))(x, (inputs if u is None else u).T, p, t).full().T)

    without = cache(plain)

    def rates(traces: tuple[Trace, ...], case: Mapping[str, float]) -> FloatArray:
        if whole is None or made is None:
            behind = [input_behind(placed, trace, nominal, case) for trace in traces]
            return plain(traces, np.concatenate(behind))
        x, u, t = motion(traces, whole.nx - nominal.nx)
        p = whole.vector({**known, **{placed.name(name): value for name, value in case.items()}})
        return np.asarray(along(made, len(t))(x, u.T, np.tile(p[:, None], len(t)), t).full().T)

    def change(parts: Sequence[Trace], given: Mapping[str, float], linear: Sequence[str]) -> list[FloatArray]:
        if not parts:
            return []
        traces, complete = tuple(parts), placed.effect.complete(given, at)
        nothing = {**complete, **{name: placed.effect.parameter(name).neutral or 0.0 for name in linear}}
        gone = not linear or placed.effect.neutral(nothing) == nothing
        before = without(traces) if gone else rates(traces, nothing)
        cases = [{**nothing, name: nothing[name] + 1.0} for name in linear] or [complete]
        changes = np.stack([rates(traces, case) - before for case in cases], axis=2)
        return np.split(changes, np.cumsum([len(trace.record) for trace in traces])[:-1])

    return change


def input_behind(placed: Placed, trace: Along, nominal: AnySystem, values: Mapping[str, float]) -> FloatArray:
    """Return the inputs behind a block at one of them; hidden states by one step of Euler's method a sample."""
    column = [channel.name for channel in nominal.inputs].index(placed.at)
    u, dt = trace.record.u.copy(), trace.dt
    signal = u[:, column]
    if placed.effect.sampled:
        u[:, column] = delay(signal, values[placed.effect.parameters[0].name], dt)
    elif not placed.effect.states:
        u[:, column] = placed.effect.evaluate(signal, [], values, 0.0, 0.0, t=trace.record.t, a=0.0, load=0.0)[0]
    else:
        slow = {
            k: max(v, dt) if placed.effect.parameter(k).unit == "s" else v for k, v in values.items()
        }  # an Euler step of a time constant below a sample would not settle
        z, here = ca.SX.sym("z", len(placed.effect.states)), ca.SX.sym("here")
        value, rates = placed.effect.evaluate(here, ca.vertsplit(z), slow, 0.0, 0.0, t=0.0, a=0.0, load=0.0)
        step = ca.Function("step", [z, here], [z + dt * ca.vertcat(*rates), value])
        begun = np.full(len(placed.effect.states), signal[0])
        u[:, column] = step.mapaccum(len(signal))(begun, signal[None])[1].full().ravel()
    return u


def test_functions(traces: Mapping[str, Sequence[Trace]], nominal: System) -> list[Direction]:
    """Return test functions that are no effect: piecewise linear forces of one or two axes, at every port.

    The axes are every state and every input; of a coordinate also position with speed, and either with each input
    together. Forces in proportion to one of them may change with the time since a record began.
    """
    names = [channel.name for channel in nominal.states]
    inputs = [channel.name for channel in nominal.inputs]
    values = {
        name: {use: [trace.x[:, row] for trace in parts] for use, parts in traces.items()}
        for row, name in enumerate(names)
    }
    values |= {
        name: {use: [trace.record.u[:, row] for trace in parts] for use, parts in traces.items()}
        for row, name in enumerate(inputs)
    }
    pairs = [
        (names[coordinate.q], other) for coordinate in nominal.coordinates for other in (names[coordinate.v], *inputs)
    ]
    pairs += [(names[coordinate.v], other) for coordinate in nominal.coordinates for other in inputs]
    readings = {use: [trace.record.y for trace in parts] for use, parts in traces.items()}
    times = {use: [trace.record.t for trace in parts] for use, parts in traces.items()}
    ports = traces["estimation"][0].ports
    return spline_directions(values, pairs, ports, readings) + drift_directions(values, times, ports, readings)


def spline_directions(
    values: Mapping[str, Mapping[str, Sequence[FloatArray]]],
    pairs: Sequence[tuple[str, str]],
    ports: Sequence[str],
    readings: Mapping[str, Sequence[FloatArray]],
) -> list[Direction]:
    """Return piecewise linear forces over each axis and over pairs of axes, at every port.

    Knots lie between the quantiles of the estimation records.

    - ``values`` mapping of str to mapping of str to sequence of array (K,): axes by name, use and record
    - ``pairs`` sequence of (str, str)
    - ``readings`` mapping of str to sequence of array (K, ny): only their shapes count
    """
    directions: list[Direction] = []
    for group in [*((name,) for name in values), *pairs]:
        counts = (EFFORT.knots,) if len(group) == 1 else EFFORT.joint_knots
        knots = []
        for name, count in zip(group, counts, strict=True):
            every = np.concatenate(list(values[name]["estimation"]))
            knots.append(np.unique(np.quantile(every, np.linspace(0.01, 0.99, count))))
        if any(len(at) < 3 for at in knots):
            continue
        basis: dict[str, list[FloatArray]] = {}
        for use, parts in readings.items():
            basis[use] = []
            for number in range(len(parts)):
                hats = [_hat_basis(values[name][use][number], at) for name, at in zip(group, knots, strict=True)]
                basis[use].append(hats[0] if len(hats) == 1 else _joint_basis(hats[0], hats[1]))
        labels = [", ".join(f"{n} {v:.3g}" for n, v in zip(group, at, strict=True)) for at in itertools.product(*knots)]
        directions += _at_every_port(basis, ports, readings, " and ".join(group), labels)
    return directions


def drift_directions(
    values: Mapping[str, Mapping[str, Sequence[FloatArray]]],
    times: Mapping[str, Sequence[FloatArray]],
    ports: Sequence[str],
    readings: Mapping[str, Sequence[FloatArray]],
) -> list[Direction]:
    """Return forces in proportion to each axis, by a factor that changes piecewise linearly with time, at every port.

    What warms up, wears or tires does so in every record; an unknown force has no part that follows the motion.

    - ``values`` mapping of str to mapping of str to sequence of array (K,): axes by name, use and record
    - ``times`` mapping of str to sequence of array (K,): of the samples; only what has passed since the first counts
    - ``readings`` mapping of str to sequence of array (K, ny): only their shapes count
    """
    longest = max(float(time[-1] - time[0]) for time in times["estimation"])
    knots = np.linspace(0.0, longest, EFFORT.joint_knots[0])
    hats = {use: [_hat_basis(time - time[0], knots) for time in parts] for use, parts in times.items()}
    hats = {use: [part - part.mean(axis=0) for part in parts] for use, parts in hats.items()}  # no lasting part
    directions: list[Direction] = []
    for name, axis in values.items():
        basis = {
            use: [value[:, None] * hat for value, hat in zip(axis[use], parts, strict=True)]
            for use, parts in hats.items()
        }
        labels = [f"{at:.3g} s" for at in knots]
        directions += _at_every_port(basis, ports, readings, f"{name}, changing with time", labels, "drift")
    return directions


def _at_every_port(
    basis: Mapping[str, Sequence[FloatArray]],
    ports: Sequence[str],
    readings: Mapping[str, Sequence[FloatArray]],
    axis: str,
    labels: Sequence[str],
    kind: ColumnKind = "linear",
) -> list[Direction]:
    """Return the forces of a basis (K, k) by use and record at each port."""
    nothing = {use: [np.zeros((*part.shape, len(labels))) for part in parts] for use, parts in readings.items()}
    directions = []
    for row, port in enumerate(ports):
        forces = {use: [_at_port(part, row, len(ports)) for part in made] for use, made in basis.items()}
        directions.append(Direction(None, {}, (f"{port} over {axis}", *labels[1:]), forces, nothing, kind))
    return directions


def _at_port(part: FloatArray, row: int, ports: int) -> FloatArray:
    """Return forces (K, k) at one of several ports (K, ports, k)."""
    whole = np.zeros((len(part), ports, part.shape[1]))
    whole[:, row] = part
    return whole


def _hat_basis(x: FloatArray, knots: FloatArray) -> FloatArray:
    """Return piecewise linear hat functions (N, K) of ``x`` (N,) at increasing ``knots`` (K,); flat outside.

    Examples
    --------
    >>> _hat_basis(np.array([0.0, 0.25, 2.0]), np.array([0.0, 1.0])).tolist()
    [[1.0, 0.0], [0.75, 0.25], [0.0, 1.0]]
    """
    clipped = np.clip(np.asarray(x, dtype=float), knots[0], knots[-1])
    if knots.size == 1:
        return np.ones((clipped.size, 1))
    cell = np.clip(np.searchsorted(knots, clipped, side="right") - 1, 0, knots.size - 2)
    part = (clipped - knots[cell]) / (knots[cell + 1] - knots[cell])
    basis = np.zeros((clipped.size, knots.size))
    rows = np.arange(clipped.size)
    basis[rows, cell] = 1 - part
    basis[rows, cell + 1] = part
    return basis


def _joint_basis(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the products (N, Ka * Kb) of two bases."""
    return (a[:, :, None] * b[:, None, :]).reshape(a.shape[0], -1)
