/* Model exchange entry points around the co-simulation wrapper. */
#define fmi2Instantiate usual_instantiate2
#define fmi3InstantiateModelExchange usual_instantiate3
#define fmi3UpdateDiscreteStates usual_update
#define fmi3CompletedIntegratorStep usual_completed
#define fmi3SetTime usual_time
#define fmi3SetContinuousStates usual_set
#define fmi3GetContinuousStateDerivatives usual_rates
#define fmi3GetEventIndicators usual_indicators
#define fmi3GetContinuousStates usual_get
#define fmi3GetNominalsOfContinuousStates usual_nominals
#define fmi3EnterEventMode usual_event
#define fmi3EnterContinuousTimeMode usual_continuous
#define fmi2GetDirectionalDerivative usual_slope2
#define fmi3GetDirectionalDerivative usual_slope3
#include "fmi.c"
#undef fmi2Instantiate
#undef fmi3InstantiateModelExchange
#undef fmi3UpdateDiscreteStates
#undef fmi3CompletedIntegratorStep
#undef fmi3SetTime
#undef fmi3SetContinuousStates
#undef fmi3GetContinuousStateDerivatives
#undef fmi3GetEventIndicators
#undef fmi3GetContinuousStates
#undef fmi3GetNominalsOfContinuousStates
#undef fmi3EnterEventMode
#undef fmi3EnterContinuousTimeMode
#undef fmi2GetDirectionalDerivative
#undef fmi3GetDirectionalDerivative

#define V ((Instance *)c)->state.v
#define FRESH ((Instance *)c)->state.stale = true

static int discrete(void *c, int *changed, int *terminate, int *defined, double *next)
{
    *changed = 0;
    if (V[V_h] <= 0 && V[V_v] < 0) { V[V_h] = 0; V[V_v] *= -V[V_e]; *changed = 1; }
    if (!V[KICKED] && V[V_time] >= V[V_when] - 1e-9) { V[V_v] += V[V_dv]; V[KICKED] = 1; *changed = 1; }
    *terminate = V[V_time] >= V[V_end];
    *defined = !V[KICKED];
    *next = V[V_when];
    FRESH;
    return 0;
}

/* d(der(h), der(v), height_mm) / d(v, u, h) are 1, 1 and 1000; all others are 0 */
static void slope(const VR unknown[], size_t n, const VR known[], size_t m, const double seed[], double result[])
{
    for (size_t i = 0; i < n; i++) {
        result[i] = 0;
        for (size_t j = 0; j < m; j++) {
            if (unknown[i] == V_der_h_ && known[j] == V_v) result[i] += seed[j];
            if (unknown[i] == V_der_v_ && known[j] == V_u) result[i] += seed[j];
            if (unknown[i] == V_height_mm && known[j] == V_h) result[i] += 1000 * seed[j];
        }
    }
}

#if FMI == 2
#define STATUS fmi2Status
#define NAME(x) fmi2##x
#define REAL fmi2Real
EXPORT fmi2Component fmi2Instantiate(fmi2String name, fmi2Type kind, fmi2String token, fmi2String resources, const fmi2CallbackFunctions *functions, fmi2Boolean visible, fmi2Boolean logging)
{
    (void)resources, (void)visible, (void)logging;
    return kind == fmi2ModelExchange ? create(name, token, NULL, (void *)functions) : NULL;
}
typedef struct { fmi2Boolean again, terminate, nominals, values, defined; fmi2Real next; } Info;
EXPORT STATUS fmi2GetDirectionalDerivative(fmi2Component c, const VR unknown[], size_t n, const VR known[], size_t m, const REAL seed[], REAL result[]) { (void)c; slope(unknown, n, known, m, seed, result); return fmi2OK; }
EXPORT STATUS fmi2NewDiscreteStates(fmi2Component c, Info *info)
{
    info->again = info->nominals = 0;
    discrete(c, &info->values, &info->terminate, &info->defined, &info->next);
    return fmi2OK;
}
EXPORT STATUS fmi2CompletedIntegratorStep(fmi2Component c, fmi2Boolean no_rollback, fmi2Boolean *event, fmi2Boolean *terminate) { (void)no_rollback; *event = 0; *terminate = V[V_time] >= V[V_end]; return fmi2OK; }
EXPORT STATUS fmi2GetDerivatives(fmi2Component c, REAL dx[], size_t n) { (void)n; dx[0] = V[V_v]; dx[1] = V[V_u] - V[V_g]; return fmi2OK; }
#else
#define STATUS fmi3Status
#define NAME(x) fmi3##x
#define REAL fmi3Float64
EXPORT In fmi3InstantiateModelExchange(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible, fmi3Boolean logging, fmi3InstanceEnvironment environment, fmi3LogMessageCallback logger)
{
    (void)resources, (void)visible, (void)logging;
    union { fmi3LogMessageCallback call; void *data; } kept = {logger};
    return create(name, token, environment, kept.data);
}
EXPORT STATUS fmi3GetDirectionalDerivative(In c, const VR unknown[], size_t n, const VR known[], size_t m, const REAL seed[], size_t n_seed, REAL result[], size_t n_result) { (void)c, (void)n_seed, (void)n_result; slope(unknown, n, known, m, seed, result); return fmi3OK; }
EXPORT STATUS fmi3UpdateDiscreteStates(In c, fmi3Boolean *again, fmi3Boolean *terminate, fmi3Boolean *nominals, fmi3Boolean *values, fmi3Boolean *defined, fmi3Float64 *next)
{
    int changed, end, due;
    discrete(c, &changed, &end, &due, next);
    *again = *nominals = false;
    *values = changed, *terminate = end, *defined = due;
    return fmi3OK;
}
EXPORT STATUS fmi3CompletedIntegratorStep(In c, fmi3Boolean no_rollback, fmi3Boolean *event, fmi3Boolean *terminate) { (void)no_rollback; *event = false; *terminate = V[V_time] >= V[V_end]; return fmi3OK; }
EXPORT STATUS fmi3GetContinuousStateDerivatives(In c, REAL dx[], size_t n) { (void)n; dx[0] = V[V_v]; dx[1] = V[V_u] - V[V_g]; return fmi3OK; }
#endif
EXPORT STATUS NAME(EnterEventMode)(void *c) { (void)c; return 0; }
EXPORT STATUS NAME(EnterContinuousTimeMode)(void *c) { (void)c; return 0; }
EXPORT STATUS NAME(SetTime)(void *c, REAL t) { V[V_time] = t; FRESH; return 0; }
EXPORT STATUS NAME(SetContinuousStates)(void *c, const REAL x[], size_t n) { (void)n; V[V_h] = x[0]; V[V_v] = x[1]; FRESH; return 0; }
EXPORT STATUS NAME(GetContinuousStates)(void *c, REAL x[], size_t n) { (void)n; x[0] = V[V_h]; x[1] = V[V_v]; return 0; }
EXPORT STATUS NAME(GetNominalsOfContinuousStates)(void *c, REAL x[], size_t n) { (void)c, (void)n; x[0] = x[1] = 1; return 0; }
EXPORT STATUS NAME(GetEventIndicators)(void *c, REAL z[], size_t n) { (void)n; z[0] = V[V_h] + (V[V_h] == 0 && V[V_v] > 0 ? 1e-9 : 0); return 0; }
