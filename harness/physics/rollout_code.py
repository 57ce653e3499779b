"""The functions behind a simulator: one Runge-Kutta stage with sensitivities, as CasADi functions and as C."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from harness.physics.ccode import FINE, c_function, dense, near_zero
from harness.signals import FloatArray

if TYPE_CHECKING:
    from harness.physics.system import System

__all__ = ["Functions", "rollout_source"]


class Functions:
    """CasADi functions of a system; the larger ones are built when they are needed.

    The sensitivity S (nx, np + nx) of the state by (p, x0) is carried along the stages of the method, row by row in C
    order: ``S' = f_x S + [f_p, 0] + f_u dU``. That is the derivative of the numerical solution itself, not an
    approximation of the derivative of the true one.
    """

    def __init__(self, system: System) -> None:
        self.system = system
        self.arguments = [system.x, system.u, system.p, system.t]
        self.h = system.upright(system.h)
        self.derivative = dense("derivative", self.arguments, [system.f])
        self.output = dense("output", self.arguments, [self.h])
        start = system.initial if system.initial is not None else ca.SX(0, 1)
        self.initial = dense("initial", [system.x, system.u, system.p], [system.upright(start)])
        self._machines: dict[Any, Any] = {}

    @functools.cached_property
    def output_slope(self) -> Any:
        """The function (x, u, p, t) -> derivative of the output by the state (ny, nx)."""
        return ca.Function("output_slope", self.arguments, [ca.jacobian(self.h, self.system.x)])

    def stage(self, delay_columns: tuple[int, ...]) -> Any:
        """Return the function (x, S, u, dU, p, t) -> (dx, dS) of one stage; dU (nu, delays) row by row."""
        s, d, matrix, injected = self._injection(delay_columns)
        system = self.system
        change = ca.mtimes(ca.jacobian(system.f, system.x), matrix)
        change[:, : system.np] += ca.jacobian(system.f, system.p)
        if delay_columns and system.nu:
            change += ca.mtimes(ca.jacobian(system.f, system.u), injected)
        inputs = [system.x, s, system.u, d, system.p, system.t]
        return dense("stage", inputs, [system.f, ca.vec(change.T)])

    def measure(self, delay_columns: tuple[int, ...]) -> Any:
        """Return the function (x, S, u, dU, p, t) -> (y, dY), dY (ny, np + nx) row by row."""
        s, d, matrix, injected = self._injection(delay_columns)
        system = self.system
        change = ca.mtimes(ca.jacobian(self.h, system.x), matrix)
        change[:, : system.np] += ca.jacobian(self.h, system.p)
        if delay_columns and system.nu:
            change += ca.mtimes(ca.jacobian(self.h, system.u), injected)
        inputs = [system.x, s, system.u, d, system.p, system.t]
        return dense("measure", inputs, [self.h, ca.vec(change.T)])

    def _injection(self, delay_columns: tuple[int, ...]) -> tuple[Any, Any, Any, Any]:
        """Return the symbols S and dU, S as a matrix, and dU as a sparse matrix (nu, np + nx)."""
        system = self.system
        ns = system.np + system.nx
        s = ca.SX.sym("S", system.nx * ns)
        d = ca.SX.sym("dU", system.nu * len(delay_columns))
        matrix = ca.reshape(s, ns, system.nx).T
        injected = ca.SX(system.nu, ns)
        for row in range(system.nu):
            for place, column in enumerate(delay_columns):
                injected[row, column] = d[row * len(delay_columns) + place]
        return s, d, matrix, injected

    def step(self, h: float, substeps: int) -> Any:
        """Return the function (x, u, p, t) -> x one sample later, input held."""
        key = ("step", h, substeps)
        if key not in self._machines:
            x, u, p, t = (ca.SX.sym("a", one.shape) for one in self.arguments)
            state = x
            for count in range(substeps):
                state = self._advance(
                    lambda y, w, s: self.derivative(y, w, p, s), state, lambda share: u, t + count * h, h
                )
            self._machines[key] = ca.Function("step", [x, u, p, t], [state])
        return self._machines[key]

    def virtual_machine(
        self,
        dt: float,
        substeps: int,
        foh: bool,
        sensitivities: bool,
        delay_columns: tuple[int, ...],
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
        step, look = self._sample(dt, substeps, foh, sensitivities, delay_columns)
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
            whole[1:] = step.mapaccum(n - 1)(start, moving[:-1].T, p, times[:-1]).full().T
        bad = ~np.isfinite(whole[:, :nx]).all(axis=1)
        if bad.any():
            whole = whole[: int(np.argmax(bad))]
        rows = whole.shape[0]
        if rows == 0:
            return whole[:, :nx], np.empty((0, self.system.ny)), np.empty((0, 0))
        found = look.map(rows)(whole.T, moving[:rows].T, p, times[:rows])
        if not sensitivities:
            return whole[:, :nx], found.full().T, np.empty((rows, 0))
        return whole[:, :nx], found[0].full().T, found[1].full().T

    def _sample(
        self, dt: float, substeps: int, foh: bool, sensitivities: bool, delay_columns: tuple[int, ...]
    ) -> tuple[Any, Any]:
        """Return the functions (state, moving, p, t) of one sample: next state, and measurement."""
        key = (dt, substeps, foh, sensitivities, delay_columns)
        if key in self._machines:
            return self._machines[key]  # type: ignore[no-any-return]
        system = self.system
        nx, nu, nd = system.nx, system.nu, len(delay_columns) if sensitivities else 0
        size = nx * (1 + system.np + nx) if sensitivities else nx
        state, p, t = ca.SX.sym("z", size), ca.SX.sym("p", system.np), ca.SX.sym("t")
        moving = ca.SX.sym("w", 2 * nu * (1 + nd))
        u, u_next = moving[:nu], moving[nu : 2 * nu]
        d = moving[2 * nu : 2 * nu + nu * nd]
        d_next = moving[2 * nu + nu * nd :]
        stage = self.stage(delay_columns) if sensitivities else None

        def slope(z: Any, w: tuple[Any, Any], s: Any) -> Any:
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

            new = self._advance(slope, new, seen, t + count * h, h)
        step = ca.Function("sample", [state, moving, p, t], [new], {"cse": False})
        if sensitivities:
            outputs = list(self.measure(delay_columns)(state[:nx], state[nx:], u, d, p, t))
        else:
            outputs = [self.output(state, u, p, t)]
        look = ca.Function("look", [state, moving, p, t], outputs)
        self._machines[key] = (step, look)
        return step, look

    def _advance(self, slope: Any, x: Any, inputs: Any, t: Any, h: float) -> Any:
        """Return the state one step later; in finer steps where a force changes its sign.

        ``inputs(part)`` is what the slope sees at a part (0 to 1) of the step.
        """
        new = _runge_kutta(slope, x, [inputs(part) for part in (0.0, 0.5, 1.0)], t, h)
        places = list(dict.fromkeys(k for k, _ in self.system.switches))
        if not places:
            return new
        near, fine = ca.SX(0), x
        for k in places:
            near = ca.logic_or(near, ca.fmin(ca.fabs(x[k]), ca.fabs(new[k])) < ca.fabs(new[k] - x[k]))
        for part in range(FINE):
            seen = [inputs((part + share) / FINE) for share in (0.0, 0.5, 1.0)]
            fine = _runge_kutta(slope, fine, seen, t + part * (h / FINE), h / FINE)
        return ca.if_else(near, fine, new)


def _runge_kutta(slope: Any, x: Any, inputs: list[Any], t: Any, h: float) -> Any:
    """Return one step of the classical method; the order of operations is that of the C code."""
    k1 = slope(x, inputs[0], t)
    k2 = slope(x + 0.5 * h * k1, inputs[1], t + 0.5 * h)
    k3 = slope(x + 0.5 * h * k2, inputs[1], t + 0.5 * h)
    k4 = slope(x + h * k3, inputs[2], t + h)
    return x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)


def rollout_source(functions: Functions, sensitivities: bool, delay_columns: tuple[int, ...]) -> str:
    """Return the C source of ``sysid_rollout`` for a system: the loop over windows, samples, substeps and stages."""
    system = functions.system
    nd = len(delay_columns) if sensitivities else 0
    if sensitivities:
        bodies = [c_function("stage", functions.stage(delay_columns))]
        bodies.append(c_function("measure", functions.measure(delay_columns)))
    else:
        bodies = [c_function("stage", functions.derivative), c_function("measure", functions.output)]
    sizes = {
        "NX": system.nx,
        "NU": system.nu,
        "NY": system.ny,
        "NP": system.np,
        "ND": nd,
        "NS": system.np + system.nx if sensitivities else 0,
    }
    sizes["FINE"] = FINE
    bodies.append(near_zero(system, "sysid"))
    head = "\n".join(f"#define {name} {size}" for name, size in sizes.items())
    call = _CALLS_SENSITIVE if sensitivities else _CALLS_PLAIN
    return "\n\n".join(["#include <math.h>\n#include <stddef.h>", head, *bodies, call + _LOOP]) + "\n"


_CALLS_SENSITIVE = """\
#define STAGE(z, u, d, p, t, dz) stage(z, (z) + NX, u, d, p, t, dz, (dz) + NX)
#define MEASURE(z, u, d, p, t, y, s) measure(z, (z) + NX, u, d, p, t, y, s)
"""

_CALLS_PLAIN = """\
#define STAGE(z, u, d, p, t, dz) stage(z, u, p, t, dz)
#define MEASURE(z, u, d, p, t, y, s) measure(z, u, p, t, y)
"""

_LOOP = """\
#define NZ (NX * (1 + NS))
#define NW (NU * ND)
#define ROOM(n) ((n) > 0 ? (n) : 1)

static void blend(const double *a, const double *b, double share, int n, double *out) {
  int i;
  for (i = 0; i < n; i++) out[i] = share == 1.0 ? b[i] : a[i] + (b[i] - a[i])*share;
}

typedef struct { const double *u, *u_next, *d, *d_next, *p; int foh; } sample;

/* One step from z to the next, h long: over the shares a to b of a sample, m between them. */
static void runge_kutta(const sample *in, const double *z, double *next, double t, double h, double a, double m,
                        double b) {
  double w[ROOM(NZ)], k1[ROOM(NZ)], k2[ROOM(NZ)], k3[ROOM(NZ)], k4[ROOM(NZ)];
  double ub[3][ROOM(NU)], db[3][ROOM(NW)];
  const double *ua = in->u, *um = in->u, *ue = in->u, *da = in->d, *dm = in->d, *de = in->d, *p = in->p;
  const double middle = t + 0.5*h, end = t + h;
  int i;
  (void)da; (void)dm; (void)de;
  if (in->foh) {
    blend(in->u, in->u_next, a, NU, ub[0]);
    blend(in->u, in->u_next, m, NU, ub[1]);
    blend(in->u, in->u_next, b, NU, ub[2]);
    ua = ub[0]; um = ub[1]; ue = ub[2];
    if (NW > 0) {
      blend(in->d, in->d_next, a, NW, db[0]);
      blend(in->d, in->d_next, m, NW, db[1]);
      blend(in->d, in->d_next, b, NW, db[2]);
      da = db[0]; dm = db[1]; de = db[2];
    }
  }
  STAGE(z, ua, da, p, &t, k1);
  for (i = 0; i < NZ; i++) w[i] = z[i] + 0.5*h*k1[i];
  STAGE(w, um, dm, p, &middle, k2);
  for (i = 0; i < NZ; i++) w[i] = z[i] + 0.5*h*k2[i];
  STAGE(w, um, dm, p, &middle, k3);
  for (i = 0; i < NZ; i++) w[i] = z[i] + h*k3[i];
  STAGE(w, ue, de, p, &end, k4);
  for (i = 0; i < NZ; i++) next[i] = z[i] + h/6.0*(k1[i] + 2.0*k2[i] + 2.0*k3[i] + k4[i]);
}

int sysid_rollout(long m, long n, const double *p, const double *x0, const double *u, const double *d,
                  const double *t0, double dt, long substeps, int foh, double *x, double *y, double *s) {
  double z[ROOM(NZ)], next[ROOM(NZ)];
  const double h = dt/(double)substeps;
  long window, k, j;
  int i, part, finite;
  (void)s;
  for (window = 0; window < m; window++, p += NP, x0 += NX) {
    for (i = 0; i < NX; i++) z[i] = x0[i];
    for (i = NX; i < NZ; i++) z[i] = 0.0;
    for (i = 0; NS > 0 && i < NX; i++) z[NX + i*NS + NP + i] = 1.0;
    for (k = 0; k < n; k++, x += NX, y += NY, u += NU) {
      const double time = t0[window] + (double)k*dt;
      const double *u_next = k + 1 < n ? u + NU : u, *d_next = k + 1 < n ? d + NW : d;
      finite = 1;
      for (i = 0; i < NX; i++) finite = finite && isfinite(z[i]);
      if (!finite) break;
      for (i = 0; i < NX; i++) x[i] = z[i];
      MEASURE(z, u, d, p, &time, y, s);
      if (NS > 0) s += NY*NS;
      const sample in = {u, u_next, d, d_next, p, foh};
      for (j = 0; k + 1 < n && j < substeps; j++) {
        const double start = time + (double)j*h, many = (double)substeps;
        runge_kutta(&in, z, next, start, h, (double)j/many, ((double)j + 0.5)/many, ((double)j + 1.0)/many);
        if (sysid_near_zero(z, next)) { /* a force changes its sign: finer steps */
          for (part = 0; part < FINE; part++) {
            const double a = ((double)j + (double)part/FINE)/many, m = ((double)j + (part + 0.5)/FINE)/many;
            runge_kutta(&in, z, next, start + part*(h/FINE), h/FINE, a, m, ((double)j + (part + 1.0)/FINE)/many);
            for (i = 0; i < NZ; i++) z[i] = next[i];
          }
        } else {
          for (i = 0; i < NZ; i++) z[i] = next[i];
        }
      }
      if (NW > 0) d += NW;
    }
    if (NW > 0) d += NW*(n - k);
    for (; k < n; k++, x += NX, y += NY, u += NU) {
      for (i = 0; i < NX; i++) x[i] = NAN;
      for (i = 0; i < NY; i++) y[i] = NAN;
      for (i = 0; i < NY*NS; i++) s[i] = NAN;
      if (NS > 0) s += NY*NS;
    }
  }
  return 0;
}"""
