enum { MEMORY = 0 };
enum { SOUND, KEEPS_STATE, KEEPS_START, KEEPS_LIBRARY, LOSES_SNAPSHOT, STANDS_STILL };
static double steps; /* of all instances together */

static const char *check(const double *v) { (void)v; return NULL; }
static void prepare(double *v) { (void)v; }
static double internal_step(const double *v) { (void)v; return 1e9; }
static void evaluate(double *v) { (void)v; }
static void advance(double *v, double h)
{
    steps += 1;
    v[V_y] += h * v[V_u] + (v[V_mode] == KEEPS_LIBRARY ? steps : 0);
}
