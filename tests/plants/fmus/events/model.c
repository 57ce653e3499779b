/* y' = gain sign u; at y = level: y = 0 and one more count; at the time "when" the gain doubles; "sign" is discrete.
   Where that time is past, y begins with 2 u. */
enum { KICKED = VARIABLES, PENDING = VARIABLES + 1, MODE = VARIABLES + 2, AGAIN = VARIABLES + 3, MEMORY = 4 };
enum { INSIDE, EVENTS, STEPS };
static const char *check(const double *v) { return v[V_level] > 0 ? NULL : "level must be positive"; }
static void prepare(double *v) { if (v[V_when] < 0) v[V_y] = 2 * v[V_u]; }
static double internal_step(const double *v) { (void)v; return HUGE_VAL; }
static void advance(double *v, double h) { v[V_y] += h * v[V_gain] * v[V_sign] * v[V_u]; }
static void evaluate(double *v) { (void)v; }
