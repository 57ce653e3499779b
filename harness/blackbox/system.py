"""An FMU as a nominal model: what the loop must know of it, and the effects around it (its equations stay unknown).

Effects act on its inputs, on its outputs and, where an input is a force whose coordinate can be read, as forces that
are added to that input. :func:`harness.blackbox.reader.fmu_system` makes one of a file.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.errors import InputError
from harness.fingerprint import fingerprint
from harness.physics.definition.dimensions import Dimensions
from harness.physics.definition.parameters import Parameter
from harness.physics.definition.ports import Port, SampledBlock
from harness.signals import Channel, FloatArray

if TYPE_CHECKING:
    from harness.blackbox.around import Around
    from harness.effects.effect import Placed


@dataclass(frozen=True)
class FmuCoordinate:
    """A position that a force input moves.

    ``position`` and ``rate`` are variables of the FMU (``rate`` None: differences of the position); ``force`` is the
    row of the input.
    """

    name: str
    unit: str
    force_unit: str
    position: str
    rate: str | None
    force: int


@dataclass(frozen=True, eq=False)
class FmuSystem(Dimensions):
    """An FMU with effects around it: read by ``fmu_system``, surrounded by :func:`.effects.surround`."""

    path: Path  # The FMU
    name: str  # Of its model
    digest: str
    # As the data have them
    inputs: tuple[Channel, ...]
    outputs: tuple[Channel, ...]
    inner_states: tuple[Channel, ...]  # States whose start values the FMU lets us set
    parameters: tuple[Parameter, ...]
    """Tunable parameters of the FMU, then those of effects, called ``effect@port.name``."""
    coordinates: tuple[FmuCoordinate, ...]
    shown: Mapping[str, str] = field(default_factory=dict)  # Outputs that show a state of another name, and that name
    hidden: tuple[Channel, ...] = ()  # Hidden states of effects
    sampled: tuple[SampledBlock, ...] = ()  # Delays and quantisers
    effects: tuple[Placed, ...] = ()
    # Longest communication step [s] and relative tolerance that it is run with; None: the records' step, its own
    step: float | None = None
    tolerance: float | None = None
    exchanges: int = 1
    """How often in a sample effects around it tell it their force: those of dry friction, which jumps (of the nominal
    one: how often they would have to)."""
    notes: tuple[str, ...] = ()  # What is to be said about how it is run
    around: Around | None = field(default=None, repr=False)  # The effects as functions
    nominal: FmuSystem | None = field(default=None, repr=False)  # The FMU alone

    loads = None
    h = None
    process: tuple[str, ...] = ()

    def __str__(self) -> str:
        return " + ".join([f"{self.name} ({self.path.name}, {self.digest})", *map(str, self.effects)])

    def __getstate__(self) -> dict[str, Any]:
        """Return all but symbols, which belong to one process."""
        return {name: value for name, value in self.__dict__.items() if name != "u"}

    @property
    def states(self) -> tuple[Channel, ...]:
        """Settable states of the FMU, then hidden states of effects."""
        return (*self.inner_states, *self.hidden)

    @cached_property
    def fingerprint(self) -> str:
        """A hash of the FMU's file, of what is declared and of the effects around it."""
        around = {} if self.around is None else {
            name: function.serialize() for name, function in self.around.functions.items()
        }  # fmt: skip
        channels = [str(channel) for group in (self.inputs, self.outputs, self.states) for channel in group]
        return fingerprint(
            self.digest,
            channels,
            self.parameters,
            self.coordinates,
            dict(self.shown),
            self.sampled,
            around,
            self.step,
            self.tolerance,
            self.exchanges,
        )

    @property
    def hidden_count(self) -> int:
        """Number of hidden states."""
        return len(self.hidden)

    @property
    def inner_count(self) -> int:
        """Number of parameters of the FMU itself."""
        return len(self.parameters if self.nominal is None else self.nominal.parameters)

    @property
    def ports(self) -> tuple[Port, ...]:
        """Where effects can act."""
        found = [Port("input", channel.name, channel.unit) for channel in self.inputs]
        found += [Port("coordinate", coordinate.name, coordinate.unit) for coordinate in self.coordinates]
        return (*found, *(Port("output", channel.name, channel.unit) for channel in self.outputs))

    @property
    def variables(self) -> tuple[str, ...]:
        """Variables of the FMU that a simulation reads: outputs, states, positions, rates; each once."""
        names = [channel.name for channel in (*self.outputs, *self.inner_states)]
        for coordinate in self.coordinates:
            names += [coordinate.position, *([coordinate.rate] if coordinate.rate is not None else [])]
        return tuple(dict.fromkeys(names))

    @cached_property
    def u(self) -> Any:
        """Symbols (CasADi) of the inputs."""
        import casadi as ca

        return ca.SX.sym("u", self.nu)

    @property
    def input_forces(self) -> Any:
        """Force of the inputs on each coordinate."""
        import casadi as ca

        return ca.vertcat(*(self.u[coordinate.force] for coordinate in self.coordinates))

    def driven_by(self, name: str) -> int | None:
        """Return the row of the coordinate that an input moves."""
        wanted = [channel.name for channel in self.inputs].index(name)
        return next((row for row, coordinate in enumerate(self.coordinates) if coordinate.force == wanted), None)

    def coordinate(self, name: str) -> Any:
        """Return a coordinate; its ``force`` is its row among them."""
        row = [coordinate.name for coordinate in self.coordinates].index(name)
        return replace(self.coordinates[row], force=row)

    def parameter(self, name: str) -> Parameter:
        """Return one parameter, or refuse the name."""
        for parameter in self.parameters:
            if parameter.name == name:
                return parameter
        raise InputError(
            f"parameter of {self.name}",
            expected=f"a tunable one ({', '.join(self.parameter_names) or 'none'})",
            got=repr(name),
            remedy="correct the name",
            file=self.path,
        )

    def values(self, given: Mapping[str, float] | None = None) -> dict[str, float]:
        """Return all parameter values: those given, the others as they are."""
        known = {name: float(value) for name, value in (given or {}).items() if self.parameter(name)}
        return {parameter.name: known.get(parameter.name, parameter.value) for parameter in self.parameters}

    def vector(self, given: Mapping[str, float] | None = None) -> FloatArray:
        """Return the same as an array (np,)."""
        return np.array(list(self.values(given).values()))

    def with_parameters(self, parameters: Mapping[str, Any]) -> FmuSystem:
        """Return the system with other values, bounds, or parameters kept fixed."""
        changed = {
            name: given if isinstance(given, Parameter) else replace(self.parameter(name), value=float(given))
            for name, given in parameters.items()
            if self.parameter(name)
        }
        return replace(self, parameters=tuple(changed.get(parameter.name, parameter) for parameter in self.parameters))
