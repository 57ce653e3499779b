/* Mass, spring and damper: m q'' + c q' + k q + k2 q^2 + k3 q^3 = u. */
enum { MEMORY = 0 };

static void rates(const double *v, const double *x, double *dx)
{
    const double spring = x[0] * (v[V_k] + x[0] * (v[V_k2] + x[0] * v[V_k3]));
    dx[0] = x[1];
    dx[1] = (v[V_u] - v[V_c] * x[1] - spring) / v[V_m];
}

static const char *check(const double *v)
{
    if (!(v[V_m] > 0) || !(v[V_substep] > 0)) return "m and substep must be positive";
    return NULL;
}

NOTHING_PREPARED
OWN_SUBSTEP

static void advance(double *v, double h)
{
    double x[2] = {v[V_q], v[V_v]};
    runge_kutta(rates, v, x, 2, h);
    v[V_q] = x[0], v[V_v] = x[1];
}

static void evaluate(double *v)
{
    const double x[2] = {v[V_q], v[V_v]};
    double dx[2];
    rates(v, x, dx);
    v[V_der_q_] = dx[0], v[V_der_v_] = dx[1];
}
