/* Free run of a linear model with stops inside, and its derivatives by every coefficient and by the initial state.

   x+ = A x + B u + E w,   y = C x + D u + F w,   z = G x + H u,   w_i = sum_j W_ij (z_i - p_ij)
   p_ij = min(max(p_ij, z_i - r_ij), z_i + r_ij)

   z_i - p_ij is a stop, never beyond r_ij, and p_ij its play (Visintin 1994, Differential Models of Hysteresis, III).
   A has blocks of two states on its diagonal, and a last one of one state where their number is odd. theta holds,
   row-major, the blocks of A, then B, E, G, H and W, whose derivatives are carried along, and C, D and F, which have no
   part in the state. The derivative of a play is that of its signal while it is drawn, and stays as it was while it
   rests. */
#include <math.h>
#include <string.h>

#ifdef _WIN32
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif

/* The sums over columns in the registers of the machine it runs on; each number is the same in all of them. */
#if defined(__x86_64__) && defined(__gnu_linux__) && defined(__GNUC__) && !defined(__clang__) && !defined(__TINYC__)
#define WIDE __attribute__((target_clones("avx512f", "avx2", "default")))
#else
#define WIDE
#endif

#define COLUMNS 64 /* derivatives that are carried through a record together, so that they stay in the near cache */

typedef struct {
    long nx, nu, ny, nz, m;
    const double *A, *B, *E, *G, *H, *W, *C, *D, *F;
} Model;

static Model parted(long nx, long nu, long ny, long nz, long m, const double *theta)
{
    Model s = {nx, nu, ny, nz, m, theta, 0, 0, 0, 0, 0, 0, 0, 0};
    s.B = s.A + 4 * (nx / 2) + nx % 2;
    s.E = s.B + nx * nu;
    s.G = s.E + nx * nz;
    s.H = s.G + nz * nx;
    s.W = s.H + nz * nu;
    s.C = s.W + nz * m;
    s.D = s.C + ny * nx;
    s.F = s.D + ny * nu;
    return s;
}

static double dot(const double *a, const double *b, long n)
{
    double sum = 0.0;
    for (long i = 0; i < n; i++) sum += a[i] * b[i];
    return sum;
}

/* x (nx) and p (nz, m), the memory of the plays, are taken from before the first sample to behind the last one.
   y (n, ny) receives the outputs; states (n, nx), stops (n, nz, m), loops (n, nz) and drawn (n, nz, m) what was inside,
   all four or none. Returns the number of steps before a state passed `far`. */
EXPORT long sysid_hysteresis_run(long n, long nx, long nu, long ny, long nz, long m, const double *theta,
                                 const double *r, double *x, double *p, const double *u, double far, double *y,
                                 double *states, double *stops, double *loops, unsigned char *drawn, double *work)
{
    const Model s = parted(nx, nu, ny, nz, m, theta);
    double *next = work, *w = work + nx;
    for (long k = 0; k < n; k++) {
        const double *v = u + k * nu;
        for (long i = 0; i < nz; i++) {
            const double z = dot(s.G + i * nx, x, nx) + dot(s.H + i * nu, v, nu);
            for (long j = i * m; j < (i + 1) * m; j++) {
                const double old = p[j];
                if (p[j] < z - r[j]) p[j] = z - r[j];
                if (p[j] > z + r[j]) p[j] = z + r[j];
                if (drawn) drawn[k * nz * m + j] = p[j] != old;
            }
            double sum = 0.0;
            for (long j = i * m; j < (i + 1) * m; j++) {
                sum += s.W[j] * (z - p[j]);
                if (stops) stops[k * nz * m + j] = z - p[j];
            }
            w[i] = sum;
        }
        if (states) {
            memcpy(states + k * nx, x, (size_t)nx * sizeof(double));
            memcpy(loops + k * nz, w, (size_t)nz * sizeof(double));
        }
        for (long o = 0; o < ny; o++)
            y[k * ny + o] = dot(s.C + o * nx, x, nx) + dot(s.D + o * nu, v, nu) + dot(s.F + o * nz, w, nz);
        for (long i = 0; i < nx; i++) {
            double sum = dot(s.B + i * nu, v, nu) + dot(s.E + i * nz, w, nz);
            if (nx % 2 && i == nx - 1)
                sum += s.A[2 * i] * x[i];
            else
                sum += s.A[2 * i] * x[i - i % 2] + s.A[2 * i + 1] * x[i - i % 2 + 1];
            next[i] = sum;
            if (!(fabs(sum) <= far)) return k + 1;
        }
        memcpy(x, next, (size_t)nx * sizeof(double));
    }
    return n;
}

static void add(double *to, const double *from, double factor)
{
    for (long c = 0; c < COLUMNS; c++) to[c] += factor * from[c];
}

/* The derivatives of some columns of one record. Work holds (2 nx + nz (m + 2)) COLUMNS doubles. */
WIDE static void carried(long n, const Model *s, long first, long last, const double *u, const double *states,
                         const double *stops, const double *loops, const unsigned char *drawn, double *slopes,
                         long wide, double *work)
{
    const long nx = s->nx, nu = s->nu, ny = s->ny, nz = s->nz, m = s->m, q = COLUMNS;
    const long b = s->B - s->A, e = s->E - s->A, g = s->G - s->A, h = s->H - s->A, o = s->W - s->A, end = s->C - s->A;
    double *d = work, *next = d + nx * q, *dp = next + nx * q, *dz = dp + nz * m * q, *dw = dz + nz * q;
    memset(work, 0, (size_t)((2 * nx + nz * (m + 2)) * q) * sizeof(double));
    for (long c = first; c < last; c++)
        if (c >= end) d[(c - end) * q + c - first] = 1.0;
    for (long k = 0; k < n; k++) {
        const double *x = states + k * nx, *v = u + k * nu, *held = stops + k * nz * m, *w = loops + k * nz;
        memset(dz, 0, (size_t)(2 * nz * q) * sizeof(double));
        for (long i = 0; i < nz; i++)
            for (long l = 0; l < nx; l++) add(dz + i * q, d + l * q, s->G[i * nx + l]);
        for (long c = first; c < last; c++) {
            if (c >= g && c < h) dz[(c - g) / nx * q + c - first] += x[(c - g) % nx];
            if (c >= h && c < o) dz[(c - h) / nu * q + c - first] += v[(c - h) % nu];
        }
        for (long j = 0; j < nz * m; j++) {
            if (drawn[k * nz * m + j]) {
                memcpy(dp + j * q, dz + j / m * q, (size_t)q * sizeof(double));
                continue;
            }
            add(dw + j / m * q, dz + j / m * q, s->W[j]);
            add(dw + j / m * q, dp + j * q, -s->W[j]);
        }
        for (long c = first; c < last; c++)
            if (c >= o && c < end) dw[(c - o) / m * q + c - first] += held[c - o];
        for (long out = 0; out < ny; out++) {
            double *row = dz; /* no longer needed */
            memset(row, 0, (size_t)q * sizeof(double));
            for (long l = 0; l < nx; l++) add(row, d + l * q, s->C[out * nx + l]);
            for (long i = 0; i < nz; i++) add(row, dw + i * q, s->F[out * nz + i]);
            memcpy(slopes + (k * ny + out) * wide + first, row, (size_t)(last - first) * sizeof(double));
        }
        memset(next, 0, (size_t)(nx * q) * sizeof(double));
        for (long i = 0; i < nx; i++) {
            double *to = next + i * q;
            if (nx % 2 && i == nx - 1) {
                add(to, d + i * q, s->A[2 * i]);
            } else {
                add(to, d + (i - i % 2) * q, s->A[2 * i]);
                add(to, d + (i - i % 2 + 1) * q, s->A[2 * i + 1]);
            }
            for (long l = 0; l < nz; l++) add(to, dw + l * q, s->E[i * nz + l]);
        }
        for (long c = first; c < last; c++) {
            if (c < b) {
                const long i = c / 2, at = (nx % 2 && i == nx - 1) ? i : i - i % 2 + c % 2;
                next[i * q + c - first] += x[at];
            } else if (c < e) {
                next[(c - b) / nu * q + c - first] += v[(c - b) % nu];
            } else if (c < g) {
                next[(c - e) / nz * q + c - first] += w[(c - e) % nz];
            }
        }
        double *swap = d;
        d = next;
        next = swap;
    }
}

/* slopes (n, ny, wide) receives the derivatives of the outputs by A, B, E, G, H, W, the initial state, C, D and F.
   states, stops, loops and drawn are those of the run; work holds (2 nx + nz (m + 2)) 64 doubles. */
EXPORT void sysid_hysteresis_slopes(long n, long nx, long nu, long ny, long nz, long m, const double *theta,
                                    const double *u, const double *states, const double *stops, const double *loops,
                                    const unsigned char *drawn, double *slopes, double *work)
{
    const Model s = parted(nx, nu, ny, nz, m, theta);
    const long moving = s.C - s.A + nx, each = nx + nu + nz, wide = moving + ny * each;
    for (long first = 0; first < moving; first += COLUMNS) {
        const long last = first + COLUMNS < moving ? first + COLUMNS : moving;
        carried(n, &s, first, last, u, states, stops, loops, drawn, slopes, wide, work);
    }
    for (long k = 0; k < n; k++)
        for (long o = 0; o < ny; o++) {
            double *row = slopes + (k * ny + o) * wide + moving;
            memset(row, 0, (size_t)(ny * each) * sizeof(double));
            memcpy(row + o * nx, states + k * nx, (size_t)nx * sizeof(double));
            memcpy(row + ny * nx + o * nu, u + k * nu, (size_t)nu * sizeof(double));
            memcpy(row + ny * (nx + nu) + o * nz, loops + k * nz, (size_t)nz * sizeof(double));
        }
}
