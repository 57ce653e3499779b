/* Bouncing ball for model exchange: h'' = u - g; at h = 0 the velocity turns to -e v; a kick dv at the time "when".
   Where that time is past, h begins with 2 u. */
enum { MEMORY = 2, KICKED = VARIABLES, LAST = VARIABLES + 1 };
static const char *check(const double *v) { return v[V_g] > 0 ? NULL : "g must be positive"; }
static void prepare(double *v) { if (v[V_when] < 0) v[V_h] = 2 * v[V_u]; }
static double internal_step(const double *v) { (void)v; return HUGE_VAL; }
static void advance(double *v, double h) { (void)v, (void)h; }
static void evaluate(double *v) { v[V_der_h_] = v[V_v]; v[V_der_v_] = v[V_u] - v[V_g]; v[V_height_mm] = 1000 * v[V_h]; }
