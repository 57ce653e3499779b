/* An FMU that misbehaves in the way its parameter "mode" says, from the time "when" on. */
#define fmi2DoStep usual_step2
#define fmi2GetRealStatus usual_real_status
#define fmi2GetBooleanStatus usual_boolean_status
#define fmi3DoStep usual_step3
#include "fmi.c"
#undef fmi2DoStep
#undef fmi2GetRealStatus
#undef fmi2GetBooleanStatus
#undef fmi3DoStep

static int due(const Instance *m, int mode) { return (int)m->state.v[V_mode] == mode && m->state.v[V_time] >= m->state.v[V_when] - 1e-12; }

#if FMI == 2
EXPORT fmi2Status fmi2DoStep(fmi2Component c, fmi2Real t, fmi2Real h, fmi2Boolean no_rollback)
{
    Instance *m = c;
    m->state.v[V_time] = t;
    if (due(m, DISCARDS) || due(m, TERMINATES)) return fmi2Discard;
    if (due(m, FAILS)) { say(m, "told to fail"); return fmi2Error; }
    if (due(m, FATAL)) return fmi2Fatal;
    if (due(m, PENDS)) return fmi2Pending;
    if (due(m, HALVES) && h > 0.004) { usual_step2(c, t, h / 2, no_rollback); return fmi2Discard; }
    if (due(m, CRAWLS)) { usual_step2(c, t, h * 1e-7, no_rollback); return fmi2Discard; }
    fmi2Status status = usual_step2(c, t, h, no_rollback);
    return due(m, WARNS) ? fmi2Warning : status;
}
EXPORT fmi2Status fmi2GetRealStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Real *value) { return usual_real_status(c, kind, value); }
EXPORT fmi2Status fmi2GetBooleanStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Boolean *value)
{
    (void)kind;
    *value = due(c, TERMINATES);
    return fmi2OK;
}
#else
EXPORT fmi3Status fmi3DoStep(fmi3Instance c, fmi3Float64 t, fmi3Float64 h, fmi3Boolean no_rollback, fmi3Boolean *event,
                             fmi3Boolean *terminate, fmi3Boolean *early, fmi3Float64 *last)
{
    Instance *m = c;
    m->state.v[V_time] = t;
    *event = *terminate = *early = false;
    *last = t;
    if (due(m, DISCARDS)) return fmi3Discard;
    if (due(m, TERMINATES)) { *terminate = true; return fmi3OK; }
    if (due(m, FAILS)) { say(m, "told to fail"); return fmi3Error; }
    if (due(m, FATAL)) return fmi3Fatal;
    if (due(m, HALVES) && h > 0.004) { usual_step3(c, t, h / 2, no_rollback, event, terminate, early, last); *early = true; return fmi3OK; }
    fmi3Status status = usual_step3(c, t, h, no_rollback, event, terminate, early, last);
    return due(m, WARNS) ? fmi3Warning : status;
}
#endif
