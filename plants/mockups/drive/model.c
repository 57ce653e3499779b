/* Linear drive, motor side (q, v) and load (q_load, v_load):
   M q'' = u - Fv q' - Fc sgn(q') - offset - contact,  ML q_load'' = contact - FvL q_load'.
   Backlash: the contact is a spring and damper outside a free play of width gap, and never pulls (Nordin and Gutman
   2002, Automatica 38:1633). With gap = 0 the two move as one body of mass M + ML. */
enum { MEMORY = 0 };

static double contact(const double *v, const double *x)
{
    const double twist = x[0] - x[2], half = 0.5 * v[V_gap], rate = x[1] - x[3];
    if (twist > half) return fmax(0, v[V_k] * (twist - half) + v[V_d] * rate);
    if (twist < -half) return fmin(0, v[V_k] * (twist + half) + v[V_d] * rate);
    return 0;
}

static void rates(const double *v, const double *x, double *dx)
{
    const double drive = v[V_u] - v[V_Fv] * x[1] - v[V_Fc] * tanh(x[1] / v[V_width]) - v[V_offset];
    dx[0] = x[1];
    dx[2] = x[3];
    if (v[V_gap] > 0) {
        const double f = contact(v, x);
        dx[1] = (drive - f) / v[V_M];
        dx[3] = (f - v[V_FvL] * x[3]) / v[V_ML];
    } else
        dx[1] = dx[3] = (drive - v[V_FvL] * x[1]) / (v[V_M] + v[V_ML]);
}

static const char *check(const double *v)
{
    if (!(v[V_M] > 0) || !(v[V_ML] > 0)) return "M and ML must be positive";
    if (!(v[V_width] > 0) || !(v[V_substep] > 0)) return "width and substep must be positive";
    return NULL;
}

static void prepare(double *v)
{
    if (!(v[V_gap] > 0)) v[V_q_load] = v[V_q], v[V_v_load] = v[V_v];
}

OWN_SUBSTEP

static void advance(double *v, double h)
{
    double x[4] = {v[V_q], v[V_v], v[V_q_load], v[V_v_load]};
    runge_kutta(rates, v, x, 4, h);
    v[V_q] = x[0], v[V_v] = x[1], v[V_q_load] = x[2], v[V_v_load] = x[3];
}

static void evaluate(double *v)
{
    const double x[4] = {v[V_q], v[V_v], v[V_q_load], v[V_v_load]};
    double dx[4];
    rates(v, x, dx);
    v[V_der_q_] = dx[0], v[V_der_v_] = dx[1], v[V_der_q_load_] = dx[2], v[V_der_v_load_] = dx[3];
}
