/* After a step the air has the wanted temperature: degC in, degF out; raw shows the input's own number. */
enum { MEMORY = 0 };
static const char *check(const double *v) { (void)v; return NULL; }
static void prepare(double *v) { (void)v; }
static double internal_step(const double *v) { (void)v; return 1e9; }
static void evaluate(double *v) { (void)v; }
static void advance(double *v, double h)
{
    (void)h;
    v[V_air] = 1.8 * v[V_wanted] + 32;
    v[V_raw] = v[V_wanted] + v[V_drive];
}
