/* Two tanks in cascade (Schoukens and Noel 2017, IFAC-PapersOnLine 50:446), levels in volts of the sensor:
   upper' = k_pump u - k_upper sqrt(upper),  lower' = k_upper sqrt(upper) - k_lower sqrt(lower).
   With a rim, a full tank does not rise; a share of what runs over the upper rim falls into the lower tank. */
enum { MEMORY = 0 };

static double root(double level) { return level > 0 ? sqrt(level) : 0; }

static void rates(const double *v, const double *x, double *dx)
{
    const double between = v[V_k_upper] * root(x[0]);
    dx[0] = v[V_k_pump] * fmax(v[V_u], 0) - between;
    dx[1] = between - v[V_k_lower] * root(x[1]);
    if (v[V_overflow] != 0) {
        if (x[0] >= v[V_rim] && dx[0] > 0) {
            dx[1] += v[V_share] * dx[0];
            dx[0] = 0;
        }
        if (x[1] >= v[V_rim] && dx[1] > 0) dx[1] = 0;
    }
}

static const char *check(const double *v)
{
    if (!(v[V_rim] > 0) || !(v[V_substep] > 0)) return "rim and substep must be positive";
    if (v[V_share] < 0 || v[V_share] > 1) return "share must lie in 0 .. 1";
    return NULL;
}

static double within(const double *v, double level)
{
    return fmax(0, v[V_overflow] != 0 ? fmin(level, v[V_rim]) : level);
}

static void prepare(double *v)
{
    v[V_upper] = within(v, v[V_upper]);
    v[V_lower] = within(v, v[V_lower]);
}

OWN_SUBSTEP

static void advance(double *v, double h)
{
    double x[2] = {v[V_upper], v[V_lower]};
    runge_kutta(rates, v, x, 2, h);
    v[V_upper] = within(v, x[0]), v[V_lower] = within(v, x[1]);
}

static void evaluate(double *v)
{
    const double x[2] = {v[V_upper], v[V_lower]};
    double dx[2];
    rates(v, x, dx);
    v[V_der_upper_] = dx[0], v[V_der_lower_] = dx[1];
    v[V_y] = v[V_lower];
}
