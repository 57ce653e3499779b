/* y = A u (2 x 2, row by row), plus a counter of steps in every integer type; "length" is that of the text "label". */
#define fmi3GetFloat64 usual_get_float64
#define fmi3SetFloat64 usual_set_float64
#define fmi3GetFloat32 usual_get_float32
#define fmi3SetFloat32 usual_set_float32
#define fmi3GetInt8 usual_get_int8
#define fmi3SetInt8 usual_set_int8
#define fmi3GetUInt64 usual_get_uint64
#define fmi3SetUInt64 usual_set_uint64
#define fmi3GetBoolean usual_get_boolean
#define fmi3SetBoolean usual_set_boolean
#define fmi3GetString usual_get_string
#define fmi3SetString usual_set_string
#define fmi3DoStep usual_step
#include "fmi.c"
#undef fmi3GetFloat64
#undef fmi3SetFloat64
#undef fmi3GetFloat32
#undef fmi3SetFloat32
#undef fmi3GetInt8
#undef fmi3SetInt8
#undef fmi3GetUInt64
#undef fmi3SetUInt64
#undef fmi3GetBoolean
#undef fmi3SetBoolean
#undef fmi3GetString
#undef fmi3SetString
#undef fmi3DoStep

static double A[4] = {1, 0, 0, 1}, u[2], y[2];
static float w, w2;
static int8_t small, small_out;
static uint64_t large, large_out;
static bool flags[2], both;
static char label[64] = "zoo";

/* value references: 10 A, 11 u, 12 y, 20 w, 21 w2, 30 small, 31 small_out, 40 large, 41 large_out, 50 flags, 51 both, 60 label, 61 label_length (Float64) */
#define COPY(to, from, count) do { memcpy(to, from, sizeof(*(from)) * (count)); used += (count); } while (0)
#define OVER for (size_t i = 0, used = 0; i < n; i++)
EXPORT fmi3Status fmi3GetFloat64(In c, const VR vr[], size_t n, fmi3Float64 values[], size_t nv)
{
    (void)c, (void)nv;
    double length = (double)strlen(label);
    OVER switch (vr[i]) {
        case 10: COPY(values + used, A, 4); break;
        case 11: COPY(values + used, u, 2); break;
        case 12: COPY(values + used, y, 2); break;
        case 61: COPY(values + used, &length, 1); break;
        default: return fmi3Error;
    }
    return fmi3OK;
}
EXPORT fmi3Status fmi3SetFloat64(In c, const VR vr[], size_t n, const fmi3Float64 values[], size_t nv)
{
    (void)c, (void)nv;
    OVER switch (vr[i]) {
        case 10: COPY(A, values + used, 4); break;
        case 11: COPY(u, values + used, 2); break;
        default: return fmi3Error;
    }
    return fmi3OK;
}
#define SCALARS(Type, in_vr, in_name, out_vr, out_name)                                                                  \
    EXPORT fmi3Status fmi3Get##Type(In c, const VR vr[], size_t n, fmi3##Type values[], size_t nv)                       \
    { (void)c, (void)nv; for (size_t i = 0; i < n; i++) { if (vr[i] == in_vr) values[i] = in_name; else if (vr[i] == out_vr) values[i] = out_name; else return fmi3Error; } return fmi3OK; } \
    EXPORT fmi3Status fmi3Set##Type(In c, const VR vr[], size_t n, const fmi3##Type values[], size_t nv)                 \
    { (void)c, (void)nv; for (size_t i = 0; i < n; i++) { if (vr[i] != in_vr) return fmi3Error; in_name = values[i]; } return fmi3OK; }
SCALARS(Float32, 20, w, 21, w2)
SCALARS(Int8, 30, small, 31, small_out)
SCALARS(UInt64, 40, large, 41, large_out)
EXPORT fmi3Status fmi3GetBoolean(In c, const VR vr[], size_t n, fmi3Boolean values[], size_t nv)
{
    (void)c, (void)nv;
    OVER switch (vr[i]) {
        case 50: COPY(values + used, flags, 2); break;
        case 51: COPY(values + used, &both, 1); break;
        default: return fmi3Error;
    }
    return fmi3OK;
}
EXPORT fmi3Status fmi3SetBoolean(In c, const VR vr[], size_t n, const fmi3Boolean values[], size_t nv)
{
    (void)c, (void)n, (void)nv;
    if (vr[0] != 50) return fmi3Error;
    memcpy(flags, values, sizeof flags);
    return fmi3OK;
}
EXPORT fmi3Status fmi3GetString(In c, const VR vr[], size_t n, fmi3String values[], size_t nv)
{
    (void)c, (void)vr, (void)nv;
    for (size_t i = 0; i < n; i++) values[i] = label;
    return fmi3OK;
}
EXPORT fmi3Status fmi3SetString(In c, const VR vr[], size_t n, const fmi3String values[], size_t nv)
{
    (void)c, (void)vr, (void)nv;
    for (size_t i = 0; i < n; i++) snprintf(label, sizeof label, "%s", values[i]);
    return fmi3OK;
}
EXPORT fmi3Status fmi3DoStep(In c, fmi3Float64 t, fmi3Float64 h, fmi3Boolean no_rollback, fmi3Boolean *event, fmi3Boolean *terminate, fmi3Boolean *early, fmi3Float64 *last)
{
    for (int i = 0; i < 2; i++) y[i] = A[2 * i] * u[0] + A[2 * i + 1] * u[1];
    w2 = 2 * w, small_out = (int8_t)-small, large_out = large + 1, both = flags[0] && flags[1];
    return usual_step(c, t, h, no_rollback, event, terminate, early, last);
}
