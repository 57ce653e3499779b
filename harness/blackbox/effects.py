"""Putting effects around a black box: on its inputs, as forces added to them, and on its outputs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, cast

from harness.blackbox.around import Around
from harness.blackbox.system import FmuSystem
from harness.effects.effect import DRY, Effect, Placed, port_units, unit_of
from harness.effects.places import port_of
from harness.errors import InputError
from harness.physics.definition.parameters import Parameter
from harness.physics.definition.ports import SampledBlock
from harness.signals import Channel

if TYPE_CHECKING:
    from harness.physics.definition.ports import Port


def fits_fmu(effect: Effect) -> bool:
    """Return True if an effect can be put around an FMU: it asks for nothing inside, hides nothing behind an output.

    Forces change between communication steps, in which bristles slip many times their length.
    """
    outside = {"input", "coordinate", "output"} & set(effect.kinds)
    hidden = "output" in effect.kinds and effect.states
    inside = {"a", "damping", "pull", "temperature"} & set(effect.extras)
    return bool(outside) and not inside and not hidden and not effect.grows


def surround(
    system: FmuSystem, placed: Sequence[Placed], sizes: Mapping[str, Mapping[str, float]] | None = None
) -> FmuSystem:
    """Return an FMU with more effects around it.

    Raises InputError if an effect does not fit its port or stands there twice.

    - ``placed``: input effects act on the command in this order, forces are added behind them, output effects come last
    - ``sizes``: sizes of the data by port, for start values that are not given
    """
    import casadi as ca

    sizes = sizes or {}

    nominal = system if system.nominal is None else system.nominal
    wanted = [*system.effects, *placed]
    names = [str(placement) for placement in wanted]
    for placement in wanted:
        if names.count(str(placement)) > 1 or not fits_fmu(placement.effect):
            raise InputError(
                f"effect {placement} around an FMU",
                expected="an effect on inputs, outputs or forces that needs no acceleration, once at a port",
                got="the same twice"
                if names.count(str(placement)) > 1
                else f"an effect on: {', '.join(placement.effect.kinds)}",
                remedy="remove it, or write the model as equations",
            )
    old = {parameter.name: parameter for parameter in system.parameters}
    parameters = [old[parameter.name] for parameter in nominal.parameters]
    q, v = (ca.SX.sym(name, len(nominal.coordinates)) for name in "qv")
    u, y, t = ca.SX.sym("u", nominal.nu), ca.SX.sym("y", nominal.ny), ca.SX.sym("t")
    place = _Placing(nominal, q, v, t, u, y)
    for placement in _ordered(nominal, wanted):
        port = port_of(cast(Any, nominal), placement)
        parameters += [
            old.get(made.name, made)
            for made in place.add(
                placement, port, sizes.get(str(placement), sizes.get(placement.at, sizes.get("", {})))
            )
        ]
    around = Around(
        u=u,
        q=q,
        v=v,
        t=t,
        z=ca.vertcat(*place.states) if place.states else ca.SX(0, 1),
        p=ca.vertcat(*place.symbols) if place.symbols else ca.SX(0, 1),
        y=y,
        command=ca.vertcat(*place.command) if place.command else ca.SX(0, 1),
        reading=ca.vertcat(*place.reading),
        derivatives=ca.vertcat(*place.derivatives) if place.derivatives else ca.SX(0, 1),
        starts=ca.vertcat(*place.starts) if place.starts else ca.SX(0, 1),
        rates=tuple(coordinate.rate is not None for coordinate in nominal.coordinates),
        reads=any(not ca.is_equal(reading, y[row]) for row, reading in enumerate(place.reading)),
    )
    return replace(
        nominal,
        parameters=tuple(parameters),
        hidden=tuple(place.hidden),
        sampled=tuple(place.sampled),
        effects=tuple(wanted),
        exchanges=nominal.exchanges if any(one.effect.whole == DRY for one in wanted) else 1,
        around=around,
        nominal=nominal,
    )


def _ordered(system: FmuSystem, placed: Sequence[Placed]) -> list[Placed]:
    """Return inputs first, then forces (transmissions last), then outputs."""
    kinds = {str(placement): port_of(cast(Any, system), placement).kind for placement in placed}
    forces = [placement for placement in placed if kinds[str(placement)] == "coordinate"]
    return [
        *(placement for placement in placed if kinds[str(placement)] == "input"),
        *sorted(forces, key=lambda placement: placement.effect.drives),
        *(placement for placement in placed if kinds[str(placement)] == "output"),
    ]


class _Placing:
    """Effects put around one after the other."""

    def __init__(self, system: FmuSystem, q: Any, v: Any, t: Any, u: Any, y: Any) -> None:
        self.system, self.q, self.v, self.t, self.u = system, q, v, t, u
        self.command: list[Any] = [u[row] for row in range(system.nu)]
        self.reading: list[Any] = [y[row] for row in range(system.ny)]
        self.driven: list[Any] | None = None
        self.symbols: list[Any] = []
        self.states: list[Any] = []
        self.derivatives: list[Any] = []
        self.starts: list[Any] = []
        self.hidden: list[Channel] = []
        self.sampled: list[SampledBlock] = []

    def add(self, placed: Placed, port: Port, sizes: Mapping[str, float]) -> list[Parameter]:
        """Add one effect; returns its parameters."""
        import casadi as ca

        system, effect = self.system, placed.effect
        row = None
        if port.kind == "coordinate":
            row = [coordinate.name for coordinate in system.coordinates].index(port.name)
            units = port_units("coordinate", port.unit, system.coordinates[row].force_unit)
        else:
            units = port_units(port.kind, port.unit)
        declared, named = [], {}
        for parameter, value in zip(effect.parameters, effect.complete(placed.values, sizes).values(), strict=True):
            fixed = parameter.fixed
            if parameter.angle_only and port.unit != "rad":
                fixed, value = True, parameter.neutral or 0.0
            symbol = ca.SX.sym(placed.name(parameter.name))
            unit, low, high = (
                unit_of(parameter.unit, units),
                parameter.lowest(sizes, value),
                parameter.highest(sizes, value),
            )
            declared.append(Parameter(placed.name(parameter.name), unit, value, low, high, fixed))
            named[parameter.name] = symbol
            self.symbols.append(symbol)
        if effect.sampled:
            channels = system.inputs if port.kind == "input" else system.outputs
            index = [channel.name for channel in channels].index(port.name)
            before = placed.name("before") if effect.sampled == "input_delay" else ""
            self.sampled.append(SampledBlock(effect.sampled, index, declared[0].name, before))  # type: ignore[arg-type]
            if before:  # an FMU that begins at its own start has no state that could take it up
                self._hide(ca.SX.sym(before), ca.SX(0.0), 0.0, Channel(before, channels[index].unit))
            return declared
        signal, q, v = self._arriving(port, row)
        states = [ca.SX.sym(placed.name(name)) for name in effect.states]
        value, derivatives = effect.evaluate(signal, states, named, q, v, t=self.t, load=signal)
        if port.kind == "coordinate":
            assert row is not None
            self.command[system.coordinates[row].force] += value
        elif port.kind == "input":
            index = [channel.name for channel in system.inputs].index(port.name)
            self.command[index] = signal + value if "coordinate" in effect.kinds else value
        else:
            self.reading[[channel.name for channel in system.outputs].index(port.name)] = value
        context = {"signal": signal, "q": q, "v": v}
        for name, unit, symbol, derivative in zip(effect.states, effect.state_units, states, derivatives, strict=True):
            start = self._at_start(context[effect.initial[name]]) if name in effect.initial else 0.0
            self._hide(symbol, derivative, start, Channel(placed.name(name), unit_of(unit, units)))
        return declared

    def _hide(self, symbol: Any, derivative: Any, start: Any, channel: Channel) -> None:
        """Add a hidden state."""
        self.states.append(symbol)
        self.derivatives.append(derivative)
        self.starts.append(start)
        self.hidden.append(channel)

    def _at_start(self, signal: Any) -> Any:
        """Return a signal as it is at the beginning: at time 0, hidden states before it where they start."""
        import casadi as ca

        found = ca.substitute(ca.SX(signal), self.t, 0.0)
        for state, start in zip(self.states, self.starts, strict=False):
            found = ca.substitute(found, state, start)
        return found

    def _arriving(self, port: Port, row: int | None) -> tuple[Any, Any, Any]:
        """Return the signal that arrives at a port, and the position and rate there."""
        system = self.system
        if port.kind == "coordinate":
            assert row is not None
            if self.driven is None:  # a force does not see the forces added beside it
                self.driven = list(self.command)
            return self.driven[system.coordinates[row].force], self.q[row], self.v[row]
        if port.kind == "input":
            index = [channel.name for channel in system.inputs].index(port.name)
            moved = next((k for k, coordinate in enumerate(system.coordinates) if coordinate.force == index), None)
            signal = self.command[index]
            return (signal, 0.0, 0.0) if moved is None else (signal, self.q[moved], self.v[moved])
        signal = self.reading[[channel.name for channel in system.outputs].index(port.name)]
        moved = next((k for k, coordinate in enumerate(system.coordinates) if coordinate.name == port.name), None)
        return (signal, signal, 0.0) if moved is None else (signal, self.q[moved], self.v[moved])
