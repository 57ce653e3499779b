/* State feedback u = r - K x with limits; no state of its own. */
enum { MEMORY = 0 };

static const char *check(const double *v) { return v[V_low] <= v[V_high] ? NULL : "low must not exceed high"; }

NOTHING_PREPARED
NO_MOTION

static void evaluate(double *v)
{
    const double u =
        v[V_r] - v[V_K1] * v[V_x1] - v[V_K2] * v[V_x2] - v[V_K3] * v[V_x3] - v[V_K4] * v[V_x4];
    v[V_u] = fmin(fmax(u, v[V_low]), v[V_high]);
}
