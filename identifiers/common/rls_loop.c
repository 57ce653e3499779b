/* Recursive least squares over n samples of one record: each new row is rotated into the triangle of a QR factorisation
   by Givens rotations (Golub & Van Loan 2013, sec. 5.1 and 6.5.1), so that the condition number is not squared.

   memory holds, all doubles: seen, rows, order, p, ny, nu, burn_in, forgetting, prior; a sample u (nu), y (ny); free
   (ny), gain (nu, ny): the next output is free + u' gain; row (p): past outputs newest first, inputs newest first (the
   first of them still to come), a constant; triangle (p, p + ny): [R z] with R theta = z; theta (p, ny); work (p + ny). */
#include <math.h>
#include <string.h>

#ifdef _WIN32
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif

enum { SEEN, ROWS, ORDER, P, NY, NU, BURN_IN, FORGETTING, PRIOR, HEAD };

typedef struct {
    long order, p, ny, nu;
    double *head, *u, *y, *free, *gain, *row, *triangle, *theta, *work;
} parts;

static parts divided(double *memory)
{
    parts s;
    s.order = (long)memory[ORDER];
    s.p = (long)memory[P];
    s.ny = (long)memory[NY];
    s.nu = (long)memory[NU];
    s.head = memory;
    s.u = memory + HEAD;
    s.y = s.u + s.nu;
    s.free = s.y + s.ny;
    s.gain = s.free + s.ny;
    s.row = s.gain + s.nu * s.ny;
    s.triangle = s.row + s.p;
    s.theta = s.triangle + s.p * (s.p + s.ny);
    s.work = s.theta + s.p * s.ny;
    return s;
}

/* Rotate the row in work, whose first non-zero column is `from`, into the triangle. */
static void rotate(const parts *s, long from)
{
    const long width = s->p + s->ny;
    double *w = s->work;
    for (long i = from; i < s->p; i++) {
        if (w[i] == 0.0) continue;
        double *r = s->triangle + i * width;
        const double length = hypot(r[i], w[i]), c = r[i] / length, q = w[i] / length;
        r[i] = length;
        for (long j = i + 1; j < width; j++) {
            const double upper = r[j];
            r[j] = c * upper + q * w[j];
            w[j] = c * w[j] - q * upper;
        }
    }
}

/* The prior theta = 0, in rows of the size of those seen so far. */
static void regularise(const parts *s)
{
    const long width = s->p + s->ny;
    const double rows = s->head[ROWS], prior = s->head[PRIOR];
    for (long j = 0; j < s->p; j++) {
        double square = 0.0;
        for (long i = 0; i <= j; i++) square += s->triangle[i * width + j] * s->triangle[i * width + j];
        s->theta[j * s->ny] = square > 0.0 ? sqrt(square / rows) : 1.0; /* kept there until it is solved for */
    }
    for (long j = 0; j < s->p; j++) {
        memset(s->work, 0, (size_t)width * sizeof(double));
        s->work[j] = sqrt(prior) * s->theta[j * s->ny];
        rotate(s, j);
    }
}

/* theta by back-substitution; a direction that no row has moved in counts as zero. */
static void solve(const parts *s)
{
    const long p = s->p, ny = s->ny, width = p + ny;
    for (long i = p - 1; i >= 0; i--) {
        const double *r = s->triangle + i * width;
        for (long k = 0; k < ny; k++) {
            double left = r[p + k];
            for (long j = i + 1; j < p; j++) left -= r[j] * s->theta[j * ny + k];
            s->theta[i * ny + k] = r[i] != 0.0 ? left / r[i] : 0.0;
        }
    }
}

/* What the next prediction is made of: the last output while there is nothing to predict by. */
static void prepare(const parts *s)
{
    const long first = s->order * s->ny;
    if (s->head[SEEN] < s->head[ORDER] || s->head[ROWS] < s->head[BURN_IN]) {
        memcpy(s->free, s->row, (size_t)s->ny * sizeof(double));
        memset(s->gain, 0, (size_t)(s->nu * s->ny) * sizeof(double));
        return;
    }
    memcpy(s->gain, s->theta + first * s->ny, (size_t)(s->nu * s->ny) * sizeof(double));
    for (long k = 0; k < s->ny; k++) {
        double sum = 0.0;
        for (long j = 0; j < s->p; j++)
            if (j < first || j >= first + s->nu) sum += s->row[j] * s->theta[j * s->ny + k];
        s->free[k] = sum;
    }
}

static void learn(const parts *s, const double *u, const double *y)
{
    const long p = s->p, ny = s->ny, nu = s->nu, width = p + ny, first = s->order * ny;
    memcpy(s->row + first, u, (size_t)nu * sizeof(double));
    if (s->head[SEEN] >= s->head[ORDER]) {
        if (s->head[FORGETTING] != 1.0) {
            const double root = sqrt(s->head[FORGETTING]);
            for (long i = 0; i < p * width; i++) s->triangle[i] *= root;
        }
        memcpy(s->work, s->row, (size_t)p * sizeof(double));
        memcpy(s->work + p, y, (size_t)ny * sizeof(double));
        rotate(s, 0);
        s->head[ROWS] += 1.0;
        if (s->head[ROWS] == s->head[BURN_IN]) regularise(s);
        if (s->head[ROWS] >= s->head[BURN_IN]) solve(s);
    }
    memmove(s->row + ny, s->row, (size_t)(first - ny) * sizeof(double));
    memcpy(s->row, y, (size_t)ny * sizeof(double));
    memmove(s->row + first + nu, s->row + first, (size_t)((s->order - 1) * nu) * sizeof(double));
    s->head[SEEN] += 1.0;
    prepare(s);
}

/* The sample that stands in the memory. */
EXPORT void sysid_rls_step(double *memory)
{
    const parts s = divided(memory);
    learn(&s, s.u, s.y);
}

/* n samples: inputs u (n, nu), the outputs y (n, ny) that they led to, guesses (n, ny), each made before its output is
   seen. With n = 0 only the next prediction is prepared. */
EXPORT void sysid_rls_run(double *memory, long n, const double *u, const double *y, double *guesses)
{
    const parts s = divided(memory);
    if (n == 0) prepare(&s);
    for (long k = 0; k < n; k++, u += s.nu, y += s.ny, guesses += s.ny) {
        for (long i = 0; i < s.ny; i++) {
            guesses[i] = s.free[i];
            for (long j = 0; j < s.nu; j++) guesses[i] += u[j] * s.gain[j * s.ny + i];
        }
        learn(&s, u, y);
    }
}

/* n rows (n, p + 1), regressors and target, rotated into a triangle (p, p + 1); before every group of rows what stands
   in it is multiplied by root, the square root of the forgetting factor. work (p + 1). */
EXPORT void sysid_rotate_rows(double *triangle, double *work, long p, long n, long group, double root, const double *rows)
{
    parts s;
    memset(&s, 0, sizeof s);
    s.p = p;
    s.ny = 1;
    s.triangle = triangle;
    s.work = work;
    for (long k = 0; k < n; k++, rows += p + 1) {
        if (root != 1.0 && k % group == 0)
            for (long i = 0; i < p * (p + 1); i++) triangle[i] *= root;
        memcpy(work, rows, (size_t)(p + 1) * sizeof(double));
        rotate(&s, 0);
    }
}
