"""The master algorithm: several plants stepped as one."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal, Self, cast

import numpy as np

from harness.cosim.wiring import Connection, Part, channel_of, check_wires, locate, place, strong_components
from harness.errors import InputError, PlantError
from harness.protocols import Ability, Feedthrough, Plant, Snapshots, Truth
from harness.signals import Channel, FloatArray, PlantSpec

__all__ = ["Coupled", "Order"]

Order = Literal["jacobi", "gauss-seidel"]


class Coupled:
    """Several plants as one.

    Parameters
    ----------
    parts : mapping of str to Plant
        The names are used in connections; the parts are owned (closed) by the coupled plant.
    connections : sequence of Connection or (source, target)
        Unit-checked; a unit that converts is converted.
    inputs : mapping of str to str or sequence of str
        External inputs: name of the new input -> the part's input that lends its channel; a sequence of
        ``"part.input"`` connects them as well, under the same names.
    outputs : sequence of str
        ``"part.output"``; their channels carry these names.
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

    def __init__(
        self,
        parts: Mapping[str, Plant],
        connections: Sequence[Connection | tuple[str, str]],
        *,
        inputs: Mapping[str, str] | Sequence[str] = (),
        outputs: Sequence[str],
        order: Order = "gauss-seidel",
        sequence: Sequence[str] | None = None,
        sample_time: float | None = None,
        loops: Literal["solve", "refuse"] = "solve",
        iterations: int = 1,
        tolerance: float = 1e-10,
    ) -> None:
        if not parts:
            raise InputError("nothing to couple", expected="at least one part", got="none", remedy="name the parts")
        if order not in ("jacobi", "gauss-seidel"):
            raise InputError("order", expected="'jacobi' or 'gauss-seidel'", got=repr(order), remedy="choose one")
        step = sample_time if sample_time is not None else min(plant.spec.sample_time for plant in parts.values())
        self._parts = place(parts, step)
        self._order: Order = order
        self._iterations = iterations
        self._tolerance = tolerance
        names = list(parts)
        if isinstance(inputs, Mapping):
            lenders = dict(inputs)
            wanted = list(connections)
        else:
            lenders = {name: name for name in inputs}
            wanted = [*connections, *(Connection(name, name) for name in inputs)]
        external = [replace(channel_of(self._parts, lender, "inputs"), name=name) for name, lender in lenders.items()]
        self._nu = sum(part.plant.spec.nu for part in self._parts)
        self._ny = sum(part.plant.spec.ny for part in self._parts)
        self._wires = check_wires(
            self._parts, [c if isinstance(c, Connection) else Connection(*c) for c in wanted], external
        )
        self._shown = np.array([locate(self._parts, name, "outputs") for name in outputs], dtype=int)
        by_name = {part.name: part for part in self._parts}
        chosen = list(sequence) if sequence is not None else names
        if sorted(chosen) != sorted(names):
            raise InputError("sequence", expected=f"each of {names} once", got=repr(chosen), remedy="list them all")
        self._sequence = [by_name[name] for name in chosen]
        self._direct, cycles = self._feedthrough_order()
        if cycles and loops == "refuse":
            raise InputError(
                "algebraic loop",
                expected="no cycle of direct feedthrough",
                got=" and ".join(" -> ".join([*cycle, cycle[0]]) for cycle in cycles),
                remedy="give one wire of the cycle delay=1, or loops='solve'",
            )
        abilities: set[Ability] = set()
        if all("snapshots" in part.plant.abilities for part in self._parts):
            abilities.add("snapshots")
        elif iterations > 1:
            lacking = [part.name for part in self._parts if "snapshots" not in part.plant.abilities]
            raise InputError(
                "strong coupling needs rollback",
                expected="the ability 'snapshots' of every part",
                got=f"{', '.join(lacking)} without it",
                remedy="use iterations=1",
            )
        states: list[Channel] = []
        for part in self._parts:
            if "truth" in part.plant.abilities:
                abilities.add("truth")
                states += [replace(c, name=f"{part.name}.{c.name}") for c in part.plant.spec.states]
        shown = [replace(channel_of(self._parts, name, "outputs"), name=name) for name in outputs]
        through = self._feeds_outputs(len(external))
        if through:
            abilities.add("feedthrough")
        self._spec = PlantSpec(tuple(external), tuple(shown), step, tuple(states), through)
        self._abilities = frozenset(abilities)
        self._tick = 0
        self._in = np.zeros(self._nu)
        self._out = np.zeros(self._ny)

    @property
    def spec(self) -> PlantSpec:
        """Channels of the coupled plant; its sample time is the communication step."""
        return self._spec

    @property
    def abilities(self) -> frozenset[Ability]:
        """Snapshots if all parts have them; truth of the parts that know it; feedthrough as the wires carry it."""
        return self._abilities

    def reset(self, *, rng: np.random.Generator, x0: Mapping[str, float] | None = None) -> FloatArray:
        """Reset every part, each with its own stream; initial states are named ``"part.state"``."""
        own: dict[str, dict[str, float]] = {part.name: {} for part in self._parts}
        for name, value in (x0 or {}).items():
            head, _, tail = name.partition(".")
            if head not in own:
                raise InputError(
                    "initial state",
                    expected=f"part.state with a part among {', '.join(own)}",
                    got=repr(name),
                    remedy="correct the name",
                )
            own[head][tail] = value
        for part, stream in zip(self._parts, rng.spawn(len(self._parts)), strict=True):
            self._out[part.outputs] = part.plant.reset(rng=stream, x0=own[part.name] or None)
        self._tick = 0
        self._in[:] = 0.0
        for wire in self._wires:
            wire.memory.clear()
        self._settle(np.zeros(self._spec.nu))
        for wire in self._wires:
            first = 0.0 if wire.external else self._out[wire.source]
            wire.memory.extend([first] * wire.delay)
        self._settle(np.zeros(self._spec.nu))
        return self._shown_outputs()

    def output(self, u: FloatArray) -> FloatArray:
        """Return the outputs with ``u`` (nu,) applied, while no time passes."""
        self._settle(self._checked(u))
        return self._shown_outputs()

    def step(self, u: FloatArray) -> FloatArray:
        """Advance every part that is due by the communication step; returns the outputs (ny,)."""
        external = self._checked(u)
        self._settle(external)
        before = self._snapshot() if self._iterations > 1 else None
        start = self._out.copy()
        guess: FloatArray | None = None
        for _ in range(self._iterations):
            if guess is not None and before is not None:
                self._restore(before)
                self._out[:] = guess
                self._wire_inputs(external)
                self._out[:] = start
            held = self._in.copy()
            self._advance(external, held, refresh=guess is None)
            if guess is not None and np.allclose(self._out, guess, rtol=self._tolerance, atol=self._tolerance):
                break
            guess = self._out.copy()
        for wire in self._wires:
            if wire.delay:
                wire.memory.append(float(external[wire.source] if wire.external else start[wire.source]))
                wire.memory.popleft()
        self._tick += 1
        self._settle(external)
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

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def _shown_outputs(self) -> FloatArray:
        shown: FloatArray = self._out[self._shown]
        return shown

    def _advance(self, external: FloatArray, held: FloatArray, *, refresh: bool) -> None:
        """Step the parts that are due, in sequence; under Gauss-Seidel with what is already new."""
        for part in self._sequence:
            if self._tick % part.every == 0:
                if self._order == "gauss-seidel" and refresh:
                    self._wire_inputs(external)
                    held = self._in
                part.held = held[part.inputs].copy()
            if (self._tick + 1) % part.every:
                continue  # a slow part: its next output appears when its own sample time has passed
            self._out[part.outputs] = part.plant.step(part.held)
            if not np.isfinite(self._out[part.outputs]).all():
                t = (self._tick + 1) * self._spec.sample_time
                raise PlantError(f"part {part.name!r}: an output is not finite at t = {t:g} s", status="diverged")

    def _wire_inputs(self, external: FloatArray) -> None:
        """Carry the signals along all wires."""
        self._in[:] = 0.0
        for wire in self._wires:
            if wire.memory:
                value = wire.memory[0]
            else:
                value = external[wire.source] if wire.external else self._out[wire.source]
            self._in[wire.target] += wire.factor * value + wire.shift

    def _settle(self, external: FloatArray) -> None:
        """Bring inputs and fed-through outputs of one instant into agreement; loops by Newton's method."""
        for group in self._direct:
            if len(group) == 1 and not self._is_loop(group[0]):
                self._refresh(group[0], external)
            else:
                self._solve_loop(group, external)
        self._wire_inputs(external)

    def _refresh(self, part: Part, external: FloatArray) -> None:
        """Recompute the outputs of one part with direct feedthrough, if it is its time."""
        if self._tick % part.every:
            return
        self._wire_inputs(external)
        self._out[part.outputs] = cast(Feedthrough, part.plant).output(self._in[part.inputs].copy())

    def _solve_loop(self, group: list[Part], external: FloatArray) -> None:
        """Solve y = g(y) for the outputs of a cycle, with a Jacobian by finite differences."""
        places = np.concatenate([np.arange(self._ny)[part.outputs] for part in group])

        def miss(values: FloatArray) -> FloatArray:
            self._out[places] = values
            for part in group:
                self._refresh(part, external)
            gap: FloatArray = self._out[places] - values
            return gap

        values = self._out[places].copy()
        gap = miss(values)
        for _ in range(50):
            scale = 1.0 + np.abs(values)
            if np.all(np.abs(gap) <= self._tolerance * scale):
                self._out[places] = values
                return
            jacobian = np.empty((len(places), len(places)))
            for j in range(len(places)):
                nudged = values.copy()
                nudged[j] += 1e-7 * scale[j]
                jacobian[:, j] = (miss(nudged) - gap) / (1e-7 * scale[j])
            move = np.linalg.lstsq(jacobian, -gap, rcond=None)[0]
            values = values + move
            gap = miss(values)
        names = " -> ".join([part.name for part in group] + [group[0].name])
        t = self._tick * self._spec.sample_time
        raise PlantError(f"algebraic loop {names} has no solution that Newton's method finds at t = {t:g} s")

    def _is_loop(self, part: Part) -> bool:
        return part in self._followers(part)

    def _followers(self, part: Part) -> list[Part]:
        """Return the parts with direct feedthrough that an undelayed wire leads to from this part."""
        found = []
        for wire in self._wires:
            if wire.external or wire.delay or not part.outputs.start <= wire.source < part.outputs.stop:
                continue
            target = next(p for p in self._parts if p.inputs.start <= wire.target < p.inputs.stop)
            if target.feeds_through and target not in found:
                found.append(target)
        return found

    def _feedthrough_order(self) -> tuple[list[list[Part]], list[list[str]]]:
        """Return the strongly connected groups of feedthrough parts in order of evaluation, and the cycles' names."""
        direct = [part for part in self._parts if part.feeds_through]
        groups = strong_components(direct, self._followers)
        cycles = [[p.name for p in group] for group in groups if len(group) > 1 or self._is_loop(group[0])]
        return groups, cycles

    def _feeds_outputs(self, externals: int) -> bool:
        """Return True if a shown output depends on an external input within the same instant."""
        reached: list[Part] = []
        for wire in self._wires:
            if wire.external and not wire.delay:
                target = next(p for p in self._parts if p.inputs.start <= wire.target < p.inputs.stop)
                if target.feeds_through and target not in reached:
                    reached.append(target)
        for part in reached:
            reached += [p for p in self._followers(part) if p not in reached]
        return externals > 0 and any(p.outputs.start <= i < p.outputs.stop for p in reached for i in self._shown)

    def _snapshot(self) -> Any:
        parts = [cast(Snapshots, part.plant).get_state() for part in self._parts]
        memories = [tuple(wire.memory) for wire in self._wires]
        return parts, self._tick, self._in.copy(), self._out.copy(), memories, [part.held for part in self._parts]

    def _restore(self, state: Any) -> None:
        parts, self._tick, held, out, memories, inputs = state
        for part, own, kept in zip(self._parts, parts, inputs, strict=True):
            cast(Snapshots, part.plant).set_state(own)
            part.held = kept
        self._in[:] = held
        self._out[:] = out
        for wire, memory in zip(self._wires, memories, strict=True):
            wire.memory = deque(memory)

    def _checked(self, u: FloatArray) -> FloatArray:
        values = np.asarray(u, dtype=float)
        if values.shape != (self._spec.nu,) or not np.isfinite(values).all():
            raise InputError(
                "input of the coupled plant",
                expected=f"{self._spec.nu} finite numbers, shape ({self._spec.nu},)",
                got=f"shape {values.shape}" if values.shape != (self._spec.nu,) else "a value that is not finite",
                remedy=f"give one value for each of {', '.join(c.name for c in self._spec.inputs) or 'no inputs'}",
            )
        return values
