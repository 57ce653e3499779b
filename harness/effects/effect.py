"""What an effect is: a block with named parameters that attaches to a port of a system; ``@effect`` writes one."""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any, Literal

import numpy as np

from harness.effects.parameter import EffectParameter, Role, par
from harness.effects.unit_templates import fill, rate_unit
from harness.errors import InputError, refuse_unknown
from harness.signals import FloatArray

__all__ = ["EXPERIMENTS", "Effect", "EffectParameter", "Kind", "Placed", "effect", "par", "port_units", "unit_of"]

Kind = Literal["input", "coordinate", "output", "base", "process", "mass"]
Along = Callable[[Mapping[str, float], FloatArray, FloatArray], bool]
KINDS: tuple[Kind, ...] = ("input", "coordinate", "output", "base", "process", "mass")
EXPERIMENTS = ("slow motion", "chirp", "turned base", "large swing", "full swing", "small reversals", "fast swing",
               "rest", "added mass")  # fmt: skip
"""Kinds of experiments that separate laws: slow triangles through standstill; a chirp to five times the corner of the
longest lag; the base turned by a known angle; swings beyond 60 deg, and beyond 90; triangles of small amplitude; decays
from high speed; no excitation at all; a known mass added."""
_FIXED_ARGUMENTS = 5
_EXTRA_ARGUMENTS = ("t", "a", "load", "damping", "pull", "temperature")
DRY = "dry friction"  # The whole of the laws whose force jumps as the motion turns.
NEEDS = ("drive", "gravity", "alone", "place", "astatic", "temperature")
"""What a law may ask of the plant about its port: an input's force on that coordinate; gravity; no other coordinate;
that something tells where the coordinate stands, as a law about a place of its own has none where every record begins
anywhere; that nothing in the model holds the coordinate anywhere, where the law's force would be one of its own;
that the port is a temperature."""


@dataclass(frozen=True, eq=False)
class Effect:
    """A physical effect that a model may lack; made with :func:`effect`.

    Attributes
    ----------
    name : str
        The name users write.
    kinds : tuple of {"input", "coordinate", "output", "base", "process", "mass"}
        Ports it fits.
    parameters : tuple of EffectParameter
    states : tuple of str
        Hidden states.
    function : callable
        The block, see :func:`effect`.
    summary : str
        First line of the block's docstring.
    formula, experiment : str
        For the report: what it computes; what would separate it from its family.
    family : tuple of str
        Names easily taken for it; the ones that it also should be compared with.
    same_as : dict
        Names that cannot be told from it at all, each with the circumstance. ``"parameter"``: a nominal parameter.
    limits : dict
        Names that it approaches, each with the limit in which it does.
    nests : tuple of str
        Simpler effects that are special cases of it.
    state_units : tuple of str
        Unit templates of the hidden states.
    drives : bool
        It acts between an input and a coordinate: the coordinate must be driven by an input.
    downstream : bool
        A process effect that also feeds the next state.
    sampled : str
        ``"input_delay"``, ``"output_delay"`` or ``"quantise"`` for effects on samples rather than on equations; else
        empty.
    linearises : bool
        Its columns in a regression mean something (False for hidden resonances).
    angles : bool
        It fits only coordinates and outputs that are angles.
    initial : dict
        Where a hidden state starts if not at 0: ``"signal"`` (what arrives at the port), ``"q"`` or ``"v"``.
    requires : dict
        What the law's own physics asks of its values: a sentence, and a function of the values by name.
    requires_along : dict
        What it asks along the motion: a sentence, and a function of the values, of places (K,) and of the damping of
        all that brakes the coordinate there (K,), this effect included.
    grows : str
        What it adds to the first of ``nests``, if it refines that law: it is tried from where that one was fitted, and
        never before, together with what adds the same to other laws.
    whole : str
        What of its place it is the whole law of, such as ``"dry friction"``: a place has one, and two together imitate
        a third.
    told_by : tuple of str
        Kinds of experiments that tell it from rivals which name the same kind; see :data:`EXPERIMENTS`.
    cuts : bool
        What it takes from a reading is lost (values beyond a limit, the sign): in a model it comes after all that bends
        or shifts the scale of that output.
    needs : tuple of str
        What the plant must have about its port, of :data:`NEEDS`: elsewhere the law makes no sense, and is not tried.
    corners : callable, optional
        ``corners(p, q)``: expressions that are 0 where the force has a corner or jumps. A step that passes one is taken
        in finer ones.
    """

    name: str
    kinds: tuple[Kind, ...]
    parameters: tuple[EffectParameter, ...]
    states: tuple[str, ...]
    function: Callable[..., Any]
    summary: str = ""
    formula: str = ""
    experiment: str = ""
    family: tuple[str, ...] = ()
    same_as: Mapping[str, str] = field(default_factory=dict)
    limits: Mapping[str, str] = field(default_factory=dict)
    nests: tuple[str, ...] = ()
    state_units: tuple[str, ...] = ()
    drives: bool = False
    downstream: bool = False
    sampled: str = ""
    linearises: bool = True
    angles: bool = False
    initial: Mapping[str, str] = field(default_factory=dict)
    extras: tuple[str, ...] = ()
    requires: Mapping[str, Callable[[Mapping[str, float]], bool]] = field(default_factory=dict)
    requires_along: Mapping[str, Along] = field(default_factory=dict)
    grows: str = ""
    whole: str = ""
    told_by: tuple[str, ...] = ()
    cuts: bool = False
    needs: tuple[str, ...] = ()
    corners: Callable[[Any, Any], Sequence[Any]] | None = None

    def __str__(self) -> str:
        return self.name

    def __reduce__(self) -> tuple[Any, ...]:
        # The decorated name now holds the Effect, so its function cannot be pickled by name: travel by address.
        return _find, (self.function.__module__, self.function.__qualname__)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the parameters, in order."""
        return tuple(parameter.name for parameter in self.parameters)

    @property
    def main(self) -> EffectParameter | None:
        """The parameter that decides about acceptance; None for an effect without parameters."""
        return next((parameter for parameter in self.parameters if parameter.main), None)

    def parameter_of(self, role: Role) -> EffectParameter | None:
        """Return the parameter that plays a role in the law, None where none does."""
        return next((parameter for parameter in self.parameters if parameter.role == role), None)

    def parameter(self, name: str) -> EffectParameter:
        """Return one parameter by name, or refuse the name."""
        for parameter in self.parameters:
            if parameter.name == name:
                return parameter
        raise InputError(
            f"parameter of effect {self.name}",
            expected=f"one of {', '.join(self.parameter_names) or 'none'}",
            got=repr(name),
            remedy="correct the name",
        )

    def violations(self, values: Mapping[str, float]) -> list[str]:
        """Return the sentences of ``requires`` that do not hold for values by name."""
        return [text for text, holds in self.requires.items() if not holds(values)]

    def violations_along(self, values: Mapping[str, float], q: FloatArray, damping: FloatArray) -> list[str]:
        """Return the sentences of ``requires_along`` that do not hold, see there."""
        return [text for text, holds in self.requires_along.items() if not holds(values, q, damping)]

    def corners_at(self, values: Mapping[str, Any], q: Any) -> tuple[Any, ...]:
        """Return the expressions that are 0 where the force has a corner, for values by name."""
        return () if self.corners is None else tuple(self.corners(SimpleNamespace(**values), q))

    def complete(self, values: Mapping[str, float], sizes: Mapping[str, float] | None = None) -> dict[str, float]:
        """Return a value for every parameter: those given, the others from their scale hints.

        Raises
        ------
        InputError
            If a name is unknown or a value is not a number within the bounds.
        """
        for name, value in values.items():
            parameter = self.parameter(name)
            if not (np.isfinite(value) and parameter.minimum <= value <= parameter.maximum):
                raise InputError(
                    f"parameter {name} of effect {self.name}",
                    expected=f"a number in [{parameter.minimum:g}, {parameter.maximum:g}]",
                    got=repr(value),
                    remedy="choose a value within the bounds",
                )
        return {
            parameter.name: float(values[parameter.name]) if parameter.name in values else parameter.start(sizes or {})
            for parameter in self.parameters
        }

    @property
    def vanishes(self) -> bool:
        """True if there are values at which the effect is not there, see :meth:`neutral`."""
        return any(parameter.neutral is not None for parameter in self.parameters)

    def neutral(self, values: Mapping[str, float] | None = None) -> dict[str, float] | None:
        """Return parameters at which the effect vanishes (the neutral ones replaced), None where there are none."""
        if not self.vanishes:
            return None
        given = self.complete(values or {})
        return {
            parameter.name: given[parameter.name] if parameter.neutral is None else parameter.neutral
            for parameter in self.parameters
        }

    def evaluate(
        self,
        signal: Any,
        states: Sequence[Any],
        values: Mapping[str, Any],
        q: Any,
        v: Any,
        **extras: Any,
    ) -> tuple[Any, list[Any]]:
        """Return the output of the block and the derivatives of its hidden states.

        Parameters
        ----------
        signal : number, array (N,) or CasADi symbol
            What arrives at the port: the input; the output; the input's force on the coordinate; the net rate of
            the process state; the pair of gravity components.
        states : sequence
            Hidden states, of the same kind.
        values : mapping
            Parameter values by name.
        q, v : number, array or symbol
            The coordinate and its rate (0 where there is none).
        **extras
            ``t``, ``a`` (acceleration), ``load``, ``damping``, ``pull``, ``temperature`` [K]: those that the block
            names as arguments must be given.
        """
        result = self.function(
            signal,
            SimpleNamespace(**dict(zip(self.states, states, strict=True))),
            SimpleNamespace(**{name: values[name] for name in self.parameter_names}),
            q,
            v,
            **{name: extras[name] for name in self.extras},
        )
        if not self.states:
            return result, []
        value, derivatives = result
        if len(derivatives) != len(self.states):
            raise InputError(
                f"effect {self.name}",
                expected=f"{len(self.states)} derivatives, one for each of {', '.join(self.states)}",
                got=str(len(derivatives)),
                remedy="return (value, [one derivative for each hidden state])",
            )
        return value, list(derivatives)


@dataclass(frozen=True)
class Placed:
    """An effect at a port.

    Parameters
    ----------
    effect : Effect
    at : str
        Name of the input, coordinate, output or process state, or ``base``.
    values : dict, optional
        Start values or true values of some of its parameters.

    Examples
    --------
    >>> from harness.effects.laws.friction import coulomb_friction
    >>> Placed(coulomb_friction, "theta").name("Fc")
    'coulomb_friction@theta.Fc'
    """

    effect: Effect
    at: str
    values: Mapping[str, float] = field(default_factory=dict)

    def __str__(self) -> str:
        return f"{self.effect.name}@{self.at}"

    def __hash__(self) -> int:
        return hash((self.effect.name, self.at))

    def name(self, parameter: str) -> str:
        """Return the full name of a parameter or hidden state in a composed system."""
        return f"{self.effect.name}@{self.at}.{parameter}"

    def main(self) -> str | None:
        """Return the full name of the main parameter."""
        return None if self.effect.main is None else self.name(self.effect.main.name)

    def generalises(self, simple: Placed) -> bool:
        """Return True for a law at the same place that this one says is a special case of it."""
        return self.at == simple.at and simple.effect.name in self.effect.nests

    def with_values(self, values: Mapping[str, float]) -> Placed:
        """Return the same effect at the same port with these values."""
        return replace(self, values={**self.values, **values})


def effect(
    kind: str | Sequence[str],
    params: Mapping[str, str | EffectParameter] | Sequence[EffectParameter] = (),
    states: str | Mapping[str, str] = "",
    *,
    name: str | None = None,
    family: Sequence[str] = (),
    same_as: Mapping[str, str] | None = None,
    limits: Mapping[str, str] | None = None,
    nests: Sequence[str] = (),
    experiment: str = "",
    formula: str = "",
    drives: bool = False,
    downstream: bool = False,
    sampled: str = "",
    linearises: bool = True,
    angles: bool = False,
    initial: Mapping[str, str] | None = None,
    requires: Mapping[str, Callable[[Mapping[str, float]], bool]] | None = None,
    requires_along: Mapping[str, Along] | None = None,
    grows: str = "",
    whole: str = "",
    told_by: Sequence[str] = (),
    cuts: bool = False,
    needs: Sequence[str] = (),
    corners: Callable[[Any, Any], Sequence[Any]] | None = None,
) -> Callable[[Callable[..., Any]], Effect]:
    """Make an effect of a function.

    Parameters
    ----------
    kind : str or sequence of str
        Ports it fits: ``input``, ``coordinate``, ``output``, ``base``, ``process``.
    params : mapping or sequence
        Name to unit template, or to an :class:`EffectParameter` where more is to be said. The first is the main one
        unless another says so.
    states : str or mapping
        Names of hidden states separated by spaces, or name to unit template. They start at 0 unless ``initial`` says
        otherwise.
    name, family, same_as, limits, nests, experiment, formula, drives, downstream, sampled, linearises, angles, initial,
    requires, requires_along, grows, whole, told_by, cuts, needs, corners
        See :class:`Effect`; ``name`` is the function's own unless given.

    Returns
    -------
    callable
        A decorator for ``function(signal, s, p, q, v)``; more arguments are passed if they are named ``t`` (time),
        ``a`` (acceleration of the coordinate; a force may depend on it linearly, hidden states may not), ``load``
        (force that the joint carries), ``damping`` and ``pull`` (nominal forces on the coordinate that no input makes:
        what the speeds add, and what is there at rest) or ``temperature`` (an input in kelvin or degC, in kelvin). It
        returns the new
        input or output; on a coordinate the force to *add*; on a process state the rate to add (with the rate to add to
        the next state, if ``downstream``); on the base the pair of gravity components. With hidden states it returns
        that and the list of their derivatives. A block that fits both a coordinate and an input returns the force to
        add at either. Use the functions of
        :mod:`harness.effects.functions`.

    Raises
    ------
    InputError
        If the kind or the function's arguments do not fit.

    Examples
    --------
    >>> @effect("input", dict(tau="s"), states="z")
    ... def my_lag(u, s, p, q, v):
    ...     return s.z, [(u - s.z) / p.tau]
    >>> my_lag.name, my_lag.parameter_names, my_lag.states
    ('my_lag', ('tau',), ('z',))
    """
    kinds = (kind,) if isinstance(kind, str) else tuple(kind)
    if not kinds or any(port_kind not in KINDS for port_kind in kinds):
        raise InputError(
            "kind of an effect", expected=f"among {', '.join(KINDS)}", got=repr(kind), remedy="name the ports it fits"
        )
    if grows and not nests:
        raise InputError(
            "an effect that grows",
            expected="nests, the law that it refines first",
            got="no nests",
            remedy="name that law in nests, or leave grows out",
        )
    refuse_unknown(
        "told_by of an effect",
        told_by,
        EXPERIMENTS,
        remedy="name kinds of experiments from this list, and say in experiment what else would tell",
    )
    refuse_unknown("needs of an effect", needs, NEEDS, remedy="choose from these")
    parameters = _parameters(params)
    hidden = dict.fromkeys(states.split(), "1") if isinstance(states, str) else dict(states)

    def decorate(function: Callable[..., Any]) -> Effect:
        arguments = tuple(inspect.signature(function).parameters)
        extras = arguments[_FIXED_ARGUMENTS:]
        if len(arguments) < _FIXED_ARGUMENTS or any(extra not in _EXTRA_ARGUMENTS for extra in extras):
            raise InputError(
                f"arguments of effect {function.__name__}",
                expected=f"(signal, s, p, q, v) and then any of {', '.join(_EXTRA_ARGUMENTS)}",
                got=f"({', '.join(arguments)})",
                remedy="name the arguments so, also those that are not used",
            )
        lines = (inspect.getdoc(function) or "").splitlines()
        return Effect(
            name=name or function.__name__,
            kinds=kinds,  # type: ignore[arg-type]
            parameters=parameters,
            states=tuple(hidden),
            function=function,
            summary=lines[0] if lines else "",
            formula=formula,
            experiment=experiment,
            family=tuple(family),
            same_as=dict(same_as or {}),
            limits=dict(limits or {}),
            nests=tuple(nests),
            state_units=tuple(hidden.values()),
            drives=drives,
            downstream=downstream,
            sampled=sampled,
            linearises=linearises,
            angles=angles,
            initial=dict(initial or {}),
            extras=extras,
            requires=dict(requires or {}),
            requires_along=dict(requires_along or {}),
            grows=grows,
            whole=whole,
            told_by=tuple(told_by),
            cuts=cuts,
            needs=tuple(needs),
            corners=corners,
        )

    return decorate


def port_units(kind: str, unit: str, force_unit: str = "") -> dict[str, str]:
    """Return the units at a port of the names in a unit template.

    Examples
    --------
    >>> port_units("coordinate", "rad", "N m")["v"]
    'rad/s'
    """
    if kind == "coordinate":
        rate = rate_unit(unit)
        force = force_unit or ("N m" if unit == "rad" else "N")
        return {"q": unit, "v": rate, "a": rate_unit(rate), "F": force}
    if kind == "process":
        return {"x": unit, "F": rate_unit(unit)}
    if kind == "mass":
        return {"M": unit}
    return {"u": unit, "F": unit} if kind == "input" else {"y": unit}


def unit_of(template: str, units: Mapping[str, str]) -> str:
    """Return the unit text of a parameter or hidden state at a port."""
    return fill(template, units)


def _parameters(params: Mapping[str, str | EffectParameter] | Sequence[EffectParameter]) -> tuple[EffectParameter, ...]:
    """Return the parameters with exactly one main one (none if there are none)."""
    if isinstance(params, Mapping):
        made = [
            replace(declared, name=name)
            if isinstance(declared, EffectParameter)
            else EffectParameter(name, declared, minimum=0.0 if declared == "s" else -np.inf)
            for name, declared in params.items()
        ]
    else:
        made = list(params)
    if made and not any(parameter.main for parameter in made):
        made[0] = replace(made[0], main=True)
    return tuple(made)


def _find(module: str, qualified_name: str) -> Effect:
    """Return the effect that stands under a function's old name."""
    found: Any = importlib.import_module(module)
    for part in qualified_name.split("."):
        found = getattr(found, part)
    if not isinstance(found, Effect):
        raise InputError(
            f"no effect at {module}.{qualified_name}",
            expected="an effect",
            got=type(found).__name__,
            remedy="import it",
        )
    return found
