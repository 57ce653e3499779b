/* Cart-pole with a point-mass pole, hanging at theta = 0. With c = cos theta, s = sin theta:
   (mc + mp) x'' + mp l c theta'' = u - bx x' - Fx sgn(x') + mp l s theta'^2
   mp l c x'' + mp l^2 theta'' = -btheta theta' - Ftheta sgn(theta') - mp g l s
   where sgn is tanh over the velocity "width". */
enum { MEMORY = 0 };

static void rates(const double *v, const double *x, double *dx)
{
    const double c = cos(x[1]), s = sin(x[1]), ml = v[V_mp] * v[V_l];
    const double force = v[V_u] - v[V_bx] * x[2] - v[V_Fx] * tanh(x[2] / v[V_width]) + ml * s * x[3] * x[3];
    const double torque = -v[V_btheta] * x[3] - v[V_Ftheta] * tanh(x[3] / v[V_width]) - ml * v[V_g] * s;
    const double a = v[V_mc] + v[V_mp], b = ml * c, d = ml * v[V_l], determinant = a * d - b * b;
    dx[0] = x[2];
    dx[1] = x[3];
    dx[2] = (d * force - b * torque) / determinant;
    dx[3] = (a * torque - b * force) / determinant;
}

static const char *check(const double *v)
{
    if (!(v[V_mc] > 0) || !(v[V_mp] > 0) || !(v[V_l] > 0)) return "mc, mp and l must be positive";
    if (!(v[V_width] > 0) || !(v[V_substep] > 0)) return "width and substep must be positive";
    return NULL;
}

NOTHING_PREPARED
OWN_SUBSTEP

static void advance(double *v, double h)
{
    double x[4] = {v[V_x], v[V_theta], v[V_v], v[V_omega]};
    runge_kutta(rates, v, x, 4, h);
    v[V_x] = x[0], v[V_theta] = x[1], v[V_v] = x[2], v[V_omega] = x[3];
}

static void evaluate(double *v)
{
    const double x[4] = {v[V_x], v[V_theta], v[V_v], v[V_omega]};
    double dx[4];
    rates(v, x, dx);
    v[V_der_x_] = dx[0], v[V_der_theta_] = dx[1], v[V_der_v_] = dx[2], v[V_der_omega_] = dx[3];
}
