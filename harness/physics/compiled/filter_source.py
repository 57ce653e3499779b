"""C source of a system for the extended Kalman filter: its steps and outputs, with their derivatives."""

from __future__ import annotations

from typing import TYPE_CHECKING

from harness.physics.compiled.filter_kernels import JOB
from harness.physics.compiled.rollout_source import RUNGE_KUTTA, STAGE, shared_source

if TYPE_CHECKING:
    from harness.physics.compiled.rollout_code import Functions


def filter_source(functions: Functions, delay_columns: tuple[int, ...]) -> str:
    """Return the C source of ``sysid_filter`` for a system whose last states are latent forces: held over a sample.

    Parameters
    ----------
    functions : Functions
        Of a system made by :func:`harness.physics.compiled.latent.with_latent_forces`.
    delay_columns : tuple of int
        Parameters through which the inputs depend on p.

    Returns
    -------
    str
        ``int sysid_filter(filter_job *in)``; :mod:`harness.physics.compiled.kalman_pass` calls it.

    Notes
    -----
    The state is linearised where the filter predicts it (extended Kalman filter: Jazwinski 1970, sec. 8.3). The
    transition F of a sample is the derivative of the numerical solution itself: columns of unit start vectors are
    carried along the Runge-Kutta stages beside those of the parameters. Outputs are taken one after the other, which
    gives the joint density because their noises are independent. The derivatives of the innovations by parameters and
    initial states hold the gain fixed (Ljung 1999, sec. 10.3 without the derivative of K). The pass itself, which
    needs to know sizes only, is that of :mod:`harness.physics.compiled.filter_kernels`: it calls ``advance`` and
    ``outputs``,
    and takes the covariance over readings and samples, with its derivatives by the noise.

    Examples
    --------
    >>> from harness.physics.compiled.latent import with_latent_forces
    >>> from harness.physics.models import drive
    >>> from harness.physics.compiled.rollout_code import Functions
    >>> source = filter_source(Functions(with_latent_forces(drive().system()).system), ())
    >>> [line for line in source.splitlines() if line.startswith("int ")]
    ['int sysid_filter(filter_job *in) {']
    """
    parts = shared_source(functions, True, delay_columns, extra=functions.system.nx + 3)  # in blocks of their own
    readings = functions.readings(delay_columns)
    scatter = [f"  c[{row}*NX + {column}] = a[{k}];" for k, (row, column, _) in enumerate(readings.entries("by_x"))]
    rows = "\n".join(["static void output_rows(const double *a, double *c) {", "  (void)a; (void)c;", *scatter, "}"])
    return "\n\n".join([*parts, JOB, STAGE, rows, RUNGE_KUTTA, _FILTER]) + "\n"


_FILTER = """\
/* Over a row of the inputs in steps of h: the state, and all blocks of columns. */
static void advance(const sample *here, double time, double h, long many, double *x, block *z, int all, void *room) {
  tangent *at = room;
  double next[NX];
  long j, part;
  int i, c;
  for (j = 0; j < many; j++) {
    const double start = time + (double)j*h, of = (double)many;
    runge_kutta(here, x, next, start, h, (double)j/of, ((double)j + 0.5)/of, ((double)j + 1.0)/of, at);
    if (sysid_near_zero(x, next)) { /* a force changes its sign: finer steps */
      for (part = 0; part < FINE; part++) {
        const double q = ((double)j + (double)part/FINE)/of, w = ((double)j + ((double)part + 0.5)/FINE)/of;
        const double g = ((double)j + ((double)part + 1.0)/FINE)/of;
        runge_kutta(here, x, next, start + (double)part*(h/FINE), h/FINE, q, w, g, at);
        for (c = 0; c < all; c++) carry_block(at, z + c*NX, c, h/FINE);
        for (i = 0; i < NX; i++) x[i] = next[i];
      }
    } else {
      for (c = 0; c < all; c++) carry_block(at, z + c*NX, c, h);
      for (i = 0; i < NX; i++) x[i] = next[i];
    }
  }
}

/* The outputs, their rows of derivatives by the state, and those by the parameters that are chosen. */
static void outputs(const sample *here, double time, const double *x, double *y, double *c, block *b) {
  double la[ROOM(LOOK_A)], lb[ROOM(NS*NY)], lf[ROOM(NY*NU)];
  look(x, here->u, here->p, &time, y, la, lb, lf);
  output_rows(la, c);
  if (here->sources) look_source(lb, lf, here->d, here->place + NS, (double *)b);
}

int sysid_filter(filter_job *in) {
  const block none = {0};
  const int chosen = (int)in->chosen;
  block z[(BLOCKS + 1)*NX], b[(BLOCKS + 1)*NY];
  tangent at[4];
  int place[ROOM(2*NS)], i, k;
  long sources = 0;
  for (i = 0; i < NS; i++) { place[i] = BLOCKS*NX*W; place[NS + i] = BLOCKS*NY*W; }
  for (i = 0; i < chosen; i++) {
    place[in->columns[i]] = (i/W)*NX*W + i%W;
    place[NS + in->columns[i]] = (i/W)*NY*W + i%W;
    sources = sources || in->columns[i] < NP;
  }
  for (k = 0; k < 4; k++) for (i = 0; i < (BLOCKS + 1)*NX; i++) at[k].b[i] = none;
  for (i = 0; i < (BLOCKS + 1)*NY; i++) b[i] = none;
  for (i = 0; i < (BLOCKS + 1)*NX; i++) z[i] = none;
  for (i = 0; i < NX; i++) ((double *)z)[place[NP + i] + W*i] = 1.0;
  for (i = 0; i < NX; i++) z[BLOCKS*NX + i] = none;
  {
    const sample first = {in->u, in->u, in->d, in->d, in->p, place, in->foh, sources};
    return in->run(in, first, NU, NW, advance, outputs, z, b, at);
  }
}"""
