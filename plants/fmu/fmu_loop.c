/* Many co-simulation steps of an FMU in one call: set inputs, step, get outputs, through the FMU's own functions.

   The Python side fills the structures below; it takes over wherever a step ends in anything but success. */
#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#ifdef _WIN32
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif

enum { F64, F32, I8, U8, I16, U16, I32, U32, I64, U64, BOOL8, BOOL32 };
enum { FINE, SET_FAILED, STEP_FAILED, GET_FAILED, OUTPUT_NOT_FINITE, INPUT_NOT_FINITE, STEP_INTERRUPTED };

typedef struct {
    void *call;         /* fmi2SetReal and the like */
    const unsigned *vr; /* n_vr value references */
    const double *scale, *offset; /* column = scale * value + offset; n of each */
    void *buffer;       /* n values of the FMU's type */
    int64_t n_vr, n, first; /* the group's columns are first .. first + n - 1 */
    int32_t type;
} Group;

typedef struct {
    void *component, *do_step;
    Group *in, *out;
    double *u, *y; /* one row each, for one() */
    double t0, h; /* h: communication step */
    int64_t n_in, n_out, nu, ny, substeps, k, done, sub, warnings;
    int32_t version, rollback, status, what;
    uint8_t event, terminate, early;
    double last;
} Loop;

typedef int Get12(void *, const unsigned *, size_t, void *);
typedef int Get3(void *, const unsigned *, size_t, void *, size_t);
typedef int Step1(void *, double, double, char);
typedef int Step2(void *, double, double, int);
typedef int Step3(void *, double, double, bool, bool *, bool *, bool *, double *);

static int call(const Loop *loop, const Group *g)
{
    if (loop->version == 3) return ((Get3 *)g->call)(loop->component, g->vr, g->n_vr, g->buffer, g->n);
    return ((Get12 *)g->call)(loop->component, g->vr, g->n_vr, g->buffer);
}

#define WRITE(Type, rounded)                                                              \
    for (int64_t i = 0; i < g->n; i++) {                                                  \
        const double x = (u[g->first + i] - g->offset[i]) / g->scale[i];                  \
        ((Type *)g->buffer)[i] = (Type)(rounded);                                         \
    }                                                                                     \
    break;
#define READ(Type)                                                                        \
    for (int64_t i = 0; i < g->n; i++)                                                    \
        y[g->first + i] = g->scale[i] * (double)((Type *)g->buffer)[i] + g->offset[i];    \
    break;

static int set(Loop *loop, const double *u)
{
    for (int64_t j = 0; j < loop->nu; j++)
        if (!isfinite(u[j])) return loop->what = INPUT_NOT_FINITE;
    for (int64_t j = 0; j < loop->n_in; j++) {
        const Group *g = loop->in + j;
        switch (g->type) {
        case F64: WRITE(double, x)
        case F32: WRITE(float, x)
        case I8: WRITE(int8_t, nearbyint(x))
        case U8: WRITE(uint8_t, nearbyint(x))
        case I16: WRITE(int16_t, nearbyint(x))
        case U16: WRITE(uint16_t, nearbyint(x))
        case I32: WRITE(int32_t, nearbyint(x))
        case U32: WRITE(uint32_t, nearbyint(x))
        case I64: WRITE(int64_t, nearbyint(x))
        case U64: WRITE(uint64_t, nearbyint(x))
        case BOOL8: WRITE(uint8_t, x != 0)
        case BOOL32: WRITE(int32_t, x != 0)
        }
        loop->status = call(loop, g);
        if (loop->status > 1) return loop->what = SET_FAILED;
        loop->warnings += loop->status == 1;
    }
    return 0;
}

static int get(Loop *loop, double *y)
{
    for (int64_t j = 0; j < loop->n_out; j++) {
        const Group *g = loop->out + j;
        loop->status = call(loop, g);
        if (loop->status > 1) return loop->what = GET_FAILED;
        loop->warnings += loop->status == 1;
        switch (g->type) {
        case F64: READ(double)
        case F32: READ(float)
        case I8: READ(int8_t)
        case U8: READ(uint8_t)
        case I16: READ(int16_t)
        case U16: READ(uint16_t)
        case I32: READ(int32_t)
        case U32: READ(uint32_t)
        case I64: READ(int64_t)
        case U64: READ(uint64_t)
        case BOOL8: READ(uint8_t)
        case BOOL32: READ(int32_t)
        }
    }
    for (int64_t j = 0; j < loop->ny; j++)
        if (!isfinite(y[j])) return loop->what = OUTPUT_NOT_FINITE;
    return 0;
}

static int advance(Loop *loop, double t)
{
    if (loop->version == 1) return ((Step1 *)loop->do_step)(loop->component, t, loop->h, 1);
    if (loop->version == 2) return ((Step2 *)loop->do_step)(loop->component, t, loop->h, !loop->rollback);
    bool event = false, terminate = false, early = false;
    const int status = ((Step3 *)loop->do_step)(loop->component, t, loop->h, !loop->rollback, &event, &terminate,
                                                &early, &loop->last);
    loop->event = event, loop->terminate = terminate, loop->early = early;
    return status;
}

/* Apply n rows of u; row i of y is what step i led to. Returns 0, or what stopped it (done rows are complete). */
EXPORT int run(Loop *loop, const double *u, double *y, int64_t n)
{
    loop->what = loop->done = 0;
    for (int64_t i = 0; i < n; i++, u += loop->nu, y += loop->ny) {
        if (set(loop, u)) return loop->what;
        for (loop->sub = 0; loop->sub < loop->substeps; loop->sub++) {
            loop->status = advance(loop, loop->t0 + (double)(loop->k * loop->substeps + loop->sub) * loop->h);
            if (loop->status > 1) return loop->what = STEP_FAILED;
            loop->warnings += loop->status == 1;
            if (loop->version == 3 && (loop->event || loop->terminate || loop->early))
                return loop->what = STEP_INTERRUPTED;
        }
        if (get(loop, y)) return loop->what;
        loop->k++;
        loop->done++;
    }
    return 0;
}

EXPORT int one(Loop *loop) { return run(loop, loop->u, loop->y, 1); }

EXPORT int look(Loop *loop)
{
    loop->what = 0;
    return get(loop, loop->y);
}

EXPORT int peek(Loop *loop)
{
    loop->what = 0;
    if (set(loop, loop->u)) return loop->what;
    return get(loop, loop->y);
}
