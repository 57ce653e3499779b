/* Starts in equilibrium with its inflow, and stays there: the level is twice the flow that it was initialised with. */
enum { MEMORY = 1, BEGUN = VARIABLES };
static const char *check(const double *v) { (void)v; return NULL; }
static double internal_step(const double *v) { (void)v; return 1e9; }
static void evaluate(double *v) { if (!v[BEGUN]) v[V_level] = 2 * v[V_flow]; }
static void prepare(double *v) { evaluate(v); v[BEGUN] = 1; }
static void advance(double *v, double h) { (void)v, (void)h; }
