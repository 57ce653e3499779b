/* PI controller with limits: the integral rests while the limited control cannot follow it (conditional
   integration; Astrom and Hagglund 2006, Advanced PID Control, sec. 3.5). The inputs are held over a step, so the
   integral is exact. */
enum { MEMORY = 0 };

static double wanted(const double *v) { return v[V_Kp] * (v[V_r] - v[V_y]) + v[V_integral]; }

static double speed(const double *v)
{
    const double u = wanted(v), rate = v[V_Ki] * (v[V_r] - v[V_y]);
    return (u > v[V_high] && rate > 0) || (u < v[V_low] && rate < 0) ? 0 : rate;
}

static const char *check(const double *v) { return v[V_low] <= v[V_high] ? NULL : "low must not exceed high"; }

NOTHING_PREPARED

static double internal_step(const double *v)
{
    (void)v;
    return HUGE_VAL;
}

static void advance(double *v, double h) { v[V_integral] += h * speed(v); }

static void evaluate(double *v)
{
    v[V_u] = fmin(fmax(wanted(v), v[V_low]), v[V_high]);
    v[V_der_integral_] = speed(v);
}
