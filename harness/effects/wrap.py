"""Effects around any plant: input and output effects sample by sample, forces through an input that acts there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self, cast

import numpy as np

from harness.effects.dictionary import find
from harness.effects.effect import Effect
from harness.effects.sampled import DelayLine, quantise
from harness.errors import InputError
from harness.protocols import Ability, Feedthrough, Plant, Snapshots, Truth
from harness.signals import Channel, FloatArray, PlantSpec

_LARGEST_SUBSTEPS = 1000
_INSIDE = frozenset({"a", "load", "damping", "pull", "temperature"})
"""Arguments of a law that nobody knows from outside a plant."""
_RATE_SUFFIXES = ("_rate", "_dot", "d")  # what the rate of a coordinate is called
_RATE_PREFIXES = ("d", "v_")


class WrappedPlant:
    """A plant with effects around it.

    Input effects change the command before the plant sees it, output effects change the reading. What a hidden state
    of an input effect does within one sample reaches the plant as its mean over the sample. A force on a coordinate
    is possible only where an input acts there: it is computed from the coordinate (half a sample ahead) and its rate
    as known at the start of the sample, and held; what is stiff within a sample belongs inside the plant.

    Parameters
    ----------
    plant : Plant
        Any plant: FMU, Bullet, pymunk, ODE, replay.
    effects : sequence of (effect, port, parameters)
        Effects by name or as :class:`harness.effects.Effect`, in order of action; parameters that are not given get
        the start values of their scale hints for data of size 1 (the main one must be given).
    drives : mapping, optional
        Coordinate (an output) to the input whose force acts on it. Without it an input drives the output of the same
        number, if their units fit (N m on rad, N on m) and no other input could be meant.

    Raises
    ------
    InputError
        If an effect, port or parameter is unknown, or the effect does not fit the port; the message names what does.

    Notes
    -----
    The wrapped plant keeps the abilities ``snapshots``, ``truth`` and ``feedthrough`` of the plant inside.

    Examples
    --------
    >>> from harness.effects.wrap import WrappedPlant
    >>> class Gain:                              # any plant: here y[k+1] = u[k]
    ...     spec = PlantSpec((Channel("u", "V"),), (Channel("y", "V"),), 0.1)
    ...     abilities = frozenset()
    ...     def reset(self, *, rng, x0=None): return np.zeros(1)
    ...     def step(self, u): return np.array(u)
    ...     def close(self): pass
    >>> late = WrappedPlant(Gain(), [("input_delay", "u", {"tau": 0.1}), ("sensor_offset", "y", {"offset": 5.0})])
    >>> late.reset(rng=np.random.default_rng(0)).tolist(), [late.step(np.array([u])).tolist() for u in (1.0, 2.0, 3.0)]
    ([5.0], [[6.0], [6.0], [7.0]])
    """

    def __init__(
        self,
        plant: Plant,
        effects: Sequence[tuple[str | Effect, str, Mapping[str, float]]],
        *,
        drives: Mapping[str, str] | None = None,
    ) -> None:
        self.plant = plant
        self._inputs: list[_Stage] = []
        self._forces: list[_Stage] = []
        self._outputs: list[_Stage] = []
        for given, port, values in effects:
            self._place(find(given), port, values, drives)
        self._y = np.zeros(plant.spec.ny)
        self._rates = np.zeros(plant.spec.ny)
        self._k = 0

    @property
    def spec(self) -> PlantSpec:
        """Channels and sample time: those of the plant inside."""
        return self.plant.spec

    @property
    def abilities(self) -> frozenset[Ability]:
        """What the plant inside can do, but for batches."""
        return frozenset(self.plant.abilities & {"snapshots", "truth", "feedthrough"})

    @property
    def snapshot_tolerance(self) -> float:
        """Tolerance of the plant inside (0: bit for bit)."""
        return float(getattr(self.plant, "snapshot_tolerance", 0.0))

    @property
    def beyond(self) -> tuple[str, ...]:
        """Parameters of the plant inside that were given values outside their bounds."""
        return tuple(getattr(self.plant, "beyond", ()))

    @property
    def held(self) -> tuple[str, ...]:
        """Effects that are forces: they are held over each sample."""
        outputs = self.spec.outputs
        return tuple(f"{stage.effect.name}@{outputs[stage.output].name}" for stage in self._forces)

    def reset(self, *, rng: np.random.Generator, x0: Mapping[str, float] | None = None) -> FloatArray:
        """Start anew; the hidden states of the effects start at rest."""
        y = np.array(self.plant.reset(rng=rng, x0=x0), dtype=float)
        for stage in self._stages():
            stage.reset()
        self._y, self._rates, self._k = y, np.zeros_like(y), 0
        self._read_rates(y, first=True)
        return self._measured(y, advance=True)

    def step(self, u: FloatArray) -> FloatArray:
        """Hold the command ``u`` (nu,) for one sample time; returns the next reading (ny,)."""
        applied = self._applied(np.array(u, dtype=float), advance=True)
        y = np.array(self.plant.step(applied), dtype=float)
        self._k += 1
        self._read_rates(y, first=False)
        self._y = y
        return self._measured(y, advance=True)

    def output(self, u: FloatArray) -> FloatArray:
        """Return the reading with ``u`` applied, while no time passes (plants with feedthrough)."""
        applied = self._applied(np.array(u, dtype=float), advance=False)
        return self._measured(np.array(cast(Feedthrough, self.plant).output(applied), dtype=float), advance=False)

    def truth(self) -> FloatArray:
        """Return the true states of the plant inside."""
        return cast(Truth, self.plant).truth()

    def get_state(self) -> Any:
        """Return the state of the plant and of every effect."""
        inside = cast(Snapshots, self.plant).get_state()
        return inside, self._y.copy(), self._rates.copy(), self._k, [stage.get_state() for stage in self._stages()]

    def set_state(self, state: Any) -> None:
        """Go back to a state of this same object."""
        inside, y, rates, self._k, stages = state
        cast(Snapshots, self.plant).set_state(inside)
        self._y, self._rates = y.copy(), rates.copy()
        for stage, saved in zip(self._stages(), stages, strict=True):
            stage.set_state(saved)

    def close(self) -> None:
        """Release the engine."""
        self.plant.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    # ---- inside ---------------------------------------------------------------------------------------------------

    def _stages(self) -> list[_Stage]:
        return [*self._inputs, *self._forces, *self._outputs]

    def _applied(self, u: FloatArray, *, advance: bool) -> FloatArray:
        """Return what the plant sees of a command."""
        t = self._k * self.spec.sample_time
        for stage in self._inputs:
            u[stage.column] = stage.pass_input(u[stage.column], t, advance=advance)
        total = u.copy()
        for stage in self._forces:
            output = stage.output
            v = self._rates[output]
            q = self._y[output] + 0.5 * self.spec.sample_time * v  # the middle of the coming sample: second order
            total[stage.column] += stage.force(u[stage.column], q, v, t, advance=advance)
        return total

    def _measured(self, y: FloatArray, *, advance: bool) -> FloatArray:
        """Return the readings of true outputs."""
        t = self._k * self.spec.sample_time
        reading = y.copy()
        for stage in self._outputs:
            reading[stage.column] = stage.pass_output(reading[stage.column], t, advance=advance)
        return reading

    def _read_rates(self, y: FloatArray, *, first: bool) -> None:
        """Find the rate of each coordinate that a force needs: measured, true, or the difference of two samples."""
        for stage in self._forces:
            row = stage.output
            measured = _rate_of(self.spec, row, self.spec.outputs)
            true = _rate_of(self.spec, row, self.spec.states)
            if measured is not None:
                self._rates[row] = y[measured]
            elif true is not None and "truth" in self.plant.abilities:
                self._rates[row] = cast(Truth, self.plant).truth()[true]
            else:
                period = self.spec.outputs[row].period
                moved = 0.0 if first else y[row] - self._y[row]
                if period is not None:
                    moved = (moved + period / 2) % period - period / 2
                self._rates[row] = moved / self.spec.sample_time

    def _place(self, effect: Effect, port: str, values: Mapping[str, float], drives: Mapping[str, str] | None) -> None:
        """Put one effect where it belongs, or refuse it."""
        spec = self.spec
        inputs = [channel.name for channel in spec.inputs]
        outputs = [channel.name for channel in spec.outputs]
        numbers = _numbers(effect, values, spec.sample_time)
        if "input" in effect.kinds and port in inputs and not _INSIDE & set(effect.extras):
            self._inputs.append(_Stage(effect, numbers, spec.sample_time, inputs.index(port)))
        elif "output" in effect.kinds and port in outputs:
            self._outputs.append(_Stage(effect, numbers, spec.sample_time, outputs.index(port)))
        elif "coordinate" in effect.kinds and not _INSIDE & set(effect.extras) and port in outputs:
            row = outputs.index(port)
            name = drives[port] if drives is not None and port in drives else _driver(spec, row)
            if name is None or name not in inputs:
                _refuse(spec, effect, port, "no input of this plant is known to act on that coordinate")
            self._forces.append(_Stage(effect, numbers, spec.sample_time, inputs.index(cast(str, name)), output=row))
        else:
            _refuse(spec, effect, port, "from outside a plant, only its inputs and outputs can be reached")


@dataclass
class _Stage:
    """One effect at work on one channel."""

    effect: Effect
    values: dict[str, float]
    dt: float
    column: int
    output: int = -1

    def __post_init__(self) -> None:
        first = self.effect.parameters[0].name if self.effect.parameters else ""
        self.line = DelayLine(self.values[first], self.dt) if self.effect.sampled.endswith("delay") else None
        self.hidden: list[float] | None = None
        self.last = 0.0

    def reset(self) -> None:
        """Forget the past."""
        self.hidden, self.last = None, 0.0
        if self.line is not None:
            self.line.reset()

    def get_state(self) -> Any:
        """Return the state of the stage: samples on its lines and hidden states."""
        line = None if self.line is None else self.line.get_state()
        return None if self.hidden is None else list(self.hidden), self.last, line

    def set_state(self, state: Any) -> None:
        """Remember what it remembered."""
        hidden, self.last, line = state
        self.hidden = None if hidden is None else list(hidden)
        if self.line is not None:
            self.line.set_state(line)

    def pass_input(self, u: float, t: float, *, advance: bool) -> float:
        """Return the mean over the coming sample of what the block makes of a held input."""
        if self.line is not None:
            return self.line.step(u) if advance else self.line.peek(u)
        both = "coordinate" in self.effect.kinds
        return self._run(u, u, 0.0, 0.0, t, advance=advance, mean=True) + (u if both else 0.0)

    def force(self, u: float, q: float, v: float, t: float, *, advance: bool) -> float:
        """Return the mean over the coming sample of the force at a held coordinate and rate."""
        return self._run(u, u, q, v, t, advance=advance, mean=True)

    def pass_output(self, y: float, t: float, *, advance: bool) -> float:
        """Return the reading of an output that moved in a straight line since the last sample."""
        if self.line is not None:
            return self.line.step(y) if advance else self.line.peek(y)
        if self.effect.sampled == "quantise":
            return float(quantise(y, self.values[self.effect.parameters[0].name]))
        before = self.last if self.hidden is not None else y
        value = self._run(before, y, y, 0.0, t, advance=advance, mean=False)
        if advance:
            self.last = y
        return value

    def _run(self, start: float, stop: float, q: float, v: float, t: float, *, advance: bool, mean: bool) -> float:
        """Advance the hidden states over one sample by Runge-Kutta steps; returns the block's mean or last value."""
        if not self.effect.states:
            return float(self._block(stop, (), q, v, t + (0.5 * self.dt if mean else 0.0))[0])
        fresh = self.hidden is None
        state = np.array(self._rest(start, q, v) if self.hidden is None else self.hidden)
        count = 0 if fresh and not mean else self._substeps(start, state, q, v, t)
        h, total, value = self.dt / max(count, 1), 0.0, 0.0

        def derivative(share: float, z: FloatArray) -> FloatArray:
            return np.array(self._block(start + share * (stop - start), z, q, v, t + share * self.dt)[1], dtype=float)

        before = float(self._block(start, state, q, v, t)[0])
        for step in range(count):
            share, half, end = step / count, (step + 0.5) / count, (step + 1) / count
            k1 = derivative(share, state)
            k2 = derivative(half, state + 0.5 * h * k1)
            k3 = derivative(half, state + 0.5 * h * k2)
            k4 = derivative(end, state + h * k3)
            state = state + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
            value = float(self._block(start + end * (stop - start), state, q, v, t + end * self.dt)[0])
            total += 0.5 * (before + value)
            before = value
        if advance:
            self.hidden = state.tolist()
        if not mean:
            return value if count else before
        return total / max(count, 1)

    def _block(self, signal: float, states: Any, q: float, v: float, t: float) -> tuple[Any, list[Any]]:
        return self.effect.evaluate(signal, states, self.values, q, v, t=t)

    def _rest(self, signal: float, q: float, v: float) -> list[float]:
        """Return where the hidden states start."""
        context = {"signal": signal, "q": q, "v": v}
        return [
            context[self.effect.initial[name]] if name in self.effect.initial else 0.0 for name in self.effect.states
        ]

    def _substeps(self, signal: float, state: FloatArray, q: float, v: float, t: float) -> int:
        """Return enough steps for the fastest of the hidden states, by differences around where they stand."""
        size = len(state)
        matrix = np.zeros((size, size))
        base = np.array(self._block(signal, state, q, v, t)[1], dtype=float)
        for column in range(size):
            moved = state.copy()
            shift = 1e-6 * max(1.0, abs(moved[column]))
            moved[column] += shift
            matrix[:, column] = (np.array(self._block(signal, moved, q, v, t)[1], dtype=float) - base) / shift
        fastest = float(np.abs(np.linalg.eigvals(matrix)).max()) if np.isfinite(matrix).all() else np.inf
        return int(np.clip(np.ceil(min(fastest * self.dt, 1e6)), 4, _LARGEST_SUBSTEPS))


def _numbers(effect: Effect, values: Mapping[str, float], dt: float) -> dict[str, float]:
    """Return all parameter values; the main one must be given."""
    if effect.main is not None and effect.main.name not in values:
        raise InputError(
            f"parameters of {effect.name}",
            expected=f"at least {effect.main.name} [{effect.main.unit}]",
            got=", ".join(values) or "none",
            remedy=f"give {effect.main.name}; the parameters are {', '.join(effect.parameter_names)}",
        )
    return effect.complete(values, {"dt": dt})


def _rate_of(spec: PlantSpec, row: int, channels: Sequence[Channel]) -> int | None:
    """Return which channel is the rate of an output: by its name, or because no other can be."""
    output = spec.outputs[row]
    names = [output.name + suffix for suffix in _RATE_SUFFIXES] + [prefix + output.name for prefix in _RATE_PREFIXES]
    rates = [place for place, channel in enumerate(channels) if channel.unit == f"{output.unit}/s"]
    named = [place for place, channel in enumerate(channels) if channel.name in names]
    if named:
        return named[0]
    alone = sum(channel.unit == output.unit for channel in spec.outputs) == 1
    return rates[0] if alone and len(rates) == 1 else None


def _driver(spec: PlantSpec, row: int) -> str | None:
    """Return the input that acts on a coordinate, if the units leave no doubt."""

    def forces(output: Channel) -> list[Channel]:
        wanted = {"rad": (["N", "m"], ["Nm"]), "m": (["N"],)}.get(output.unit, ())
        return [
            channel
            for channel in spec.inputs
            if sorted(channel.unit.replace(".", " ").replace("*", " ").split()) in wanted
        ]

    output = spec.outputs[row]
    candidates = forces(output)
    same = [channel for channel in spec.outputs if channel.unit == output.unit]
    if len(candidates) == 1 and len(same) == 1:
        return candidates[0].name
    if len(candidates) == len(same) and candidates:  # one motor for each joint, in the same order
        return candidates[same.index(output)].name
    return None


def _refuse(spec: PlantSpec, effect: Effect, port: str, why: str) -> None:
    """Raise, naming the ports that the effect fits."""
    where: list[str] = []
    if "input" in effect.kinds and not _INSIDE & set(effect.extras):
        where += [channel.name for channel in spec.inputs]
    if "output" in effect.kinds:
        where += [channel.name for channel in spec.outputs]
    if "coordinate" in effect.kinds and not _INSIDE & set(effect.extras):
        where += [channel.name for row, channel in enumerate(spec.outputs) if _driver(spec, row) is not None]
    raise InputError(
        f"effect {effect.name} does not fit {port!r} from outside this plant ({why})",
        expected=f"one of {', '.join(dict.fromkeys(where))}" if where else "a plant that takes effects inside (ode)",
        got=repr(port),
        remedy="choose such a port, or say which input drives the coordinate (drives=)",
    )
