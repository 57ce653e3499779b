/* FMI 3.0 co-simulation in event mode, strict about what may be called when. */
#define fmi3InstantiateCoSimulation usual_instantiate
#define fmi3ExitInitializationMode usual_exit
#define fmi3EnterEventMode usual_event
#define fmi3EnterStepMode usual_step_mode
#define fmi3UpdateDiscreteStates usual_update
#define fmi3SetInt32 usual_set
#define fmi3DoStep usual_step
#include "fmi.c"
#undef fmi3InstantiateCoSimulation
#undef fmi3ExitInitializationMode
#undef fmi3EnterEventMode
#undef fmi3EnterStepMode
#undef fmi3UpdateDiscreteStates
#undef fmi3SetInt32
#undef fmi3DoStep

#define M ((Instance *)c)
#define V M->state.v
#define USED (M->name[0] == 'e') /* the name is not needed: it keeps what was asked for at the instantiation */
#define EARLY (M->name[1] == 'e')
#define NEED(mode, what) do { if (V[MODE] != (mode)) return (fmi3Status)fail(c, what); } while (0)

EXPORT In fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible, fmi3Boolean logging, fmi3Boolean events, fmi3Boolean early, const VR intermediate[], size_t n, fmi3InstanceEnvironment environment, fmi3LogMessageCallback logger, fmi3IntermediateUpdateCallback update)
{
    In c = usual_instantiate(name, token, resources, visible, logging, events, early, intermediate, n, environment, logger, update);
    if (c) M->name[0] = events ? 'e' : '-', M->name[1] = early ? 'e' : '-';
    return c;
}
EXPORT fmi3Status fmi3ExitInitializationMode(In c) { V[MODE] = USED ? EVENTS : INSIDE; return usual_exit(c); }
EXPORT fmi3Status fmi3EnterEventMode(In c) { NEED(STEPS, "event mode from outside step mode"); V[MODE] = EVENTS; V[V_entries]++; return fmi3OK; }
EXPORT fmi3Status fmi3EnterStepMode(In c) { NEED(EVENTS, "step mode from outside event mode"); V[MODE] = STEPS; return fmi3OK; }
EXPORT fmi3Status fmi3SetInt32(In c, const VR vr[], size_t n, const fmi3Int32 values[], size_t n_values)
{
    if (M->state.phase == STEPPING && V[MODE] == STEPS) return (fmi3Status)fail(c, "a discrete input set in step mode");
    return usual_set(c, vr, n, values, n_values);
}
static void kick(In c) { V[V_gain] *= 2; V[KICKED] = 1; }
EXPORT fmi3Status fmi3UpdateDiscreteStates(In c, fmi3Boolean *again, fmi3Boolean *terminate, fmi3Boolean *nominals, fmi3Boolean *values, fmi3Boolean *defined, fmi3Float64 *next)
{
    NEED(EVENTS, "discrete states updated outside event mode");
    *again = *nominals = *values = false;
    if (V[PENDING]) V[PENDING] = 0, V[V_y] -= V[V_level], V[V_count]++, *again = *values = true;
    if (!V[KICKED] && V[V_time] >= V[V_when] - 1e-9) kick(c);
    *terminate = V[V_count] >= V[V_limit];
    *defined = !V[KICKED];
    *next = V[V_when];
    return fmi3OK;
}

/* The time from now to the next event, at most h. */
static double to_event(In c, double h)
{
    double rate = V[V_gain] * V[V_sign] * V[V_u], left = h;
    if (rate > 0 && (V[V_level] - V[V_y]) / rate < left) left = (V[V_level] - V[V_y]) / rate;
    return left > 0 ? left : 0;
}
EXPORT fmi3Status fmi3DoStep(In c, fmi3Float64 t, fmi3Float64 h, fmi3Boolean no_rollback, fmi3Boolean *event, fmi3Boolean *terminate, fmi3Boolean *early, fmi3Float64 *last)
{
    if (USED) {
        NEED(STEPS, "a step outside step mode");
        if (!V[KICKED] && t + h > V[V_when] + 1e-9) return (fmi3Status)fail(c, "a step beyond the next event");
        double part = to_event(c, h);
        bool met = part < h - 1e-12;
        fmi3Status status = usual_step(c, t, met && EARLY ? part : h, no_rollback, event, terminate, early, last);
        if (met) V[PENDING] = 1, *event = true, *early = EARLY;
        return status;
    }
    const double end = t + h;
    fmi3Status status = fmi3OK;
    while (t < end - 1e-12 && status == fmi3OK) {
        double part = to_event(c, end - t);
        bool due = !V[KICKED] && t + part >= V[V_when] - 1e-12;
        if (due) part = V[V_when] - t > 0 ? V[V_when] - t : 0;
        status = usual_step(c, t, part, no_rollback, event, terminate, early, last);
        t += part;
        if (due) kick(c);
        else if (t < end - 1e-12) V[V_y] -= V[V_level], V[V_count]++;
    }
    *last = end;
    return status;
}
