/* Starts in equilibrium with its inflow, and stays there: the level is twice the flow that it was initialised with. */
enum { MEMORY = 0 };
static const char *check(const double *v) { (void)v; return NULL; }
static void prepare(double *v) { v[V_level] = 2 * v[V_flow]; }
static double internal_step(const double *v) { (void)v; return 1e9; }
static void evaluate(double *v) { (void)v; }
static void advance(double *v, double h) { (void)v, (void)h; }
