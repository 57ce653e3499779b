"""Passes of a Kalman filter and of its smoother, compiled; they know sizes only: made once, shared by all systems."""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Sequence
from typing import Any

from harness.physics.compiled.compilation import Compilation
from harness.physics.compiled.rollout_source import BLOCK, SAMPLE
from harness.signals import FloatArray

_LAYOUT = """\
/* Matrices of states as rows of blocks: NB blocks hold a row. */
#define NB ((NX + W - 1)/W)
#define AT(m, i, k) (((double *)(m[i]))[k])
/* Derivatives by logarithms of the noise: s, tau, w of every latent force, r of every output. */
#define NN (3*NL + NY)
#define MB ((NN + W - 1)/W)
#if W > 1
#define OVER_NB(...) for (k = 0; k < NB; k++) { __VA_ARGS__ }
#define OVER_MB(...) for (m = 0; m < MB; m++) { __VA_ARGS__ }
#else /* a compiler that unrolls nothing */
#define OVER_NB(...) { EACH_K }
#define OVER_MB(...) { EACH_M }
#endif"""

JOB = """\
/* What a system does: over a row of the inputs in many steps of h, and at a row. */
typedef void advancing(const sample *here, double time, double h, long many, double *x, block *z, int all, void *room);
typedef void reading(const sample *here, double time, const double *x, double *y, double *c, block *b);
typedef struct filter_job {
  long n, substeps, every, chosen, foh;
  double dt, t0;
  const double *p, *x0, *p0, *u, *d;
  const int *columns;
  const double *measured, *r, *period, *a, *q, *w, *fade, *q_tau;
  double *e, *s, *j, *e_noise, *s_noise;
  double *x_before, *p_before, *x_after, *p_after, *transition, *gain, *row;
  int (*run)(struct filter_job *in, sample here, long nu, long nw, advancing *advance, reading *outputs, block *z,
             block *b, void *room);
} filter_job;"""
"""A pass, as Python, the kernels and the filter of a system know it; ``z`` and ``b`` hold blocks of four columns each,
of what is chosen and then, in blocks of their own, of the transition."""


def kernel_source(nx: int, ny: int, nl: int) -> str:
    """Return the C source for some numbers of states, outputs and latent forces (the last states).

    Notes
    -----
    ``sysid_run`` is a pass over a record; what depends on the system, its steps and outputs, it calls. ``sysid_read``
    and ``sysid_step`` take the covariance (NX, NB) over a reading and over a sample, and with ``dP`` its derivatives
    (NX, NX, MB) and those of the state by the logarithms of the noise: covariance and gain are differentiated, the
    transition is held fixed (Gupta & Mehra 1974, IEEE Trans. Autom. Control 19:774, sec. III). Latent forces fade over
    a sample: ``d <- a d + w``.

    Examples
    --------
    >>> kernel_source(3, 1, 1).splitlines()[0]
    '#define NX 3'
    """
    layout = _LAYOUT.replace("EACH_K", _each("k", nx)).replace("EACH_M", _each("m", 3 * nl + ny))
    return f"#define NX {nx}\n#define NY {ny}\n#define NL {nl}\n{_HEAD}\n{SAMPLE}\n{layout}\n{JOB}\n{_STEPS}\n{_RUN}\n"


def _each(name: str, count: int) -> str:
    """Return the C text of a statement for every value of a name."""
    return " ".join(f"{{ enum {{ {name} = {value} }}; __VA_ARGS__ }}" for value in range(count))


def smoother_source(nx: int, ny: int) -> str:
    """Return the C source of what runs along a pass that was kept.

    Notes
    -----
    ``sysid_smooth`` is the modified Bryson-Frazier recursion (Bierman 1973, Automatica 9:503, eqs. 12-17),
    ``sysid_respond`` what small forces and sensor errors do to the innovations with gains held fixed.
    """
    return f"#include <math.h>\n#define NX {nx}\n#define NY {ny}\n{_SMOOTHER}\n"


class FilterKernels:
    """The compiled pass of some sizes.

    - ``run``: address for the filter of a system
    """

    def __init__(self, library: ctypes.CDLL) -> None:
        self.run = ctypes.cast(library.sysid_run, ctypes.c_void_p).value


class SmootherKernels:
    """What is compiled to go along a pass of some sizes."""

    def __init__(self, library: ctypes.CDLL) -> None:
        self._smooth, self._respond = library.sysid_smooth, library.sysid_respond

    def smooth(self, n: int, given: Sequence[FloatArray], into: Sequence[FloatArray]) -> None:
        """Smooth a pass of n samples: e, s, transition, gain, row, x_before, p_before into x and its variance."""
        self._smooth(ctypes.c_long(n), *(_address(array) for array in (*given, *into)))

    def respond(self, n: int, m: int, given: Sequence[FloatArray], push: Sequence[Any], into: FloatArray) -> None:
        """Respond to m cases: transition, gain, row; pushes (n, NX, width) and forces (n, width, m), readings."""
        width = 0 if push[0] is None else push[0].shape[2]
        self._respond(
            ctypes.c_long(n),
            ctypes.c_long(m),
            ctypes.c_long(width),
            *(_address(array) for array in (*given, *push, into)),
        )


def _address(array: FloatArray | None) -> ctypes.c_void_p:
    if array is None:
        return ctypes.c_void_p()
    assert array.flags.c_contiguous
    return ctypes.c_void_p(array.ctypes.data)


@functools.cache
def filter_kernels(nx: int, ny: int, nl: int) -> FilterKernels | None:
    """Return the pass of some sizes; None if there is no working compiler."""
    library = Compilation(kernel_source(nx, ny, nl), level="-O3").library()
    return None if library is None else FilterKernels(library)


@functools.cache
def smoother_kernels(nx: int, ny: int) -> SmootherKernels | None:
    """Return what goes along a pass of some sizes; None if there is no working compiler."""
    library = Compilation(smoother_source(nx, ny), level="-O3").library()
    return None if library is None else SmootherKernels(library)


_HEAD = (
    """\
#include <math.h>
#include <stddef.h>
"""
    + BLOCK
)

_STEPS = """\
/* The reading of an output with row co, variance r of its noise and innovation e (NaN: not measured), the o-th: its
   variance is returned and, where it was measured, the covariance updated; K becomes the gain. */
static double sysid_read(block (*P)[NB], const double *co, double r, double e, double *K,
                         block (*dP)[NX][MB], block (*dx)[MB], long o, double *by_e, double *by_s) {
  const block none = {0};
  block pc[NB], dpc[NX][MB], ds[MB], de[MB];
  const double *Pc = (const double *)pc;
  double s = r;
  int i, k, m;
  OVER_NB(pc[k] = none;)
  for (i = 0; i < NX; i++) {
    const double f = co[i];
    const block *row = P[i];
    if (f != 0.0) OVER_NB(pc[k] += f*row[k];)
  }
  for (i = 0; i < NX; i++) s += co[i]*Pc[i];
  if (isnan(e) || !(s > 0.0) || !isfinite(s)) {
    if (dP) for (i = 0; i < NN; i++) by_e[i] = by_s[i] = 0.0;
    return s;
  }
  for (i = 0; i < NX; i++) K[i] = Pc[i]/s;
  for (i = 0; i < NX; i++) {
    const double f = K[i];
    block *row = P[i];
    OVER_NB(row[k] -= f*pc[k];)
  }
  if (!dP) return s;
  OVER_MB(ds[m] = de[m] = none;)
  for (i = 0; i < NX; i++) {
    block *to = dpc[i];
    OVER_MB(to[m] = none;)
    for (k = 0; k < NX; k++) {
      const double f = co[k];
      const block *from = dP[i][k];
      if (f != 0.0) OVER_MB(to[m] += f*from[m];)
    }
    if (co[i] != 0.0) {
      const double f = co[i];
      const block *from = dx[i];
      OVER_MB(ds[m] += f*to[m]; de[m] -= f*from[m];)
    }
  }
  LANE(ds, 3*NL + o) += 2.0*r;
  for (i = 0; i < NX; i++) {
    const double f = K[i], by = e/s;
    const block *row = dpc[i];
    block *moved = dx[i];
    OVER_MB(moved[m] += (row[m] - f*ds[m])*by + f*de[m];)
    for (k = 0; k <= i; k++) {
      const double g = K[k], both = f*g;
      const block *other = dpc[k];
      block *here = dP[i][k], *there = dP[k][i];
      OVER_MB(here[m] = there[m] = here[m] - g*row[m] - f*other[m] + both*ds[m];)
    }
  }
  for (i = 0; i < NN; i++) { by_e[i] = LANE(de, i); by_s[i] = LANE(ds, i)/s; }
  return s;
}

/* Over a step with transition F, after which the state is x: latent forces fade by exp(-fade) and gain q, the white
   ones of variance w act during the step only. */
static void sysid_step(block (*P)[NB], block (*F)[NB], const double *x, const double *fade, const double *w,
                       const double *q, const double *q_tau, block (*dP)[NX][MB], block (*dx)[MB]) {
  const block none = {0};
  block FP[NX][NB], Ft[NX][NB];
  int i, k, m, o;
  for (i = 0; i < NX; i++) OVER_NB(Ft[i][k] = none;)
  for (i = 0; i < NX; i++) for (k = 0; k < NX; k++) AT(Ft, k, i) = AT(F, i, k);
  for (i = 0; i < NX; i++) {
    const double first = AT(F, i, 0);
    block *to = FP[i];
    OVER_NB(to[k] = first*P[0][k];)
    for (o = 1; o < NX; o++) {
      const double f = AT(F, i, o);
      const block *from = P[o];
      if (f != 0.0) OVER_NB(to[k] += f*from[k];)
    }
  }
  for (i = 0; i < NX; i++) {
    const double first = AT(FP, i, 0);
    block *to = P[i];
    OVER_NB(to[k] = first*Ft[0][k];)
    for (o = 1; o < NX; o++) {
      const double f = AT(FP, i, o);
      const block *from = Ft[o];
      OVER_NB(to[k] += f*from[k];)
    }
  }
  if (dP) {
    block FdP[NX][NX][MB], moved[NX][MB];
    for (i = 0; i < NX; i++) {
      block *to = moved[i];
      OVER_MB(to[m] = none;)
      for (k = 0; k < NX; k++) OVER_MB(FdP[i][k][m] = none;)
      for (o = 0; o < NX; o++) {
        const double f = AT(F, i, o);
        const block *from = dx[o];
        if (f == 0.0) continue;
        OVER_MB(to[m] += f*from[m];)
        for (k = 0; k < NX; k++) {
          const block *row = dP[o][k];
          block *into = FdP[i][k];
          OVER_MB(into[m] += f*row[m];)
        }
      }
    }
    for (i = 0; i < NX; i++) {
      OVER_MB(dx[i][m] = moved[i][m];)
      for (k = 0; k <= i; k++) {
        block sum[MB], *here = dP[i][k], *there = dP[k][i];
        OVER_MB(sum[m] = none;)
        for (o = 0; o < NX; o++) {
          const double f = AT(F, k, o);
          const block *from = FdP[i][o];
          if (f != 0.0) OVER_MB(sum[m] += f*from[m];)
        }
        OVER_MB(here[m] = there[m] = sum[m];)
      }
    }
    for (o = 0; o < NL; o++) {
      const int l = NX - NL + o;
      LANE(dx[l], NL + o) += fade[o]*x[l];
      for (k = 0; k < NX; k++) {
        LANE(dP[l][k], NL + o) += fade[o]*AT(P, l, k);
        LANE(dP[k][l], NL + o) += fade[o]*AT(P, k, l);
      }
      LANE(dP[l][l], o) += 2.0*q[o];
      LANE(dP[l][l], NL + o) += q_tau[o];
      for (i = 0; i < NX - NL; i++)
        for (k = 0; k < NX - NL; k++) LANE(dP[i][k], 2*NL + o) += 2.0*w[o]*AT(F, i, l)*AT(F, k, l);
    }
  }
  for (o = 0; o < NL; o++)
    if (w[o] > 0.0)
      for (i = 0; i < NX - NL; i++)
        for (k = 0; k < NX - NL; k++) AT(P, i, k) += w[o]*AT(F, i, NX - NL + o)*AT(F, k, NX - NL + o);
  for (i = 1; i < NX; i++)
    for (k = 0; k < i; k++) AT(P, i, k) = AT(P, k, i) = 0.5*(AT(P, i, k) + AT(P, k, i));
  for (o = 0; o < NL; o++) AT(P, NX - NL + o, NX - NL + o) += q[o];
}
"""

_RUN = """\
static double wrapped(double r, double period) {
  if (period <= 0.0) return r;
  r += period/2;
  if (!(r >= 0.0 && r < period)) { r = fmod(r, period); if (r < 0.0) r += period; }
  return r - period/2;
}

static void copy_matrix(double *to, block (*from)[NB]) {
  int i, m;
  for (i = 0; i < NX; i++) for (m = 0; m < NX; m++) to[i*NX + m] = AT(from, i, m);
}

static void copy(double *to, const double *from, int n) {
  int i;
  for (i = 0; i < n; i++) to[i] = from[i];
}

/* Whether nothing disturbs the plant, whose state is known: then it stays so, and no reading corrects it. */
static int undisturbed(const filter_job *in) {
  int i, free = 0;
  for (i = 0; i < NX*NX; i++) free = free || in->p0[i] != 0.0;
  for (i = 0; i < NL; i++) free = free || in->q[i] != 0.0 || in->w[i] != 0.0;
  return !free;
}

int sysid_run(filter_job *in, sample here, long nu, long nw, advancing *advance, reading *outputs, block *z, block *b,
              void *room) {
  const double h = in->dt/(double)in->substeps;
  const int chosen = (int)in->chosen, blocks = (chosen + W - 1)/W, sure = undisturbed(in);
  const int moving = !sure || in->transition, all = blocks + (moving ? NB : 0), slopes = in->e_noise && !sure;
  const block none = {0};
  block P[NX][NB], F[NX][NB], dP[NX][NX][MB], dx[NX][MB], *unit = z + blocks*NX;
  double x[NX], prior[NX], y[NY], c[NY*NX], K[NX];
  int i, m, o, k4;
  long k, row = 0;
  for (i = 0; i < NY*NX; i++) c[i] = 0.0;
  copy(x, in->x0, NX);
  for (i = 0; i < NX; i++) for (m = 0; m < NB; m++) P[i][m] = none;
  for (i = 0; i < NX; i++) for (m = 0; m < NX; m++) AT(P, i, m) = in->p0[i*NX + m];
  if (slopes) {
    for (i = 0; i < NX; i++)
      for (k4 = 0; k4 < MB; k4++) { dx[i][k4] = none; for (m = 0; m < NX; m++) dP[i][m][k4] = none; }
    for (o = 0; o < NL; o++) LANE(dP[NX - NL + o][NX - NL + o], o) = 2.0*AT(P, NX - NL + o, NX - NL + o);
  }
  for (k = 0; k < in->n; k++) {
    const double time = in->t0 + (double)k*in->dt;
    const long last = k + 1 >= in->n;
    here.u = in->u + k*nu;
    here.u_next = last ? here.u : here.u + nu;
    here.d = nw > 0 ? in->d + k*nw : NULL;
    here.d_next = nw > 0 && !last ? here.d + nw : here.d;
    for (i = 0; i < NX; i++) if (!isfinite(x[i])) return 1;
    if (k % in->every == 0) {
      const double *measured = in->measured + row*NY;
      if (in->x_before) { copy(in->x_before + row*NX, x, NX); copy_matrix(in->p_before + row*NX*NX, P); }
      outputs(&here, time, x, y, c, b);
      copy(prior, x, NX);
      for (o = 0; o < NY; o++) {
        const double *co = c + o*NX;
        const long at_row = row*NY + o;
        double s, e = wrapped(measured[o] - y[o], in->period[o]);
        for (i = 0; i < NX; i++) e -= co[i]*(x[i] - prior[i]);
        s = sysid_read(P, co, in->r[o], e, K, slopes ? dP : NULL, dx, o,
                       slopes ? in->e_noise + at_row*NN : NULL, slopes ? in->s_noise + at_row*NN : NULL);
        if (in->e_noise && !slopes)
          for (i = 0; i < NN; i++) {
            in->e_noise[at_row*NN + i] = 0.0;
            in->s_noise[at_row*NN + i] = i == 3*NL + o && !isnan(e) ? 2.0 : 0.0;
          }
        in->e[at_row] = e;
        in->s[at_row] = s;
        if (isnan(e)) { /* nothing was measured here */
          if (in->j) for (i = 0; i < chosen; i++) in->j[at_row*chosen + i] = 0.0;
          if (in->gain) for (i = 0; i < NX; i++) in->gain[at_row*NX + i] = 0.0;
          if (in->row) copy(in->row + at_row*NX, co, NX);
          continue;
        }
        if (!(s > 0.0) || !isfinite(s)) return 1;
        for (i = 0; i < NX; i++) x[i] += K[i]*e;
        for (k4 = 0; k4 < blocks; k4++) {
          block v = -b[k4*NY + o];
          for (i = 0; i < NX; i++) v -= co[i]*z[k4*NX + i];
          for (i = 0; i < NX; i++) z[k4*NX + i] += K[i]*v;
          if (in->j)
            for (i = 0; i < W && W*k4 + i < chosen; i++) in->j[at_row*chosen + W*k4 + i] = LANE(&v, i);
        }
        if (in->gain) copy(in->gain + at_row*NX, K, NX);
        if (in->row) copy(in->row + at_row*NX, co, NX);
      }
      if (in->x_after) { copy(in->x_after + row*NX, x, NX); copy_matrix(in->p_after + row*NX*NX, P); }
      if (in->transition) for (i = 0; i < NX*NX; i++) in->transition[row*NX*NX + i] = i % (NX + 1) == 0;
      row++;
    }
    if (last) break;
    for (i = 0; moving && i < NX*NB; i++) unit[i] = none;
    for (i = 0; moving && i < NX; i++) LANE(&unit[(i/W)*NX + i], i%W) = 1.0;
    advance(&here, time, h, in->substeps, x, z, all, room);
    for (m = 0; m < NL; m++) { /* the latent forces fade, the white ones act during this sample only */
      const int l = NX - NL + m;
      x[l] *= in->a[m];
      for (k4 = 0; k4 < all; k4++) z[k4*NX + l] *= in->a[m];
    }
    for (i = 0; moving && i < NX; i++) for (k4 = 0; k4 < NB; k4++) F[i][k4] = unit[k4*NX + i];
    if (!sure) sysid_step(P, F, x, in->fade, in->w, in->q, in->q_tau, slopes ? dP : NULL, dx);
    if (in->transition) { /* since the last measurement */
      double *total = in->transition + (row - 1)*NX*NX, before[NX*NX];
      copy(before, total, NX*NX);
      for (i = 0; i < NX; i++)
        for (m = 0; m < NX; m++) {
          double sum = 0.0;
          for (o = 0; o < NX; o++) sum += AT(F, i, o)*before[o*NX + m];
          total[i*NX + m] = sum;
        }
    }
  }
  return 0;
}
"""

_SMOOTHER = """\
void sysid_smooth(long n, const double *e, const double *s, const double *transition, const double *gain,
                  const double *row, const double *x_before, const double *p_before, double *x, double *variance) {
  double adjoint[NX], information[NX][NX], moved[NX], product[NX][NX];
  long t;
  int i, k, o, l;
  for (i = 0; i < NX; i++) { adjoint[i] = 0.0; for (k = 0; k < NX; k++) information[i][k] = 0.0; }
  for (t = n - 1; t >= 0; t--) {
    const double *f = transition + t*NX*NX, *p = p_before + t*NX*NX;
    if (t + 1 < n) {
      for (i = 0; i < NX; i++) {
        moved[i] = 0.0;
        for (k = 0; k < NX; k++) product[i][k] = 0.0;
        for (l = 0; l < NX; l++) {
          moved[i] += f[l*NX + i]*adjoint[l];
          for (k = 0; k < NX; k++) product[i][k] += f[l*NX + i]*information[l][k];
        }
      }
      for (i = 0; i < NX; i++) {
        adjoint[i] = moved[i];
        for (k = 0; k < NX; k++) information[i][k] = 0.0;
        for (l = 0; l < NX; l++) for (k = 0; k < NX; k++) information[i][k] += product[i][l]*f[l*NX + k];
      }
    }
    for (o = NY - 1; o >= 0; o--) {
      const double *c = row + (t*NY + o)*NX, *K = gain + (t*NY + o)*NX, v = s[t*NY + o], r = e[t*NY + o];
      double along = 0.0, twice = 0.0;
      if (!isfinite(r)) continue;
      for (i = 0; i < NX; i++) {
        along += K[i]*adjoint[i];
        moved[i] = 0.0;
        for (k = 0; k < NX; k++) moved[i] += information[i][k]*K[k];
      }
      for (i = 0; i < NX; i++) twice += K[i]*moved[i];
      for (i = 0; i < NX; i++) {
        adjoint[i] -= c[i]*(along + r/v);
        for (k = 0; k < NX; k++) information[i][k] += c[i]*c[k]*(twice + 1.0/v) - c[i]*moved[k] - moved[i]*c[k];
      }
    }
    for (i = 0; i < NX; i++) {
      double state = x_before[t*NX + i], left = p[i*NX + i];
      for (k = 0; k < NX; k++) {
        double sum = 0.0;
        state -= p[i*NX + k]*adjoint[k];
        for (l = 0; l < NX; l++) sum += information[k][l]*p[l*NX + i];
        left -= p[i*NX + k]*sum;
      }
      x[t*NX + i] = state;
      variance[t*NX + i] = left;
    }
  }
}

/* Cases side by side; response (n, NY, m) holds the readings' part on entry, or 0; state is room for 2 NX m. */
void sysid_respond(long n, long m, long width, const double *transition, const double *gain, const double *row,
                   const double *push, const double *forces, double *state, double *response) {
  double *next = state + NX*m;
  long t, j, l;
  int i, k, o;
  for (j = 0; j < NX*m; j++) state[j] = 0.0;
  for (t = 0; t < n; t++) {
    const double *f = transition + t*NX*NX;
    for (o = 0; o < NY; o++) {
      const double *c = row + (t*NY + o)*NX, *K = gain + (t*NY + o)*NX;
      double *change = response + (t*NY + o)*m;
      for (i = 0; i < NX; i++) if (c[i] != 0.0) for (j = 0; j < m; j++) change[j] -= c[i]*state[i*m + j];
      for (i = 0; i < NX; i++) if (K[i] != 0.0) for (j = 0; j < m; j++) state[i*m + j] += K[i]*change[j];
    }
    for (i = 0; i < NX; i++) {
      for (j = 0; j < m; j++) next[i*m + j] = 0.0;
      for (k = 0; k < NX; k++) {
        const double a = f[i*NX + k];
        if (a != 0.0) for (j = 0; j < m; j++) next[i*m + j] += a*state[k*m + j];
      }
      for (l = 0; l < width; l++) {
        const double a = push[(t*NX + i)*width + l];
        if (a != 0.0) for (j = 0; j < m; j++) next[i*m + j] += a*forces[(t*width + l)*m + j];
      }
    }
    for (j = 0; j < NX*m; j++) state[j] = next[j];
  }
}"""
