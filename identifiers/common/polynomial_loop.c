/* Free run of a polynomial state-space model, and its derivatives by every coefficient and by the initial state.

   x+ = x + p(x, u) W,   y = q(x, u) V

   p (mx) and q (my) are monomials, given by their exponents in z = [x, u] (m, nz), row-major. theta holds W (mx, nx)
   and then V (my, ny). Derivatives are carried forward (Paduart et al. 2010, Automatica 46, sec. 4.2): d (nx, mx nx + nx)
   holds those of the state by W and by the initial state; V has no part in the state. */
#include <math.h>
#include <stdint.h>
#include <string.h>

#ifdef _WIN32
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif

/* Values of monomials (m), and where `by` is given their derivatives by the states (m, nx). */
static void monomials(long m, long nx, long nz, long top, const int64_t *exponents, const double *powers,
                      double *values, double *by)
{
    const long row = top + 1;
    for (long j = 0; j < m; j++) {
        const int64_t *e = exponents + j * nz;
        double value = 1.0;
        for (long v = 0; v < nz; v++)
            if (e[v]) value *= powers[v * row + e[v]];
        values[j] = value;
        if (!by) continue;
        for (long i = 0; i < nx; i++) {
            if (!e[i]) {
                by[j * nx + i] = 0.0;
                continue;
            }
            double slope = (double)e[i] * powers[i * row + e[i] - 1];
            for (long v = 0; v < nz; v++)
                if (v != i && e[v]) slope *= powers[v * row + e[v]];
            by[j * nx + i] = slope;
        }
    }
}

/* x (nx) and d, which may be null, are taken from the first sample to behind the last one. y (n, ny) receives the
   outputs, states (n, nx) the states before each sample, slopes (n, ny, mx nx + my ny + nx) the derivatives by W, V and
   the initial state; both may be null. work holds nz (top + 1) + (mx + my) (1 + nx) + nx (1 + nx + mx nx + nx) doubles.
   Returns the number of steps before a state passed `far`. */
EXPORT long sysid_polynomial_run(long n, long nx, long nu, long ny, long top, long mx, long my, const int64_t *ex,
                                 const int64_t *ey, const double *theta, double *x, double *d, const double *u,
                                 double far, double *y, double *states, double *slopes, double *work)
{
    const long nz = nx + nu, row = top + 1, wide = mx * nx, r = wide + nx, p = wide + my * ny, q = p + nx;
    const double *W = theta, *V = theta + wide;
    double *powers = work, *inner = powers + nz * row, *outer = inner + mx, *by_in = outer + my,
           *by_out = by_in + mx * nx, *next = by_out + my * nx, *turn = next + nx, *moved = turn + nx * nx;

    for (long k = 0; k < n; k++) {
        for (long v = 0; v < nz; v++) {
            const double z = v < nx ? x[v] : u[k * nu + v - nx];
            powers[v * row] = 1.0;
            for (long e = 1; e < row; e++) powers[v * row + e] = powers[v * row + e - 1] * z;
        }
        if (states) memcpy(states + k * nx, x, (size_t)nx * sizeof(double));
        monomials(mx, nx, nz, top, ex, powers, inner, slopes ? by_in : 0);
        monomials(my, nx, nz, top, ey, powers, outer, slopes ? by_out : 0);
        for (long o = 0; o < ny; o++) {
            double sum = 0.0;
            for (long j = 0; j < my; j++) sum += outer[j] * V[j * ny + o];
            y[k * ny + o] = sum;
            if (!slopes) continue;
            double *out = slopes + (k * ny + o) * q;
            memset(out, 0, (size_t)q * sizeof(double));
            for (long i = 0; i < nx; i++) {
                double by_x = 0.0;
                for (long j = 0; j < my; j++) by_x += by_out[j * nx + i] * V[j * ny + o];
                const double *from = d + i * r;
                for (long c = 0; c < wide; c++) out[c] += by_x * from[c];
                for (long c = 0; c < nx; c++) out[p + c] += by_x * from[wide + c];
            }
            for (long j = 0; j < my; j++) out[wide + j * ny + o] = outer[j];
        }
        for (long i = 0; i < nx; i++) {
            double sum = x[i];
            for (long j = 0; j < mx; j++) sum += inner[j] * W[j * nx + i];
            next[i] = sum;
            if (!(fabs(sum) <= far)) return k + 1;
        }
        if (slopes) {
            for (long i = 0; i < nx; i++)
                for (long l = 0; l < nx; l++) {
                    double sum = i == l;
                    for (long j = 0; j < mx; j++) sum += by_in[j * nx + l] * W[j * nx + i];
                    turn[i * nx + l] = sum;
                }
            memset(moved, 0, (size_t)(nx * r) * sizeof(double));
            for (long i = 0; i < nx; i++) {
                double *to = moved + i * r;
                for (long l = 0; l < nx; l++) {
                    const double factor = turn[i * nx + l], *from = d + l * r;
                    for (long c = 0; c < r; c++) to[c] += factor * from[c];
                }
                for (long j = 0; j < mx; j++) to[j * nx + i] += inner[j];
            }
            memcpy(d, moved, (size_t)(nx * r) * sizeof(double));
        }
        memcpy(x, next, (size_t)nx * sizeof(double));
    }
    return n;
}
