"""What a diagnosis asks of a system: one given by its equations and an FMU both have it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Protocol, Self, TypeGuard, TypeVar

from harness.effects.effect import Placed
from harness.physics.definition.parameters import Parameter
from harness.physics.definition.ports import Port, SampledBlock
from harness.signals import Channel, FloatArray

if TYPE_CHECKING:
    from harness.physics.compiled.system import System


class Measured(Protocol):
    """What has a name, inputs and outputs: all that data are checked against."""

    @property
    def name(self) -> str:
        """Name of the model."""
        ...

    @property
    def inputs(self) -> tuple[Channel, ...]:
        """Inputs as the data have them."""
        ...

    @property
    def outputs(self) -> tuple[Channel, ...]:
        """Outputs as the data have them."""
        ...


class Parametrised(Protocol):
    """What has parameters: all that a regression asks for."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Parameters, those of effects last."""
        ...

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Their names, in order."""
        ...

    def parameter(self, name: str) -> Parameter:
        """Return one parameter by name."""
        ...

    def values(self) -> dict[str, float]:
        """Return the value of every parameter by name."""
        ...

    def vector(self) -> FloatArray:
        """Return the same as an array (np,)."""
        ...


class _Coordinate(Protocol):
    """What both kinds of coordinates tell."""

    @property
    def name(self) -> str:
        """Of the position."""
        ...

    @property
    def unit(self) -> str:
        """Of the position."""
        ...

    @property
    def force_unit(self) -> str:
        """Of the force that moves it."""
        ...


class AnySystem(Measured, Parametrised, Protocol):
    """A nominal model, or one with effects: a system of equations, or an FMU with what is around it.

    See :class:`harness.physics.compiled.system.System`, and
    :class:`harness.physics.definition.model_equations.Equations` for the attributes.
    """

    @property
    def states(self) -> tuple[Channel, ...]:
        """States, hidden ones of effects last."""
        ...

    @property
    def coordinates(self) -> Sequence[_Coordinate]:
        """Positions that a force moves."""
        ...

    @property
    def ports(self) -> tuple[Port, ...]:
        """Where effects can act."""
        ...

    @property
    def sampled(self) -> tuple[SampledBlock, ...]:
        """Delays and quantisers."""
        ...

    @property
    def effects(self) -> tuple[Placed, ...]:
        """The effects in it."""
        ...

    @property
    def hidden_count(self) -> int:
        """How many of the states were brought by effects."""
        ...

    @property
    def nx(self) -> int:
        """Number of states."""
        ...

    @property
    def nu(self) -> int:
        """Number of inputs."""
        ...

    @property
    def ny(self) -> int:
        """Number of outputs."""
        ...

    @property
    def h(self) -> Any:
        """Outputs as a CasADi expression; None where the equations are unknown."""
        ...

    def values(self, given: Mapping[str, float] | None = None) -> dict[str, float]:
        """Return the value of every parameter by name, those in ``given`` replaced."""
        ...

    def vector(self, given: Mapping[str, float] | None = None) -> FloatArray:
        """Return the same as an array (np,)."""
        ...

    def with_parameters(self, parameters: Mapping[str, Parameter | float]) -> Self:
        """Return the model with other nominal values, bounds or fixed flags."""
        ...


Starts = Sequence[Mapping[str, float]]
"""Values of parameters by name, from each of which a fit begins."""
SystemT = TypeVar("SystemT", bound=AnySystem)
"""One kind of model."""


def by_equations(model: AnySystem) -> TypeGuard[System]:
    """Return True for a model given by its equations, False for an FMU."""
    return model.h is not None
