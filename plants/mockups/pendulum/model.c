/* Pendulum: J theta'' + b theta' + mgl sin theta + friction = u, theta = 0 hanging down.

   Dry friction with a true standstill (Karnopp 1985, eq. 3): at rest it balances up to Fs; in motion it is
   Fc + (Fs - Fc) exp(-(omega / vs)^2) against the motion. A reversal is located inside the step, where the
   integration starts anew. Quadratic drag: c2 omega |omega|. */
enum { MEMORY = 1, SIDE = VARIABLES }; /* v[SIDE]: direction of the friction during a step: -1, 0, 1 */

static void rates(const double *v, const double *x, double *dx)
{
    const double drive = v[V_u] - v[V_mgl] * sin(x[0]) - v[V_b] * x[1] - v[V_c2] * x[1] * fabs(x[1]);
    double friction = 0;
    if (v[SIDE] != 0) {
        const double excess = v[V_Fs] > v[V_Fc] ? v[V_Fs] - v[V_Fc] : 0;
        const double ratio = x[1] / v[V_vs];
        friction = v[SIDE] * (v[V_Fc] + (excess > 0 ? excess * exp(-ratio * ratio) : 0));
    }
    dx[0] = x[1];
    dx[1] = (drive - friction) / v[V_J];
}

static const char *check(const double *v)
{
    if (!(v[V_J] > 0)) return "J must be positive";
    if (!(v[V_vs] > 0)) return "vs must be positive";
    if (!(v[V_substep] > 0)) return "substep must be positive";
    if (v[V_Fc] < 0 || v[V_Fs] < 0) return "Fc and Fs must not be negative";
    return NULL;
}

NOTHING_PREPARED
OWN_SUBSTEP

static void advance(double *v, double h)
{
    double x[2] = {v[V_theta], v[V_omega]};
    const double hold = fmax(v[V_Fc], v[V_Fs]);
    for (int reversals = 0; h > 0 && reversals < 8; reversals++) {
        v[SIDE] = 0;
        if (hold > 0) {
            if (x[1] == 0) {
                const double drive = v[V_u] - v[V_mgl] * sin(x[0]);
                if (fabs(drive) <= hold) break; /* stuck */
                v[SIDE] = drive > 0 ? 1 : -1;
            } else
                v[SIDE] = x[1] > 0 ? 1 : -1;
        }
        const double before[2] = {x[0], x[1]};
        runge_kutta(rates, v, x, 2, h);
        if (v[SIDE] == 0 || v[SIDE] * x[1] >= 0) break;
        const double part = before[1] != 0 ? before[1] / (before[1] - x[1]) : 1;
        x[0] = before[0], x[1] = before[1];
        runge_kutta(rates, v, x, 2, part * h);
        x[1] = 0;
        h -= part * h;
    }
    v[V_theta] = x[0], v[V_omega] = x[1];
}

static void evaluate(double *v)
{
    const double x[2] = {v[V_theta], v[V_omega]};
    double dx[2];
    const double hold = fmax(v[V_Fc], v[V_Fs]), drive = v[V_u] - v[V_mgl] * sin(x[0]);
    v[SIDE] = hold > 0 && x[1] != 0 ? (x[1] > 0 ? 1 : -1) : 0;
    rates(v, x, dx);
    if (hold > 0 && x[1] == 0) dx[1] = fabs(drive) <= hold ? 0 : (drive - copysign(hold, drive)) / v[V_J];
    v[V_der_theta_] = dx[0], v[V_der_omega_] = dx[1];
}
