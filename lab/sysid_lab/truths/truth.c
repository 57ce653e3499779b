/* Truth of the studies: a pendulum or a cart-pole with laws written by hand, integrated by Runge-Kutta in fine steps.

   It shares no code with the models or the dictionary. Dry friction has a true standstill (Karnopp 1985): at rest it
   balances what pulls, up to its level; in motion it is the level against the motion; a reversal is located inside
   the step. Dead zone, limits, play and stops have sharp corners.

   Coordinate 0 is driven: the angle of the pendulum or the position of the cart. p[] is indexed by the enum that is
   put before this text; a name that ends in 0 or 1 belongs to that coordinate. State: q0 q1 v0 v1, motor angle and
   rate, hysteresis of both coordinates, Maxwell element of both, bristles of both, slip elements of both.

   Other formulations of the same effects, as hardware has them: bristles (LuGre, Canudas de Wit et al. 1995; Dahl 1968
   is the same without damping and Stribeck) instead of a standstill, slip elements in parallel (Iwan 1966) as the
   hysteresis of a gear, a logarithmic law (Eyring 1936) as sub-linear friction, contacts after Hunt & Crossley 1975, a
   flexible joint that hardens, a motor with inductance, back-EMF, current and voltage limits under a current
   controller, a command that is sampled and held by a slower clock, a payload that is taken up in a while.

   Machines around it: a gear whose friction follows from its efficiency (as Modelica's LossyGear), a commutation that
   ripples, a supply whose voltage falls with the current that was drawn, a propeller, a spring over
   a lever arm, a base that sways on a spring (pendulum). */
#include <math.h>

enum { SLIPS = 4, MANY = 50, NX = 22, MOTOR = 4, RATE = 5, HYST = 6, MAXWELL = 8, BRISTLE = 10, SLIP = 12, BASE = 20 };
#define SOONEST 5000.0 /* 1/s: a fine step is 0.2 ms */
#define AT(name, i) p[name##0 + (i) * (P_b1 - P_b0)]

static double sign(double x) { return (x > 0) - (x < 0); }
static double play(double x, double gap) { return fabs(x) <= gap ? 0 : x - copysign(gap, x); }

/* Share of a payload that has been taken up so long after its instant. */
static double taken(double since, double ramp)
{
    if (since < 0) return 0;
    return since >= ramp ? 1 : since / ramp;
}

/* Force of a contact, stiffness at the penetration `scale`; the damping is that of the material, and never pulls. */
static double hunt(double stiffness, double beyond, double v, double scale)
{
    const double force = stiffness * beyond * sqrt(fabs(beyond) / scale), rate = v * sign(beyond);
    return force * fmax(0, 1 + 0.4 * rate / (10 * scale));
}

/* What the joint of coordinate i carries across its motion. */
static double carried(const double *p, int i, const double *x)
{
    const double g = p[P_g];
    if (p[P_dof] < 1.5) return p[P_mgl] * cos(x[0]) + p[P_J] * x[2] * x[2];
    const double ml = p[P_mp] * p[P_l];
    if (i == 0) return (p[P_mc] + p[P_mp]) * g + ml * x[3] * x[3] * cos(x[1]);
    return ml * g * cos(x[1]) + ml * p[P_l] * x[3] * x[3];
}

/* What a gear loses of the force that it transmits, by its efficiency and by who drives. */
static double lost(const double *p, double side, double transmitted)
{
    const double size = fabs(transmitted);
    if (p[P_eta] >= 1) return 0;
    return side * transmitted > 0 ? (1 - p[P_eta]) * size : (1 / p[P_eta] - 1) * size;
}

static double transmitted; /* by the gear, now */

/* Level of the dry friction of coordinate i for motion in one direction. */
static double level(const double *p, int i, double side, const double *x)
{
    const double v = x[2 + i], ratio = v / AT(P_vs, i);
    double value = side > 0 ? AT(P_Fp, i) : AT(P_Fm, i);
    value += AT(P_Fst, i) + (AT(P_Fss, i) - AT(P_Fst, i)) * exp(-ratio * ratio);
    value += (1 + AT(P_pa, i) * cos(x[i] + AT(P_pphi, i))) * AT(P_Fpos, i);
    value += AT(P_mu, i) * fabs(carried(p, i, x));
    if (i == 0) value += lost(p, side, transmitted);
    return value > 0 ? value : 0;
}

/* Elements in parallel, each a spring that slips at a length of its own: in (-1, 1). */
static double slip(const double *p, int i, const double *x, double *dx)
{
    static const double length[SLIPS] = {0.3, 0.7, 1.3, 2.2};
    const double v = x[2 + i];
    double sum = 0;
    for (int j = 0; j < SLIPS; j++) {
        const int at = SLIP + SLIPS * i + j;
        const double z = x[at];
        sum += fmax(-1, fmin(1, z)) / SLIPS;
        dx[at] = fabs(z) >= 1 && z * v > 0 ? 0 : v / (length[j] * AT(P_xs, i));
    }
    return sum;
}

/* Force on coordinate i without dry friction; dx of the hidden states of that coordinate. */
static double force(const double *p, int i, const double *x, double *dx, double u, double t)
{
    const double q = x[i], v = x[2 + i];
    double f = AT(P_F0, i) - AT(P_b, i) * v - AT(P_c, i) * fabs(v) * v;
    f -= AT(P_k, i) * q + AT(P_k2, i) * q * q + AT(P_k3, i) * q * q * q;
    f -= AT(P_A, i) * cos(q);
    f += AT(P_cog, i) * sin(AT(P_cogk, i) * q + AT(P_cogphi, i));
    f += AT(P_per, i) * sin(AT(P_perw, i) * t + AT(P_perphi, i));
    f -= AT(P_und, i) * cos(q) * v;
    const double beyond = play(q, AT(P_stop, i));
    if (beyond != 0 && AT(P_hunt, i) == 0) f -= AT(P_ks, i) * beyond + AT(P_ds, i) * v;
    if (beyond != 0 && AT(P_hunt, i) > 0) f -= hunt(AT(P_ks, i), beyond, v, AT(P_hunt, i));
    if (AT(P_slip, i) > 0)
        f -= AT(P_Fh, i) * slip(p, i, x, dx);
    else {
        const double z = x[HYST + i];
        f -= AT(P_Fh, i) * z;
        dx[HYST + i] = (v - 0.5 * fabs(v) * z - 0.5 * v * fabs(z)) / AT(P_xs, i);
    }
    if (AT(P_bs, i) > 0) { /* bristles of this stiffness and damping carry the dry friction */
        /* what settles sooner than a step follows comes to the same deflection, only later: at speed the force is g */
        const double g = level(p, i, v, x), z = x[BRISTLE + i], slips = AT(P_bs, i) * fabs(v);
        dx[BRISTLE + i] = slips < SOONEST * g ? v - slips / g * z : SOONEST * (g * sign(v) / AT(P_bs, i) - z);
        f -= AT(P_bs, i) * z + AT(P_bd, i) * dx[BRISTLE + i];
    }
    const double m = x[MAXWELL + i];
    f -= AT(P_km, i) * m;
    dx[MAXWELL + i] = v - m / AT(P_taum, i);
    f -= AT(P_root, i) * (AT(P_rootv, i) > 0 ? asinh(v / AT(P_rootv, i)) : sign(v) * sqrt(fabs(v)));
    f -= AT(P_even, i) * v * v + AT(P_vdp, i) * q * q * v;
    f += AT(P_ripple, i) * u * cos(5 * q);
    if (AT(P_mag, i) != 0) {
        const double off = (q - AT(P_magq, i)) / AT(P_magw, i);
        f -= AT(P_mag, i) * off * exp(-0.5 * off * off);
    }
    f -= AT(P_drag3, i) * v * v * v + AT(P_warm, i) * (1 - t / AT(P_warmt, i)) * v + AT(P_tire, i) * u * fabs(v);
    if (t >= AT(P_stept, i) && t < AT(P_stepe, i)) f += AT(P_stepf, i);
    f -= AT(P_dG, i) * taken(t - AT(P_t0, i), p[P_ramp]) * sin(q);
    return f;
}

/* Mass matrix (a, b, d) and total forces without dry friction; hidden rates into dx. */
static void equations(const double *p, const double *x, double *dx, double u, double t, double *m, double *f)
{
    const int two = p[P_dof] > 1.5;
    const double g = p[P_g], tilt = p[P_tilt];
    u *= 1 + p[P_rip] * sin(p[P_ripk] * x[0] + p[P_ripphi]);
    transmitted = u;
    double drive = u;
    if (p[P_kt] > 0) {
        const double e = x[MOTOR] - x[0], contact = play(e, p[P_gap]);
        drive = contact != 0 ? p[P_kt] * contact * (1 + p[P_hard] * contact * contact) + p[P_dt] * (x[RATE] - x[2]) : 0;
        if (p[P_push] > 0 && drive * contact < 0) drive = 0; /* flanks push and never pull */
        dx[MOTOR] = x[RATE];
        dx[RATE] = (u - drive) / p[P_Jm];
    } else
        dx[MOTOR] = dx[RATE] = 0;
    f[0] = drive + force(p, 0, x, dx, u, t);
    f[1] = 0;
    if (!two) {
        f[0] -= p[P_mgl] * sin(x[0] + tilt);
        m[0] = p[P_J], m[1] = 0, m[2] = 1;
        if (p[P_bm] > 0) { /* the base's acceleration put into the joint's equation */
            const double ml = p[P_mgl] / g, share = ml * cos(x[0]) / p[P_bm];
            f[0] += share * (p[P_bk] * x[BASE] + p[P_bc] * x[BASE + 1] - ml * sin(x[0]) * x[2] * x[2]);
            m[0] -= share * ml * cos(x[0]);
        }
        dx[HYST + 1] = dx[MAXWELL + 1] = dx[BRISTLE + 1] = 0;
        for (int j = 0; j < SLIPS; j++) dx[SLIP + SLIPS + j] = 0;
    } else {
        const double ml = p[P_mp] * p[P_l];
        f[0] += ml * sin(x[1]) * x[3] * x[3] - (p[P_mc] + p[P_mp]) * g * sin(tilt);
        f[1] = force(p, 1, x, dx, u, t) - ml * g * sin(x[1] + tilt);
        m[0] = p[P_mc] + p[P_mp], m[1] = ml * cos(x[1]), m[2] = ml * p[P_l] * (1 + p[P_rod]);
        m[2] += p[P_dJ1] * taken(t - p[P_t01], p[P_ramp]);
    }
    if (p[P_arm] > 0) { /* spring between the end of an arm and an anchor at the distance and angle from the axis */
        const double angle = x[two] - p[P_place], a = p[P_arm], b = p[P_anchor];
        const double length = sqrt(a * a + b * b - 2 * a * b * cos(angle));
        f[two] -= p[P_kc] * (1 - p[P_free] / length) * a * b * sin(angle);
    }
    m[0] += p[P_dJ0] * taken(t - p[P_t00], p[P_ramp]);
}

/* mode: 0 free of dry friction, +-1 sliding, 2 stuck. */
static void rates(const double *p, const double *x, double *dx, double u, double t, const int *mode)
{
    double m[3], f[2];
    equations(p, x, dx, u, t, m, f);
    for (int i = 0; i < 2; i++)
        if (mode[i] == 1 || mode[i] == -1) f[i] -= mode[i] * level(p, i, mode[i], x);
    double a0, a1;
    if (p[P_dof] < 1.5) {
        a0 = mode[0] == 2 ? 0 : f[0] / m[0];
        a1 = 0;
    } else if (mode[0] == 2 || mode[1] == 2) {
        a0 = mode[0] == 2 ? 0 : f[0] / m[0];
        a1 = mode[1] == 2 ? 0 : f[1] / m[2];
    } else {
        const double determinant = m[0] * m[2] - m[1] * m[1];
        a0 = (m[2] * f[0] - m[1] * f[1]) / determinant;
        a1 = (m[0] * f[1] - m[1] * f[0]) / determinant;
    }
    dx[0] = x[2], dx[1] = x[3], dx[2] = a0, dx[3] = a1;
    dx[BASE] = dx[BASE + 1] = 0;
    if (p[P_bm] > 0) {
        const double ml = p[P_mgl] / p[P_g], pull = ml * (a0 * cos(x[0]) - x[2] * x[2] * sin(x[0]));
        dx[BASE] = x[BASE + 1];
        dx[BASE + 1] = -(p[P_bk] * x[BASE] + p[P_bc] * x[BASE + 1] + pull) / p[P_bm];
    }
}

static void runge_kutta(const double *p, double *x, double u, double t, double h, const int *mode)
{
    double k1[NX], k2[NX], k3[NX], k4[NX], y[NX];
    rates(p, x, k1, u, t, mode);
    for (int i = 0; i < NX; i++) y[i] = x[i] + 0.5 * h * k1[i];
    rates(p, y, k2, u, t + 0.5 * h, mode);
    for (int i = 0; i < NX; i++) y[i] = x[i] + 0.5 * h * k2[i];
    rates(p, y, k3, u, t + 0.5 * h, mode);
    for (int i = 0; i < NX; i++) y[i] = x[i] + h * k3[i];
    rates(p, y, k4, u, t + h, mode);
    for (int i = 0; i < NX; i++) x[i] += h / 6 * (k1[i] + 2 * k2[i] + 2 * k3[i] + k4[i]);
}

/* Whether coordinates at rest stay there, and which way those that slip begin to move. */
static void choose(const double *p, const double *x, double u, double t, int *mode)
{
    const int n = p[P_dof] > 1.5 ? 2 : 1;
    mode[0] = mode[1] = 0;
    for (int i = 0; i < n; i++)
        if (AT(P_bs, i) == 0 && (level(p, i, 1, x) > 0 || level(p, i, -1, x) > 0)) mode[i] = x[2 + i] > 0 ? 1 : x[2 + i] < 0 ? -1 : 2;
    for (int i = 0; i < n; i++) {
        if (mode[i] != 2) continue;
        double m[3], f[2], dx[NX];
        equations(p, x, dx, u, t, m, f);
        double pull = f[i];
        const int j = 1 - i;
        if (n == 2 && mode[j] != 2) { /* the other one moves: its inertia pulls at this one */
            const double other = f[j] - (mode[j] ? mode[j] * level(p, j, mode[j], x) : 0);
            pull -= m[1] * other / m[2 * j];
        }
        const int way = pull > 0 ? 1 : -1;
        if (fabs(pull) > level(p, i, way, x)) mode[i] = way;
    }
}

static void slide(const double *p, double *x, double u, double t, double h)
{
    for (int reversals = 0; h > 0 && reversals < 8; reversals++) {
        int mode[2];
        double before[NX];
        choose(p, x, u, t, mode);
        for (int i = 0; i < NX; i++) before[i] = x[i];
        runge_kutta(p, x, u, t, h, mode);
        double part = 1;
        int who = -1;
        for (int i = 0; i < 2; i++) {
            if ((mode[i] != 1 && mode[i] != -1) || mode[i] * x[2 + i] >= 0 || before[2 + i] == 0) continue;
            const double share = before[2 + i] / (before[2 + i] - x[2 + i]);
            if (who < 0 || share < part) part = share, who = i;
        }
        if (who < 0) break;
        for (int i = 0; i < NX; i++) x[i] = before[i];
        runge_kutta(p, x, u, t, part * h, mode);
        x[2 + who] = 0;
        t += part * h;
        h -= part * h;
    }
}

/* Which stops and which flanks of a play are touched. */
static int touched(const double *p, const double *x)
{
    int found = p[P_kt] > 0 && play(x[MOTOR] - x[0], p[P_gap]) != 0;
    for (int i = 0; i < 2; i++) found |= (play(x[i], AT(P_stop, i)) != 0) << (i + 1);
    return found;
}

/* Where a damper takes hold within a step, the force jumps: many steps for that one. */
static void advance(const double *p, double *x, double u, double t, double h)
{
    double before[NX];
    for (int i = 0; i < NX; i++) before[i] = x[i];
    slide(p, x, u, t, h);
    if (touched(p, before) == touched(p, x)) return;
    for (int i = 0; i < NX; i++) x[i] = before[i];
    for (int k = 0; k < MANY; k++) slide(p, x, u, t + k * (h / MANY), h / MANY);
}

/* n samples of substeps fine steps h each; u: command, d: unknown force, both held over a sample.
   states (n, 4): q0 q1 v0 v1 at the samples. readings (n, 2): q0 q1 as the sensors delay them. passed (n): the force
   that left the actuator in the first fine step of each sample. */
__attribute__((visibility("default"))) int simulate(const double *p, const double *start, const double *u, const double *d, int n, int substeps, double h,
             double *states, double *readings, double *passed)
{
    double x[NX] = {start[0], start[1], start[2], start[3], start[0], start[2]};
    double current = u[0], integral = u[0]; /* of the motor, in units of its torque */
    double drawn = 0; /* of the supply, as it sags */
    const long held = p[P_hold] > h ? lround(p[P_hold] / h) : 1;
    const long late = lround(p[P_delay] / h), sensor[2] = {lround(p[P_sdelay0] / h), lround(p[P_sdelay1] / h)};
    const double share = p[P_tau] > 0 ? 1 - exp(-h / p[P_tau]) : 1;
    double z = u[0];
    for (int k = 0; k < n; k++)
        for (int i = 0; i < 2; i++) readings[2 * k + i] = start[i];
    for (long s = 0; s < (long)n * substeps; s++) {
        const long k = s / substeps, seen = s / held * held - late, command = seen < 0 ? 0 : seen / substeps;
        for (int i = 0; i < 2; i++) {
            const long at = s + sensor[i];
            if (at % substeps == 0 && at / substeps < n) readings[2 * (at / substeps) + i] = x[i];
        }
        double f = play(u[command], p[P_width]);
        f *= 1 - p[P_droop] * fabs(f);
        if (p[P_sagtau] > 0) {
            const double old = drawn;
            drawn += (1 - exp(-h / p[P_sagtau])) * (fabs(f) - drawn);
            f *= 1 - p[P_sagc] * 0.5 * (old + drawn);
        }
        if (p[P_square] > 0) f *= fabs(f) / p[P_square];
        f *= 1 - p[P_sag] * (s * h - p[P_sagt]);
        if (fabs(f) > p[P_limit]) f = copysign(p[P_limit], f);
        if (p[P_te] == 0 && p[P_volt] < 1e29) /* no inductance: the back-EMF leaves less voltage at speed */
            f = fmax(-p[P_volt] - p[P_emf] * x[2], fmin(p[P_volt] - p[P_emf] * x[2], f));
        if (p[P_te] > 0) { /* inductance and back-EMF, under a PI current controller with a bounded voltage */
            const double error = f - current, voltage = p[P_loop] * error + integral;
            const double bounded = fmax(-p[P_volt], fmin(p[P_volt], voltage));
            if (bounded == voltage) integral += h * p[P_loop] / p[P_te] * error;
            const double old = current;
            current += (1 - exp(-h / p[P_te])) * (bounded - current - p[P_emf] * x[2]);
            f = 0.5 * (old + current);
        }
        const double change = share * (f - z), most = p[P_R] * h;
        const double old = z;
        z += fabs(change) > most ? copysign(most, change) : change;
        /* the mean over the step: of a lag exactly, of a limited rate halfway between old and new state */
        if (p[P_R] < 1e29)
            f = 0.5 * (old + z);
        else if (p[P_tau] > 0)
            f += (old - f) * share * p[P_tau] / h;
        f *= p[P_gain];
        if (s % substeps == 0) {
            for (int i = 0; i < 4; i++) states[4 * k + i] = x[i];
            passed[k] = f;
        }
        advance(p, x, f + d[k], s * h, h);
        if (!isfinite(x[0]) || fabs(x[0]) > 1e6 || fabs(x[1]) > 1e6) return 1;
    }
    return 0;
}
