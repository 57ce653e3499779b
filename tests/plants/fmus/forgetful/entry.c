/* An FMU whose reset or whose kept states do not bring it back, in the way that its parameter "mode" says. */
#define fmi2Reset usual_reset
#define fmi2SetFMUstate usual_set_state
#define fmi2DoStep usual_step
#include "fmi.c"
#undef fmi2Reset
#undef fmi2SetFMUstate
#undef fmi2DoStep

static double given; /* the start value of y that was last set before a run */

EXPORT fmi2Status fmi2Reset(fmi2Component c)
{
    Instance *m = c;
    double y = m->state.v[V_y], mode = m->state.v[V_mode];
    if (mode == KEEPS_START && y > 50) given = 100; /* was started there */
    fmi2Status status = usual_reset(c);
    if (mode == KEEPS_STATE) m->state.v[V_y] = y;
    if (mode == KEEPS_START) m->state.v[V_y] = given;
    return status;
}
EXPORT fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate state)
{
    Instance *m = c;
    return m->state.v[V_mode] == LOSES_SNAPSHOT ? fmi2OK : usual_set_state(c, state);
}
/* Like FMUs of one public library: a step that may be taken back leaves the state as it was. */
EXPORT fmi2Status fmi2DoStep(fmi2Component c, fmi2Real t, fmi2Real h, fmi2Boolean no_way_back)
{
    Instance *m = c;
    double y = m->state.v[V_y];
    fmi2Status status = usual_step(c, t, h, no_way_back);
    if (m->state.v[V_mode] == STANDS_STILL && !no_way_back) m->state.v[V_y] = y;
    return status;
}
