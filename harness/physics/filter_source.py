"""C source of the compiled extended Kalman filter: one pass over a record, with the derivatives of the innovations."""

from __future__ import annotations

from typing import TYPE_CHECKING

from harness.physics.filter_kernels import LAYOUT
from harness.physics.rollout_source import RUNGE_KUTTA, STAGE, shared_source

if TYPE_CHECKING:
    from harness.physics.rollout_code import Functions

__all__ = ["filter_source"]


def filter_source(functions: Functions, delay_columns: tuple[int, ...], latent: int) -> str:
    """Return the C source of ``sysid_filter`` for a system whose last states are latent forces.

    Parameters
    ----------
    functions : Functions
        Of a system made by :func:`harness.physics.latent.with_latent_forces`.
    delay_columns : tuple of int
        Parameters through which the inputs depend on p.
    latent : int
        The last so many states are latent forces: held over a sample, then ``d <- a d + w``.

    Returns
    -------
    str
        ``int sysid_filter(filter_job *in)``; :mod:`harness.physics.kalman_pass` calls it.

    Notes
    -----
    The state is linearised where the filter predicts it (extended Kalman filter: Jazwinski 1970, sec. 8.3). The
    transition F of a sample is the derivative of the numerical solution itself: columns of unit start vectors are
    carried along the Runge-Kutta stages beside those of the parameters. Outputs are taken one after the other, which
    gives the joint density because their noises are independent. The derivatives of the innovations by parameters and
    initial states hold the gain fixed (Ljung 1999, sec. 10.3 without the derivative of K). The covariance is taken
    over readings and samples by :mod:`harness.physics.filter_kernels`, with its derivatives by the noise.

    Examples
    --------
    >>> from harness.physics.latent import with_latent_forces
    >>> from harness.physics.models import drive
    >>> from harness.physics.rollout_code import Functions
    >>> source = filter_source(Functions(with_latent_forces(drive().system()).system), (), 1)
    >>> [line for line in source.splitlines() if line.startswith("int ")]
    ['int sysid_filter(filter_job *in) {']
    """
    parts = shared_source(functions, True, delay_columns, extra=functions.system.nx)
    readings = functions.readings(delay_columns)
    scatter = [f"  c[{row}*NX + {column}] = a[{k}];" for k, (row, column, _) in enumerate(readings.entries("by_x"))]
    rows = "\n".join(["static void output_rows(const double *a, double *c) {", "  (void)a; (void)c;", *scatter, "}"])
    head = parts[0] + f"\n#define NL {latent}"
    return "\n\n".join([head, *parts[1:], LAYOUT, STAGE, rows, RUNGE_KUTTA, _FILTER]) + "\n"


_FILTER = """\
typedef struct {
  long n, substeps, every, chosen, foh;
  double dt, t0;
  const double *p, *x0, *p0, *u, *d;
  const int *columns;
  const double *measured, *r, *period, *a, *q, *w, *fade, *q_tau;
  double *e, *s, *j, *e_noise, *s_noise;
  double *x_before, *p_before, *x_after, *p_after, *transition, *gain, *row;
  double (*read)(block (*P)[NB], const double *co, double r, double e, double *K,
                 block (*dP)[NX][MB], block (*dx)[MB], long o, double *by_e, double *by_s);
  void (*step)(block (*P)[NB], block (*F)[NB], const double *x, const double *fade, const double *w, const double *q,
               const double *q_tau, block (*dP)[NX][MB], block (*dx)[MB]);
} filter_job;

#define COLUMN(c, i) (((double *)(z + ((c)/4)*NX + (i)))[(c) & 3])

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

int sysid_filter(filter_job *in) {
  const long many = in->substeps;
  const double h = in->dt/(double)many;
  const int chosen = (int)in->chosen, blocks = (chosen + 3)/4, all = (chosen + NX + 3)/4;
  const block none = {0};
  block P[NX][NB], F[NX][NB], dP[NX][NX][MB], dx[NX][MB];
  double x[NX], next[NX], prior[NX], y[NY], c[NY*NX], K[NX];
  double la[ROOM(LOOK_A)], lb[ROOM(NS*NY)], lf[ROOM(NY*NU)];
  block z[(BLOCKS + 1)*NX], b[(BLOCKS + 1)*NY];
  tangent at[4];
  int place[ROOM(2*NS)], i, m, o, k4;
  long sources = 0, k, j, part, row = 0;
  for (i = 0; i < NS; i++) { place[i] = BLOCKS*NX*4; place[NS + i] = BLOCKS*NY*4; }
  for (i = 0; i < chosen; i++) {
    place[in->columns[i]] = (i/4)*NX*4 + i%4;
    place[NS + in->columns[i]] = (i/4)*NY*4 + i%4;
    sources = sources || in->columns[i] < NP;
  }
  for (k4 = 0; k4 < 4; k4++) for (i = 0; i < (BLOCKS + 1)*NX; i++) at[k4].b[i] = none;
  for (i = 0; i < (BLOCKS + 1)*NY; i++) b[i] = none;
  for (i = 0; i < (BLOCKS + 1)*NX; i++) z[i] = none;
  for (i = 0; i < NX; i++) ((double *)z)[place[NP + i] + 4*i] = 1.0;
  for (i = 0; i < NX; i++) z[BLOCKS*NX + i] = none;
  for (i = 0; i < NY*NX; i++) c[i] = 0.0;
  copy(x, in->x0, NX);
  for (i = 0; i < NX; i++) for (m = 0; m < NB; m++) P[i][m] = F[i][m] = none;
  for (i = 0; i < NX; i++) for (m = 0; m < NX; m++) AT(P, i, m) = in->p0[i*NX + m];
  if (in->e_noise) {
    for (i = 0; i < NX; i++)
      for (k4 = 0; k4 < MB; k4++) { dx[i][k4] = none; for (m = 0; m < NX; m++) dP[i][m][k4] = none; }
    for (o = 0; o < NL; o++) ((double *)dP[NX - NL + o][NX - NL + o])[o] = 2.0*AT(P, NX - NL + o, NX - NL + o);
  }
  for (k = 0; k < in->n; k++) {
    const double *u = in->u + k*NU, *d = NW > 0 ? in->d + k*NW : NULL;
    const double time = in->t0 + (double)k*in->dt;
    const long last = k + 1 >= in->n;
    const sample here = {u, last ? u : u + NU, d, NW > 0 && !last ? d + NW : d, in->p, place, in->foh, sources};
    for (i = 0; i < NX; i++) if (!isfinite(x[i])) return 1;
    if (k % in->every == 0) {
      const double *measured = in->measured + row*NY;
      if (in->x_before) { copy(in->x_before + row*NX, x, NX); copy_matrix(in->p_before + row*NX*NX, P); }
      look(x, u, in->p, &time, y, la, lb, lf);
      output_rows(la, c);
      if (sources) look_source(lb, lf, d, place + NS, (double *)b);
      copy(prior, x, NX);
      for (o = 0; o < NY; o++) {
        const double *co = c + o*NX;
        const long at_row = row*NY + o;
        double s, e = wrapped(measured[o] - y[o], in->period[o]);
        for (i = 0; i < NX; i++) e -= co[i]*(x[i] - prior[i]);
        s = in->read(P, co, in->r[o], e, K, in->e_noise ? dP : NULL, dx, o,
                     in->e_noise ? in->e_noise + at_row*NN : NULL, in->e_noise ? in->s_noise + at_row*NN : NULL);
        in->e[row*NY + o] = e;
        in->s[row*NY + o] = s;
        if (isnan(e)) { /* nothing was measured here */
          if (in->j) for (i = 0; i < chosen; i++) in->j[(row*NY + o)*chosen + i] = 0.0;
          if (in->gain) for (i = 0; i < NX; i++) in->gain[(row*NY + o)*NX + i] = 0.0;
          if (in->row) copy(in->row + (row*NY + o)*NX, co, NX);
          continue;
        }
        if (!(s > 0.0) || !isfinite(s)) return 1;
        for (i = 0; i < NX; i++) x[i] += K[i]*e;
        for (k4 = 0; k4 < blocks; k4++) {
          block v = -b[k4*NY + o];
          for (i = 0; i < NX; i++) v -= co[i]*z[k4*NX + i];
          for (i = 0; i < NX; i++) z[k4*NX + i] += K[i]*v;
          if (in->j)
            for (i = 0; i < 4 && 4*k4 + i < chosen; i++) in->j[(row*NY + o)*chosen + 4*k4 + i] = v[i];
        }
        if (in->gain) copy(in->gain + (row*NY + o)*NX, K, NX);
        if (in->row) copy(in->row + (row*NY + o)*NX, co, NX);
      }
      if (in->x_after) { copy(in->x_after + row*NX, x, NX); copy_matrix(in->p_after + row*NX*NX, P); }
      if (in->transition) for (i = 0; i < NX*NX; i++) in->transition[row*NX*NX + i] = i % (NX + 1) == 0;
      row++;
    }
    if (last) break;
    for (i = 0; i < NX; i++) for (m = 0; m < NX; m++) COLUMN(chosen + m, i) = (double)(i == m);
    for (j = 0; j < many; j++) {
      const double start = time + (double)j*h, of = (double)many;
      runge_kutta(&here, x, next, start, h, (double)j/of, ((double)j + 0.5)/of, ((double)j + 1.0)/of, at);
      if (sysid_near_zero(x, next)) { /* a force changes its sign: finer steps */
        for (part = 0; part < FINE; part++) {
          const double q = ((double)j + (double)part/FINE)/of, w = ((double)j + ((double)part + 0.5)/FINE)/of;
          const double g = ((double)j + ((double)part + 1.0)/FINE)/of;
          runge_kutta(&here, x, next, start + (double)part*(h/FINE), h/FINE, q, w, g, at);
          for (k4 = 0; k4 < all; k4++) carry_block(at, z + k4*NX, k4, h/FINE);
          copy(x, next, NX);
        }
      } else {
        for (k4 = 0; k4 < all; k4++) carry_block(at, z + k4*NX, k4, h);
        copy(x, next, NX);
      }
    }
    for (m = 0; m < NL; m++) { /* the latent forces fade, the white ones act during this sample only */
      const int l = NX - NL + m;
      x[l] *= in->a[m];
      for (i = 0; i < chosen; i++) COLUMN(i, l) *= in->a[m];
      for (i = 0; i < NX; i++) COLUMN(chosen + i, l) *= in->a[m];
    }
    for (i = 0; i < NX; i++)
      for (m = 0; m < NX; m++) AT(F, i, m) = COLUMN(chosen + m, i);
    in->step(P, F, x, in->fade, in->w, in->q, in->q_tau, in->e_noise ? dP : NULL, dx);
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
}"""
