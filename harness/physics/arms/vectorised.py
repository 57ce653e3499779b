"""A CasADi SX function on whole records at once, by numpy: one array operation for each instruction."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np

from harness.physics.compiled.ccode import dense
from harness.signals import FloatArray

_UFUNCS: dict[str, Callable[..., Any]] = {
    "OP_ADD": np.add,
    "OP_SUB": np.subtract,
    "OP_MUL": np.multiply,
    "OP_DIV": np.divide,
    "OP_LT": np.less,
    "OP_LE": np.less_equal,
    "OP_EQ": np.equal,
    "OP_NE": np.not_equal,
    "OP_AND": np.logical_and,
    "OP_OR": np.logical_or,
    "OP_FMIN": np.fmin,
    "OP_FMAX": np.fmax,
    "OP_POW": np.power,
    "OP_CONSTPOW": np.power,
    "OP_ATAN2": np.arctan2,
    "OP_FMOD": np.fmod,
    "OP_COPYSIGN": np.copysign,
    "OP_HYPOT": np.hypot,
    "OP_IF_ELSE_ZERO": lambda test, value: np.where(test, value, 0.0),
    "OP_ASSIGN": lambda x: x,
    "OP_NEG": np.negative,
    "OP_NOT": np.logical_not,
    "OP_SQ": np.square,
    "OP_TWICE": lambda x: 2.0 * x,
    "OP_INV": lambda x: 1.0 / x,
    "OP_SIGN": np.sign,
    "OP_ASIN": np.arcsin,
    "OP_ACOS": np.arccos,
    "OP_ATAN": np.arctan,
    "OP_ASINH": np.arcsinh,
    "OP_ACOSH": np.arccosh,
    "OP_ATANH": np.arctanh,
    **{
        f"OP_{name.upper()}": getattr(np, name)
        for name in (
            *("sin", "cos", "tan", "sinh", "cosh", "tanh", "exp", "log", "sqrt"),
            *("floor", "ceil", "fabs", "expm1", "log1p"),
        )
    },
}


class Vectorised:
    """A function of columns, called with a row for each sample.

    Raises ValueError if CasADi uses an operation that has no array operation here.

    - ``inputs, outputs``: columns

    Examples
    --------
    >>> x = ca.SX.sym("x", 2)
    >>> f = Vectorised([x], [x[0] * x[1], ca.vertcat(x[0], 3)])
    >>> [output.tolist() for output in f(np.array([[1.0, 2.0], [3.0, 4.0]]))]
    [[[2.0], [12.0]], [[1.0, 3.0], [3.0, 3.0]]]
    """

    def __init__(self, inputs: list[Any], outputs: list[Any]) -> None:
        function = dense("vectorised", inputs, outputs)
        known = {getattr(ca, name): ufunc for name, ufunc in _UFUNCS.items() if hasattr(ca, name)}
        self._sizes = [function.size1_out(row) for row in range(function.n_out())]
        self._program: list[tuple[str, Any, list[int], list[int]]] = []
        for k in range(function.n_instructions()):
            code = function.instruction_id(k)
            into, out = list(function.instruction_input(k)), list(function.instruction_output(k))
            if code == ca.OP_CONST:
                self._program.append(("const", np.float64(function.instruction_constant(k)), into, out))
            elif code == ca.OP_INPUT:
                self._program.append(("input", None, into, out))
            elif code == ca.OP_OUTPUT:
                self._program.append(("output", None, into, out))
            elif code in known:
                self._program.append(("call", known[code], into, out))
            else:
                raise ValueError(f"no array operation for CasADi operation {code}")

    def __call__(self, *arguments: FloatArray) -> list[FloatArray]:
        """Return the outputs, each (N, size); arguments are (N, size), columns in the order of the inputs.

        An argument (size,) is the same in every sample, the first one excepted.
        """
        n = arguments[0].shape[0]
        columns = [np.ascontiguousarray(argument.T) for argument in arguments]
        results = [np.empty((n, size)) for size in self._sizes]
        work: dict[int, Any] = {}
        with np.errstate(all="ignore"):
            for kind, what, into, out in self._program:
                if kind == "call":
                    work[out[0]] = what(*(work[operand] for operand in into))
                elif kind == "input":
                    work[out[0]] = columns[into[0]][into[1]]
                elif kind == "const":
                    work[out[0]] = what
                else:
                    results[out[0]][:, out[1]] = work[into[0]]
        return results


class OnRecords:
    """A CasADi SX function called with whole records: array operations, or CasADi's map where numpy lacks one.

    - ``function``: of columns; an output may be a matrix

    Examples
    --------
    >>> x, p = ca.SX.sym("x", 2), ca.SX.sym("p")
    >>> f = OnRecords(ca.Function("f", [x, p], [p * x, ca.erf(x[0])]))
    >>> [output.round(3).tolist() for output in f(np.array([[1.0, 2.0], [0.0, 4.0]]), np.array([3.0]))]
    [[[3.0, 6.0], [0.0, 12.0]], [[0.843], [0.0]]]
    """

    def __init__(self, function: Any) -> None:
        self.function = function
        symbols = function.sx_in()
        columns = [ca.vec(output) for output in function.call(symbols)]
        self._arrays: Vectorised | None
        try:
            self._arrays = Vectorised(symbols, columns)
        except ValueError:
            self._arrays, self._flat = None, dense("flat", symbols, columns)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the function; the rest is made again."""
        return OnRecords, (self.function,)

    def __call__(self, *arguments: FloatArray) -> list[FloatArray]:
        """Return the outputs (N, size), a matrix column by column; see :meth:`Vectorised.__call__`."""
        if self._arrays is not None:
            return self._arrays(*arguments)
        n = arguments[0].shape[0]
        rows = [argument.T if argument.ndim == 2 else np.tile(argument[:, None], (1, n)) for argument in arguments]
        return [np.array(output, dtype=float).T for output in self._flat.map(n).call(rows)]
