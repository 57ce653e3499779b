/* Quantising sensor: a count of (u + offset) / resolution, rounded and limited to a signed number of some bits. */
enum { MEMORY = 0 };
enum { NEAREST = 1, DOWN = 2, TOWARD_ZERO = 3 };

static const char *check(const double *v)
{
    if (!(v[V_resolution] > 0)) return "resolution must be positive";
    if (v[V_bits] < 0 || v[V_bits] > 31) return "bits must lie in 0 .. 31";
    if (v[V_rounding] < NEAREST || v[V_rounding] > TOWARD_ZERO) return "rounding is 1, 2 or 3";
    return NULL;
}

NOTHING_PREPARED
NO_MOTION

static void evaluate(double *v)
{
    const double ratio = (v[V_u] + v[V_offset]) / v[V_resolution];
    double count = v[V_rounding] == NEAREST ? nearbyint(ratio) : v[V_rounding] == DOWN ? floor(ratio) : trunc(ratio);
    if (v[V_bits] > 0) {
        const double half = ldexp(1, (int)v[V_bits] - 1);
        count = fmin(fmax(count, -half), half - 1);
    }
    v[V_count] = count;
    v[V_y] = v[V_enabled] != 0 ? count * v[V_resolution] : v[V_u];
}
