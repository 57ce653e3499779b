/* FMI 3.0 co-simulation entry points of fmi.c. */
#ifndef FMI_HEADERS
typedef void *fmi3Instance, *fmi3InstanceEnvironment, *fmi3FMUState;
typedef uint32_t fmi3ValueReference;
typedef float fmi3Float32;
typedef double fmi3Float64;
typedef int8_t fmi3Int8;
typedef uint8_t fmi3UInt8, fmi3Byte;
typedef int16_t fmi3Int16;
typedef uint16_t fmi3UInt16;
typedef int32_t fmi3Int32;
typedef uint32_t fmi3UInt32;
typedef int64_t fmi3Int64;
typedef uint64_t fmi3UInt64;
typedef bool fmi3Boolean, fmi3Clock;
typedef const char *fmi3String;
typedef const fmi3Byte *fmi3Binary;
typedef enum { fmi3OK, fmi3Warning, fmi3Discard, fmi3Error, fmi3Fatal } fmi3Status;
typedef enum { fmi3Independent, fmi3Constant, fmi3Fixed, fmi3Tunable, fmi3Discrete, fmi3Dependent } fmi3DependencyKind;
typedef enum { fmi3IntervalNotYetKnown, fmi3IntervalUnchanged, fmi3IntervalChanged } fmi3IntervalQualifier;
typedef void (*fmi3LogMessageCallback)(fmi3InstanceEnvironment, fmi3Status, fmi3String, fmi3String);
typedef void (*fmi3ClockUpdateCallback)(fmi3InstanceEnvironment);
typedef void (*fmi3IntermediateUpdateCallback)(fmi3InstanceEnvironment, fmi3Float64, fmi3Boolean, fmi3Boolean,
                                               fmi3Boolean, fmi3Boolean, fmi3Boolean *, fmi3Float64 *);
typedef void (*fmi3LockPreemptionCallback)();
typedef void (*fmi3UnlockPreemptionCallback)();
#endif
typedef fmi3Instance In;
typedef fmi3ValueReference VR;

static void say(const Instance *m, const char *message)
{
    union { /* ISO C has no cast between data and function pointers */
        void *data;
        fmi3LogMessageCallback call;
    } logger = {m->logger};
    if (logger.data) logger.call(m->environment, fmi3Error, "logStatusError", message);
}

EXPORT const char *fmi3GetVersion(void) { return "3.0"; }

EXPORT fmi3Status fmi3SetDebugLogging(In c, fmi3Boolean on, size_t n, const fmi3String categories[])
{
    (void)c, (void)on, (void)n, (void)categories;
    return fmi3OK;
}

EXPORT In fmi3InstantiateModelExchange(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
                                       fmi3Boolean logging, fmi3InstanceEnvironment environment,
                                       fmi3LogMessageCallback logger)
{
    (void)name, (void)token, (void)resources, (void)visible, (void)logging, (void)environment, (void)logger;
    return NULL;
}

EXPORT In fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
                                      fmi3Boolean logging, fmi3Boolean events, fmi3Boolean early,
                                      const VR intermediate[], size_t n, fmi3InstanceEnvironment environment,
                                      fmi3LogMessageCallback logger, fmi3IntermediateUpdateCallback update)
{
    union {
        fmi3LogMessageCallback call;
        void *data;
    } kept = {logger};
    (void)resources, (void)visible, (void)logging, (void)events, (void)early, (void)intermediate, (void)n;
    (void)update;
    return create(name, token, environment, kept.data);
}

EXPORT In fmi3InstantiateScheduledExecution(fmi3String name, fmi3String token, fmi3String resources,
                                            fmi3Boolean visible, fmi3Boolean logging,
                                            fmi3InstanceEnvironment environment, fmi3LogMessageCallback logger,
                                            fmi3ClockUpdateCallback update, fmi3LockPreemptionCallback lock,
                                            fmi3UnlockPreemptionCallback unlock)
{
    (void)name, (void)token, (void)resources, (void)visible, (void)logging, (void)environment, (void)logger;
    (void)update, (void)lock, (void)unlock;
    return NULL;
}

EXPORT void fmi3FreeInstance(In c) { free(c); }

EXPORT fmi3Status fmi3EnterInitializationMode(In c, fmi3Boolean has_tolerance, fmi3Float64 tolerance, fmi3Float64 t,
                                              fmi3Boolean has_stop, fmi3Float64 stop)
{
    (void)has_tolerance, (void)tolerance, (void)has_stop, (void)stop;
    return begin(c, t);
}
EXPORT fmi3Status fmi3ExitInitializationMode(In c) { return finish(c); }
EXPORT fmi3Status fmi3EnterStepMode(In c)
{
    (void)c;
    return fmi3OK;
}
EXPORT fmi3Status fmi3Terminate(In c)
{
    ((Instance *)c)->state.phase = TERMINATED;
    return fmi3OK;
}
EXPORT fmi3Status fmi3Reset(In c)
{
    start(c);
    return fmi3OK;
}

#define ACCESSORS(Name)                                                                                             \
    EXPORT fmi3Status fmi3Get##Name(In c, const VR vr[], size_t n, fmi3##Name values[], size_t n_values)            \
    {                                                                                                               \
        if (n != n_values) return (fmi3Status)fail(c, "as many values as variables are wanted");                    \
        for (size_t i = 0; i < n; i++) {                                                                            \
            double x;                                                                                               \
            if (get_value(c, vr[i], &x)) return fmi3Error;                                                          \
            values[i] = (fmi3##Name)x;                                                                              \
        }                                                                                                           \
        return fmi3OK;                                                                                              \
    }                                                                                                               \
    EXPORT fmi3Status fmi3Set##Name(In c, const VR vr[], size_t n, const fmi3##Name values[], size_t n_values)      \
    {                                                                                                               \
        if (n != n_values) return (fmi3Status)fail(c, "as many values as variables are wanted");                    \
        for (size_t i = 0; i < n; i++)                                                                              \
            if (set_value(c, vr[i], (double)values[i])) return fmi3Error;                                           \
        return fmi3OK;                                                                                              \
    }
ACCESSORS(Float64)
ACCESSORS(Int32)
ACCESSORS(Int64)
ACCESSORS(Boolean)

/* Types that no mockup has a variable of. */
#define EMPTY(Name)                                                                                                 \
    EXPORT fmi3Status fmi3Get##Name(In c, const VR vr[], size_t n, fmi3##Name values[], size_t n_values)            \
    {                                                                                                               \
        (void)vr, (void)values, (void)n_values;                                                                     \
        return n == 0 ? fmi3OK : (fmi3Status)fail(c, "no variable of this type");                                   \
    }                                                                                                               \
    EXPORT fmi3Status fmi3Set##Name(In c, const VR vr[], size_t n, const fmi3##Name values[], size_t n_values)      \
    {                                                                                                               \
        (void)vr, (void)values, (void)n_values;                                                                     \
        return n == 0 ? fmi3OK : (fmi3Status)fail(c, "no variable of this type");                                   \
    }
EMPTY(Float32)
EMPTY(Int8)
EMPTY(UInt8)
EMPTY(Int16)
EMPTY(UInt16)
EMPTY(UInt32)
EMPTY(UInt64)
EMPTY(String)

/* Services that no mockup offers. */
#define REFUSE(name, ...)                                                \
    EXPORT fmi3Status name(In c, __VA_ARGS__)                            \
    {                                                                    \
        return (fmi3Status)fail(c, #name " is not offered by this model"); \
    }
#pragma GCC diagnostic push
#pragma GCC diagnostic ignored "-Wunused-parameter"
REFUSE(fmi3GetBinary, const VR vr[], size_t n, size_t sizes[], fmi3Binary values[], size_t n_values)
REFUSE(fmi3SetBinary, const VR vr[], size_t n, const size_t sizes[], const fmi3Binary values[], size_t n_values)
REFUSE(fmi3GetClock, const VR vr[], size_t n, fmi3Clock values[])
REFUSE(fmi3SetClock, const VR vr[], size_t n, const fmi3Clock values[])
REFUSE(fmi3GetNumberOfVariableDependencies, VR vr, size_t *n)
REFUSE(fmi3GetVariableDependencies, VR vr, size_t of[], VR on[], size_t at[], fmi3DependencyKind kinds[], size_t n)
REFUSE(fmi3GetDirectionalDerivative, const VR unknowns[], size_t n, const VR knowns[], size_t m,
       const fmi3Float64 seed[], size_t n_seed, fmi3Float64 result[], size_t n_result)
REFUSE(fmi3GetAdjointDerivative, const VR unknowns[], size_t n, const VR knowns[], size_t m, const fmi3Float64 seed[],
       size_t n_seed, fmi3Float64 result[], size_t n_result)
REFUSE(fmi3GetIntervalDecimal, const VR vr[], size_t n, fmi3Float64 intervals[], fmi3IntervalQualifier qualifiers[])
REFUSE(fmi3GetIntervalFraction, const VR vr[], size_t n, fmi3UInt64 counters[], fmi3UInt64 resolutions[],
       fmi3IntervalQualifier qualifiers[])
REFUSE(fmi3GetShiftDecimal, const VR vr[], size_t n, fmi3Float64 shifts[])
REFUSE(fmi3GetShiftFraction, const VR vr[], size_t n, fmi3UInt64 counters[], fmi3UInt64 resolutions[])
REFUSE(fmi3SetIntervalDecimal, const VR vr[], size_t n, const fmi3Float64 intervals[])
REFUSE(fmi3SetIntervalFraction, const VR vr[], size_t n, const fmi3UInt64 counters[], const fmi3UInt64 resolutions[])
REFUSE(fmi3SetShiftDecimal, const VR vr[], size_t n, const fmi3Float64 shifts[])
REFUSE(fmi3SetShiftFraction, const VR vr[], size_t n, const fmi3UInt64 counters[], const fmi3UInt64 resolutions[])
REFUSE(fmi3UpdateDiscreteStates, fmi3Boolean *again, fmi3Boolean *terminate, fmi3Boolean *nominals, fmi3Boolean *values,
       fmi3Boolean *next, fmi3Float64 *time)
REFUSE(fmi3CompletedIntegratorStep, fmi3Boolean no_rollback, fmi3Boolean *event, fmi3Boolean *terminate)
REFUSE(fmi3SetTime, fmi3Float64 t)
REFUSE(fmi3SetContinuousStates, const fmi3Float64 x[], size_t n)
REFUSE(fmi3GetContinuousStateDerivatives, fmi3Float64 dx[], size_t n)
REFUSE(fmi3GetEventIndicators, fmi3Float64 z[], size_t n)
REFUSE(fmi3GetContinuousStates, fmi3Float64 x[], size_t n)
REFUSE(fmi3GetNominalsOfContinuousStates, fmi3Float64 x[], size_t n)
REFUSE(fmi3GetNumberOfEventIndicators, size_t *n)
REFUSE(fmi3GetNumberOfContinuousStates, size_t *n)
REFUSE(fmi3GetOutputDerivatives, const VR vr[], size_t n, const fmi3Int32 orders[], fmi3Float64 values[],
       size_t n_values)
REFUSE(fmi3ActivateModelPartition, VR clock, fmi3Float64 t)
#pragma GCC diagnostic pop

EXPORT fmi3Status fmi3EnterConfigurationMode(In c)
{
    (void)c;
    return fmi3OK;
}
EXPORT fmi3Status fmi3ExitConfigurationMode(In c)
{
    (void)c;
    return fmi3OK;
}
EXPORT fmi3Status fmi3EnterEventMode(In c) { return (fmi3Status)fail(c, "event mode is not offered"); }
EXPORT fmi3Status fmi3EnterContinuousTimeMode(In c) { return (fmi3Status)fail(c, "not a model exchange FMU"); }
EXPORT fmi3Status fmi3EvaluateDiscreteStates(In c) { return (fmi3Status)fail(c, "no discrete states"); }

EXPORT fmi3Status fmi3GetFMUState(In c, fmi3FMUState *state) { return (fmi3Status)keep_state(c, state); }
EXPORT fmi3Status fmi3SetFMUState(In c, fmi3FMUState state) { return (fmi3Status)restore_state(c, state); }
EXPORT fmi3Status fmi3FreeFMUState(In c, fmi3FMUState *state)
{
    (void)c;
    return (fmi3Status)drop_state(state);
}
EXPORT fmi3Status fmi3SerializedFMUStateSize(In c, fmi3FMUState state, size_t *size)
{
    (void)c, (void)state;
    *size = sizeof(State);
    return fmi3OK;
}
EXPORT fmi3Status fmi3SerializeFMUState(In c, fmi3FMUState state, fmi3Byte bytes[], size_t size)
{
    (void)c;
    return (fmi3Status)write_state(state, (unsigned char *)bytes, size);
}
EXPORT fmi3Status fmi3DeserializeFMUState(In c, const fmi3Byte bytes[], size_t size, fmi3FMUState *state)
{
    (void)c;
    return (fmi3Status)read_state((const unsigned char *)bytes, size, state);
}

EXPORT fmi3Status fmi3DoStep(In c, fmi3Float64 t, fmi3Float64 h, fmi3Boolean no_rollback, fmi3Boolean *event,
                             fmi3Boolean *terminate, fmi3Boolean *early, fmi3Float64 *last)
{
    (void)no_rollback;
    *event = *terminate = *early = false;
    fmi3Status status = (fmi3Status)do_step(c, t, h);
    *last = ((Instance *)c)->state.v[V_time];
    return status;
}
