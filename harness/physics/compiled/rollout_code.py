"""The functions behind a simulator: a system, its derivatives, and one sample of the Runge-Kutta method in CasADi."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from harness.physics.compiled.ccode import FINE, NEAR, STEEP, corners, dense, steepness
from harness.physics.compiled.rollout_call import Given
from harness.physics.definition.model_equations import Equations
from harness.signals import FloatArray

How = tuple[float, int, bool, bool, tuple[int, ...]]
"""Sample time, substeps, whether inputs move along lines, whether sensitivities are asked for, columns of delays."""


@contextlib.contextmanager
def _literally() -> Iterator[None]:
    """Keep CasADi from simplifying expressions: they are then computed in the order of the C code, to the last bit."""
    before = ca.GlobalOptions.getSimplificationOnTheFly()
    ca.GlobalOptions.setSimplificationOnTheFly(False)
    try:
        yield
    finally:
        ca.GlobalOptions.setSimplificationOnTheFly(before)


@dataclass(frozen=True, eq=False)
class DifferentiatedFunction:
    """A function of (x, u, p, t) with its derivatives, sparse: the value (n, 1), by x (n, nx), by p, by u."""

    arguments: list[Any]
    value: Any
    by_x: Any
    by_p: Any
    by_u: Any

    def entries(self, kind: str) -> list[tuple[int, int, Any]]:
        """Return row, column and expression of the entries of ``by_x``, ``by_p`` or ``by_u`` that are not always 0."""
        matrix = getattr(self, kind)
        rows, columns = matrix.sparsity().get_triplet()
        return list(zip(rows, columns, matrix.nonzeros(), strict=True))

    def function(self, name: str) -> Any:
        """Return the CasADi function (x, u, p, t) -> (value, entries by x, by p, by u)."""
        parts = [ca.vertcat(*[entry for _, _, entry in self.entries(kind)]) for kind in ("by_x", "by_p", "by_u")]
        with _literally():
            return dense(name, self.arguments, [self.value, *(ca.SX(part) for part in parts)])


def _without_quotients(arguments: list[Any], outputs: list[Any]) -> list[Any]:
    """Return the outputs with the quotients in all but the first one written as products with a reciprocal.

    The derivatives of a quotient divide by the same number again and again, and a division costs as much as ten
    products. What the first output computes stays as it is.
    """
    function = ca.Function("whole", arguments, outputs)
    steps = [
        (function.instruction_id(k), function.instruction_input(k), function.instruction_output(k))
        for k in range(function.n_instructions())
    ]
    needed, kept = set(), [False] * len(steps)
    for k in reversed(range(len(steps))):
        operation, source, target = steps[k]
        if operation == ca.OP_OUTPUT:
            kept[k] = target[0] == 0
        else:
            kept[k] = target[0] in needed
            needed.discard(target[0])
        if kept[k] and operation != ca.OP_INPUT:
            needed.update(source)
    entries: list[list[Any]] = [[] for _ in outputs]
    work: dict[int, Any] = {}
    reciprocals: dict[int, Any] = {}
    with _literally():
        for k, (operation, source, target) in enumerate(steps):
            if operation == ca.OP_OUTPUT:
                entries[target[0]].append(work[source[0]])
            elif operation == ca.OP_INPUT:
                work[target[0]] = arguments[source[0]].nz[source[1]]
            elif operation == ca.OP_CONST:
                work[target[0]] = ca.SX(function.instruction_constant(k))
            elif operation == ca.OP_DIV and not kept[k]:
                by = work[source[1]]
                place = by.element_hash()
                if place not in reciprocals:
                    reciprocals[place] = 1.0 / by
                work[target[0]] = work[source[0]] * reciprocals[place]
            elif len(source) == 1:
                work[target[0]] = ca.SX.unary(operation, work[source[0]])
            else:
                work[target[0]] = ca.SX.binary(operation, work[source[0]], work[source[1]])
        return [
            ca.SX(output.sparsity(), ca.vertcat(*found)) if found else output
            for output, found in zip(outputs, entries, strict=True)
        ]


class Functions:
    """CasADi functions of a system; the larger ones are built when they are needed.

    The sensitivity S (nx, np + nx) of the state by (p, x0) is carried along the stages of the method, row by row in C
    order: ``S' = f_x S + [f_p, 0] + f_u dU``. That is the derivative of the numerical solution itself, not an
    approximation of the derivative of the true one.
    """

    def __init__(self, system: Equations) -> None:
        self.system = system
        self.arguments = [system.x, system.u, system.p, system.t]
        self.h = system.upright(system.h)
        self.derivative = dense("derivative", self.arguments, [system.f])
        self.output = dense("output", self.arguments, [self.h])
        start = system.initial if system.initial is not None else ca.SX(0, 1)
        start = ca.substitute(start, system.t, ca.SX(0.0))  # an input that a law of time disturbs: as at its beginning
        self.initial = dense("initial", [system.x, system.u, system.p], [system.upright(start)])
        self._machines: dict[Any, Any] = {}
        self._maps: dict[tuple[int, int, bool], Any] = {}

    @functools.cached_property
    def output_jacobian(self) -> Any:
        """The function (x, u, p, t) -> derivative of the output by the state (ny, nx)."""
        return ca.Function("output_jacobian", self.arguments, [ca.jacobian(self.h, self.system.x)])

    @functools.cached_property
    def _steepness(self) -> Any:
        """See :func:`harness.physics.compiled.ccode.steepness`."""
        return steepness(self.system)

    @functools.cached_property
    def _corners(self) -> Any:
        """See :func:`harness.physics.compiled.ccode.corners`."""
        return corners(self.system)

    def rates(self, delay_columns: tuple[int, ...]) -> DifferentiatedFunction:
        """Return dx/dt with its derivatives; those by u only if the inputs depend on parameters."""
        return self._linear("rates", self.system.f, bool(delay_columns))

    def readings(self, delay_columns: tuple[int, ...]) -> DifferentiatedFunction:
        """Return the outputs with their derivatives; those by u only if the inputs depend on parameters."""
        return self._linear("readings", self.h, bool(delay_columns))

    def _linear(self, name: str, value: Any, delays: bool) -> DifferentiatedFunction:
        if (name, delays) not in self._machines:
            x, u, p, _ = self.arguments
            by_u = ca.jacobian(value, u) if delays else ca.SX(value.shape[0], u.shape[0])
            found = [ca.densify(value), ca.jacobian(value, x), ca.jacobian(value, p), by_u]
            self._machines[name, delays] = DifferentiatedFunction(
                self.arguments, *_without_quotients(self.arguments, ca.cse(found))
            )
        return self._machines[name, delays]  # type: ignore[no-any-return]

    def stage(self, delay_columns: tuple[int, ...]) -> Any:
        """Return the function (x, S, u, dU, p, t) -> (dx, dS) of one stage; dU (nu, delays) row by row."""
        return self._carried("stage", self.rates(delay_columns), delay_columns)

    def measure(self, delay_columns: tuple[int, ...]) -> Any:
        """Return the function (x, S, u, dU, p, t) -> (y, dY), dY (ny, np + nx) row by row."""
        return self._carried("measure", self.readings(delay_columns), delay_columns)

    def _carried(self, name: str, parts: DifferentiatedFunction, delay_columns: tuple[int, ...]) -> Any:
        """Return the function of the value and of A S + (B + F dU), in the order of the C code."""
        system = self.system
        ns = system.np + system.nx
        s = ca.SX.sym("S", system.nx * ns)
        d = ca.SX.sym("dU", system.nu * len(delay_columns))
        matrix = ca.reshape(s, ns, system.nx).T
        with _literally():
            source = {(row, column): entry for row, column, entry in parts.entries("by_p")}
            for place, column in enumerate(delay_columns):
                late: dict[int, Any] = {}
                for row, port, entry in parts.entries("by_u"):
                    term = entry * d[port * len(delay_columns) + place]
                    late[row] = late[row] + term if row in late else term
                for row, term in late.items():
                    source[row, column] = source[row, column] + term if (row, column) in source else term
            rows: dict[int, Any] = {}
            for row, column, entry in parts.entries("by_x"):
                term = matrix[column, :] if entry.is_one() else entry * matrix[column, :]
                rows[row] = rows[row] + term if row in rows else term
            change = [rows.get(row, ca.SX.zeros(1, ns)) for row in range(parts.value.shape[0])]
            for (row, column), entry in source.items():
                change[row][column] = change[row][column] + entry
            x, u, p, t = self.arguments
            return dense(name, [x, s, u, d, p, t], [parts.value, ca.vertcat(*(row.T for row in change))])

    def step(self, h: float, substeps: int) -> Any:
        """Return the function (x, u, p, t) -> x one sample later, input held."""
        key = ("step", h, substeps)
        if key not in self._machines:
            x, u, p, t = (ca.SX.sym("a", argument.shape) for argument in self.arguments)
            state = x
            for count in range(substeps):
                state = self._advance(
                    lambda y, w, s: self.derivative(y, w, p, s), state, p, lambda share: u, t + count * h, h
                )
            self._machines[key] = ca.Function("step", [x, u, p, t], [state])
        return self._machines[key]

    def windows(self, given: Given, how: How) -> tuple[FloatArray, FloatArray, FloatArray | None]:
        """Simulate windows on the virtual machine; ``how`` is dt, substeps, foh, sensitivities and delay columns."""
        p, x0, u, input_jacobian, t0 = given
        m, n = u.shape[:2]
        _, _, foh, sensitivities, _ = how
        nx, ny, ns = self.system.nx, self.system.ny, self.system.np + self.system.nx
        x, y = np.full((m, n, nx), np.nan), np.full((m, n, ny), np.nan)
        s = np.full((m, n, ny, ns), np.nan) if sensitivities else None
        for window in range(m):
            held = u[window]
            after = np.vstack([held[1:], held[-1:]]) if foh else held
            d_held = d_after = None
            if input_jacobian is not None and sensitivities:
                d_held = input_jacobian[window].reshape(n, -1)
                d_after = np.vstack([d_held[1:], d_held[-1:]]) if foh else d_held
            start = p[window], x0[window]
            k = self.virtual_machine(how, *start, held, after, d_held, d_after, float(t0[window]))
            rows = k[0].shape[0]
            x[window, :rows], y[window, :rows] = k[0], k[1]
            if s is not None:
                s[window, :rows] = k[2].reshape(rows, ny, ns)
        return x, y, s

    def virtual_machine(
        self,
        how: How,
        p: FloatArray,
        x0: FloatArray,
        u: FloatArray,
        u_next: FloatArray,
        d: FloatArray | None,
        d_next: FloatArray | None,
        t0: float,
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Simulate one window; returns (x, y, sensitivities of y), rows up to the last finite state."""
        n, nx = u.shape[0], self.system.nx
        dt, _, _, sensitivities, _ = how
        step, look = self._sample(*how)
        columns = [u, u_next] + ([d, d_next] if d is not None and d_next is not None else [])
        moving = np.hstack(columns) if d is not None else np.hstack([u, u_next])
        start = x0
        if sensitivities:
            seed = np.zeros((nx, self.system.np + nx))
            seed[:, self.system.np :] = np.eye(nx)
            start = np.concatenate([x0, seed.ravel()])
        times = t0 + np.arange(n) * dt
        whole = np.empty((n, start.shape[0]))
        whole[0] = start
        if n > 1:
            whole[1:] = self._repeated(step, n - 1, True)(start, moving[:-1].T, p, times[:-1]).full().T
        found = self._repeated(look, n, False)(whole.T, moving.T, p, times)
        bad = ~np.isfinite(whole[:, :nx]).all(axis=1)
        rows = int(np.argmax(bad)) if bad.any() else n
        whole = whole[:rows, :nx]
        if not sensitivities:
            return whole, found.full().T[:rows], np.empty((rows, 0))
        return whole, found[0].full().T[:rows], found[1].full().T[:rows]

    def _repeated(self, function: Any, n: int, following: bool) -> Any:
        """Return a function for n samples, each beginning where the one before ended if ``following``."""
        key = (id(function), n, following)
        if key not in self._maps:
            self._maps[key] = function.mapaccum(n) if following else function.map(n)
        return self._maps[key]

    def sample(self, dt: float, substeps: int, foh: bool, sensitivities: bool = False) -> tuple[Any, Any]:
        """Return the functions (x, (u, next u), p, t) of one sample: next state, and outputs.

        With ``sensitivities`` S follows x, row by row, and the derivatives of the outputs their values.
        """
        return self._sample(dt, substeps, foh, sensitivities, ())

    def coarse(self, dt: float, substeps: int, foh: bool, sensitivities: bool = False) -> tuple[Any, Any]:
        """Return the functions of one sample without finer steps: the next state, and whether finer ones are needed."""
        key = ("coarse", dt, substeps, foh, sensitivities)
        if key not in self._machines:
            nears: list[Any] = []
            with _literally():
                step, _ = self._sampled(dt, substeps, foh, sensitivities, (), nears)
                state, moving, p, t = (ca.SX.sym("c", step.size1_in(k)) for k in range(4))
                new, near = step(state, moving, p, t)
                arguments = [state, moving, p, t]
                self._machines[key] = ca.Function("step", arguments, [new]), ca.Function("near", arguments, [near])
        return self._machines[key]  # type: ignore[no-any-return]

    def _sample(
        self, dt: float, substeps: int, foh: bool, sensitivities: bool, delay_columns: tuple[int, ...]
    ) -> tuple[Any, Any]:
        """Return the functions (state, moving, p, t) of one sample: next state, and measurement."""
        key = (dt, substeps, foh, sensitivities, delay_columns)
        if key not in self._machines:
            with _literally():
                self._machines[key] = self._sampled(dt, substeps, foh, sensitivities, delay_columns)
        return self._machines[key]  # type: ignore[no-any-return]

    def _sampled(
        self,
        dt: float,
        substeps: int,
        foh: bool,
        sensitivities: bool,
        delay_columns: tuple[int, ...],
        nears: list[Any] | None = None,
    ) -> tuple[Any, Any]:
        system = self.system
        nx, nu, nd = system.nx, system.nu, len(delay_columns) if sensitivities else 0
        size = nx * (1 + system.np + nx) if sensitivities else nx
        state, p, t = ca.SX.sym("z", size), ca.SX.sym("p", system.np), ca.SX.sym("t")
        moving = ca.SX.sym("w", 2 * nu * (1 + nd))
        u, u_next = moving[:nu], moving[nu : 2 * nu]
        d = moving[2 * nu : 2 * nu + nu * nd]
        d_next = moving[2 * nu + nu * nd :]
        stage = self.stage(delay_columns) if sensitivities else None

        def derivative(z: Any, w: tuple[Any, Any], s: Any) -> Any:
            if stage is None:
                return self.derivative(z, w[0], p, s)
            return ca.vertcat(*stage(z[:nx], z[nx:], w[0], w[1], p, s))

        h = dt / substeps
        new = state
        for count in range(substeps):

            def seen(part: float, count: int = count) -> Any:
                share = (count + part) / substeps
                if not foh:
                    return u, d
                # The end of the sample is the next input itself, to the last bit, as in the C code.
                return (u_next, d_next) if share == 1.0 else (u + (u_next - u) * share, d + (d_next - d) * share)

            new = self._advance(derivative, new, p, seen, t + count * h, h, nears)
        told = [new]
        if nears is not None:
            told.append(ca.logic_not(ca.logic_not(sum(nears, ca.SX(0)))))
        step = ca.Function("sample", [state, moving, p, t], told, {"cse": False})
        if sensitivities:
            outputs = list(self.measure(delay_columns)(state[:nx], state[nx:], u, d, p, t))
        else:
            outputs = [self.output(state, u, p, t)]
        look = ca.Function("look", [state, moving, p, t], outputs)
        return step, look

    def _advance(
        self, derivative: Any, x: Any, p: Any, inputs: Any, t: Any, h: float, nears: list[Any] | None = None
    ) -> Any:
        """Return the state one step later; in finer steps where a force changes its sign.

        ``inputs(part)`` is what the derivative sees at a part (0 to 1) of the step. With ``nears`` the step is never
        finer, and whether it should be is added to them.
        """
        new = _runge_kutta(derivative, x, [inputs(part) for part in (0.0, 0.5, 1.0)], t, h)
        if not self.system.divided:
            return new
        near, fine, nx = ca.SX(0), x, self.system.nx
        if self.system.corners:
            before, after = (ca.vertsplit(self._corners(state[:nx], p)) for state in (x, new))
            for c, d in zip(before, after, strict=True):
                near = ca.logic_or(near, ca.fmin(ca.fabs(c), ca.fabs(d)) < ca.fabs(d - c))
        slopes = self._steepness(x[:nx], p) if self.system.switches else ca.SX(0)
        for number, (k, name) in enumerate(self.system.switches):
            near = ca.logic_or(near, ca.fmin(ca.fabs(x[k]), ca.fabs(new[k])) < ca.fabs(new[k] - x[k]))
            close = ca.fabs(x[k]) < NEAR * p[self.system.parameter_names.index(name)]
            near = ca.logic_or(near, ca.logic_and(close, h * slopes[number] > STEEP))
        if nears is not None:
            nears.append(near)
            return new
        for part in range(FINE):
            seen = [inputs((part + share) / FINE) for share in (0.0, 0.5, 1.0)]
            fine = _runge_kutta(derivative, fine, seen, t + part * (h / FINE), h / FINE)
        return ca.if_else(near, fine, new)


def _runge_kutta(derivative: Any, x: Any, inputs: list[Any], t: Any, h: float) -> Any:
    """Return one step of the classical method; the order of operations is that of the C code."""
    k1 = derivative(x, inputs[0], t)
    k2 = derivative(x + 0.5 * h * k1, inputs[1], t + 0.5 * h)
    k3 = derivative(x + 0.5 * h * k2, inputs[1], t + 0.5 * h)
    k4 = derivative(x + h * k3, inputs[2], t + h)
    return x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
