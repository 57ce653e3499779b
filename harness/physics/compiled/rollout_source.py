"""C source of the compiled roll-out: windows, samples, steps, sensitivities, and the sums of the normal equations."""

from __future__ import annotations

from typing import TYPE_CHECKING

from harness.physics.compiled.ccode import FINE, c_function, near_zero

if TYPE_CHECKING:
    from harness.physics.compiled.rollout_code import DifferentiatedFunction, Functions


def rollout_source(functions: Functions, sensitivities: bool, delay_columns: tuple[int, ...]) -> str:
    """Return the C source of ``sysid_rollout`` for a system.

    - ``sensitivities``: with the derivatives by (p, x0), as many columns of them as the caller chooses, and the sums
      over the samples
    - ``delay_columns``: parameters through which the inputs depend on p
    - returns ``int sysid_rollout(job *in)``; :func:`harness.physics.compiled.rollout_call.call_rollout` calls it

    Notes
    -----
    Rates and their derivatives come from the system; the product ``S' = A S + B`` is a loop over columns, four side by
    side in one vector register: a step computes A and B of its four stages first, then carries each four columns
    through all stages without leaving the registers.

    Examples
    --------
    >>> from harness.physics.models import drive
    >>> from harness.physics.compiled.rollout_code import Functions
    >>> source = rollout_source(Functions(drive().system()), True, ())
    >>> [line for line in source.splitlines() if line.startswith("int ")]
    ['int sysid_rollout(job *in) {']
    """
    loop = _SENSITIVE if sensitivities else _PLAIN
    return "\n\n".join([*shared_source(functions, sensitivities, delay_columns), loop, RUNGE_KUTTA, _LOOP]) + "\n"


def shared_source(
    functions: Functions, sensitivities: bool, delay_columns: tuple[int, ...], extra: int = 0
) -> list[str]:
    """Return the parts of the C source that a roll-out and a Kalman filter share: rates, outputs, their derivatives.

    - ``delay_columns``: see :func:`rollout_source`
    - ``extra``: columns to make room for beside the derivatives by (p, x0)
    """
    system = functions.system
    sizes = {
        "NX": system.nx,
        "NU": system.nu,
        "NY": system.ny,
        "NP": system.np,
        "ND": len(delay_columns) if sensitivities else 0,
        "NS": system.np + system.nx if sensitivities else 0,
        "EXTRA": extra,
        "FINE": FINE,
    }
    bodies = []
    for name, linear in (("rate", functions.rates), ("look", functions.readings)):
        if not sensitivities:
            bodies.append(c_function(name, functions.derivative if name == "rate" else functions.output))
            continue
        parts = linear(delay_columns)
        sizes[f"{name.upper()}_A"] = len(parts.entries("by_x"))
        bodies.append(c_function(name, parts.function(name)))
        bodies.append(_source(name, parts, delay_columns))
        if name == "rate":
            bodies.append(_TANGENT)
        bodies.append(_carry(parts) if name == "rate" else _look(parts))
    bodies.append(near_zero(system, "sysid"))
    head = "\n".join(f"#define {name} {size}" for name, size in sizes.items())
    return ["#include <math.h>\n#include <stddef.h>", head, _TYPES, *bodies]


def _terms(parts: DifferentiatedFunction, row: int, s: str, a: str, b: str) -> str:
    """Return the C text of a row of A S + B; an entry of A that is 1 is left out."""
    terms = [
        f"{s}{column}" if entry.is_one() else f"{a}[{place}]*{s}{column}"
        for place, (line, column, entry) in enumerate(parts.entries("by_x"))
        if line == row
    ]
    if any(line == row for kind in ("by_p", "by_u") for line, _, _ in parts.entries(kind)):
        terms.append(f"{b}[{row}]")
    return " + ".join(terms) if terms else "none"


def _carry(parts: DifferentiatedFunction) -> str:
    """Return the C function that carries four columns over a step whose stages are known."""
    rows = range(parts.value.shape[0])
    lines = [f"block s{i} = s[{i}], w{i} = s{i}, k{i}, sum{i};" for i in rows]
    for stage, (how, step) in enumerate((("k", "half"), ("sum + two*k", "half"), ("sum + two*k", "whole"))):
        lines += [f"k{i} = {_terms(parts, i, 'w', f'at[{stage}].a', f'(at[{stage}].b + c*NX)')};" for i in rows]
        for i in rows:
            total = how.replace("sum", f"sum{i}").replace("k", f"k{i}")
            lines.append(f"sum{i} = {total}; w{i} = s{i} + {step}*k{i};")
    lines += [f"k{i} = {_terms(parts, i, 'w', 'at[3].a', '(at[3].b + c*NX)')};" for i in rows]
    lines += [f"s[{i}] = s{i} + sixth*(sum{i} + k{i});" for i in rows]
    head = [
        "static void carry_block(const tangent *at, block *s, int c, double h) {",
        "  const block none = {0};",
        "  const double half = 0.5*h, whole = h, sixth = h/6.0, two = 2.0;",
        "  (void)none; (void)at; (void)c; (void)half; (void)whole; (void)sixth; (void)two;",
    ]
    return "\n".join([*head, *(f"  {line}" for line in lines), "}"])


def _look(parts: DifferentiatedFunction) -> str:
    """Return the C functions of four columns of the outputs' derivatives, and of a product of two columns."""
    rows = range(parts.value.shape[0])
    lines = [f"  y[{i}] = {_terms(parts, i, 's', 'a', 'b')};" for i in rows]
    reads = [f"  block s{i} = s[{i}];" for i in sorted({column for _, column, _ in parts.entries("by_x")})]
    product = " + ".join(f"LANE(&column[{i}], k)*y[{i}]" for i in rows)
    return "\n".join(
        [
            "static void look_block(const double *a, const block *b, const block *s, block *y) {",
            "  const block none = {0};",
            "  (void)none; (void)a; (void)b; (void)s; (void)y;",
            *reads,
            *lines,
            "}",
            "static inline block product(const block *column, int k, const block *y) {",
            f"  return {product};",
            "}",
        ]
    )


def _source(name: str, parts: DifferentiatedFunction, delay_columns: tuple[int, ...]) -> str:
    """Return the C function that puts the entries of B = df/dp + df/du dU where the chosen columns want them."""
    lines = []
    own = parts.entries("by_p")
    for place, (row, column, _) in enumerate(own):
        lines.append(f"  to[place[{column}] + W*{row}] = b[{place}];")
    taken = {(row, column) for row, column, _ in own}
    by_row: dict[int, list[str]] = {}
    for place, (row, column, _) in enumerate(parts.entries("by_u")):
        by_row.setdefault(row, []).append(f"f[{place}]*d[{column}*ND + DELAY]")
    for delay, column in enumerate(delay_columns):
        for row, terms in by_row.items():
            how = "+=" if (row, column) in taken else "="
            total = " + ".join(terms).replace("DELAY", str(delay))
            lines.append(f"  to[place[{column}] + W*{row}] {how} {total};")
    head = f"static inline void {name}_source(const double *b, const double *f, const double *d, const int *place,"
    return "\n".join([head, "    double *to) {", "  (void)b; (void)f; (void)d; (void)place; (void)to;", *lines, "}"])


SAMPLE = """\
/* What a step sees of the inputs, here and at the next row, of their derivatives d, and of the parameters. */
typedef struct { const double *u, *u_next, *d, *d_next, *p; const int *place; long foh, sources; } sample;"""

BLOCK = """\
/* Numbers side by side in a register; one where the compiler knows no vectors. */
#ifdef __TINYC__
#define W 1
typedef double block;
#else
#define W 4
typedef double block __attribute__((vector_size(32), may_alias));
#endif
#define LANE(b, l) (((double *)(b))[l])"""

_TYPES = """\
#define ROOM(n) ((n) > 0 ? (n) : 1)
#define NW (NU*ND)
#define BLOCKS ((NS + EXTRA + W - 1)/W)

BLOCK

/* What the roll-outs of some windows of equal length take and give; see Simulator. */
typedef struct {
  long m, n, substeps, every, chosen;
  double dt, budget;
  long foh;
  const double *p, *x0, *u, *d, *t0;
  const int *columns;
  double *x, *y, *s;
  const double *measured, *sigma, *period, *limit;
  double *cost, *squares, *gram, *gradient;
} job;

SAMPLE

static void blend(const double *a, const double *b, double share, int n, double *out) {
  int i;
  for (i = 0; i < n; i++) out[i] = share == 1.0 ? b[i] : a[i] + (b[i] - a[i])*share;
}""".replace("SAMPLE", SAMPLE).replace("BLOCK\n", BLOCK + "\n")

_TANGENT = """\
/* A and B of a stage. */
typedef struct { double a[ROOM(RATE_A)]; block b[(BLOCKS + 1)*ROOM(NX)]; } tangent;"""

_PLAIN = """\
typedef struct { int none; } tangent;
typedef struct { int none; } columns;

static void stage(const double *x, const double *u, const double *d, const sample *in, double t, double *dx,
                  tangent *at) {
  (void)d; (void)at;
  rate(x, u, in->p, &t, dx);
}

static void clear(tangent *at, columns *s, const job *in, int *place) { (void)at; (void)s; (void)in; (void)place; }
static void begin(columns *s, const int *place) { (void)s; (void)place; }
static void carry(const tangent *at, columns *s, double h) { (void)at; (void)s; (void)h; }
static void reading(const double *x, const sample *in, double t, columns *s, double *y) {
  (void)s;
  look(x, in->u, in->p, &t, y);
}
static void give(const columns *s, double *out) { (void)s; (void)out; }
static void add(columns *s, const job *in, const double *y, const double *measured, double *residual, double *cost) {
  (void)s; (void)in; (void)y; (void)measured; (void)residual; (void)cost;
}
static void total(columns *s, const job *in, long window, int whole, double cost) {
  (void)s; (void)in; (void)window; (void)whole; (void)cost;
}"""

STAGE = """\
static void stage(const double *x, const double *u, const double *d, const sample *in, double t, double *dx,
                  tangent *at) {
  double b[ROOM(NS*NX)], f[ROOM(NX*NU)];
  rate(x, u, in->p, &t, dx, at->a, b, f);
  if (in->sources) rate_source(b, f, d, in->place, (double *)at->b);
}"""

_SENSITIVE = """\
/* dx/d(p, x0) in blocks of four columns, the derivatives of the outputs, and the sums over the samples. */
typedef struct {
  int blocks, chosen;
  block s[(BLOCKS + 1)*ROOM(NX)], y[ROOM(BLOCKS)][NY], b[(BLOCKS + 1)*NY];
  block gradient[ROOM(BLOCKS)], gram[ROOM(NS)][ROOM(BLOCKS)];
  double squares[NY];
} columns;

STAGE

/* Choose the columns, and where they are among blocks of four; those that nobody wants share the last block. */
static void clear(tangent *at, columns *s, const job *in, int *place) {
  const block none = {0};
  int i, k;
  s->chosen = (int)in->chosen;
  s->blocks = (s->chosen + W - 1)/W;
  for (i = 0; i < NS; i++) { place[i] = BLOCKS*NX*W; place[NS + i] = BLOCKS*NY*W; }
  for (i = 0; i < s->chosen; i++) {
    place[in->columns[i]] = (i/W)*NX*W + i%W;
    place[NS + in->columns[i]] = (i/W)*NY*W + i%W;
  }
  for (k = 0; k < 4; k++) for (i = 0; i < (BLOCKS + 1)*NX; i++) at[k].b[i] = none;
  for (i = 0; i < (BLOCKS + 1)*NY; i++) s->b[i] = none;
}

/* Begin a window. */
static void begin(columns *s, const int *place) {
  const block none = {0};
  int i, k;
  for (i = 0; i < (BLOCKS + 1)*NX; i++) s->s[i] = none;
  for (i = 0; i < NX; i++) ((double *)s->s)[place[NP + i] + W*i] = 1.0;
  for (k = 0; k < BLOCKS; k++) s->gradient[k] = none;
  for (i = 0; i < NS; i++) for (k = 0; k < BLOCKS; k++) s->gram[i][k] = none;
  for (i = 0; i < NY; i++) s->squares[i] = 0.0;
}

static void carry(const tangent *at, columns *all, double h) {
  int c;
  for (c = 0; c < all->blocks; c++) carry_block(at, all->s + c*NX, c, h);
}

static void reading(const double *x, const sample *in, double t, columns *s, double *y) {
  double a[ROOM(LOOK_A)], b[ROOM(NS*NY)], f[ROOM(NY*NU)];
  int c;
  look(x, in->u, in->p, &t, y, a, b, f);
  if (in->sources) look_source(b, f, in->d, in->place + NS, (double *)s->b);
  for (c = 0; c < s->blocks; c++) look_block(a, s->b + c*NY, s->s + c*NX, s->y[c]);
}

/* Give the derivatives of the outputs (NY, chosen); NaN where there are none. */
static void give(const columns *s, double *out) {
  int i, c;
  for (i = 0; i < NY; i++)
    for (c = 0; c < s->chosen; c++) *out++ = LANE(&s->y[c/W][i], c%W);
}

/* Add a sample to the sums: r'r, J'r and the upper triangle of J'J. */
static void add(columns *s, const job *in, const double *y, const double *measured, double *residual, double *cost) {
  int i, c, k;
  for (i = 0; i < NY; i++) {
    const double period = in->period[i], weight = 1.0/in->sigma[i];
    double r = measured[i] - y[i];
    if (period > 0.0) {
      r += period/2;
      if (!(r >= 0.0 && r < period)) { r = fmod(r, period); if (r < 0.0) r += period; }
      r -= period/2;
    }
    residual[i] = r;
    s->squares[i] += r*r;
    r *= weight;
    *cost += 0.5*r*r;
    for (c = 0; c < s->blocks; c++) { s->y[c][i] *= weight; s->gradient[c] += r*s->y[c][i]; }
  }
  for (k = 0; k < s->chosen; k++) {
    for (c = k/W; c < s->blocks; c++) s->gram[k][c] += product(s->y[k/W], k%W, s->y[c]);
  }
}

/* Give the sums of a window; what diverged has an infinite cost. */
static void total(columns *s, const job *in, long window, int whole, double cost) {
  double *gram = in->gram + window*NS*NS, *gradient = in->gradient + window*NS;
  int i, k;
  whole = whole && isfinite(cost);
  for (k = 0; k < s->chosen; k++)
    for (i = k; i < s->chosen; i++) whole = whole && isfinite(LANE(&s->gram[k][i/W], i%W));
  for (k = 0; k < s->chosen; k++) {
    gradient[in->columns[k]] = whole ? LANE(&s->gradient[k/W], k%W) : NAN;
    for (i = k; i < s->chosen; i++) {
      const double value = whole ? LANE(&s->gram[k][i/W], i%W) : NAN;
      gram[in->columns[k]*NS + in->columns[i]] = gram[in->columns[i]*NS + in->columns[k]] = value;
    }
  }
  for (i = 0; i < NY; i++) in->squares[i] += whole ? s->squares[i] : NAN;
  in->cost[window] = whole ? cost : INFINITY;
}""".replace("STAGE", STAGE)

RUNGE_KUTTA = """\
/* One step from z to the next, h long: over the shares a to b of a sample, m between them. */
static void runge_kutta(const sample *in, const double *z, double *next, double t, double h, double a, double m,
                        double b, tangent *at) {
  double w[ROOM(NX)], k1[ROOM(NX)], k2[ROOM(NX)], k3[ROOM(NX)], k4[ROOM(NX)];
  double ub[3][ROOM(NU)], db[3][ROOM(NW)];
  const double *ua = in->u, *um = in->u, *ue = in->u, *da = in->d, *dm = in->d, *de = in->d;
  const double middle = t + 0.5*h, end = t + h;
  int i;
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
  stage(z, ua, da, in, t, k1, at);
  for (i = 0; i < NX; i++) w[i] = z[i] + 0.5*h*k1[i];
  stage(w, um, dm, in, middle, k2, at + 1);
  for (i = 0; i < NX; i++) w[i] = z[i] + 0.5*h*k2[i];
  stage(w, um, dm, in, middle, k3, at + 2);
  for (i = 0; i < NX; i++) w[i] = z[i] + h*k3[i];
  stage(w, ue, de, in, end, k4, at + 3);
  for (i = 0; i < NX; i++) next[i] = z[i] + h/6.0*(k1[i] + 2.0*k2[i] + 2.0*k3[i] + k4[i]);
}"""

_LOOP = """\
int sysid_rollout(job *in) {
  const long n = in->n, many = in->substeps, rows = (n + in->every - 1)/in->every;
  const double h = in->dt/(double)many;
  double z[ROOM(NX)], next[ROOM(NX)], y[NY], residual[NY];
  tangent at[4];
  columns s;
  int place[ROOM(2*NS)], i;
  long sources = 0, window, k, j, part, row;
  clear(at, &s, in, place);
  for (k = 0; k < in->chosen; k++) sources = sources || in->columns[k] < NP;
  for (window = 0; window < in->m; window++) {
    const double *x0 = in->x0 + window*NX, *p = in->p + window*NP;
    double cost = 0.0, limit = in->limit ? in->limit[window] : INFINITY;
    int going = 1;
    if (in->budget < limit) limit = in->budget;
    if (limit < 0.0) going = 0;
    for (i = 0; i < NX; i++) z[i] = x0[i];
    begin(&s, place);
    row = 0;
    for (k = 0; going && k < n; k++) {
      const double *u = in->u + (window*n + k)*NU, *d = NW > 0 ? in->d + (window*n + k)*NW : NULL;
      const double time = in->t0[window] + (double)k*in->dt;
      const sample here = {u, k + 1 < n ? u + NU : u, d, NW > 0 && k + 1 < n ? d + NW : d, p, place, in->foh, sources};
      for (i = 0; i < NX; i++) going = going && isfinite(z[i]);
      if (!going) break;
      if (k % in->every == 0) {
        const long to = window*rows + row;
        reading(z, &here, time, &s, y);
        if (in->x) for (i = 0; i < NX; i++) in->x[to*NX + i] = z[i];
        if (in->s) give(&s, in->s + to*NY*in->chosen);
        if (in->measured) {
          add(&s, in, y, in->measured + to*NY, residual, &cost);
          if (isfinite(limit)) going = cost <= limit;
        }
        if (in->y) for (i = 0; i < NY; i++) in->y[to*NY + i] = in->measured ? residual[i] : y[i];
        row++;
      }
      for (j = 0; going && k + 1 < n && j < many; j++) {
        const double start = time + (double)j*h, of = (double)many;
        runge_kutta(&here, z, next, start, h, (double)j/of, ((double)j + 0.5)/of, ((double)j + 1.0)/of, at);
        if (sysid_near_zero(z, next, here.p, h)) { /* a force changes its sign: finer steps */
          for (part = 0; part < FINE; part++) {
            const double a = ((double)j + (double)part/FINE)/of, m = ((double)j + ((double)part + 0.5)/FINE)/of;
            const double b = ((double)j + ((double)part + 1.0)/FINE)/of;
            runge_kutta(&here, z, next, start + (double)part*(h/FINE), h/FINE, a, m, b, at);
            carry(at, &s, h/FINE);
            for (i = 0; i < NX; i++) z[i] = next[i];
          }
        } else {
          carry(at, &s, h);
          for (i = 0; i < NX; i++) z[i] = next[i];
        }
      }
    }
    for (; row < rows; row++) {
      const long to = window*rows + row, width = NY*in->chosen;
      if (in->x) for (i = 0; i < NX; i++) in->x[to*NX + i] = NAN;
      if (in->y) for (i = 0; i < NY; i++) in->y[to*NY + i] = NAN;
      if (in->s) for (j = 0; j < width; j++) in->s[to*width + j] = NAN;
      going = 0;
    }
    if (in->measured) {
      total(&s, in, window, going, cost);
      if (isfinite(in->budget)) in->budget = isfinite(in->cost[window]) ? in->budget - in->cost[window] : -1.0;
    }
  }
  return 0;
}"""
