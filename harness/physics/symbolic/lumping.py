"""Lumped parameters of a mechanism: L and Q as sums of parameter combinations times known functions of the motion."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import sympy as sp

from harness.errors import InputError, unknown_name
from harness.physics.symbolic.mechanism import Mechanism


@dataclass(frozen=True, eq=False)
class Split:
    """``L = L_0 + sum_k pi_k L_k``, ``Q_i = Q_0i + sum_k pi_k Q_ki``; the pi_k contain parameters only."""

    combinations: tuple[Any, ...]  # pi_k
    lagrangians: tuple[Any, ...]  # L_k, without parameters
    forces: tuple[tuple[Any, ...], ...]  # Q_k, one expression for each coordinate
    # L_0 and Q_0: what has no unknown parameter (the inputs, mostly)
    known_lagrangian: Any
    known_forces: tuple[Any, ...]


def split(mechanism: Mechanism, known: Mapping[str, float] | None = None) -> Split:
    """Return the lumped parameters of a mechanism and the functions that multiply them.

    Raises InputError if a term does not separate into parameters and motion (a parameter inside a function of the state
    that no addition theorem takes apart), a known parameter is unknown, or the mechanism is generated code.

    - ``known``: parameters whose value is known: they are replaced by it
    - returns the split with the least number of combinations: monomials in the parameters that always come in the same
      proportion to each other are added up (row reduction of the table of functions against monomials)

    Examples
    --------
    >>> from harness.physics.models import double_pendulum
    >>> [str(combination) for combination in split(double_pendulum()).combinations][:3]
    ['I1 + l1**2*m2 + lc1**2*m1', 'I2 + lc2**2*m2', 'l1*m2 + lc1*m1']
    """
    if not mechanism.symbolic:
        raise InputError(
            f"lumped parameters of {mechanism.name} in symbols",
            expected="a mechanism whose Lagrangian is written out",
            got="an arm whose energies are generated code",
            remedy="use lumped(mechanism): it finds base parameters on the columns of the regressor",
        )
    values = known_symbols(mechanism, known or {})
    table = _Table(set(mechanism.p) - set(values))
    table.add("L", lagrangian(mechanism).subs(values))
    for row, force in enumerate(mechanism.forces()):
        table.add(row, force.subs(values))
    return table.split(len(mechanism.q))


def known_symbols(mechanism: Mechanism, known: Mapping[str, float]) -> dict[Any, Any]:
    """Return known values by symbol; raises InputError for a name that is no parameter."""
    symbols = {str(symbol): symbol for symbol in mechanism.p}
    for name in known:
        if name not in symbols:
            raise unknown_name(f"known parameter of {mechanism.name!r}", name, symbols)
    return {symbols[name]: sp.Float(float(value), 17) for name, value in known.items()}


def energies(mechanism: Mechanism) -> tuple[Any, Any]:
    """Return kinetic energy T and potential energy V of a mechanism, bodies included.

    Examples
    --------
    >>> from harness.physics.models import pendulum
    >>> [str(sp.trigsimp(energy)) for energy in energies(pendulum())]
    ['J*v_theta**2/2', '-mgl*cos(theta)']
    """
    kinetic, potential = sp.sympify(mechanism.T), sp.sympify(mechanism.V)
    rates = list(zip(mechanism.q, mechanism.v, strict=True))
    for body in mechanism.bodies:
        velocity = [sum(sp.diff(part, q) * v for q, v in rates) + sp.diff(part, mechanism.t) for part in body.position]
        spin = sum(sp.diff(body.angle, q) * v for q, v in rates) + sp.diff(body.angle, mechanism.t)
        kinetic += body.mass * sum(sp.expand(part**2) for part in velocity) / 2
        kinetic += body.inertia * sp.expand(spin**2) / 2
        potential += body.weight * body.position[1]
    return kinetic, potential


def lagrangian(mechanism: Mechanism) -> Any:
    """Return T - V of a mechanism, bodies included."""
    kinetic, potential = energies(mechanism)
    return kinetic - potential


class _Table:
    """Collects terms ``monomial(parameters) * function(motion)`` by place (the Lagrangian, or a force)."""

    def __init__(self, parameters: set[Any]) -> None:
        self.parameters = parameters
        self.entries: dict[tuple[Any, Any], dict[Any, Any]] = {}
        self.monomials: list[Any] = []
        self.decimal = False

    def add(self, place: Any, expression: Any) -> None:
        """Take one expression apart."""
        expanded = sp.expand(sp.expand_trig(sp.expand(expression))) if self._hidden(expression) else None
        if expanded is None:
            expanded = sp.expand(expression)
        # cos^2 + sin^2 = 1, found term by term where it matters: the kinetic energy of rotating bodies.
        for term in sp.Add.make_args(without_squared_sines(expanded)):
            inside, outside = (
                term.as_independent(*self.parameters, as_Add=False) if self.parameters else (term, sp.Integer(1))
            )
            number, function = sp.sympify(inside).as_coeff_Mul()
            if number.is_Float:
                # as a decimal without the rounding of products: what depends on each other must cancel exactly
                number, self.decimal = sp.Rational(format(float(number), ".14g")), True
            motion = outside.free_symbols - self.parameters
            if motion:
                raise InputError(
                    "term of a model",
                    expected="(function of parameters) times (function of the motion)",
                    got=str(term),
                    remedy=f"give the value of {', '.join(sorted(map(str, outside.free_symbols & self.parameters)))}",
                )
            if place == "L" and not function.free_symbols and function == 1:
                continue  # a constant energy moves nothing
            if outside not in self.monomials:
                self.monomials.append(outside)
            row = self.entries.setdefault((place, function), {})
            row[outside] = row.get(outside, 0) + number

    def _hidden(self, expression: Any) -> bool:
        """Return True if a parameter stands beside the motion inside a trigonometric function."""
        return any(
            node.free_symbols & self.parameters and node.free_symbols - self.parameters
            for node in expression.atoms(sp.sin, sp.cos)
        )

    def _shown(self, number: Any) -> Any:
        """Return a number as it is read: a fraction as a decimal where the model is written in decimals."""
        if number.is_Integer:
            return number
        near = sp.Integer(round(number))
        if abs(number - near) < 1e-12:
            return near
        return sp.Float(float(number)) if self.decimal else number

    def split(self, n: int) -> Split:
        """Return the combinations and what multiplies them."""
        unknown = [monomial for monomial in self.monomials if monomial != 1]
        places = list(self.entries)
        rows = [[self.entries[place].get(monomial, 0) for monomial in unknown] for place in places]
        reduced, pivots = sp.Matrix(rows).rref() if unknown and rows else (sp.zeros(0, 0), ())
        combinations, lagrangians, forces = [], [], []
        for number, pivot in enumerate(pivots):
            shares = [self._shown(reduced[number, c]) for c in range(len(unknown))]
            combinations.append(sum(share * monomial for share, monomial in zip(shares, unknown, strict=True)))
            energy, force = sp.Integer(0), [sp.Integer(0)] * n
            for place, row in zip(places, rows, strict=True):
                share = row[pivot] * place[1]
                if place[0] == "L":
                    energy += share
                else:
                    force[place[0]] += share
            lagrangians.append(energy)
            forces.append(tuple(force))
        known_energy, known_force = sp.Integer(0), [sp.Integer(0)] * n
        for place, entries in self.entries.items():
            share = entries.get(sp.Integer(1), 0) * place[1]
            if place[0] == "L":
                known_energy += share
            else:
                known_force[place[0]] += share
        return Split(tuple(combinations), tuple(lagrangians), tuple(forces), known_energy, tuple(known_force))


def without_squared_sines(expanded: Any) -> Any:
    """Return a sum in which ``a sin(x)^2 + a cos(x)^2`` is replaced by ``a``, for every angle x."""
    angles = sorted({node.args[0] for node in expanded.atoms(sp.sin)}, key=str)
    for angle in angles:
        square = sp.sin(angle) ** 2
        if expanded.has(square):
            # sin^2 = 1 - cos^2 everywhere gives a normal form: what cancels, cancels.
            expanded = sp.expand(
                expanded.replace(
                    lambda node, angle=angle: (
                        node.is_Pow and node.base == sp.sin(angle) and node.exp.is_Integer and node.exp >= 2
                    ),
                    lambda node, angle=angle: (
                        (1 - sp.cos(angle) ** 2) ** (node.exp // 2) * sp.sin(angle) ** (node.exp % 2)
                    ),
                )
            )
    return expanded
