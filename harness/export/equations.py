"""The equations of a model for others to read and to run: text, LaTeX, Python and C, with units.

What is printed as Python or C is what the project computes with, operation by operation.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING, Any, Literal

import sympy as sp

from harness.errors import InputError
from harness.signals import Channel
from harness.units.grammar import factors

if TYPE_CHECKING:
    from harness.physics.compiled.system import System

Form = Literal["text", "latex", "python", "c"]
FORMS = ("text", "latex", "python", "c")
LONG = 5000  # Operations beyond which an equation, written out, is not read, but run.


@dataclass(frozen=True, eq=False)
class Quantity:
    """A function of a model as CasADi computes it."""

    name: str
    arguments: tuple[str, ...]  # Names of the columns that it takes
    function: Any  # Of dense columns, to one dense column
    rows: tuple[str, ...]  # What each entry of the result is


@dataclass(frozen=True, eq=False)
class WrittenModel:
    """A model ready to be written."""

    system: System
    values: Mapping[str, float]  # Of its parameters
    quantities: tuple[Quantity, ...]
    """``derivative`` and ``output``; of mechanical models also ``energy`` (kinetic, potential), and of those without
    effects ``lumped`` (the lumped parameters), ``regressor`` (row by row) and ``known``, so that ``regressor @ lumped =
    known``."""
    lumps: tuple[tuple[str, str], ...]  # tuple of (str, str): Lumped parameters and their units

    def write(self, form: Form = "text") -> str:
        """Return the equations in a form.

        Raises InputError if there is no such form, or the equations are too long to be read.

        Examples
        --------
        >>> from harness.physics.models import load_model
        >>> print(written_model(load_model("pendulum")).write().splitlines()[3])
          J*theta'' + b*theta' + mgl*sin(theta) = u
        """
        if form not in FORMS:
            raise InputError("form of the equations", expected=", ".join(FORMS), got=repr(form), remedy="choose one")
        return {"text": self._text, "latex": self._latex, "python": self._python, "c": self._c}[form]()

    # ---- to be read ------------------------------------------------------------------------------------------------

    def _channels(self) -> list[tuple[str, Sequence[Channel]]]:
        system = self.system
        return [("inputs u", system.inputs), ("states x", system.states), ("outputs y", system.outputs)]

    def _text(self) -> str:
        lines = [str(self.system), "", "equations of motion" if self.system.coordinates else "equations"]
        lines += [f"  {line}" for line in self._equations("text")]
        for title, left, right in self._energies("text"):
            lines += ["", title, f"  {left} = {right}"]
        if self.lumps:
            lines += ["", "lumped parameters"]
            lines += [f"  {name} [{unit}]" for name, unit in self.lumps]
            lines += ["", "regressor (times the lumped parameters; the right-hand side is what is known)"]
            lines += [f"  {row}" for row in self._regressor("text")]
        for title, channels in self._channels():
            lines += ["", title, *(f"  {channel.name} [{channel.unit}]" for channel in channels)]
        lines += ["", "parameters p"]
        lines += [f"  {p.name} = {self.values[p.name]!r} [{p.unit}]" for p in self.system.parameters]
        return "\n".join(lines) + "\n"

    def _latex(self) -> str:
        lines = [f"% {self.system}", r"\begin{align}"]
        lines += [line.replace("=", "&=", 1) + r" \\" for line in self._equations("latex")]
        lines += [f"{left} &= {right} \\\\" for _, left, right in self._energies("latex")]
        lines.append(r"\end{align}")
        if self.lumps:
            lines += [r"\begin{tabular}{ll}", r"lumped parameter & unit \\"]
            lines += [f"${sp.latex(sp.sympify(name, locals=_symbols(name)))}$ & {_upright(unit)} \\\\"
                      for name, unit in self.lumps]  # fmt: skip
            lines += [r"\end{tabular}", r"\begin{align}"]
            lines += [row.replace("=", "&=", 1) + r" \\" for row in self._regressor("latex")]
            lines.append(r"\end{align}")
        lines += [r"\begin{tabular}{lll}", r"symbol & value & unit \\"]
        lines += [f"${sp.latex(sp.Symbol(p.name))}$ & {self.values[p.name]:.6g} & {_upright(p.unit)} \\\\"
                  for p in self.system.parameters]  # fmt: skip
        return "\n".join([*lines, r"\end{tabular}"]) + "\n"

    def _equations(self, form: Literal["text", "latex"]) -> list[str]:
        """Return the equations: of a mechanism as it is written, else those that are computed, term by term."""
        from harness.physics.symbolic.equation_text import equations

        system, mechanism = self.system, self.system.mechanism
        if mechanism is not None and not system.effects and getattr(mechanism, "symbolic", True):
            return equations(mechanism, form)
        names = {"x": [c.name for c in system.states], "u": [c.name for c in system.inputs],
                 "p": [p.name for p in system.parameters], "t": ["t"]}  # fmt: skip
        derivative = self.quantities[0].function
        size = _written_out(derivative)
        if size > LONG:
            raise InputError(
                f"equations of {system.name}",
                expected=f"at most {LONG} operations to be read",
                got=f"{size:.0f}, written out",
                remedy="write them as python or c",
            )
        show = sp.sstr if form == "text" else sp.latex
        rows = _in_symbols(derivative, [names[key] for key in ("x", "u", "p", "t")])
        left = [f"d({name})/dt" if form == "text" else rf"\frac{{d}}{{dt}} {sp.latex(sp.Symbol(name))}"
                for name in names["x"]]  # fmt: skip
        lines = [f"{a} = {show(b)}" for a, b in zip(left, rows, strict=True)]
        outputs = _in_symbols(self.quantities[1].function, [names[key] for key in ("x", "u", "p", "t")])
        lines += [
            f"{show(sp.Symbol(channel.name))} = {show(row)}"
            for channel, row in zip(system.outputs, outputs, strict=True)
            if str(row) != channel.name
        ]
        return lines

    def _energies(self, form: Literal["text", "latex"]) -> list[tuple[str, str, str]]:
        """Return title, symbol and expression of the energies of a mechanism that is written out."""
        from harness.physics.symbolic.equation_text import written
        from harness.physics.symbolic.lumping import energies

        mechanism = self.system.mechanism
        if not self.system.coordinates or not hasattr(mechanism, "T") or not getattr(mechanism, "symbolic", True):
            return []
        words = ("kinetic energy [J]", "T"), ("potential energy [J]", "V")
        return [(*word, written(one, mechanism, form)) for word, one in zip(words, energies(mechanism), strict=True)]

    def _regressor(self, form: Literal["text", "latex"]) -> list[str]:
        """Return the rows of the regressor, times pi, and what they are equal to."""
        from harness.physics.symbolic.equation_text import written
        from harness.physics.symbolic.lumping import split

        mechanism = self.system.mechanism
        parts, pi = split(mechanism), r"\pi" if form == "latex" else "pi"
        lines = []
        for i in range(len(mechanism.q)):
            row = [_rate(mechanism, one, i) - sp.sympify(force[i])
                   for one, force in zip(parts.lagrangians, parts.forces, strict=True)]  # fmt: skip
            known = sp.sympify(parts.known_forces[i]) - _rate(mechanism, parts.known_lagrangian, i)
            entries = ", ".join(written(entry, mechanism, form) for entry in row)
            lines.append(f"[{entries}] {pi} = {written(known, mechanism, form)}")
        return lines

    # ---- to be run -------------------------------------------------------------------------------------------------

    def _head(self, mark: str) -> list[str]:
        lines = [f"{mark} {self.system}"]
        for title, channels in self._channels():
            lines.append(f"{mark} {title}: " + (", ".join(f"{c.name} [{c.unit}]" for c in channels) or "none"))
        lines.append(f"{mark} parameters p: " + ", ".join(f"{p.name} [{p.unit}]" for p in self.system.parameters))
        if self.lumps:
            lines.append(f"{mark} lumped parameters pi: " + ", ".join(f"{name} [{unit}]" for name, unit in self.lumps))
        return lines

    def _python(self) -> str:
        lines = [*self._head("#"), "import math", ""]
        lines += ["p = [", *(f"    {float(self.values[p.name])!r},  # {p.name} [{p.unit}]"
                             for p in self.system.parameters), "]", ""]  # fmt: skip
        for quantity in self.quantities:
            arguments = ", ".join("p=p" if name == "p" else name for name in _last(quantity.arguments, "p"))
            lines += ["", f"def {quantity.name}({arguments}):", f'    """Return {", ".join(quantity.rows)}."""']
            lines += [f"    {line}" for line in _python_lines(quantity.function, quantity.arguments)]
            lines.append("")
        return "\n".join(lines).rstrip() + "\n"

    def _c(self) -> str:
        from harness.physics.compiled.ccode import c_function

        name = _identifier(self.system.name)
        head = [f"/*{line} */" for line in self._head("")]
        values = ", ".join(repr(float(self.values[p.name])) for p in self.system.parameters)
        lines = [*head, "#include <math.h>", "", f"const double {name}_p[] = {{{values or '0'}}};"]
        for quantity in self.quantities:
            text = c_function(f"{name}_{quantity.name}", quantity.function).replace("static void", "void", 1)
            first, _, rest = text.partition("\n")
            for place, argument in enumerate(quantity.arguments):
                first = re.sub(rf"\bi{place}\b", argument, first)
                rest = re.sub(rf"\bi{place}\b", argument, rest)
            first, rest = (re.sub(r"\bo0\b", "result", part) for part in (first, rest))
            lines += ["", f"/* result: {', '.join(quantity.rows)} */", f"{first}\n{rest}"]
        return "\n".join(lines) + "\n"


def written_model(model: Any) -> WrittenModel:
    """Return a model ready to be written.

    Raises InputError if it is no model of equations.

    - ``model``: nominal, or with effects built in; a fitted model is written with the values that were found
    """
    import casadi as ca

    from harness.physics.compiled.ccode import dense

    given = getattr(model, "model", model)  # what was fitted
    fitted = getattr(given, "parameters", None)
    values = fitted if isinstance(fitted, Mapping) else None
    system = given.system() if callable(getattr(given, "system", None)) else given
    if not hasattr(system, "generalized_forces"):
        raise InputError(
            "equations of a model",
            expected="a physical model: a name, a URDF, FILE.py:NAME, or a grey box of identify or close-loop",
            got=type(given).__name__,
            remedy="sysid list models shows names",
        )
    arguments = [system.x, system.u, system.p, system.t]
    names = ("x", "u", "p", "t")
    found = [
        Quantity("derivative", names, dense("derivative", arguments, [system.f]),
                 tuple(f"d({channel.name})/dt" for channel in system.states)),
        Quantity("output", names, dense("output", arguments, [system.upright(system.h)]),
                 tuple(channel.name for channel in system.outputs)),
    ]  # fmt: skip
    mechanism = system.mechanism
    lumps: tuple[tuple[str, str], ...] = ()
    if system.coordinates and hasattr(mechanism, "T"):
        n = len(system.coordinates)
        kinetic = system.upright(ca.mtimes([system.x[n : 2 * n].T, system.mass_matrix, system.x[n : 2 * n]]) / 2)
        if getattr(mechanism, "symbolic", True):
            kinetic, potential = _energies_of(mechanism, system)
            found.append(Quantity("energy", ("x", "p", "t"), dense("energy", [system.x, system.p, system.t], [
                ca.vertcat(kinetic, potential)]), ("kinetic energy [J]", "potential energy [J]")))  # fmt: skip
        else:
            found.append(Quantity("energy", names, dense("energy", arguments, [kinetic]), ("kinetic energy [J]",)))
        if not system.effects and getattr(mechanism, "symbolic", True):
            more, lumps = _lumped(mechanism, system)
            found += more
    return WrittenModel(system, system.values(values), tuple(found), lumps)


def _columns(mechanism: Any, system: System) -> dict[Any, Any]:
    """Return the CasADi symbol of every symbol of a mechanism."""
    n, table = len(mechanism.q), {mechanism.t: system.t}
    for symbols, column in ((mechanism.q, system.x[:n]), (mechanism.v, system.x[n : 2 * n]), (mechanism.p, system.p)):
        table.update({symbol: column[row] for row, symbol in enumerate(symbols)})
    return table


def _energies_of(mechanism: Any, system: System) -> list[Any]:
    """Return kinetic and potential energy in the symbols of a system."""
    from harness.physics.symbolic.convert import to_casadi
    from harness.physics.symbolic.lumping import energies

    table = _columns(mechanism, system)
    return [to_casadi(sp.sympify(energy), table) for energy in energies(mechanism)]


def _lumped(mechanism: Any, system: System) -> tuple[list[Quantity], tuple[tuple[str, str], ...]]:
    """Return lumped parameters, regressor and what is known, and the names and units of the lumped parameters."""
    import casadi as ca

    from harness.physics.compiled.ccode import dense
    from harness.physics.lumps.lumped_functions import motion_terms
    from harness.physics.symbolic.convert import to_casadi
    from harness.physics.symbolic.lumping import split

    try:
        parts = split(mechanism)
    except InputError:  # a parameter inside a function of the motion: nothing is lumped
        return [], ()
    table, names = _columns(mechanism, system), [str(combination) for combination in parts.combinations]
    if not names:
        return [], ()
    terms = motion_terms(mechanism, parts)
    units = {parameter.name: parameter.unit for parameter in system.parameters}
    lumps = tuple((name, _unit_of(one, units)) for name, one in zip(names, parts.combinations, strict=True))
    values = ca.vertcat(*(to_casadi(sp.sympify(one), table) for one in parts.combinations))
    coordinates = [coordinate.name for coordinate in system.coordinates]
    arguments = ("q", "v", "u", "t", "a")
    rows = tuple(f"{q}: {name}" for q in coordinates for name in names)
    return [
        Quantity("lumped", ("p",), dense("lumped", [system.p], [values]), tuple(names)),
        Quantity("regressor", arguments, dense("regressor", *terms["torque"]), rows),
        Quantity("known", arguments, dense("known", *terms["torque_known"]), tuple(coordinates)),
    ], lumps


def _unit_of(expression: Any, units: Mapping[str, str]) -> str:
    """Return the unit of a lumped parameter: that of its first term."""
    found: dict[str, Fraction] = {}
    for factor in sp.Mul.make_args(sp.Add.make_args(sp.sympify(expression))[0]):
        base, power = factor.as_base_exp()
        if base.is_Symbol:
            for name, own in factors(units[str(base)]):
                found[name] = found.get(name, Fraction(0)) + own * Fraction(str(sp.Rational(power)))
    shown = [(name, power) for name, power in found.items() if power]
    if not shown:
        return "1"
    return " ".join(name if power == 1 else f"{name}^{power if power.denominator == 1 else f'({power})'}"
                    for name, power in shown)  # fmt: skip


def _rate(mechanism: Any, expression: Any, row: int) -> Any:
    """Return d/dt dL/dv - dL/dq of one coordinate, of a part of the Lagrangian."""
    part = sp.sympify(expression)
    momentum = sp.diff(part, mechanism.v[row])
    rate = sp.diff(momentum, mechanism.t)
    for q, v in zip(mechanism.q, mechanism.v, strict=True):
        rate += sp.diff(momentum, q) * v + sp.diff(momentum, v) * sp.Symbol(f"a_{q}", real=True)
    return rate - sp.diff(part, mechanism.q[row])


def _symbols(text: str) -> dict[str, Any]:
    return {name: sp.Symbol(name) for name in re.findall(r"[^\W\d]\w*", text)}


def _upright(unit: str) -> str:
    return unit.replace("^", r"\textasciicircum{}")


def _identifier(name: str) -> str:
    """Return a name that C takes."""
    plain = re.sub(r"\W", "_", name, flags=re.ASCII)
    return f"_{plain}" if plain[:1].isdigit() or not plain else plain


def _last(names: Sequence[str], one: str) -> list[str]:
    """Return names with one of them at the end."""
    return [name for name in names if name != one] + [one] * (one in names)


def _python_lines(function: Any, arguments: Sequence[str]) -> list[str]:
    """Return the lines of a Python function: one a CasADi instruction, the result a list."""
    import casadi as ca

    from harness.physics.compiled.ccode import formats

    texts = formats() | {getattr(ca, name): text for name, text in _PYTHON.items() if hasattr(ca, name)}
    size, lines = function.size1_out(0), []
    lines.append(f"result = [0.0] * {size}")
    for k in range(function.n_instructions()):
        operation = function.instruction_id(k)
        into, out = function.instruction_input(k), function.instruction_output(k)
        if operation == ca.OP_CONST:
            value = function.instruction_constant(k)
            lines.append(f"w{out[0]} = {value!r}" if math.isfinite(value) else f'w{out[0]} = float("{value!r}")')
        elif operation == ca.OP_INPUT:
            name = arguments[into[0]]
            lines.append(f"w{out[0]} = {name}" if name == "t" else f"w{out[0]} = {name}[{into[1]}]")
        elif operation == ca.OP_OUTPUT:
            lines.append(f"result[{out[1]}] = w{into[0]}")
        else:
            text = texts[operation].format(*(f"w{operand}" for operand in into))
            named = re.sub(r"\b(?!min\b|max\b|if\b|or\b|and\b|not\b)([a-z]\w*)\(", r"math.\1(", text)
            lines.append(f"w{out[0]} = {named}")
    return [*lines, "return result"]


_PYTHON = {
    "OP_AND": "float(bool({0}) and bool({1}))",
    "OP_OR": "float(bool({0}) or bool({1}))",
    "OP_NOT": "float(not {0})",
    "OP_FMIN": "min({0}, {1})",
    "OP_FMAX": "max({0}, {1})",
    "OP_IF_ELSE_ZERO": "({1} if {0} else 0.0)",
    "OP_SIGN": "(-1.0 if {0} < 0 else 1.0 if {0} > 0 else {0})",
}
"""Operations that Python writes otherwise than C."""


def _written_out(function: Any) -> float:
    """Return of how many operations the results are where nothing that is shared is shared."""
    import casadi as ca

    sizes: dict[int, float] = {}
    total = 0.0
    for k in range(function.n_instructions()):
        into, out = list(function.instruction_input(k)), list(function.instruction_output(k))
        if function.instruction_id(k) == ca.OP_INPUT:
            sizes[out[0]] = 1.0
        elif function.instruction_id(k) == ca.OP_OUTPUT:
            total += sizes[into[0]]
        else:
            sizes[out[0]] = 1.0 + sum(sizes[place] for place in into)
    return total


def _in_symbols(function: Any, names: Sequence[Sequence[str]]) -> list[Any]:
    """Return the result of a CasADi function as SymPy expressions of named symbols."""
    import casadi as ca

    of_unary = {getattr(ca, f"OP_{name.upper()}"): getattr(sp, symbolic) for name, symbolic in _SYMPY.items()}
    more = {
        ca.OP_ADD: lambda a, b: a + b, ca.OP_SUB: lambda a, b: a - b, ca.OP_MUL: lambda a, b: a * b,
        ca.OP_DIV: lambda a, b: a / b, ca.OP_NEG: lambda a: -a, ca.OP_SQ: lambda a: a**2,
        ca.OP_TWICE: lambda a: 2 * a, ca.OP_INV: lambda a: 1 / a, ca.OP_POW: lambda a, b: a**b,
        ca.OP_CONSTPOW: lambda a, b: a**b, ca.OP_ASSIGN: lambda a: a, ca.OP_FMIN: sp.Min, ca.OP_FMAX: sp.Max,
        ca.OP_ATAN2: sp.atan2, ca.OP_LT: sp.StrictLessThan, ca.OP_LE: sp.LessThan, ca.OP_EQ: sp.Eq, ca.OP_NE: sp.Ne,
        ca.OP_AND: sp.And, ca.OP_OR: sp.Or, ca.OP_NOT: sp.Not,
        ca.OP_IF_ELSE_ZERO: lambda test, a: sp.Piecewise((a, _truth(test)), (0, True)),
    }  # fmt: skip
    work: dict[int, Any] = {}
    result: list[Any] = [sp.Integer(0)] * function.size1_out(0)
    for k in range(function.n_instructions()):
        operation = function.instruction_id(k)
        into, out = list(function.instruction_input(k)), list(function.instruction_output(k))
        if operation == ca.OP_CONST:
            value = function.instruction_constant(k)
            work[out[0]] = sp.Integer(round(value)) if float(value).is_integer() else sp.Float(value)
        elif operation == ca.OP_INPUT:
            work[out[0]] = sp.Symbol(names[into[0]][into[1]], real=True)
        elif operation == ca.OP_OUTPUT:
            result[out[1]] = work[into[0]]
        else:
            made = (of_unary | more).get(operation)
            if made is None:
                raise InputError(
                    "equations in symbols",
                    expected="operations that SymPy has",
                    got=f"operation {operation} of CasADi",
                    remedy="write them as python or c",
                )
            work[out[0]] = made(*(work[operand] for operand in into))
    return result


def _truth(test: Any) -> Any:
    """Return a test, or that a number is not 0."""
    return test if isinstance(test, sp.logic.boolalg.Boolean) else sp.Ne(test, 0)


_SYMPY = {
    name: name
    for name in ("sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "asinh", "acosh", "atanh", "exp",
                 "log", "sqrt", "floor", "sign", "erf")
} | {"fabs": "Abs"}  # fmt: skip
