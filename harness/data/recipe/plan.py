"""What a data set declares, worked out before a row is read: the model, its ports, the channel of every signal."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from harness.data.recipe.loaded import Nominal
from harness.data.recipe.ports import Ports, located_model, ports_of, rate_unit
from harness.data.recipe.si import si_unit
from harness.data.sections import Description, NominalParameter, SignalSection
from harness.errors import InputError
from harness.signals import Channel, stated_categories
from harness.trust import names_fmu, registered_only
from harness.units import convert, fits


class Plan:
    """The declared side of a data set.

    Parameters
    ----------
    path : Path
        The file that holds the description; models are found relative to it.
    description : Description
    model : str or None
        Nominal model in place of the declared one.
    ports : Ports or None
        Channels of the model, where the caller knows them.
    header_unit : callable
        Returns the unit that the files state for a signal, or None; its second argument is a unit of what the signal
        is expected to measure, or None.

    Raises
    ------
    InputError
        If two signals share a port, a port is unknown, or a unit is unknown or does not fit.

    Attributes
    ----------
    inputs, outputs, references : list of str
        Names of the signals by role, in the model's order.
    channels : dict
        The channel of each signal, in the unit that its values will have.
    unrecorded : list of Channel
        Inputs of the model that no signal gives and that are not declared as undriven.
    notes : list of str
        What was noticed.
    """

    def __init__(
        self,
        path: Path,
        description: Description,
        *,
        model: str | None,
        ports: Ports | None,
        header_unit: Callable[[str, str | None], str | None],
    ) -> None:
        self.path, self.description = path, description
        self.notes: list[str] = []
        self.unrecorded: list[Channel] = []
        self._header_unit = header_unit
        self.nominal = self._nominal(model)
        self.ports = self._ports(ports)
        self.inputs, self.outputs, self.references = self._arranged()
        self.units: dict[str, str] = {}
        self.channels = {name: self._channel(name) for name in (*self.inputs, *self.outputs, *self.references)}

    def noise(self) -> dict[str, float]:
        """Return the declared standard deviation of each sensor, by output channel, in its SI unit."""
        result = {}
        for name in self.outputs:
            given, channel = self.signal(name).noise, self.channels[name]
            if given is not None:
                zero, value = convert(np.array([0.0, given]), self.units[name], channel.unit)
                result[channel.name] = float(abs(value - zero))
        return result

    def _nominal(self, model: str | None) -> Nominal | None:
        """Return the nominal model; one that the caller names keeps what is known only if it is the same."""
        section = self.description.nominal
        if model is not None and (section is None or section.model != model):
            return Nominal(located_model(model, Path.cwd()))
        if section is None:
            return None
        if model is None:  # else the caller named it too
            registered_only(section.model, file=self.path, place="nominal.model")
        registered_only(section.options, file=self.path, place="nominal.options", options=True)
        parameters = {
            name: given if isinstance(given, NominalParameter) else NominalParameter(value=float(given))
            for name, given in section.parameters.items()
        }
        return Nominal(located_model(section.model, self.path.parent), section.options, parameters, section.analogy)

    def _ports(self, ports: Ports | None) -> Ports | None:
        """Return the ports that signals may sit on; None where any will do."""
        if ports is not None or self.nominal is None:
            return ports
        try:
            return ports_of(self.nominal.model, self.nominal.options, analogy=self.nominal.analogy)
        except InputError as error:
            raise error.located(place="nominal.model") from error

    def _arranged(self) -> tuple[list[str], list[str], list[str]]:
        """Return the names of inputs, outputs and references, in the model's order; two on one port are refused."""
        taken: dict[tuple[str, str, int], str] = {}
        ranks: dict[str, tuple[int, int]] = {}
        for row, (name, signal) in enumerate(self.description.signals.items()):
            if signal.role == "reference":
                continue
            port = self.port(name)
            key = ("", port, signal.derivative)
            if key in taken:
                raise InputError(
                    "two signals on one port",
                    expected="one signal for each port (or its rate, derivative = 1)",
                    got=f"{taken[key]} and {name} on {port}",
                    remedy="correct the port of one, or remove it",
                    place=f"signals.{name}.port",
                )
            taken[key] = name
            rank = row
            if self.ports is not None:
                try:
                    channel = self.ports.find(port, signal.role)
                except InputError as error:
                    raise error.located(place=f"signals.{name}") from error
                rank = (self.ports.inputs if signal.role == "input" else self.ports.outputs).index(channel)
            ranks[name] = (signal.derivative, rank)
        role = {name: signal.role for name, signal in self.description.signals.items()}
        self._check_undriven({self.port(name) for name in role if role[name] == "input"})
        ordered = sorted(ranks, key=lambda name: ranks[name])
        return (
            [name for name in ordered if role[name] == "input"],
            [name for name in ordered if role[name] == "output"],
            [name for name in role if role[name] == "reference"],
        )

    def _check_undriven(self, recorded: set[str]) -> None:
        """Hold the declared undriven inputs against the model's, and keep those that nothing is known of."""
        declared = self.description.undriven
        channels = () if self.ports is None else self.ports.inputs
        for name in declared:
            if name in recorded or name not in [channel.name for channel in channels]:
                free = [channel.name for channel in channels if channel.name not in recorded]
                raise InputError(
                    "undriven input",
                    expected=f"an input of the model that no signal gives ({', '.join(free) or 'there is none'})",
                    got=repr(name) + (", which a signal gives" if name in recorded else ""),
                    remedy="correct or remove the name",
                    place="undriven",
                )
        for channel in channels:
            if channel.name in recorded:
                continue
            if channel.name not in declared:
                self.unrecorded.append(channel)
                continue
            fmu = self.nominal is not None and names_fmu(self.nominal.model)
            value = "its start value" if fmu else "0"
            self.notes.append(f"input {channel.name} is declared as undriven: {value} in all records")

    def signal(self, name: str) -> SignalSection:
        """Return the section of a signal."""
        return self.description.signals[name]

    def like(self, name: str) -> str | None:
        """Return a unit of what a signal measures: the declared one, else its port's; None if neither is known."""
        signal = self.signal(name)
        if signal.unit is not None or signal.role == "reference" or self.ports is None or not self.ports.units_fixed:
            return signal.unit
        return rate_unit(self.ports.find(self.port(name), signal.role).unit, signal.derivative)

    def port(self, name: str) -> str:
        """Return the port that a signal sits on: its own name unless it says otherwise."""
        signal = self.signal(name)
        port = signal.port or name
        return port if self.ports is None else self.ports.named(port, signal.role)

    def _channel(self, name: str) -> Channel:
        """Return the channel of a signal, in the unit that its values will have."""
        signal, place = self.signal(name), f"signals.{name}.unit"
        unit = signal.unit or self._header_unit(name, self.like(name))
        if unit is None:
            raise InputError(
                f"signal {name} has no unit",
                expected='unit = "..." (or a column title such as "theta [rad]")',
                got="none",
                remedy=f'declare it (sysid: --unit {name}=...); unit = "1" is a plain number',
                place=place,
            )
        label = Ports.channel_name(self.port(name), signal.derivative) if signal.role == "output" else self.port(name)
        stated = stated_categories(unit)
        self.units[name] = unit if stated is None else "1"
        if signal.role == "reference":
            return Channel(name, _si(self.units[name], place))
        if signal.categories is not None or stated is not None:
            return self._category(name, label, stated)
        if self.ports is None:
            return Channel(label, _si(unit, place))
        port = self.ports.find(self.port(name), signal.role)
        target = rate_unit(port.unit, signal.derivative)
        if not self.ports.units_fixed or port.name in self.ports.untold:
            return Channel(label, _si(unit, place))
        if not _fits(unit, target, place):
            raise InputError(
                "unit does not fit",
                expected=f"a unit that converts to {target} ({label} of {self.ports.model})",
                got=repr(unit),
                remedy="correct the unit or the port, or declare the port's unit and a scale into it in a dataset.toml",
                place=place,
            )
        if signal.derivative:
            return Channel(label, target)
        return replace(port, name=label)

    def _category(self, name: str, label: str, stated: int | None) -> Channel:
        """Return the channel of a signal whose numbers are names, as declared or as its unit states: 0 .. count - 1."""
        signal, place = self.signal(name), f"signals.{name}.categories"
        count = stated if signal.categories is None else signal.categories
        if count is None or count < 2:
            raise InputError(
                "categories", expected="their number, at least 2", got=str(count), remedy="correct it", place=place
            )
        if self.ports is not None:
            port = self.ports.find(self.port(name), signal.role)
            if port.kind == "category" and port.categories == count:
                return replace(port, name=label)
            raise InputError(
                "categories that the model does not have",
                expected=f"{port} of {self.ports.model}",
                got=f"{count} categories",
                remedy="remove the nominal model, or correct the number",
                place=place,
            )
        if signal.categories is None:
            self.notes.append(f"the numbers of {name} count as names, {count} categories, as its unit says")
        return Channel(label, "1", 0, count - 1, kind="category")


def _si(unit: str, place: str) -> str:
    """Return the SI form of a unit, its refusal placed."""
    try:
        return si_unit(unit)
    except InputError as error:
        raise error.located(place=place) from error


def _fits(unit: str, target: str, place: str) -> bool:
    """Return True if a unit fits, its refusal placed; the port's own needs no reading (which takes 0.3 s to load)."""
    if unit.strip() == target.strip():
        return True
    try:
        return fits(unit, target)
    except InputError as error:
        raise error.located(place=place) from error
