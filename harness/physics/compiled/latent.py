"""Latent forces: a system whose equations of motion (or rates) are disturbed by forces that nobody measured."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import casadi as ca

from harness.physics.definition.ports import Hidden
from harness.signals import Channel

if TYPE_CHECKING:
    from harness.physics.compiled.system import System

PREFIX = "latent@"


@dataclass(frozen=True)
class LatentForce:
    """One latent force: the port that it acts on, and its unit."""

    port: str
    unit: str


@dataclass(frozen=True, eq=False)
class Disturbed:
    """A system with latent forces as its last states."""

    system: System  # Its last ``len(forces)`` states are the forces, of rate 0
    forces: tuple[LatentForce, ...]


def with_latent_forces(system: System) -> Disturbed:
    """Return the system with a latent force on every equation of motion, or on every rate where there are none.

    A delay of a reading becomes part of the outputs, as the first terms of its Taylor series along the motion: a filter
    looks at the present state only. Rounding of readings is left out: it counts as noise.

    Examples
    --------
    >>> from harness.physics.models import cart_pole
    >>> [str(channel) for channel in with_latent_forces(cart_pole().system()).system.states][-2:]
    ['latent@x [N]', 'latent@theta [N m]']
    """
    made: list[Hidden] = []
    ports: list[LatentForce] = []
    forces: dict[str, Any] = {}
    rates: dict[str, Any] = {}
    if system.coordinates:
        for coordinate in system.coordinates:
            symbol = ca.SX.sym(PREFIX + coordinate.name)
            ports.append(LatentForce(coordinate.name, coordinate.force_unit))
            forces[coordinate.name] = symbol
            made.append(Hidden(Channel(PREFIX + coordinate.name, coordinate.force_unit), symbol, ca.SX(0.0)))
    else:
        for channel in system.states[: system.nx - system.hidden_count]:
            symbol = ca.SX.sym(PREFIX + channel.name)
            unit = f"{channel.unit}/s"
            ports.append(LatentForce(channel.name, unit))
            rates[channel.name] = symbol
            made.append(Hidden(Channel(PREFIX + channel.name, unit), symbol, ca.SX(0.0)))
    return Disturbed(_readable(system.rebuild(forces=forces, rates=rates, states=made)), tuple(ports))


def without_latent_forces(system: System) -> Disturbed:
    """Return the system with no latent force: output error, the limit in which nothing disturbs the plant."""
    return Disturbed(_readable(system), ())


def _readable(disturbed: System) -> System:
    """Return the system with delays of readings in its outputs, and without rounding."""
    h = ca.SX(disturbed.h)
    symbols = dict(zip(disturbed.parameter_names, ca.vertsplit(disturbed.p), strict=True))
    kept = []
    for block in disturbed.sampled:
        if block.kind == "input_delay":
            kept.append(block)
        elif block.kind == "output_delay":
            h[block.index] = _delayed(disturbed, h[block.index], symbols[block.parameter])
    return replace(disturbed, h=h, sampled=tuple(kept))


def _delayed(system: System, y: Any, tau: Any) -> Any:
    """Return y(t - tau) as the first four terms of its Taylor series along the motion, inputs and forces held."""
    late, term, factor = y, y, ca.SX(1.0)
    for order in range(1, 4):
        term = ca.jtimes(term, system.x, system.f) + ca.jtimes(term, system.t, ca.SX(1.0))
        factor = -factor * tau / order
        late = late + factor * term
    return late
