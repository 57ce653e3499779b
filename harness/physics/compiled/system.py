"""System: equations of a grey box that effects change, that choose their outputs, and that are simulated."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import casadi as ca

from harness.errors import InputError
from harness.physics.compiled.simulator import Backend, Simulator
from harness.physics.definition.model_equations import Equations, index_of
from harness.physics.definition.parameters import Parameter
from harness.physics.definition.ports import BodyTerm, Coordinate, Hidden, Port, SampledBlock
from harness.signals import Channel

__all__ = ["BodyTerm", "Coordinate", "Hidden", "Port", "SampledBlock", "System"]


@dataclass(frozen=True, eq=False)
class System(Equations):
    """A continuous-time grey box, nominal or with effects built in; what it consists of: :class:`Equations`.

    Notes
    -----
    *How effects hook in* (:mod:`harness.effects.compose` does it). One call of :meth:`rebuild` places one effect, and
    calls are chained. ``rebuild`` first substitutes in every expression: ``inputs`` (what the dynamics see in place of
    u), ``parameters_as`` (an expression in place of a parameter: a payload that comes at t0), ``gravity``. Then it adds
    ``forces`` to the generalized forces of coordinates, ``mass`` to the mass matrix, ``rates`` to the derivatives of
    named states, replaces ``outputs``, and appends states and parameters. Because a substitution reaches into
    everything that was there before, several input effects are placed in *reverse* order of their action on the
    command (the one next to the plant first); force and output effects in the order of action.

    ``acceleration``, ``loads``, ``input_forces`` (the part of Q that comes from the inputs), ``bodies`` and
    ``h`` are ordinary expressions that an effect may use. Everything of hidden states (``Hidden``) starts at its
    ``initial``.

    Examples
    --------
    >>> from harness.physics.models import pendulum
    >>> system = pendulum().system()
    >>> [str(port.kind) + ":" + port.name for port in system.ports]
    ['input:u', 'coordinate:theta', 'output:theta', 'base:base']
    >>> stuck = system.rebuild(forces={"theta": -0.3 * system.x[1]})
    >>> ca.depends_on(stuck.generalized_forces, stuck.x[1])
    True
    """

    # ---- other systems from this one ------------------------------------------------------------------------------

    def rebuild(
        self,
        *,
        inputs: Mapping[str, Any] | None = None,
        parameters_as: Mapping[str, Any] | None = None,
        gravity: Any = None,
        forces: Mapping[str, Any] | None = None,
        mass: Any = None,
        rates: Mapping[str, Any] | None = None,
        outputs: Mapping[str, Any] | None = None,
        states: Sequence[Hidden] = (),
        parameters: Sequence[tuple[Parameter, Any]] = (),
        sampled: Sequence[SampledBlock] = (),
        switches: Sequence[tuple[int, str]] = (),
        corners: Sequence[Any] = (),
        remarks: Sequence[str] = (),
    ) -> System:
        """Return a system in which something was changed.

        Parameters
        ----------
        inputs : mapping, optional
            Input name to the SX that the dynamics (and h) see instead of it.
        parameters_as : mapping, optional
            Parameter name to the SX used in place of it.
        gravity : sequence of 2 SX, optional
            Direction of gravity (horizontal, vertical), in place of ``self.gravity``.
        forces : mapping, optional
            Coordinate name to the SX added to its generalized force.
        mass : SX (n, n), optional
            Added to the mass matrix.
        rates : mapping, optional
            Name of a state that is not a coordinate to the SX added to its derivative.
        outputs : mapping, optional
            Output name to the SX that replaces it.
        states : sequence of Hidden
            New states; their derivatives see the *old* inputs (a later input effect is substituted into them too).
        parameters : sequence of (Parameter, SX symbol)
            New parameters.
        sampled : sequence of SampledBlock
            New delays or quantisers.
        switches : sequence of (int, str)
            Appended to ``switches``.
        corners : sequence of SX
            Appended to ``corners``.
        remarks : sequence of str
            Appended to ``remarks``.

        Raises
        ------
        InputError
            If a name is unknown or used twice.
        """
        swapped = self._substitution(inputs or {}, parameters_as or {}, gravity)
        total = ca.SX(swapped(self.generalized_forces))
        for key, value in (forces or {}).items():
            total[self.coordinate(key).force] += value
        change = ca.SX(swapped(self.rates))
        first = 2 * len(self.coordinates)
        names = [channel.name for channel in self.states[first:]]
        for key, value in (rates or {}).items():
            change[index_of(key, names, "state")] += value
        h = ca.SX(swapped(self.h))
        for key, value in (outputs or {}).items():
            h[index_of(key, [channel.name for channel in self.outputs], "output")] = value
        matrix = swapped(self.mass_matrix)
        start = self.initial if self.initial is not None else ca.SX.zeros(self.hidden_count)
        added = [state.initial if state.initial is not None else ca.SX(0.0) for state in states]
        self._refuse_twice([state.channel.name for state in states] + [parameter.name for parameter, _ in parameters])
        bodies = tuple(
            replace(body, mass_matrix=swapped(body.mass_matrix), forces=swapped(body.forces)) for body in self.bodies
        )
        return replace(
            self,
            states=(*self.states, *(state.channel for state in states)),
            parameters=(*self.parameters, *(parameter for parameter, _ in parameters)),
            x=ca.vertcat(self.x, *(state.symbol for state in states)),
            p=ca.vertcat(self.p, *(symbol for _, symbol in parameters)),
            mass_matrix=matrix if mass is None else matrix + mass,
            generalized_forces=total,
            rates=ca.vertcat(change, *(state.derivative for state in states)),
            h=h,
            loads=swapped(self.loads),
            bodies=bodies,
            sampled=(*self.sampled, *sampled),
            initial=ca.vertcat(swapped(start), *added),
            hidden_count=self.hidden_count + len(states),
            switches=(*self.switches, *switches),
            corners=(*map(swapped, self.corners), *corners),
            remarks=(*self.remarks, *remarks),
        )

    def _substitution(
        self, inputs: Mapping[str, Any], parameters: Mapping[str, Any], gravity: Any
    ) -> Callable[[Any], Any]:
        """Return what puts other expressions in place of inputs, parameters and gravity."""
        input_names = [channel.name for channel in self.inputs]
        swaps = [(self.u[index_of(key, input_names, "input")], value) for key, value in inputs.items()]
        swaps += [
            (self.p[index_of(key, self.parameter_names, "parameter")], value) for key, value in parameters.items()
        ]
        if gravity is not None:
            swaps += [(self.gravity[0], gravity[0]), (self.gravity[1], gravity[1])]
        if not swaps:
            return lambda expression: expression
        old, new = ca.vertcat(*(symbol for symbol, _ in swaps)), ca.vertcat(*(ca.SX(value) for _, value in swaps))
        return lambda expression: None if expression is None else ca.substitute(expression, old, new)

    def _refuse_twice(self, added: Sequence[str]) -> None:
        """Refuse names of new states and parameters that are there already."""
        known = {*self.parameter_names, *(channel.name for channel in self.states)}
        for fresh in added:
            if fresh in known:
                raise InputError(
                    f"{fresh!r} is there twice in {self.name}",
                    expected="states and parameters with names of their own",
                    got=repr(fresh),
                    remedy="place an effect only once at a port",
                )
            known.add(fresh)

    def with_outputs(self, chosen: Sequence[str | tuple[str, int] | tuple[str, int, str]]) -> System:
        """Return the system with these measured outputs.

        Parameters
        ----------
        chosen : sequence
            Each a port (an output, coordinate or state by name) or ``(port, derivative)`` or
            ``(port, derivative, name)``; the rate of ``theta`` is called ``theta_rate`` unless named.

        Raises
        ------
        InputError
            If a port is unknown, a derivative is not 0, 1 or 2, or effects already act on the outputs.

        Examples
        --------
        >>> from harness.physics.models import pendulum
        >>> [str(channel) for channel in pendulum().system().with_outputs(["theta", ("theta", 1)]).outputs]
        ['theta [rad]', 'theta_rate [rad/s]']
        """
        if any(block.kind != "input_delay" for block in self.sampled) or self.effects:
            raise InputError(
                f"outputs of {self.name}",
                expected="a system without effects",
                got=", ".join(map(str, self.effects)),
                remedy="choose the outputs first and place the effects then",
            )
        known: dict[str, tuple[Channel, Any]] = {}
        for row, channel in enumerate(self.states):
            known[channel.name] = (channel, self.x[row])
        for row, channel in enumerate(self.outputs):
            known[channel.name] = (channel, self.h[row])
        channels, rows = [], []
        for item in chosen:
            port, order, label = (item, 0, "") if isinstance(item, str) else (item[0], item[1], "".join(item[2:]))
            if port not in known or order not in (0, 1, 2):
                raise InputError(
                    f"measured output of {self.name}",
                    expected=f"one of {', '.join(known)}, with derivative 0, 1 or 2",
                    got=repr(item),
                    remedy="correct the port or the derivative",
                )
            channel, row = known[port]
            for _ in range(order):
                row = ca.jtimes(row, self.x, self.f) + ca.jtimes(row, self.t, ca.SX(1.0))
            if order:
                suffix = "_rate" if order == 1 else "_acceleration"
                unit = _per_second(channel.unit, order)
                channel = Channel(label or port + suffix, unit)
            elif label and label != channel.name:
                channel = replace(channel, name=label)
            channels.append(channel)
            rows.append(row)
        names = [channel.name for channel in channels]
        if len(set(names)) != len(names) or not names:
            raise InputError(
                f"measured outputs of {self.name}",
                expected="at least one, each once",
                got=", ".join(names) or "none",
                remedy="remove the double or name it otherwise",
            )
        return replace(self, outputs=tuple(channels), h=ca.vertcat(*rows))

    def with_parameters(self, parameters: Mapping[str, Parameter | float]) -> System:
        """Return the system with other nominal values, bounds or fixed flags.

        Examples
        --------
        >>> from harness.physics.models import pendulum
        >>> pendulum().system().with_parameters({"J": 0.2}).parameter("J").value
        0.2
        """
        for name in parameters:
            self.parameter(name)
        changed = []
        for old in self.parameters:
            new = parameters.get(old.name, old)
            changed.append(new if isinstance(new, Parameter) else replace(old, value=float(new), declared=True))
        return replace(self, parameters=tuple(changed))

    def simulator(
        self,
        dt: float,
        *,
        intersample: Literal["zoh", "foh", "smooth"] = "zoh",
        substeps: int | None = None,
        backend: Backend = "auto",
    ) -> Simulator:
        """Return a fixed-step simulator of this system; see :class:`harness.physics.compiled.simulator.Simulator`."""
        key = (float(dt), intersample, substeps, backend)
        cache: dict[Any, Simulator] = self.__dict__.setdefault("_simulators", {})
        if key not in cache:
            cache[key] = Simulator(self, dt, intersample=intersample, substeps=substeps, backend=backend)
        return cache[key]


def _per_second(unit: str, order: int) -> str:
    """Return the unit of a time derivative."""
    return f"{unit}/s" if order == 1 else f"{unit}/s^2"
