"""Equations typed as text, with units: a model without a line of Python, and without running anything."""

from __future__ import annotations

import ast
import operator
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import sympy as sp

from harness.errors import InputError, refuse_unknown
from harness.physics.definition.parameters import as_parameter
from harness.physics.symbolic.ode import Ode
from harness.units import is_unit

SUFFIX = ".eqs"
LONGEST = 20_000  # Characters of a file.
_NAME = r"[A-Za-z_]\w*"
_UNIT = r"(?:\s*\[(?P<unit>[^\]]*)\])?"
_RATE = re.compile(rf"(?P<name>{_NAME})\s*'\s*=(?P<rest>.+)")
_OUTPUT = re.compile(rf"output\s+(?P<name>{_NAME})\s*(?:=(?P<rest>[^\[]+))?{_UNIT}")
_LIST = re.compile(r"(?P<kind>input|state|level)\s+(?P<rest>.+)")
_MOTION = re.compile(rf"motion\s+(?P<name>{_NAME})\s*:\s*(?P<speed>{_NAME})\s*(?:,\s*(?P<inertia>{_NAME}))?")
_BALANCE = re.compile(rf"(?P<name>{_NAME})\s*:\s*(?P<left>[^=]*'[^=]*)=(?P<right>[^=]+)")
_PRIME = "_prime_"  # what a rate is called while an expression is read
_VALUE = re.compile(
    rf"(?P<name>{_NAME})\s*=\s*(?P<value>[-+]?[\d.]+(?:[eE][-+]?\d+)?)\s*(?P<unit>[^>]*?)\s*"
    r"(?:>=\s*(?P<low>\S+?))?\s*(?P<fixed>\bfixed)?"
)
_ITEM = re.compile(rf"(?P<name>{_NAME}){_UNIT}")
_BINARY: dict[type, Callable[[Any, Any], Any]] = {
    ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul, ast.Div: operator.truediv,
    ast.Pow: operator.pow,
}  # fmt: skip
_CALLS: dict[str, Callable[..., Any]] = {
    name: getattr(sp, name)
    for name in ("sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "exp", "log", "sqrt", "sign")
} | {"abs": sp.Abs, "min": sp.Min, "max": sp.Max, "atan2": sp.atan2}
_KINDS = "input NAME [UNIT] | state NAME [UNIT] | level NAME [UNIT] | motion NAME: SPEED, INERTIA | NAME' = ... | \
NAME: ... SPEED' ... = ... | NAME = NUMBER UNIT [>= NUMBER] [fixed] | output NAME = ... [UNIT]"


@dataclass
class _Read:
    """What the lines have said so far."""

    inputs: list[str] = field(default_factory=list)
    levels: list[str] = field(default_factory=list)
    units: dict[str, str] = field(default_factory=dict)
    rates: dict[str, tuple[int, str]] = field(default_factory=dict)
    parameters: dict[str, Any] = field(default_factory=dict)
    motions: dict[str, tuple[str, str | None]] = field(default_factory=dict)
    balances: dict[str, tuple[int, str, str]] = field(default_factory=dict)
    outputs: dict[str, tuple[int, str]] = field(default_factory=dict)


def typed_model(path: Path) -> Ode:
    """Return the model that a file holds; see :func:`read_equations`.

    Raises InputError if the file cannot be read, or a line is not understood.
    """
    if not path.is_file():
        raise InputError("no such file of equations", expected=f"a file FILE{SUFFIX}", got="no file",
                         remedy="check the path", file=path)  # fmt: skip
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(
            "equations", expected="UTF-8 text", got=str(error), remedy="save it as UTF-8", file=path
        ) from error
    try:
        return read_equations(text, path.stem)
    except InputError as error:
        raise error.located(file=path) from error


def read_equations(text: str, name: str = "typed") -> Ode:
    """Return the model that lines of text describe.

    - ``text``: a line each, in any order, ``#`` begins a comment: ``x' = EXPRESSION`` for every state, ``input u [N]``,
      ``state x [m]`` (its unit), ``level h [m]`` (a state that is one), ``motion shaft: w, J`` (w is the speed of a
      joint with inertia J), ``k = 2.5 N/m`` (a parameter, where a fit starts, and its unit; ``>= 0`` bounds it,
      ``fixed`` at the end says that it is known), ``output y`` or ``output y = EXPRESSION [UNIT]`` (by default the
      states). Joints that accelerate each other have a row of the mass matrix each in place of an inertia: ``motion x:
      v`` and ``x: M*v' + C*cos(a)*w' = F``, the balance of what acts along x. Expressions are made of these names, of
      ``t``, numbers, ``+ - * / ^ ( )`` and usual functions. Nothing in them is evaluated as Python.
    - ``name``: of the model

    Raises InputError naming the line, if one is not understood, a name is unknown or a unit is none.

    Examples
    --------
    >>> motor = read_equations('''
    ... input v [V]
    ... state i [A], w [rad/s]
    ... motion shaft: w, J
    ... R = 2 ohm >= 0
    ... L = 1e-3 H
    ... K = 0.05 N m/A
    ... J = 1e-4 kg m^2
    ... i' = (v - R*i - K*w) / L
    ... w' = K*i / J
    ... ''', "motor")
    >>> print(motor.system())
    motor: v [V] -> i [A], w [rad/s]

    A crane, as its equations of motion are written:

    >>> crane = read_equations('''
    ... input F [N]
    ... state s [m], a [rad], v [m/s], w [rad/s]
    ... motion s: v
    ... motion a: w
    ... M = 2.5 kg
    ... C = 0.3 kg m
    ... J = 0.18 kg m^2
    ... s' = v
    ... a' = w
    ... s: M*v' + C*cos(a)*w' = F + C*sin(a)*w^2
    ... a: C*cos(a)*v' + J*w' = -9.81*C*sin(a)
    ... ''', "crane")
    >>> print(crane.system())
    crane: F [N] -> s [m], a [rad], v [m/s], w [rad/s]
    """
    if len(text) > LONGEST:
        raise InputError("equations", expected=f"at most {LONGEST} characters", got=str(len(text)),
                         remedy="write a larger model in Python")  # fmt: skip
    read = _Read()
    for number, line in _lines(text):
        _take(read, number, line)
    balanced = {name: read.motions[name][0] for name in read.balances if name in read.motions}
    states = [*read.rates, *balanced.values()]
    if not states:
        raise InputError(
            "equations of a model", expected="a line x' = ... for every state", got="none", remedy="write one"
        )
    for declared in (*read.levels, *(speed for speed, _ in read.motions.values())):
        _known(declared, states, "state")
    _refuse_half_a_joint(read)
    clean = re.sub(r"\W", "_", name)
    ode = Ode(
        clean if clean and not clean[0].isdigit() else f"_{clean}",
        x=" ".join(states),
        u=" ".join(read.inputs),
        p=" ".join(read.parameters),
        units=read.units,
        parameters=read.parameters,
        process=" ".join(read.levels),
    )
    known = {str(symbol): symbol for symbol in (*ode.x, *ode.u, *ode.p, ode.t)}
    slopes = [_expression(rest, known, number) for number, rest in read.rates.values()]
    for joint, (speed, inertia) in read.motions.items():
        if inertia is not None:
            ode.move(joint, speed, inertia)
        else:
            row, force = _balance(*read.balances[joint], [other for other, _ in read.motions.values()], known)
            ode.move(joint, speed, row)
            slopes.append(force)
    ode.rhs = slopes
    for output, (number, rest) in read.outputs.items():
        ode.outputs[output] = (_expression(rest, known, number), read.units.get(output, "1"))
    return ode


def _refuse_half_a_joint(read: _Read) -> None:
    """Refuse a joint without an inertia or a row, with both, and a row without a joint."""
    for joint, (number, left, _) in read.balances.items():
        if joint not in read.motions:
            raise _refused(number, f"{joint}: {left}", f"motion {joint}: SPEED, in a line of its own")
        if read.motions[joint][1] is not None or read.motions[joint][0] in read.rates:
            speed = read.motions[joint][0]
            raise _refused(
                number, f"{joint}: {left}", f"motion {joint}: {speed} alone, and no {speed}' = ... beside it"
            )
    for joint, (speed, inertia) in read.motions.items():
        if inertia is None and joint not in read.balances:
            raise InputError(
                f"motion {joint} has no inertia",
                expected=f"motion {joint}: {speed}, INERTIA, or a row {joint}: ... {speed}' ... = ...",
                got="neither",
                remedy=f"name the parameter that {speed}' is multiplied by to give a torque or a force",
            )


def _balance(
    number: int, left: str, right: str, speeds: list[str], known: dict[str, Any]
) -> tuple[dict[str, Any], Any]:
    """Return a row of the mass matrix by speed, and the generalized force on its right side."""
    rates = {speed + _PRIME: sp.Symbol(speed + _PRIME, real=True) for speed in speeds}
    sides = [re.sub(rf"({_NAME})\s*'", rf"\1{_PRIME}", side) for side in (left, right)]
    over = sp.expand(_expression(sides[0], known | rates, number) - _expression(sides[1], known | rates, number))
    row = {speed: sp.diff(over, rates[speed + _PRIME]) for speed in speeds}
    if any(entry.free_symbols & set(rates.values()) for entry in row.values()):
        raise _refused(number, f"{left.strip()} = {right.strip()}", "rates of the speeds to the first power only")
    return (
        {speed: sp.simplify(entry) for speed, entry in row.items() if entry != 0},
        -over.xreplace(dict.fromkeys(rates.values(), sp.Integer(0))),
    )


def _lines(text: str) -> Iterator[tuple[int, str]]:
    """Return the number and the text of every line that says something."""
    for number, line in enumerate(text.splitlines(), 1):
        said = line.partition("#")[0].strip().rstrip(";").replace("\N{RIGHT SINGLE QUOTATION MARK}", "'")
        if said:
            yield number, said


def _take(read: _Read, number: int, line: str) -> None:
    """Put what a line says where it belongs."""
    if (found := _RATE.fullmatch(line)) is not None:
        _fresh(found["name"], read.rates, number)
        read.rates[found["name"]] = (number, found["rest"])
    elif (found := _LIST.fullmatch(line)) is not None:
        for item in re.split(r",(?![^\[]*\])", found["rest"]):
            one = _ITEM.fullmatch(item.strip())
            if one is None:
                raise _refused(number, item.strip(), "NAME [UNIT], separated by commas")
            read.units[one["name"]] = _unit(one["unit"], number)
            if found["kind"] != "state":
                (read.inputs if found["kind"] == "input" else read.levels).append(one["name"])
    elif (found := _MOTION.fullmatch(line)) is not None:
        _fresh(found["name"], read.motions, number)
        read.motions[found["name"]] = (found["speed"], found["inertia"])
    elif (found := _BALANCE.fullmatch(line)) is not None:
        _fresh(found["name"], read.balances, number)
        read.balances[found["name"]] = (number, found["left"], found["right"])
    elif (found := _OUTPUT.fullmatch(line)) is not None:
        _fresh(found["name"], read.outputs, number)
        read.outputs[found["name"]] = (number, found["rest"] or found["name"])
        if found["unit"] is not None:
            read.units[found["name"]] = _unit(found["unit"], number)
    elif (found := _VALUE.fullmatch(line)) is not None:
        _fresh(found["name"], read.parameters, number)
        unit, low = _unit(found["unit"].strip().strip("[]"), number), found["low"]
        numbers = [_number(given, number) for given in (found["value"], *([low] if low else []))]
        parameter = as_parameter(found["name"], (unit, *numbers))
        read.parameters[found["name"]] = replace(parameter, fixed=found["fixed"] is not None)
    else:
        raise _refused(number, line, _KINDS)


def _refused(number: int, line: str, expected: str) -> InputError:
    """Return the refusal of a line."""
    return InputError(
        "a line that is no part of a model",
        expected=expected,
        got=repr(line[:80]),
        remedy="correct it",
        place=f"line {number}",
    )


def _fresh(name: str, known: dict[str, Any], number: int) -> None:
    if name in known:
        raise InputError(f"{name!r} is there twice", expected="each once", got=f"{name} again",
                         remedy="remove one line", place=f"line {number}")  # fmt: skip


def _known(name: str, states: list[str], what: str) -> None:
    refuse_unknown(f"a {what} without an equation", name, states, remedy=f"write {name}' = ...")


def _number(text: str, number: int) -> float:
    try:
        return float(text)
    except ValueError:
        raise _refused(number, text, "a number") from None


def _unit(text: str | None, number: int) -> str:
    """Return a unit, "1" where none is stated."""
    unit = (text or "").strip() or "1"
    if not is_unit(unit):
        raise InputError("unknown unit", expected="a unit such as 'N m', 'rad/s', 'V' or '1'", got=repr(unit),
                         remedy="correct it", place=f"line {number}")  # fmt: skip
    return unit


def _expression(text: str, known: dict[str, Any], number: int) -> Any:
    """Return text as a SymPy expression, built node by node; only what is listed here can be in it."""
    try:
        tree = ast.parse(text.strip().replace("^", "**"), mode="eval").body
        return _node(tree, known)
    except (SyntaxError, ValueError, RecursionError, MemoryError, ArithmeticError, TypeError) as error:
        raise InputError(
            "an expression that cannot be read",
            expected=f"numbers, {', '.join(known)}, + - * / ^ ( ), and {', '.join(_CALLS)}",
            got=f"{text.strip()[:60]!r} ({str(error).splitlines()[0][:80]})",
            remedy="write products with *, and declare every name",
            place=f"line {number}",
        ) from error


def _node(node: ast.AST, known: dict[str, Any]) -> Any:
    """Return one node of an expression."""
    if isinstance(node, ast.Constant) and type(node.value) in (int, float):
        return sp.Float(node.value) if isinstance(node.value, float) else sp.Integer(node.value)
    if isinstance(node, ast.Name):
        if node.id in known:
            return known[node.id]
        if node.id == "pi":
            return sp.pi
        raise ValueError(f"unknown name {node.id}")
    if isinstance(node, ast.BinOp) and type(node.op) in _BINARY:
        left, right = _node(node.left, known), _node(node.right, known)
        if isinstance(node.op, ast.Pow) and left.is_number and right.is_number and abs(right) > 100:
            raise ValueError("a power that is too large")
        value = _BINARY[type(node.op)](left, right)
        if value.has(sp.zoo, sp.nan, sp.oo):
            raise ValueError("a division by 0")
        return value
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.UAdd):
        value = _node(node.operand, known)
        return -value if isinstance(node.op, ast.USub) else value
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in _CALLS and not node.keywords:
        return _CALLS[node.func.id](*(_node(one, known) for one in node.args))
    raise ValueError(f"{type(node).__name__} has no place here")
