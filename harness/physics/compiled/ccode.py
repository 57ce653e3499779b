"""C source of a system's functions."""

from __future__ import annotations

import functools
from typing import Any

import casadi as ca
import numpy as np

from harness.signals import FloatArray

_BINARY = {
    "OP_ADD": "{0}+{1}",
    "OP_SUB": "{0}-{1}",
    "OP_MUL": "{0}*{1}",
    "OP_DIV": "{0}/{1}",
    "OP_LT": "{0}<{1}",
    "OP_LE": "{0}<={1}",
    "OP_EQ": "{0}=={1}",
    "OP_NE": "{0}!={1}",
    "OP_AND": "{0}&&{1}",
    "OP_OR": "{0}||{1}",
    "OP_FMIN": "fmin({0},{1})",
    "OP_FMAX": "fmax({0},{1})",
    "OP_POW": "pow({0},{1})",
    "OP_CONSTPOW": "pow({0},{1})",
    "OP_ATAN2": "atan2({0},{1})",
    "OP_FMOD": "fmod({0},{1})",
    "OP_COPYSIGN": "copysign({0},{1})",
    "OP_HYPOT": "hypot({0},{1})",
    "OP_IF_ELSE_ZERO": "({0}?{1}:0)",
}
_UNARY = {
    "OP_ASSIGN": "{0}",
    "OP_NEG": "-{0}",
    "OP_NOT": "!{0}",
    "OP_SQ": "{0}*{0}",
    "OP_TWICE": "2.*{0}",
    "OP_INV": "1./{0}",
    "OP_SIGN": "({0}<0?-1:({0}>0?1:{0}))",
    **{
        f"OP_{name.upper()}": f"{name}({{0}})"
        for name in (
            *("sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "asinh", "acosh", "atanh"),
            *("exp", "log", "sqrt", "floor", "ceil", "fabs", "erf", "expm1", "log1p"),
        )
    },
}


@functools.cache
def formats() -> dict[int, str]:
    """Return the C text of every operation by its CasADi number."""
    return {getattr(ca, name): text for name, text in {**_BINARY, **_UNARY}.items() if hasattr(ca, name)}


def c_function(name: str, function: Any) -> str:
    """Return a CasADi SX function as one static C function of plain arrays.

    Raises ValueError if CasADi uses an operation that has no C text here.

    - ``name``: name of the C function
    - ``function``: of SX; inputs and outputs dense columns
    - returns ``static void NAME(const double *i0, ..., double *o0, ...)``. An input without elements may be NULL.

    Examples
    --------
    >>> x = ca.SX.sym("x")
    >>> print(c_function("twice", ca.Function("twice", [x], [2 * x])))
    static void twice(const double *i0, double *o0) {
      double w0;
      w0 = i0[0];
      w0 = 2.*w0;
      o0[0] = w0;
    }
    """
    known = formats()
    lines = []
    for k in range(function.n_instructions()):
        operation = function.instruction_id(k)
        into, out = function.instruction_input(k), function.instruction_output(k)
        if operation == ca.OP_CONST:
            lines.append(f"w{out[0]} = {_number(function.instruction_constant(k))};")
        elif operation == ca.OP_INPUT:
            lines.append(f"w{out[0]} = i{into[0]}[{into[1]}];")
        elif operation == ca.OP_OUTPUT:
            lines.append(f"o{out[0]}[{out[1]}] = w{into[0]};")
        elif operation in known:
            lines.append(f"w{out[0]} = {known[operation].format(*(f'w{operand}' for operand in into))};")
        else:
            raise ValueError(f"no C text for CasADi operation {operation} in {name}")
    inputs = [f"const double *i{row}" for row in range(function.n_in())]
    outputs = [f"double *o{row}" for row in range(function.n_out())]
    unused = "".join(
        f"(void)i{row}; " for row in range(function.n_in()) if not any(f"i{row}[" in line for line in lines)
    )
    work = [f"w{row}" for row in range(function.sz_w())]
    head = f"static void {name}({', '.join(inputs + outputs)}) {{"
    declare = [f"double {', '.join(work)};"] if work else []
    body = [*declare, *([unused.strip()] if unused else []), *lines]
    return "\n".join([head, *("  " + line for line in body), "}"])


def _number(value: float) -> str:
    """Return a C literal that reads back as the same double."""
    if value != value:
        return "NAN"
    if value in (float("inf"), float("-inf")):
        return "INFINITY" if value > 0 else "-INFINITY"
    text = repr(float(value))
    return text if any(mark in text for mark in ".e") else text + "."


def dense(name: str, inputs: list[Any], outputs: list[Any]) -> Any:
    """Return a CasADi function whose outputs are dense columns."""
    flat = [ca.densify(ca.SX(output)) for output in outputs]
    return ca.Function(name, inputs, flat, {"cse": True})


def system_source(system: Any, prefix: str = "model") -> str:
    """Return the C source of a system: derivative, output, start of hidden states, one Runge-Kutta step.

    Every function is static, so that a loader cannot bind it to another library's name, and needs ``math.h`` only.
    Delays and quantisers (``system.sampled``) act on samples and are not part of it.

    - ``prefix``: in front of each name
    - returns source with the macros ``PREFIX_NX``, ``PREFIX_NU``, ``PREFIX_NY``, ``PREFIX_NP``, ``PREFIX_NZ`` (hidden
      states) and::

        static void PREFIX_derivative(x, u, p, t, dx);   /* const double *x, *u, *p, *t; double *dx */
        static void PREFIX_output(x, u, p, t, y);
        static void PREFIX_initial(x, u, p, z);          /* start of the hidden states, the last of x */
        static void PREFIX_step(double *x, u, p, double t, double h);

    Examples
    --------
    >>> from harness.physics.models import drive
    >>> "static void drive_derivative(" in system_source(drive().system(), "drive")
    True
    """
    arguments = [system.x, system.u, system.p, system.t]
    start = system.initial if system.initial is not None else ca.SX(0, 1)
    upper = prefix.upper()
    sizes = {"NX": system.nx, "NU": system.nu, "NY": system.ny, "NP": system.np, "NZ": system.hidden_count}
    parts = [
        "#include <math.h>",
        "\n".join(f"#define {upper}_{name} {size}" for name, size in sizes.items()),
        c_function(f"{prefix}_derivative", dense("f", arguments, [system.f])),
        c_function(f"{prefix}_output", dense("h", arguments, [system.upright(system.h)])),
        c_function(f"{prefix}_initial", dense("z", [system.x, system.u, system.p], [start])),
        _STEP.replace("PREFIX", prefix).replace("NX", f"{upper}_NX"),
        near_zero(system, prefix),
        _ADVANCE.replace("PREFIX", prefix).replace("NX", f"{upper}_NX"),
    ]
    return "\n\n".join(parts) + "\n"


FINE = 8  # Parts of a step that comes near the zero of a speed whose sign a force takes, or near a corner.
NEAR = 4.0  # Widths of a sign from its zero within which it is steep: beyond, tanh has 0.1 % of its slope at most.
STEEP = 1.0  # Slope of a speed's rate by itself, times the step, above which a step is too long: 2.8 is the limit.


def without_signs(system: Any, p: FloatArray) -> FloatArray:
    """Return parameters with which no force takes a sign: signs are steep at rest only, and there steps are finer."""
    smooth = np.array(p, dtype=float)
    smooth[[system.parameter_names.index(name) for _, name in system.switches]] = 1e9
    return smooth


def steepness(system: Any) -> Any:
    """Return the CasADi function of state and parameters that tells how fast the speed of every switch dies away [1/s].

    What the inputs add to a force that takes a sign is left out.
    """
    by_itself = [-ca.jacobian(system.f[k], system.x[k]) for k, _ in system.switches]
    given = ca.vertcat(system.u, system.t)
    return dense(
        "steepness", [system.x, system.p], [ca.substitute(ca.vertcat(*by_itself), given, ca.DM.zeros(given.size1()))]
    )


def corners(system: Any) -> Any:
    """Return the CasADi function of state and parameters that is 0 where a force has a corner."""
    return dense("corners", [system.x, system.p], [ca.vertcat(*system.corners)])


def near_zero(system: Any, prefix: str) -> str:
    """Return the C functions that tell whether a step from x to y comes near a corner or the zero of a switch.

    Nothing of a mass that stands passes the zero, and the sign is as steep there: what a step makes of small changes,
    of variances too, is stable in finer ones alone.
    """
    head = f"static int {prefix}_near_zero(const double *x, const double *y, const double *p, double h) {{"
    if not system.divided:
        return "\n".join([head, "  (void)x; (void)y; (void)p; (void)h;", "  return 0;", "}"])
    made, lines = [], ["  (void)h;"]
    if system.corners:
        made.append(c_function(f"{prefix}_corners", corners(system)))
        count = len(system.corners)
        lines += [f"  double c[{count}], d[{count}];", f"  {prefix}_corners(x, p, c);", f"  {prefix}_corners(y, p, d);"]
        lines += [f"  if (fmin(fabs(c[{k}]), fabs(d[{k}])) < fabs(d[{k}] - c[{k}])) return 1;" for k in range(count)]
    if not system.switches:
        return "\n".join([*made, head, *lines, "  return 0;", "}"])
    places = {name: number for number, name in enumerate(system.parameter_names)}
    lines.insert(0, f"  double s[{len(system.switches)}];")
    for k, _ in system.switches:
        lines.append(f"  if (fmin(fabs(x[{k}]), fabs(y[{k}])) < fabs(y[{k}] - x[{k}])) return 1;")
    near = [f"fabs(x[{k}]) < {NEAR}*p[{places[name]}]" for k, name in system.switches]
    lines += [f"  if (!({' || '.join(near)})) return 0;", f"  {prefix}_steepness(x, p, s);"]
    lines += [f"  if ({close} && h*s[{number}] > {STEEP}) return 1;" for number, close in enumerate(near)]
    made.append(c_function(f"{prefix}_steepness", steepness(system)))
    return "\n".join([*made, "", head, *lines, "  return 0;", "}"])


_STEP = """\
/* One step of the classical fourth-order Runge-Kutta method, input held. */
static void PREFIX_runge_kutta(double *x, const double *u, const double *p, double t, double h) {
  double k1[NX], k2[NX], k3[NX], k4[NX], y[NX], middle = t + 0.5*h, end = t + h;
  int i;
  PREFIX_derivative(x, u, p, &t, k1);
  for (i = 0; i < NX; i++) y[i] = x[i] + 0.5*h*k1[i];
  PREFIX_derivative(y, u, p, &middle, k2);
  for (i = 0; i < NX; i++) y[i] = x[i] + 0.5*h*k2[i];
  PREFIX_derivative(y, u, p, &middle, k3);
  for (i = 0; i < NX; i++) y[i] = x[i] + h*k3[i];
  PREFIX_derivative(y, u, p, &end, k4);
  for (i = 0; i < NX; i++) x[i] = x[i] + h/6.0*(k1[i] + 2.0*k2[i] + 2.0*k3[i] + k4[i]);
}"""

_ADVANCE = f"""\
/* One step, or {FINE} finer ones where a force changes its sign or has a corner. */
static void PREFIX_step(double *x, const double *u, const double *p, double t, double h) {{
  double y[NX];
  int i;
  for (i = 0; i < NX; i++) y[i] = x[i];
  PREFIX_runge_kutta(y, u, p, t, h);
  if (PREFIX_near_zero(x, y, p, h))
    for (i = 0; i < {FINE}; i++) PREFIX_runge_kutta(x, u, p, t + i*(h/{FINE}), h/{FINE});
  else
    for (i = 0; i < NX; i++) x[i] = y[i];
}}"""
