/* The FMI 2.0 and FMI 3.0 co-simulation interface of a mockup; its physics stands in model.c, its variables in
   modelDescription.xml. One source for both versions: compile with -DFMI=2 or -DFMI=3.

   All variables are doubles in one array v, so that a snapshot is a copy of it. -DFMI_HEADERS compiles against the
   standard's own headers, which proves the signatures below. */
#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "variables.h" /* V_name, VARIABLES, START, ACCESS, TOKEN: written from modelDescription.xml */

/* One step of the classical Runge-Kutta method for n <= 8 states. */
typedef void Rates(const double *v, const double *x, double *dx);

static inline void runge_kutta(Rates *rates, const double *v, double *x, int n, double h)
{
    double k1[8], k2[8], k3[8], k4[8], z[8];
    rates(v, x, k1);
    for (int i = 0; i < n; i++) z[i] = x[i] + 0.5 * h * k1[i];
    rates(v, z, k2);
    for (int i = 0; i < n; i++) z[i] = x[i] + 0.5 * h * k2[i];
    rates(v, z, k3);
    for (int i = 0; i < n; i++) z[i] = x[i] + h * k3[i];
    rates(v, z, k4);
    for (int i = 0; i < n; i++) x[i] += h / 6 * (k1[i] + 2 * (k2[i] + k3[i]) + k4[i]);
}

/* Parts of model.c that most models have alike. */
#define NOTHING_PREPARED static void prepare(double *v) { (void)v; }
#define OWN_SUBSTEP static double internal_step(const double *v) { return v[V_substep]; }
#define NO_MOTION                                                                                      \
    static double internal_step(const double *v)                                                       \
    {                                                                                                  \
        (void)v;                                                                                       \
        return HUGE_VAL;                                                                               \
    }                                                                                                  \
    static void advance(double *v, double h) { (void)v, (void)h; }

/* model.c defines: MEMORY (slots of v beyond the declared variables); check(v), a complaint or NULL; prepare(v),
   after initialisation; internal_step(v) in s; advance(v, h), one internal step; evaluate(v), all that is calculated. */
#include "model.c"

#ifdef _WIN32
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif

#ifdef FMI_HEADERS
#if FMI == 2
#include "fmi2Functions.h"
#else
#include "fmi3Functions.h"
#endif
#endif

enum { OK = 0, DISCARD = 2, ERROR = 3 };
enum { INSTANTIATED, INITIALIZING, STEPPING, TERMINATED };

typedef struct {
    double v[VARIABLES + MEMORY];
    int phase;
    bool stale; /* calculated variables wait for evaluate() */
} State;

typedef struct {
    State state;
    void *environment;
    void *logger;
    char name[64];
} Instance;

static void say(const Instance *m, const char *message);

static int fail(Instance *m, const char *message)
{
    m->state.phase = TERMINATED;
    say(m, message);
    return ERROR;
}

static void start(Instance *m)
{
    memset(&m->state, 0, sizeof m->state);
    memcpy(m->state.v, START, sizeof START);
    m->state.stale = true;
}

static Instance *create(const char *name, const char *token, void *environment, void *logger)
{
    Instance *m = calloc(1, sizeof *m);
    if (!m) return NULL;
    m->environment = environment;
    m->logger = logger;
    snprintf(m->name, sizeof m->name, "%s", name ? name : "");
    if (!token || strcmp(token, TOKEN) != 0) {
        say(m, "the instantiation token is not that of this model");
        free(m);
        return NULL;
    }
    start(m);
    return m;
}

static int set_value(Instance *m, unsigned vr, double value)
{
    if (vr >= VARIABLES || ACCESS[vr] == 'c') return fail(m, "a variable that cannot be set");
    if ((ACCESS[vr] == 'f' || ACCESS[vr] == 'x') && m->state.phase > INITIALIZING)
        return fail(m, "a start value or fixed parameter set after the initialisation");
    m->state.v[vr] = value;
    m->state.stale = true;
    return OK;
}

static int get_value(Instance *m, unsigned vr, double *value)
{
    if (vr >= VARIABLES) return fail(m, "a variable that does not exist");
    if (m->state.stale && ACCESS[vr] == 'c') {
        evaluate(m->state.v);
        m->state.stale = false;
    }
    *value = m->state.v[vr];
    return OK;
}

static int begin(Instance *m, double t)
{
    if (m->state.phase != INSTANTIATED) return fail(m, "initialisation of a model that is already initialised");
    m->state.v[V_time] = t;
    m->state.phase = INITIALIZING;
    return OK;
}

static int finish(Instance *m)
{
    if (m->state.phase != INITIALIZING) return fail(m, "initialisation left without being entered");
    const char *complaint = check(m->state.v);
    if (complaint) return fail(m, complaint);
    prepare(m->state.v);
    m->state.stale = true;
    m->state.phase = STEPPING;
    return OK;
}

static int do_step(Instance *m, double t, double h)
{
    double *v = m->state.v;
    if (m->state.phase != STEPPING) return fail(m, "a step outside step mode");
    if (!(h >= 0) || isinf(h)) return fail(m, "a step size that is negative or not finite");
    const char *complaint = check(v); /* tunable parameters may have moved */
    if (complaint) return fail(m, complaint);
    double wanted = ceil(h / internal_step(v) - 1e-9);
    if (!(wanted <= 1e9)) return fail(m, "a step size beyond 1e9 internal steps");
    long n = wanted < 1 ? 1 : (long)wanted;
    for (long i = 0; i < n; i++) {
        v[V_time] = t + h * (double)i / (double)n;
        advance(v, h / (double)n);
    }
    v[V_time] = t + h;
    m->state.stale = true;
    return OK;
}

static int keep_state(const Instance *m, void **slot)
{
    if (!*slot) *slot = malloc(sizeof(State));
    if (!*slot) return ERROR;
    memcpy(*slot, &m->state, sizeof(State));
    return OK;
}

static int restore_state(Instance *m, const void *slot)
{
    if (!slot) return ERROR;
    memcpy(&m->state, slot, sizeof(State));
    return OK;
}

static int drop_state(void **slot)
{
    if (slot) {
        free(*slot);
        *slot = NULL;
    }
    return OK;
}

static int write_state(const void *state, unsigned char *bytes, size_t size)
{
    if (size < sizeof(State)) return ERROR;
    memcpy(bytes, state, sizeof(State));
    return OK;
}

static int read_state(const unsigned char *bytes, size_t size, void **slot)
{
    if (size < sizeof(State)) return ERROR;
    if (!*slot) *slot = malloc(sizeof(State));
    if (!*slot) return ERROR;
    memcpy(*slot, bytes, sizeof(State));
    return OK;
}

#if FMI == 2
#include "fmi2.h"
#else
#include "fmi3.h"
#endif
