"""What effects around an FMU would add to its inputs, or to its readings, along the motion of a free run."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from harness.algebra import advanced
from harness.blackbox.effects import surround
from harness.blackbox.system import FmuSystem
from harness.diagnosis.directions.directions import (
    Direction,
    Lines,
    choices,
    drift_directions,
    input_behind,
    reading_directions,
    spline_directions,
)
from harness.diagnosis.effort import EFFORT
from harness.diagnosis.search.fit import WAVE
from harness.effects.effect import Placed
from harness.effects.places import port_of
from harness.errors import HarnessError
from harness.physics.fitting.smoothing import Smoothed, smooth
from harness.signals import FloatArray, Trajectory

PARTS = 4
"""Steps of a hidden state within a sample."""


@dataclass(frozen=True, eq=False)
class Moved:
    """A record, the inputs behind delays (K, nu), positions and rates (K, n), outputs of the free run (K, ny)."""

    record: Trajectory
    u: FloatArray
    q: FloatArray
    v: FloatArray
    y: FloatArray
    dt: float

    @property
    def expected(self) -> FloatArray:
        """Outputs of the model (K, ny)."""
        return self.y


def as_measured(
    nominal: FmuSystem, record: Trajectory, q: FloatArray, v: FloatArray, y: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return positions and rates (K, n) of a free run, led to those that its record tells.

    Without what it lacks, a model may move quite otherwise than its plant did: a spring without the friction that damps
    it swings through ten times the way. The force of a law is that along the motion of the plant, and the response of
    the model to it is exact where the model is linear. So the error of the free run, smoothed, is added to it: where
    the model is right nothing is.
    """
    dt = record.spec.sample_time
    error: dict[str | None, Smoothed] = {}
    for k, channel in enumerate(record.spec.outputs):
        off = record.y[:, k] - y[:, k]
        period = channel.period or 0.0
        off = (off + period / 2) % period - period / 2 if period > 0 else off
        error[channel.name] = error[nominal.shown.get(channel.name)] = smooth(np.nan_to_num(off), dt)
    error.pop(None, None)
    q, v = q.copy(), v.copy()
    for row, coordinate in enumerate(nominal.coordinates):
        place, rate = error.get(coordinate.position), error.get(coordinate.rate)
        if place is not None:
            q[:, row] += place.value
        if rate is not None:
            v[:, row] += rate.value
        elif place is not None:
            v[:, row] += place.rate
        if place is None and rate is not None:  # its integral, but for where it began and for a drift
            gone = dt * np.concatenate([[0.0], np.cumsum(0.5 * (rate.value[1:] + rate.value[:-1]))])
            q[:, row] += gone - np.polyval(np.polyfit(record.t, gone, 1), record.t)
    return q, v


def pushes(
    nominal: FmuSystem,
    moved: Mapping[str, Sequence[Moved]],
    candidates: Sequence[Placed],
    sizes: Mapping[str, Mapping[str, float]],
) -> list[Direction]:
    """Return the directions of candidates, several for one whose parameters are not all linear."""
    directions: list[Direction] = []

    @functools.cache
    def lines() -> list[float]:
        return _lines(moved)

    for placed in candidates:
        kind = port_of(nominal, placed).kind  # type: ignore[arg-type]
        try:
            if kind == "output":
                directions += reading_directions(moved, nominal, placed, sizes, ports=nominal.nu, lines=lines)
            else:
                directions += _commands(nominal, moved, placed, sizes, kind, lines)
        except (HarnessError, ArithmeticError, np.linalg.LinAlgError):
            continue
    return [
        direction
        for direction in directions
        if all(
            np.isfinite(part).all()
            for side in (direction.forces, direction.readings)
            for parts in side.values()
            for part in parts
        )
    ]


def test_pushes(nominal: FmuSystem, moved: Mapping[str, Sequence[Moved]]) -> list[Direction]:
    """Return piecewise linear pushes over positions, rates, outputs, inputs and time, at every input of the FMU."""
    names = [name for coordinate in nominal.coordinates for name in (coordinate.name, f"{coordinate.name}'")]
    shown = [row for row, output in enumerate(nominal.outputs) if output.name not in names]
    values = {
        name: {use: [part.q[:, row] if not rate else part.v[:, row] for part in parts] for use, parts in moved.items()}
        for row, coordinate in enumerate(nominal.coordinates)
        for rate, name in enumerate((coordinate.name, f"{coordinate.name}'"))
    }
    for row in shown:
        values[nominal.outputs[row].name] = {use: [part.y[:, row] for part in parts] for use, parts in moved.items()}
    for row, channel in enumerate(nominal.inputs):
        values[channel.name] = {use: [part.u[:, row] for part in parts] for use, parts in moved.items()}
    inputs = [channel.name for channel in nominal.inputs]
    pairs = [
        (coordinate.name, other) for coordinate in nominal.coordinates for other in (f"{coordinate.name}'", *inputs)
    ]
    pairs += [(f"{coordinate.name}'", other) for coordinate in nominal.coordinates for other in inputs]
    readings = {use: [part.y for part in parts] for use, parts in moved.items()}
    times = {use: [part.record.t for part in parts] for use, parts in moved.items()}
    return spline_directions(values, pairs, inputs, readings) + drift_directions(values, times, inputs, readings)


def _commands(
    nominal: FmuSystem,
    moved: Mapping[str, Sequence[Moved]],
    placed: Placed,
    sizes: Mapping[str, Mapping[str, float]],
    kind: str,
    lines: Lines,
) -> list[Direction]:
    """Return the directions of an effect before the FMU: what it makes of the command, less the command."""
    at = sizes.get(placed.at, {})
    directions = []
    for given, linear, phase in _tried(placed, at, lines):
        names = linear or ("effect",)
        complete = placed.effect.complete(given, at)
        cases = [{**complete, **case} for case in _cases(placed, linear, phase)]
        forces: dict[str, list[FloatArray]] = {}
        for use, parts in moved.items():
            forces[use] = []
            for part in parts:
                if kind == "input":
                    each = [input_behind(placed, part, nominal, case) - part.record.u for case in cases]
                else:
                    each = [_added(nominal, placed, part, case) for case in cases]
                columns = [later - each[0] for later in each[1:]] if linear else each
                forces[use].append(np.stack(columns, axis=2))
        readings = {use: [np.zeros((len(part.y), nominal.ny, len(names))) for part in parts]
                    for use, parts in moved.items()}  # fmt: skip
        directions.append(Direction(placed, given, names, forces, readings, "wave" if phase else "linear"))
    return directions


def _cases(placed: Placed, linear: Sequence[str], phase: bool) -> list[dict[str, float]]:
    """Return values of the linear parameters: none of them, then each alone; sine and cosine of a phase."""
    if not linear:
        return [{}]
    amplitude = next(
        (parameter.name for parameter in placed.effect.parameters if parameter.linear and not parameter.fixed), ""
    )
    turn = placed.effect.parameter_of("phase")
    if phase and turn is not None:
        cases = ((0.0, 0.0), (1.0, 0.0), (1.0, 0.5 * np.pi))
        return [{amplitude: size, turn.name: angle} for size, angle in cases]
    nothing = {name: placed.effect.parameter(name).neutral or 0.0 for name in linear}
    return [nothing, *({**nothing, name: nothing[name] + 1.0} for name in linear)]


def _tried(
    placed: Placed, at: Mapping[str, float], lines: Lines
) -> list[tuple[dict[str, float], tuple[str, ...], bool]]:
    """Return choices of the nonlinear parameters; of a periodic push the strongest lines of the output error."""
    frequency = placed.effect.parameter_of("frequency")
    if frequency is None:
        return [(given, linear, False) for given, linear in choices(placed, at)]
    return [({frequency.name: omega}, WAVE, True) for omega in lines()]


def _lines(moved: Mapping[str, Sequence[Moved]]) -> list[float]:
    """Return the angular frequencies [rad/s] of the strongest lines of the output error."""
    longest = max(moved["estimation"], key=lambda part: len(part.y))
    error = np.nan_to_num(longest.record.y - longest.y)
    n = len(error)
    power = (np.abs(np.fft.rfft((error - error.mean(axis=0)) * np.hanning(n)[:, None], 4 * n, axis=0)) ** 2).sum(axis=1)
    omega = 2 * np.pi * np.arange(len(power)) / (4 * n * longest.dt)
    power[omega * n * longest.dt < 2 * 2 * np.pi] = 0.0  # two periods at least
    lines: list[float] = []
    for _ in range(EFFORT.lines):
        peak = int(np.argmax(power))
        if omega[peak] > 0:
            lines.append(float(omega[peak]))
        power[max(peak - 12, 0) : peak + 13] = 0.0
    return lines


def _added(nominal: FmuSystem, placed: Placed, moved: Moved, values: Mapping[str, float]) -> FloatArray:
    """Return what an effect adds to the command along a motion (K, nu); hidden states by Runge-Kutta steps."""
    made, step = _compiled(nominal, placed, moved.dt)
    around = made.around
    assert around is not None
    n = len(moved.u)
    pairs = zip(placed.effect.parameters, made.parameters[made.inner_count :], strict=True)
    p = np.array([parameter.value if parameter.fixed else values[short.name] for short, parameter in pairs])
    functions, z = around.functions, np.zeros((around.z.shape[0], n))
    motion = [moved.u.T, moved.q.T, moved.v.T, moved.record.t[None]]
    if around.z.shape[0]:
        begun = np.array(functions["starts"](moved.u[0], moved.q[0], moved.v[0], p)).ravel()
        run = step.mapaccum(n - 1)(begun, *(part[:, :-1] for part in motion), *(part[:, 1:] for part in motion),
                                   np.tile(p[:, None], n - 1))  # fmt: skip
        z = np.concatenate([begun[:, None], run.full()], axis=1)
    command = functions["command"].map(n)(*motion, z, np.tile(p[:, None], n)).full().T
    return np.asarray(command - moved.u)


@functools.lru_cache(maxsize=64)
def _compiled(nominal: FmuSystem, placed: Placed, dt: float) -> tuple[FmuSystem, Any]:
    """Return the FMU with one effect around it, and a Runge-Kutta step of the effect's states; None without any."""
    import casadi as ca

    made = surround(nominal, [placed])
    around = made.around
    assert around is not None
    if not around.z.shape[0]:
        return made, None
    sizes = (nominal.nu, len(nominal.coordinates), len(nominal.coordinates), 1)
    start, end = ([ca.SX.sym(name, size) for name, size in zip("uqvt", sizes, strict=True)] for _ in range(2))
    first, own = ca.SX.sym("z", around.z.shape[0]), ca.SX.sym("p", len(placed.effect.parameters))

    def derivative(now: Any, share: float) -> Any:
        mixed = [start[0], *((1 - share) * a + share * b for a, b in zip(start[1:], end[1:], strict=True))]
        return around.functions["derivatives"](*mixed, now, own)

    after = advanced(derivative, first, dt, PARTS)
    return made, ca.Function("step", [first, *start, *end, own], [after])
