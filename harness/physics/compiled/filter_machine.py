"""The pass of the Kalman filter where there is no compiler: one CasADi function for a sample, mapped over a record."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from harness.physics.compiled.rollout_code import Functions
from harness.signals import FloatArray


@dataclass(frozen=True)
class PassRequest:
    """What a pass is asked for beside innovations and their variances.

    Parameters
    ----------
    columns : bool
        Derivatives of the innovations by parameters and initial state, gains held fixed.
    noise : bool
        Derivatives of innovations and variances by the logarithms of the noise.
    path : bool
        What a smoother needs.
    """

    columns: bool
    noise: bool
    path: bool


class FilterMachine:
    """What :mod:`harness.physics.compiled.filter_kernels` does in C, on CasADi's virtual machine: the same equations.

    - ``functions``: of a system whose last ``nl`` states are latent forces
    - ``dt``: time from a row of the inputs to the next [s]
    - ``substeps, every``: steps of the solver for each row; rows for each sample
    - ``delay_columns``: parameters through which the inputs depend on p
    - ``periods`` (ny,): of the outputs; 0 for one that does not wrap
    """

    def __init__(
        self,
        functions: Functions,
        dt: float,
        substeps: int,
        every: int,
        foh: bool,
        delay_columns: tuple[int, ...],
        nl: int,
        periods: FloatArray,
    ) -> None:
        system = functions.system
        self.functions, self.dt, self.every, self.delay_columns = functions, dt, every, delay_columns
        self.nx, self.nu, self.ny, self.np, self.nl = system.nx, system.nu, len(periods), system.np, nl
        self.ns, self.nn = system.np + system.nx - nl, 3 * nl + len(periods)
        self.periods = periods
        self._row = self._advancing(substeps, foh)
        self._samples: dict[PassRequest, Any] = {}
        self._maps: dict[tuple[PassRequest, int], Any] = {}

    def __call__(
        self, wanted: PassRequest, given: Mapping[str, FloatArray], times: FloatArray
    ) -> dict[str, FloatArray]:
        """Run over a record.

        - ``given``: ``x0`` (nx,), ``p0`` (nx, nx), ``p``, ``r``, ``w``, ``a``, ``q``, ``fade``, ``q_tau`` as the C code
          has, ``u`` (rows, nu), ``d`` (rows, nu, delays), ``measured`` (samples, ny)
        - ``times`` (samples,): [s]
        - returns arrays by name, a row for each sample
        """
        n, nx = len(times), self.nx
        known = np.isfinite(given["measured"])
        rows = np.minimum(np.arange(n)[:, None] * self.every + np.arange(self.every + 1), len(given["u"]) - 1)
        delays = (
            given["d"].reshape(len(given["d"]), -1)[rows].reshape(n, -1) if self.delay_columns else np.zeros((n, 0))
        )
        moving = [
            given["u"][rows].reshape(n, -1),
            delays,
            np.where(known, given["measured"], 0.0),
            known,
            times[:, None],
        ]
        lower = np.tril_indices(nx)
        start = [given["x0"], _packed(given["p0"], lower)]
        if wanted.columns:
            seed = np.zeros((nx, self.ns))
            seed[: nx - self.nl, self.np :] = np.eye(nx - self.nl)
            start.append(seed.ravel(order="F"))
        if wanted.noise:
            slopes = np.zeros((self.nn, nx, nx))
            for o in range(self.nl):
                place = nx - self.nl + o
                slopes[o, place, place] = 2.0 * given["p0"][place, place]
            start += [np.zeros(nx * self.nn), *(_packed(one, lower) for one in slopes)]
        constant = np.concatenate([given[name] for name in ("p", "r", "w", "a", "q", "fade", "q_tau")])
        found = self._map(wanted, n)(np.concatenate(start), np.hstack(moving).T, constant)
        made = {name: part.full().T for name, part in zip(self._names(wanted), found[1:], strict=True)}
        made["e"][~known] = np.nan
        return made

    def _names(self, wanted: PassRequest) -> list[str]:
        """Return what a sample tells, in order."""
        names = ["e", "s", *(["j"] if wanted.columns else []), *(["e_noise", "s_noise"] if wanted.noise else [])]
        path = ["x_before", "p_before", "x_after", "p_after", "transition", "gain", "row"]
        return [*names, *(path if wanted.path else [])]

    def _map(self, wanted: PassRequest, n: int) -> Any:
        """Return the function of a record of n samples."""
        if (wanted, n) not in self._maps:
            if wanted not in self._samples:
                self._samples[wanted] = self._sample(wanted)
            self._maps[wanted, n] = self._samples[wanted].mapaccum(n)
        return self._maps[wanted, n]

    def _advancing(self, substeps: int, foh: bool) -> Any:
        """Return the function (x, u, later u, p, t) of a row: next state, its derivatives by x, p, u and later u.

        Finer steps, where a force changes its sign, cost so much that they are computed only where they are needed.
        """
        functions, how = self.functions, (self.dt, substeps, foh)
        finely = self._differentiated(functions.sample(*how)[0], lambda: functions.sample(*how, True)[0])
        if not functions.system.divided:
            return finely
        step, self._near = functions.coarse(*how)
        self._coarse = self._differentiated(step, lambda: functions.coarse(*how, True)[0])
        either = ca.Function.if_else("either", finely, self._coarse)
        x, u, later, p, t = (ca.MX.sym("m", finely.size1_in(k)) for k in range(5))
        return ca.Function(
            "row", [x, u, later, p, t], list(either(self._near(x, ca.vertcat(u, later), p, t), x, u, later, p, t))
        )

    def _differentiated(self, step: Any, sensitive: Callable[[], Any]) -> Any:
        """Return a step with its derivatives: carried along the stages, a third to a half of the Jacobian's work.

        ``sensitive`` makes the step of the state and its derivatives by (p, x0), if the inputs do not depend on p.
        """
        x, u, p, t = (ca.SX.sym("a", argument.shape) for argument in self.functions.arguments)
        later = ca.SX.sym("v", u.shape)
        if self.delay_columns:
            after = step(x, ca.vertcat(u, later), p, t)
            parts = [ca.jacobian(after, by) for by in (x, p, u, later)]
        else:
            seed = np.hstack([np.zeros((self.nx, self.np)), np.eye(self.nx)])
            found = sensitive()(ca.vertcat(x, ca.DM(seed.ravel())), ca.vertcat(u, later), p, t)
            after, columns = found[: self.nx], ca.reshape(found[self.nx :], self.np + self.nx, self.nx).T
            parts = [ca.sparsify(columns[:, self.np :]), ca.sparsify(columns[:, : self.np])]
        return ca.Function("row", [x, u, later, p, t], [after, *parts], {"cse": True})

    def _blocks(self, wanted: PassRequest) -> list[Any]:
        """Return symbols of what a state holds: x, lower triangle of its covariance, S, dx, triangles of dP."""
        size = self.nx * (self.nx + 1) // 2
        return [
            ca.SX.sym("x", self.nx),
            ca.SX.sym("P", size),
            ca.SX.sym("S", self.nx, self.ns if wanted.columns else 0),
            ca.SX.sym("dx", self.nx, self.nn if wanted.noise else 0),
            *(ca.SX.sym("dP", size) for _ in range(self.nn if wanted.noise else 0)),
        ]

    def _sample(self, wanted: PassRequest) -> Any:
        """Return the function (state, moving, constant) of a sample: next state, and what it tells.

        Most samples need no finer steps: one flat function computes them, and whether they do.
        """
        if not self.functions.system.divided:
            return self._flat(wanted, self._row, ca.SX.sym)
        plainly, finely = (
            self._flat(wanted, self._coarse, ca.SX.sym, self._near),
            self._flat(wanted, self._row, ca.MX.sym),
        )
        given = [ca.MX.sym("g", plainly.size1_in(k)) for k in range(3)]
        made = [ca.MX.sym("k", plainly.size_out(k)) for k in range(plainly.n_out() - 1)]
        again = ca.Function("again", [*given, *made], finely(*given))
        either = ca.Function.if_else("either", again, ca.Function("kept", [*given, *made], made))
        *found, near = plainly(*given)
        return ca.Function("sample", given, list(either(near, *given, *found)))

    def _flat(self, wanted: PassRequest, row: Any, symbol: Any, near: Any = None) -> Any:
        """Return the function of a sample whose rows are advanced by ``row``; with ``near``, the last output."""
        read, spread = self._reading(wanted), self._spreading(wanted)
        nd, rows = len(self.delay_columns), self.every + 1
        sizes = [self.nu] * rows + [self.nu * nd] * rows + [self.ny, self.ny, 1]
        state, moving = symbol("z", read.size1_in(0)), symbol("m", sum(sizes))
        parts = ca.vertsplit(moving, [0, *np.cumsum(sizes).tolist()])
        u, d, (y, known, t) = parts[:rows], parts[rows : 2 * rows], parts[2 * rows :]
        constant = symbol("c", self.np + self.ny + 5 * self.nl)
        p, r, noise = ca.vertsplit(constant, [0, self.np, self.np + self.ny, constant.shape[0]])
        now, *told = read(state, u[0], d[0], y, known, p, r, t)
        transition = symbol("T", 0) if not wanted.path else ca.DM(np.eye(self.nx).ravel())
        finer = ca.SX(0)
        for k in range(self.every):
            place = now[: self.nx], u[k], u[k + 1], p, t + k * self.dt
            if near is not None:
                finer = ca.logic_or(finer, near(place[0], ca.vertcat(u[k], u[k + 1]), p, place[4]))
            now, transition = spread(now, transition, d[k], d[k + 1], noise, *row(*place))
        if wanted.path:
            told.insert(-2, transition)  # before gain and row
        outputs = [now, *told, *([finer] if near is not None else [])]
        options = {"cse": True} if symbol is ca.SX.sym else {}
        return ca.Function("sample", [state, moving, constant], outputs, options)

    def _reading(self, wanted: PassRequest) -> Any:
        """Return the function (state, u, d, y, known, p, r, t) -> state after the outputs were seen, what they tell."""
        x, packed, s, dx, *slopes = blocks = self._blocks(wanted)
        state = ca.vertcat(*map(ca.vec, blocks))
        u, d = ca.SX.sym("u", self.nu), ca.SX.sym("d", self.nu * len(self.delay_columns))
        y, known, t = ca.SX.sym("y", self.ny), ca.SX.sym("known", self.ny), ca.SX.sym("t")
        p, r = ca.SX.sym("p", self.np), ca.SX.sym("r", self.ny)
        pp, dp = _unpacked(packed, self.nx), [_unpacked(one, self.nx) for one in slopes]
        told: dict[str, list[Any]] = {name: [] for name in ("e", "s", "j", "e_noise", "s_noise", "gain", "row")}
        after, whole, s, dx, dp = self._read((x, pp, s, dx, dp), (u, d, y, known, p, r, t), told)
        result = ca.vertcat(after, _pack(whole), ca.vec(s), ca.vec(dx), *map(_pack, dp))
        outputs = {name: ca.horzcat(*parts) for name, parts in told.items() if parts}
        outputs |= {"x_before": x, "p_before": ca.vec(pp.T), "x_after": after, "p_after": ca.vec(whole.T)}
        names = [name for name in self._names(wanted) if name != "transition"]
        parts = [ca.densify(ca.vec(outputs[name])) for name in names]
        return ca.Function("read", [state, u, d, y, known, p, r, t], [ca.densify(result), *parts], {"cse": True})

    def _spreading(self, wanted: PassRequest) -> Any:
        """Return the function (state, transition, d, next d, noise, row...) -> state and transition after a row."""
        nx, nl, nu, nd = self.nx, self.nl, self.nu, len(self.delay_columns)
        _, packed, s, dx, *slopes = blocks = self._blocks(wanted)
        state = ca.vertcat(*map(ca.vec, blocks))
        transition = ca.SX.sym("T", nx * nx if wanted.path else 0)
        held, next_held = ca.SX.sym("d", nu * nd), ca.SX.sym("e", nu * nd)
        noise = ca.SX.sym("noise", 5 * nl)
        w, a, q, fade, q_tau = ca.vertsplit(noise, [k * nl for k in range(6)])
        row = [ca.SX.sym("row", self._row.sparsity_out(k)) for k in range(self._row.n_out())]
        keep = ca.vertcat(ca.SX.ones(nx - nl), a)
        new, f = row[0] * keep, ca.diag(keep) @ row[1]
        if wanted.columns:
            s = f @ s
            s[:, : self.np] += ca.diag(keep) @ row[2]
            for place, column in enumerate(self.delay_columns):
                now, then = (ca.reshape(given, nd, nu)[place, :].T for given in (held, next_held))
                s[:, column] += keep * (row[3] @ now + row[4] @ then)
        pp, dp = _unpacked(packed, nx), [_unpacked(one, nx) for one in slopes]
        pp, dx, dp = self._spread((new, f, pp, dx, dp), (w, q, fade, q_tau))
        result = ca.vertcat(new, _pack(pp), ca.vec(s), ca.vec(dx), *map(_pack, dp))
        moved = ca.vec((f @ ca.reshape(transition, nx, nx).T).T) if wanted.path else transition
        return ca.Function(
            "spread",
            [state, transition, held, next_held, noise, *row],
            [ca.densify(result), ca.densify(moved)],
            {"cse": True},
        )

    def _read(self, state: Any, given: Any, told: dict[str, list[Any]]) -> Any:
        """Return the state after the outputs were taken one after the other; see ``sysid_read`` of the kernels."""
        x, pp, s, dx, dp = state
        u, d, y, known, p, r, t = given
        functions, nd = self.functions, len(self.delay_columns)
        ax, au, ap, at = (
            ca.SX.sym(name, argument.shape) for name, argument in zip("xupt", functions.arguments, strict=True)
        )
        h = functions.output(ax, au, ap, at)
        look = ca.Function("look", [ax, au, ap, at], [h, *(ca.jacobian(h, by) for by in (ax, ap, au))])
        told_y, c, by_p, by_u = look(x, u, p, t)
        prior = x
        for o in range(self.ny):
            co = c[o, :]
            e = y[o] - told_y[o]
            if period := float(self.periods[o]):
                e = e - period * ca.floor((e + period / 2) / period)
            e = e - co @ (x - prior)
            spread = pp @ co.T
            total = r[o] + co @ spread
            gain = known[o] * spread / total
            told["e"].append(e)
            told["s"].append(total)
            told["gain"].append(gain.T)
            told["row"].append(co)
            if s.shape[1]:
                change = -(co @ s)
                change[: self.np] -= by_p[o, :]
                for place, column in enumerate(self.delay_columns):
                    change[column] -= by_u[o, :] @ ca.reshape(d, nd, self.nu)[place, :].T
                s = s + gain @ change
                told["j"].append(known[o] * change)
            if dp:
                slope, by_e, by_s = [], [], []
                for m, one in enumerate(dp):
                    moved = one @ co.T
                    of_s = co @ moved + (2.0 * r[o] if m == 3 * self.nl + o else 0.0)
                    of_e = -(co @ dx[:, m])
                    dx[:, m] = dx[:, m] + (moved - gain * of_s) * (known[o] * e / total) + gain * of_e
                    slope.append(one - gain @ moved.T - moved @ gain.T + (gain @ gain.T) * of_s)
                    by_e.append(known[o] * of_e)
                    by_s.append(known[o] * of_s / total)
                dp = slope
                told["e_noise"].append(ca.horzcat(*by_e))
                told["s_noise"].append(ca.horzcat(*by_s))
            x = x + gain * e
            pp = pp - gain @ spread.T
        return x, pp, s, dx, dp

    def _spread(self, state: Any, noise: Any) -> Any:
        """Return covariance and its derivatives after a row; see ``sysid_step`` of the kernels."""
        x, f, pp, dx, dp = state
        w, q, fade, q_tau = noise
        nx, nl = self.nx, self.nl
        pp = f @ pp @ f.T
        if dp:
            dx, dp = f @ dx, [f @ one @ f.T for one in dp]
            for o in range(nl):
                place = nx - nl + o
                dx[place, nl + o] += fade[o] * x[place]
                dp[nl + o][place, :] += fade[o] * pp[place, :]
                dp[nl + o][:, place] += fade[o] * pp[:, place]
                dp[o][place, place] += 2.0 * q[o]
                dp[nl + o][place, place] += q_tau[o]
                white = f[: nx - nl, place]
                dp[2 * nl + o][: nx - nl, : nx - nl] += 2.0 * w[o] * (white @ white.T)
        for o in range(nl):
            place = nx - nl + o
            white = f[: nx - nl, place]
            pp[: nx - nl, : nx - nl] += w[o] * (white @ white.T)
            pp[place, place] += q[o]
        return pp, dx, dp


def _packed(matrix: FloatArray, lower: Any) -> FloatArray:
    """Return the lower triangle, row by row."""
    packed: FloatArray = matrix[lower]
    return packed


def _pack(matrix: Any) -> Any:
    """Return the lower triangle of an expression, row by row."""
    return ca.vertcat(*[matrix[i, k] for i in range(matrix.shape[0]) for k in range(i + 1)])


def _unpacked(packed: Any, n: int) -> Any:
    """Return the symmetric matrix of a lower triangle."""
    matrix = ca.SX(n, n)
    place = 0
    for i in range(n):
        for k in range(i + 1):
            matrix[i, k] = matrix[k, i] = packed[place]
            place += 1
    return matrix
