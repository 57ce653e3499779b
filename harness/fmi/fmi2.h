/* FMI 2.0 co-simulation entry points of fmi.c. */
#ifndef FMI_HEADERS
typedef void *fmi2Component, *fmi2ComponentEnvironment, *fmi2FMUstate;
typedef unsigned int fmi2ValueReference;
typedef double fmi2Real;
typedef int fmi2Integer, fmi2Boolean;
typedef char fmi2Char, fmi2Byte;
typedef const fmi2Char *fmi2String;
typedef enum { fmi2OK, fmi2Warning, fmi2Discard, fmi2Error, fmi2Fatal, fmi2Pending } fmi2Status;
typedef enum { fmi2ModelExchange, fmi2CoSimulation } fmi2Type;
typedef enum { fmi2DoStepStatus, fmi2PendingStatus, fmi2LastSuccessfulTime, fmi2Terminated } fmi2StatusKind;
typedef struct {
    void (*logger)(fmi2ComponentEnvironment, fmi2String, fmi2Status, fmi2String, fmi2String, ...);
    void *(*allocateMemory)(size_t, size_t);
    void (*freeMemory)(void *);
    void (*stepFinished)(fmi2ComponentEnvironment, fmi2Status);
    fmi2ComponentEnvironment componentEnvironment;
} fmi2CallbackFunctions;
#endif
typedef fmi2ValueReference VR;

static void say(const Instance *m, const char *message)
{
    const fmi2CallbackFunctions *f = m->logger;
    if (f && f->logger) f->logger(f->componentEnvironment, m->name, fmi2Error, "logStatusError", "%s", message);
}

EXPORT const char *fmi2GetTypesPlatform(void) { return "default"; }
EXPORT const char *fmi2GetVersion(void) { return "2.0"; }

EXPORT fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean on, size_t n, const fmi2String categories[])
{
    (void)c, (void)on, (void)n, (void)categories;
    return fmi2OK;
}

EXPORT fmi2Component fmi2Instantiate(fmi2String name, fmi2Type kind, fmi2String token, fmi2String resources,
                                     const fmi2CallbackFunctions *functions, fmi2Boolean visible, fmi2Boolean logging)
{
    (void)resources, (void)visible, (void)logging;
    return kind == fmi2CoSimulation ? create(name, token, NULL, (void *)functions) : NULL;
}

EXPORT void fmi2FreeInstance(fmi2Component c) { free(c); }

EXPORT fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean has_tolerance, fmi2Real tolerance, fmi2Real t,
                                      fmi2Boolean has_stop, fmi2Real stop)
{
    (void)has_tolerance, (void)tolerance, (void)has_stop, (void)stop;
    ((Instance *)c)->state.v[V_time] = t;
    return fmi2OK;
}

EXPORT fmi2Status fmi2EnterInitializationMode(fmi2Component c) { return begin(c, ((Instance *)c)->state.v[V_time]); }
EXPORT fmi2Status fmi2ExitInitializationMode(fmi2Component c) { return finish(c); }

EXPORT fmi2Status fmi2Terminate(fmi2Component c)
{
    ((Instance *)c)->state.phase = TERMINATED;
    return fmi2OK;
}

EXPORT fmi2Status fmi2Reset(fmi2Component c)
{
    start(c);
    return fmi2OK;
}

#define ACCESSORS(Name, Type)                                                                          \
    EXPORT fmi2Status fmi2Get##Name(fmi2Component c, const VR vr[], size_t n, Type value[])            \
    {                                                                                                  \
        for (size_t i = 0; i < n; i++) {                                                               \
            double x;                                                                                  \
            if (get_value(c, vr[i], &x)) return fmi2Error;                                             \
            value[i] = (Type)x;                                                                        \
        }                                                                                              \
        return fmi2OK;                                                                                 \
    }                                                                                                  \
    EXPORT fmi2Status fmi2Set##Name(fmi2Component c, const VR vr[], size_t n, const Type value[])      \
    {                                                                                                  \
        for (size_t i = 0; i < n; i++)                                                                 \
            if (set_value(c, vr[i], (double)value[i])) return fmi2Error;                               \
        return fmi2OK;                                                                                 \
    }
ACCESSORS(Real, fmi2Real)
ACCESSORS(Integer, fmi2Integer)
ACCESSORS(Boolean, fmi2Boolean)

EXPORT fmi2Status fmi2GetString(fmi2Component c, const VR vr[], size_t n, fmi2String value[])
{
    (void)vr, (void)value;
    return n == 0 ? fmi2OK : (fmi2Status)fail(c, "no variable of this type");
}
EXPORT fmi2Status fmi2SetString(fmi2Component c, const VR vr[], size_t n, const fmi2String value[])
{
    (void)vr, (void)value;
    return n == 0 ? fmi2OK : (fmi2Status)fail(c, "no variable of this type");
}

EXPORT fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *state) { return keep_state(c, state); }
EXPORT fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate state) { return restore_state(c, state); }
EXPORT fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *state)
{
    (void)c;
    return drop_state(state);
}
EXPORT fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, fmi2FMUstate state, size_t *size)
{
    (void)c, (void)state;
    *size = sizeof(State);
    return fmi2OK;
}
EXPORT fmi2Status fmi2SerializeFMUstate(fmi2Component c, fmi2FMUstate state, fmi2Byte bytes[], size_t size)
{
    (void)c;
    return (fmi2Status)write_state(state, (unsigned char *)bytes, size);
}
EXPORT fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte bytes[], size_t size, fmi2FMUstate *state)
{
    (void)c;
    return (fmi2Status)read_state((const unsigned char *)bytes, size, state);
}

#define REFUSE(Name, Words, ...)                                                                       \
    EXPORT fmi2Status Name(fmi2Component c, const VR vr[], size_t n, __VA_ARGS__) { return (fmi2Status)fail(c, Words); }
#pragma GCC diagnostic push
#pragma GCC diagnostic ignored "-Wunused-parameter"
REFUSE(fmi2GetDirectionalDerivative, "directional derivatives are not offered", const VR known[], size_t m,
       const fmi2Real seed[], fmi2Real result[])
REFUSE(fmi2SetRealInputDerivatives, "inputs are not interpolated", const fmi2Integer order[], const fmi2Real value[])
REFUSE(fmi2GetRealOutputDerivatives, "output derivatives are not offered", const fmi2Integer order[], fmi2Real value[])
#pragma GCC diagnostic pop

EXPORT fmi2Status fmi2DoStep(fmi2Component c, fmi2Real t, fmi2Real h, fmi2Boolean no_rollback)
{
    (void)no_rollback;
    return (fmi2Status)do_step(c, t, h);
}
EXPORT fmi2Status fmi2CancelStep(fmi2Component c) { return (fmi2Status)fail(c, "no step is pending"); }

#define DISCARD(Name, Type)                                                                            \
    EXPORT fmi2Status Name(fmi2Component c, const fmi2StatusKind kind, Type *value)                    \
    {                                                                                                  \
        (void)c, (void)kind, (void)value;                                                              \
        return fmi2Discard;                                                                            \
    }
DISCARD(fmi2GetStatus, fmi2Status)
DISCARD(fmi2GetIntegerStatus, fmi2Integer)
DISCARD(fmi2GetStringStatus, fmi2String)
EXPORT fmi2Status fmi2GetRealStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Real *value)
{
    if (kind != fmi2LastSuccessfulTime) return fmi2Discard;
    *value = ((Instance *)c)->state.v[V_time];
    return fmi2OK;
}
EXPORT fmi2Status fmi2GetBooleanStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Boolean *value)
{
    if (kind != fmi2Terminated) return fmi2Discard;
    *value = ((Instance *)c)->state.phase == TERMINATED;
    return fmi2OK;
}
