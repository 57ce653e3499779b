"""The master algorithm: several plants stepped as one."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from math import isfinite
from typing import Any, Literal, Self, cast

import numpy as np

from harness.cosim.controlled import Controlled, Hold, SignalLines
from harness.cosim.graph import followers, newton, reached_at_once, strong_components
from harness.cosim.initial import initialise
from harness.cosim.texts import split
from harness.cosim.watched import watched
from harness.cosim.wiring import Connection, Part, ShownOutput, channel_of, check_wires, locate, place, shower
from harness.errors import InputError, PlantError, refuse_unknown
from harness.protocols import Ability, Feedthrough, Plant, Snapshots, Truth
from harness.signals import Channel, FloatArray, PlantSpec

Order = Literal["jacobi", "gauss-seidel"]
ASTRAY = "what they compute from their inputs at the start has no end in a loop: they begin at their own start values"


def _check_asked(parts: Mapping[str, Plant], order: str) -> None:
    """Refuse nothing to couple, and an order that does not exist."""
    if not parts:
        raise InputError("nothing to couple", expected="at least one part", got="none", remedy="name the parts")
    refuse_unknown("order", order, ("jacobi", "gauss-seidel"), remedy="choose one")


class Coupled:
    """Several plants as one.

    Parameters
    ----------
    parts : mapping of str to Plant
        The names are used in connections; the parts are owned (closed) by the coupled plant.
    connections : sequence of Connection or (source, target)
        Unit-checked; a unit that converts is converted. Texts and bytes of FMUs are carried as they are, at
        communication instants.
    inputs : mapping of str to str or Channel, or sequence of str
        External inputs: name of the new input -> its channel, or the part's input that lends it; a sequence of
        ``"part.input"`` connects them as well, under the same names.
    outputs : sequence of str or Shown
        ``"part.output"``; their channels carry these names. A :class:`harness.cosim.wiring.ShownOutput` brings its own.
    order : {"gauss-seidel", "jacobi"}
        Order of stepping.
    sequence : sequence of str, optional
        Order of the parts within a Gauss-Seidel step; default: the order of ``parts``.
    sample_time : float, optional
        Communication step [s]; default: the smallest sample time of the parts. Every part's sample time must be an
        integer multiple of it.
    loops : {"solve", "refuse"}
        What to do with algebraic loops (cycles of parts with direct feedthrough): Newton iteration on the signals of
        the cycle, or an error that names the cycle.
    iterations : int
        Passes over each step; more than one (strong coupling) rolls the parts back in between and needs the ability
        ``"snapshots"`` of every part.
    tolerance : float
        Relative tolerance of the loop iterations.
    hold : {"constant", "linear"}
        What a part takes a real signal of another part for within a step: its value at the beginning, or the mean of
        the line through its values (extrapolated from the last step, interpolated where the source has stepped).
        ``"linear"`` is of second order in the step; it needs one rate and one pass.
    error : float, optional
        Largest error of a signal per step, relative to one more than its size: the parts exchange as often within a
        communication step as that asks for, see :class:`harness.cosim.controlled.Controlled`.
    initial : mapping of str to float, optional
        Initial states ``"part.state"`` of every run, where ``reset`` does not say otherwise.

    Raises
    ------
    InputError
        If a name, a unit, a sample time or an ability does not fit, an input is left open or driven twice, or there
        is an algebraic loop and ``loops="refuse"``.

    Examples
    --------
    >>> from harness import registry
    >>> arms = {name: registry.create("plants", "pendulum-ode", sample_time=0.01) for name in ("left", "right")}
    >>> pair = Coupled(arms, [Connection("push", "left.u"), Connection("push", "right.u", gain=-1.0)],
    ...                inputs={"push": "left.u"}, outputs=["left.theta", "right.theta"])
    >>> print(pair.spec)
    push [N m] -> left.theta [rad], right.theta [rad] every 0.01 s
    """

    snapshot_tolerance: float  # Sum of the parts' tolerances; not there where every part repeats bit for bit.
    beyond: tuple[str, ...]  # Parameters of parts that were given values outside their bounds.
    warnings: tuple[str, ...] = ()  # What is odd about the system that the plant was built from.
    input_starts: tuple[float, ...] = ()  # Start values of the inputs in SI, where the system says any.

    def __init__(
        self,
        parts: Mapping[str, Plant],
        connections: Sequence[Connection | tuple[str, str]],
        *,
        inputs: Mapping[str, str | Channel] | Sequence[str] = (),
        outputs: Sequence[str | ShownOutput],
        order: Order = "gauss-seidel",
        sequence: Sequence[str] | None = None,
        sample_time: float | None = None,
        loops: Literal["solve", "refuse"] = "solve",
        iterations: int = 1,
        tolerance: float = 1e-10,
        hold: Hold = "constant",
        error: float | None = None,
        initial: Mapping[str, float] | None = None,
    ) -> None:
        _check_asked(parts, order)
        step = sample_time if sample_time is not None else min(plant.spec.sample_time for plant in parts.values())
        parts = {name: watched(plant, name) for name, plant in parts.items()}
        self._parts = place(parts, step)
        self.beyond = tuple(f"{name}.{text}" for name, part in parts.items() for text in getattr(part, "beyond", ()))
        self._order: Order = order
        self._iterations = iterations
        self._tolerance = tolerance
        self._initial = dict(initial or {})
        self._checked_states(self._initial)
        external, led_in = self._external_inputs(inputs)
        self._ny = sum(part.plant.spec.ny for part in self._parts)
        given = [c if isinstance(c, Connection) else Connection(*c) for c in connections]
        wanted, self._texts = split(parts, given)
        self._wires = check_wires(self._parts, [*wanted, *led_in], external)
        self._late = [wire for wire in self._wires if wire.delay]
        shown, seen = self._outputs_seen(outputs, external)
        self._sequence = self._in_sequence(list(parts) if sequence is None else sequence)
        self._self_fed, self._direct = self._direct_groups(refuse_loops=loops == "refuse")
        touched = reached_at_once(self._parts, self._wires)
        through = self._feeds_through(seen, touched)
        self._show = shower([(i, one.transform) for i, one in zip(seen, shown, strict=True)])
        channels = tuple(external), tuple(one.channel for one in shown)
        self._abilities, states = self._told(through)
        self._abilities |= self._rollback(iterations)
        self._spec = PlantSpec(*channels, step, states, through)
        self._on_close: list[Callable[[], object]] = []
        self._outside = slice(self._ny, self._ny + len(external))
        self._shape = (len(external),)
        self._exposed = [group for group in self._direct if any(part in touched for part in group)]
        self._one_rate = all(part.every == 1 for part in self._parts)
        # bound methods looked up once: the loop over the parts is the hot path
        self._calls = [(part, part.read, part.plant.step, part.outputs, part.plant.spec.ny) for part in self._sequence]
        self._lines = SignalLines(self._parts, self._ny) if self._checked_hold(hold) == "linear" else None
        self._controlled = None if error is None else Controlled(self._parts, error, self._late, iterations)
        self._tick = 0
        self._signals = [0.0] * (self._ny + len(external) + len(self._late))

    def _external_inputs(
        self, inputs: Mapping[str, str | Channel] | Sequence[str]
    ) -> tuple[list[Channel], list[Connection]]:
        """Return the channels of the external inputs, and the connections that a plain sequence of them makes."""
        lenders: Mapping[str, str | Channel] = (
            inputs if isinstance(inputs, Mapping) else {name: name for name in inputs}
        )
        channels = [
            replace(lender if isinstance(lender, Channel) else channel_of(self._parts, lender, "inputs"), name=name)
            for name, lender in lenders.items()
        ]
        return channels, [] if isinstance(inputs, Mapping) else [Connection(name, name) for name in inputs]

    def _outputs_seen(
        self, outputs: Sequence[str | ShownOutput], external: Sequence[Channel]
    ) -> tuple[list[ShownOutput], list[int]]:
        """Return the outputs with their channels, and where each stands among the signals."""
        shown = [
            one
            if isinstance(one, ShownOutput)
            else ShownOutput(one, replace(channel_of(self._parts, one, "outputs"), name=one))
            for one in outputs
        ]
        slots = {channel.name: self._ny + at for at, channel in enumerate(external)}
        seen = [
            slots[one.source] if one.source in slots else locate(self._parts, one.source, "outputs") for one in shown
        ]
        return shown, seen

    def _feeds_through(self, seen: Sequence[int], touched: Sequence[Part]) -> bool:
        """Return True if an output is an external input, or of a part that one reaches within the step."""
        return any(i >= self._ny or any(part.outputs.start <= i < part.outputs.stop for part in touched) for i in seen)

    def _told(self, through: bool) -> tuple[frozenset[Ability], tuple[Channel, ...]]:
        """Return what the system can tell of itself, and the states of the parts that tell theirs."""
        knowing = [part for part in self._parts if "truth" in part.plant.abilities]
        states = [replace(c, name=f"{part.name}.{c.name}") for part in knowing for c in part.plant.spec.states]
        told: dict[Ability, bool] = {"truth": bool(knowing), "feedthrough": through}
        return frozenset(name for name, there in told.items() if there), tuple(states)

    def _in_sequence(self, names: Sequence[str]) -> list[Part]:
        """Return the parts in their order within a step."""
        by_name = {part.name: part for part in self._parts}
        if sorted(names) != sorted(by_name):
            raise InputError(
                "sequence", expected=f"each of {list(by_name)} once", got=repr(list(names)), remedy="list them all"
            )
        return [by_name[name] for name in names]

    def _direct_groups(self, *, refuse_loops: bool) -> tuple[list[Part], list[list[Part]]]:
        """Return the parts that feed themselves, and those with feedthrough, grouped by the cycles that they form."""
        after = {part.name: followers(part, self._parts, self._wires) for part in self._parts}
        self_fed = [part for part in self._parts if part in after[part.name]]
        groups = strong_components([p for p in self._parts if p.feeds_through], lambda part: after[part.name])
        cycles = [[p.name for p in group] for group in groups if len(group) > 1 or group[0] in self_fed]
        if cycles and refuse_loops:
            raise InputError(
                "algebraic loop",
                expected="no cycle of direct feedthrough",
                got=" and ".join(" -> ".join([*cycle, cycle[0]]) for cycle in cycles),
                remedy="give one wire of the cycle delay=1, or loops='solve'",
            )
        return self_fed, groups

    def _rollback(self, iterations: int) -> set[Ability]:
        """Return the ability to be rolled back, which all parts must have; strong coupling needs it."""
        lacking = [part.name for part in self._parts if "snapshots" not in part.plant.abilities]
        if lacking and iterations > 1:
            raise InputError(
                "strong coupling needs rollback",
                expected="the ability 'snapshots' of every part",
                got=f"{', '.join(lacking)} without it",
                remedy="use iterations=1",
            )
        if lacking:
            return set()
        tolerances = [getattr(part.plant, "snapshot_tolerance", 0.0) for part in self._parts]
        if any(tolerances):
            self.snapshot_tolerance = float(sum(tolerances))
        return {"snapshots"}

    @property
    def now(self) -> float:
        """Time [s] that was reached by the last step."""
        return self._tick * self._spec.sample_time

    @property
    def spec(self) -> PlantSpec:
        """Channels of the coupled plant; its sample time is the communication step."""
        return self._spec

    @property
    def abilities(self) -> frozenset[Ability]:
        """Snapshots if all parts have them; truth of the parts that know it; feedthrough as the wires carry it."""
        return self._abilities

    def reset(self, *, rng: np.random.Generator, x0: Mapping[str, float] | None = None) -> FloatArray:
        """Reset every part, each with its own stream; initial states are named ``"part.state"``.

        What an FMU computes from its inputs while it initialises, it computes from what drives them then.
        """
        own = self._checked_states({**self._initial, **(x0 or {})})
        outside = self.input_starts or (0.0,) * len(self._spec.inputs)
        inside = {wire.target for wire in self._wires if not wire.external or self.input_starts}
        led = [part for part in self._parts if inside & set(range(part.inputs.start, part.inputs.stop))]
        initial = [part for part in led if getattr(part.plant, "drives", False)]
        for part, stream in zip(self._parts, rng.spawn(len(self._parts)), strict=True):
            if part in initial:
                cast(Any, part.plant).enter(rng=stream, x0=own[part.name] or None)
            else:
                self._put(part, part.plant.reset(rng=stream, x0=own[part.name] or None))
        self._tick = 0
        if self._lines is not None:
            self._lines.forget()
        if self._controlled is not None:
            self._controlled.forget()
        signals = self._signals
        signals[self._outside] = list(outside)
        if initial:
            self._initialise(initial, inside)
        for group in self._direct:  # a delay line starts with its source's first value
            self._fill_lines()
            self._evaluate([group])
        self._fill_lines()
        for wire in self._late:
            wire.memory = deque([signals[wire.source]] * wire.delay)
        if self._texts is not None:
            self._texts.move()
        self._evaluate(self._direct)
        return self._shown_outputs()

    def _initialise(self, initial: Sequence[Part], inside: set[int]) -> None:
        """Bring parts through their initialisation, with what drives their inputs, and parts that answer at once."""
        static = [part for group in self._direct for part in group if part not in initial]

        def agree() -> None:
            self._fill_lines()
            for part in static:
                self._refresh(part)
            self._fill_lines()

        stuck = initialise(initial, self._signals, inside, self._put, agree, self._tolerance)
        if stuck and (said := f"{', '.join(stuck)}: {ASTRAY}") not in self.warnings:
            self.warnings += (said,)
        for part in initial:
            self._put(part, cast(Any, part.plant).leave())

    def preset(self, values: Mapping[str, Any]) -> None:
        """Set parameters and start values of parts (``"part.name"``, SI) for the resets to come, where they take any.

        Raises
        ------
        InputError
            If there is no such part, it takes none, or it has no such variable.
        """
        for name, own in self._checked_states(values).items():
            if not own:
                continue
            plant: Any = next(part.plant for part in self._parts if part.name == name)
            if not hasattr(plant, "preset"):
                raise InputError(
                    "values of a part",
                    expected="a part that is an FMU",
                    got=f"{name!r}, a {type(plant).__name__}",
                    remedy="give its options in the file",
                )
            plant.preset(own)

    def output(self, u: FloatArray) -> FloatArray:
        """Return the outputs with ``u`` (nu,) applied, while no time passes."""
        self._apply(u)
        return self._shown_outputs()

    def step(self, u: FloatArray) -> FloatArray:
        """Advance every part that is due by the communication step; returns the outputs (ny,)."""
        self._apply(u)
        if self._controlled is not None:
            self._controlled.step(self._snapshot, self._restore, self._through, lambda: self._signals[: self._ny])
        elif self._iterations > 1:
            self._iterate()
        elif self._late:
            start = self._signals.copy()
            self._advance(None)
            self._move_lines(start)
        else:
            self._advance(None)
        self._tick += 1
        if self._direct:
            self._evaluate(self._direct)
        if self._texts is not None:
            self._texts.move()
        return self._shown_outputs()

    def truth(self) -> FloatArray:
        """Return the true states of all parts that know them."""
        known = [cast(Truth, p.plant).truth() for p in self._parts if "truth" in p.plant.abilities]
        return np.concatenate(known) if known else np.zeros(0)

    def get_state(self) -> Any:
        """Return the states of all parts, the held signals and the delay lines."""
        return self._snapshot()

    def set_state(self, state: Any) -> None:
        """Go back to a state taken with :meth:`get_state`."""
        self._restore(state)

    def close(self) -> None:
        """Close every part."""
        for part in self._parts:
            part.plant.close()
        for job in self._on_close:
            job()
        self._on_close.clear()

    def after_close(self, job: Callable[[], object]) -> None:
        """Have something done once when the coupled plant is closed (a temporary folder removed)."""
        self._on_close.append(job)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def _shown_outputs(self) -> FloatArray:
        return self._show(self._signals)

    def _apply(self, u: FloatArray) -> None:
        """Take the external inputs over, and what they reach within the instant."""
        values = u.tolist() if isinstance(u, np.ndarray) and u.shape == self._shape else self._checked(u)
        if values == self._signals[self._outside]:
            return  # all signals agree already
        if not isfinite(sum(values)):
            values = self._checked(u)
        self._signals[self._outside] = values
        if self._exposed:
            self._evaluate(self._exposed)

    def _put(self, part: Part, y: FloatArray) -> None:
        """Store a part's outputs."""
        values = y.tolist()
        if len(values) != part.outputs.stop - part.outputs.start:
            raise PlantError(f"part {part.name!r}: {len(values)} outputs instead of {part.plant.spec.ny}")
        self._signals[part.outputs] = values

    def _advance(self, held: dict[str, FloatArray] | None) -> None:
        """Step the parts that are due, in sequence; under Gauss-Seidel with what is already new."""
        tick, signals = self._tick, self._signals
        if self._lines is not None:
            self._along_lines(self._lines, 0, 1)
            return
        if held is None and self._order == "jacobi":
            held = {part.name: part.read(signals) for part in self._sequence if tick % part.every == 0}
        if held is None and self._one_rate:
            for part, read, step, place, count in self._calls:
                values = step(read(signals)).tolist()
                if len(values) != count or not isfinite(sum(values)):
                    self._check_outputs(part, values)
                signals[place] = values
            return
        for part in self._sequence:
            if tick % part.every == 0:
                part.held = part.read(signals) if held is None else held[part.name]
            if (tick + 1) % part.every == 0:  # else its next output appears when its own sample time has passed
                values = part.plant.step(part.held).tolist()
                self._check_outputs(part, values)
                signals[part.outputs] = values

    def _through(self, count: int) -> None:
        """Advance through a communication step in so many equal exchanges."""
        for k in range(count):
            if self._lines is not None:
                self._along_lines(self._lines, k, count)
            else:
                jacobi = [part.read(self._signals) for part in self._sequence] if self._order == "jacobi" else None
                for number, part in enumerate(self._sequence):
                    u = part.read(self._signals) if jacobi is None else jacobi[number]
                    self._step_part(part, u, k, count)
                if self._direct and k < count - 1:
                    self._evaluate(self._direct)

    def _along_lines(self, lines: SignalLines, k: int, count: int) -> None:
        """Step every part over the k-th of so many pieces, signals of others being lines within it."""
        start, h = self._signals.copy(), self._spec.sample_time / count
        middle = lines.extrapolated(start, h)
        for part in self._sequence:
            self._step_part(part, part.read(middle), k, count)
            if self._order == "gauss-seidel" and not part.feeds_through:  # else it shows what it held, not the end
                lines.interpolate(middle, start, self._signals, part)
        if self._direct:
            self._evaluate(self._direct)
        lines.remember(start, self._signals, h)

    def _step_part(self, part: Part, u: FloatArray, k: int, count: int) -> None:
        """Step one part over the k-th of so many equal pieces of the communication step."""
        y = part.plant.step(u) if count == 1 else cast(Any, part.plant).step_part(u, k, count)
        values = y.tolist()
        self._check_outputs(part, values)
        self._signals[part.outputs] = values

    def _checked_hold(self, hold: str) -> str:
        """Return how signals are held within a step, or refuse it."""
        refuse_unknown("hold", hold, ("constant", "linear"), remedy="choose one")
        slow = [part.name for part in self._parts if part.every > 1]
        if hold == "linear" and (slow or self._iterations > 1 or self._late):
            got = (
                f"{', '.join(slow)} at another rate" if slow else "several passes" if self._iterations > 1 else "delays"
            )
            raise InputError(
                "signals as lines within a step",
                expected="parts of one rate, one pass, no delayed wires",
                got=got,
                remedy="hold='constant'",
            )
        return hold

    def _check_outputs(self, part: Part, values: list[float]) -> None:
        """Refuse outputs of a wrong number or that are not finite."""
        t = (self._tick + 1) * self._spec.sample_time
        if len(values) != part.plant.spec.ny:
            raise PlantError(f"part {part.name!r}: {len(values)} outputs instead of {part.plant.spec.ny}")
        if not all(map(isfinite, values)):
            raise PlantError(f"part {part.name!r}: an output is not finite at t = {t:g} s", status="diverged")

    def _iterate(self) -> None:
        """Repeat the step with the outputs of the pass before as inputs, until they agree (strong coupling)."""
        before = self._snapshot()
        start, ny = self._signals.copy(), self._ny
        self._advance(None)
        for _ in range(1, self._iterations):
            guess = self._signals[:ny]
            self._restore(before)
            self._signals[:ny] = guess
            held = {part.name: part.read(self._signals) for part in self._parts}
            self._signals[:ny] = start[:ny]
            self._advance(held)
            if np.allclose(self._signals[:ny], guess, rtol=self._tolerance, atol=self._tolerance):
                break
        self._move_lines(start)

    def _fill_lines(self) -> None:
        """Let every delayed wire show its source as it is now."""
        for wire in self._late:
            self._signals[wire.slot] = self._signals[wire.source]

    def _move_lines(self, start: list[float]) -> None:
        """Take the signals of the step's beginning into the delay lines, and show what comes out of them next."""
        for wire in self._late:
            wire.memory.append(start[wire.source])
            wire.memory.popleft()
            self._signals[wire.slot] = wire.memory[0]

    def _evaluate(self, groups: list[list[Part]]) -> None:
        """Bring inputs and fed-through outputs of one instant into agreement; loops by Newton's method."""
        for group in groups:
            if len(group) == 1 and group[0] not in self._self_fed:
                self._refresh(group[0])
            else:
                self._solve_loop(group)

    def _refresh(self, part: Part) -> None:
        """Recompute the outputs of one part with direct feedthrough, if it is its time."""
        if self._tick % part.every == 0:
            self._put(part, cast(Feedthrough, part.plant).output(part.read(self._signals)))

    def _solve_loop(self, group: list[Part]) -> None:
        """Solve y = g(y) for the outputs of a cycle."""
        places = [i for part in group for i in range(part.outputs.start, part.outputs.stop)]

        def put(values: FloatArray) -> None:
            for i, value in zip(places, values.tolist(), strict=True):
                self._signals[i] = value

        def miss(values: FloatArray) -> FloatArray:
            put(values)
            for part in group:
                self._refresh(part)
            gap: FloatArray = np.array([self._signals[i] for i in places]) - values
            return gap

        found = newton(miss, np.array([self._signals[i] for i in places]), self._tolerance)
        if found is not None:
            put(found)
            return
        names = " -> ".join([part.name for part in group] + [group[0].name])
        t = self._tick * self._spec.sample_time
        raise PlantError(f"algebraic loop {names} has no solution that Newton's method finds at t = {t:g} s")

    def _snapshot(self) -> Any:
        parts = [cast(Snapshots, part.plant).get_state() for part in self._parts]
        memories = [tuple(wire.memory) for wire in self._late]
        lines = None if self._lines is None else tuple(self._lines.rates)
        return parts, self._tick, tuple(self._signals), memories, [part.held for part in self._parts], lines

    def _restore(self, state: Any) -> None:
        parts, self._tick, signals, memories, inputs, rates = state
        if self._lines is not None and rates is not None:
            self._lines.rates[:] = rates
        for part, own, kept in zip(self._parts, parts, inputs, strict=True):
            cast(Snapshots, part.plant).set_state(own)
            part.held = kept
        self._signals[:] = signals
        for wire, memory in zip(self._late, memories, strict=True):
            wire.memory = deque(memory)

    def _checked_states(self, given: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
        """Return the initial states by part, or refuse a part."""
        own: dict[str, dict[str, Any]] = {part.name: {} for part in self._parts}
        for name, value in given.items():
            head, _, tail = name.partition(".")
            if head not in own:
                raise InputError(
                    "initial state",
                    expected=f"part.state with a part among {', '.join(own)}",
                    got=repr(name),
                    remedy="correct the name",
                )
            own[head][tail] = value
        return own

    def _checked(self, u: FloatArray) -> list[float]:
        """Return the external inputs as numbers, or refuse them."""
        values = np.asarray(u, dtype=float)
        if values.shape != self._shape or not np.isfinite(values).all():
            raise InputError(
                "input of the coupled plant",
                expected=f"{self._spec.nu} finite numbers, shape ({self._spec.nu},)",
                got=f"shape {values.shape}" if values.shape != (self._spec.nu,) else "a value that is not finite",
                remedy=f"give one value for each of {', '.join(c.name for c in self._spec.inputs) or 'no inputs'}",
            )
        numbers: list[float] = values.tolist()
        return numbers
