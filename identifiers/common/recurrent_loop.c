/* Free run of a small recurrent network, and its derivatives by every parameter and by the initial state.

   x+ = x + [x, u, 1] A + tanh([x, u, 1] W1) W2,   y = [x, u, 1] C + tanh([x, u, 1] V1) V2

   All tables are row-major and follow one another in theta: A (nz, nx), W1 (nz, h), W2 (h, nx), C (nz, ny),
   V1 (nz, g), V2 (g, ny), with nz = nx + nu + 1. Derivatives are carried forward (real-time recurrent learning,
   Williams and Zipser 1989, Neural Computation 1, eq. 8): one column for each of the q = p + nx unknowns. */
#include <math.h>
#include <string.h>

#ifdef _WIN32
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif

/* y (n, ny) receives the outputs; slopes (n, ny, q) their derivatives, or is null. work holds
   nz + h + g + nx + nx * h + nx * nx + 2 * nx * q doubles. Returns the number of steps before a state passed `far`. */
EXPORT long sysid_recurrent_run(long n, long nx, long nu, long ny, long h, long g, const double *theta,
                                const double *start, const double *u, double far, double *y, double *slopes,
                                double *work)
{
    const long nz = nx + nu + 1;
    const double *A = theta, *W1 = A + nz * nx, *W2 = W1 + nz * h, *C = W2 + h * nx, *V1 = C + nz * ny,
                 *V2 = V1 + nz * g;
    const long at_w1 = W1 - theta, at_w2 = W2 - theta, at_c = C - theta, at_v1 = V1 - theta, at_v2 = V2 - theta;
    const long p = at_v2 + g * ny, q = p + nx;
    double *z = work, *inner = z + nz, *outer = inner + h, *next = outer + g, *bend = next + nx,
           *turn = bend + nx * h, *d = turn + nx * nx, *moved = d + nx * q;

    memcpy(z, start, (size_t)nx * sizeof(double));
    z[nz - 1] = 1.0;
    if (slopes) {
        memset(d, 0, (size_t)(nx * q) * sizeof(double));
        for (long i = 0; i < nx; i++) d[i * q + p + i] = 1.0;
    }
    for (long k = 0; k < n; k++) {
        memcpy(z + nx, u + k * nu, (size_t)nu * sizeof(double));
        for (long j = 0; j < g; j++) {
            double sum = 0.0;
            for (long i = 0; i < nz; i++) sum += z[i] * V1[i * g + j];
            outer[j] = tanh(sum);
        }
        for (long o = 0; o < ny; o++) {
            double sum = 0.0;
            for (long i = 0; i < nz; i++) sum += z[i] * C[i * ny + o];
            for (long j = 0; j < g; j++) sum += outer[j] * V2[j * ny + o];
            y[k * ny + o] = sum;
            if (!slopes) continue;
            double *row = slopes + (k * ny + o) * q;
            memset(row, 0, (size_t)q * sizeof(double));
            for (long i = 0; i < nx; i++) {
                double by_x = C[i * ny + o];
                for (long j = 0; j < g; j++) by_x += V1[i * g + j] * (1.0 - outer[j] * outer[j]) * V2[j * ny + o];
                for (long c = 0; c < q; c++) row[c] += by_x * d[i * q + c];
            }
            for (long i = 0; i < nz; i++) {
                row[at_c + i * ny + o] += z[i];
                for (long j = 0; j < g; j++)
                    row[at_v1 + i * g + j] += z[i] * (1.0 - outer[j] * outer[j]) * V2[j * ny + o];
            }
            for (long j = 0; j < g; j++) row[at_v2 + j * ny + o] += outer[j];
        }
        for (long j = 0; j < h; j++) {
            double sum = 0.0;
            for (long i = 0; i < nz; i++) sum += z[i] * W1[i * h + j];
            inner[j] = tanh(sum);
        }
        for (long i = 0; i < nx; i++) {
            double sum = z[i];
            for (long j = 0; j < nz; j++) sum += z[j] * A[j * nx + i];
            for (long j = 0; j < h; j++) sum += inner[j] * W2[j * nx + i];
            next[i] = sum;
            if (!(fabs(sum) <= far)) return k + 1;
        }
        if (slopes) {
            for (long i = 0; i < nx; i++)
                for (long j = 0; j < h; j++) bend[i * h + j] = (1.0 - inner[j] * inner[j]) * W2[j * nx + i];
            for (long i = 0; i < nx; i++)
                for (long j = 0; j < nx; j++) {
                    double sum = (i == j) + A[j * nx + i];
                    for (long m = 0; m < h; m++) sum += bend[i * h + m] * W1[j * h + m];
                    turn[i * nx + j] = sum;
                }
            memset(moved, 0, (size_t)(nx * q) * sizeof(double));
            for (long i = 0; i < nx; i++) {
                double *row = moved + i * q;
                for (long j = 0; j < nx; j++) {
                    const double factor = turn[i * nx + j], *from = d + j * q;
                    for (long c = 0; c < q; c++) row[c] += factor * from[c];
                }
                for (long j = 0; j < nz; j++) {
                    row[j * nx + i] += z[j];
                    for (long m = 0; m < h; m++) row[at_w1 + j * h + m] += z[j] * bend[i * h + m];
                }
                for (long m = 0; m < h; m++) row[at_w2 + m * nx + i] += inner[m];
            }
            double *swap = d;
            d = moved;
            moved = swap;
        }
        memcpy(z, next, (size_t)nx * sizeof(double));
    }
    return n;
}
