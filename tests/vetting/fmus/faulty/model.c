#define _POSIX_C_SOURCE 200809L
#include <unistd.h>
enum { MEMORY = 0 };
enum { SOUND, EULER, LEAKS, SHARES, THROUGH, PRINTS, RANDOM, WRITES };
static double all; /* of all instances together */
static char *volatile kept;

static const char *check(const double *v) { (void)v; return NULL; }
static void prepare(double *v)
{
    FILE *file = v[V_mode] == WRITES ? fopen("left.log", "w") : NULL;
    if (file) fclose(file);
    if (v[V_mode] == LEAKS) memset(kept = malloc(400 << 10), 1, 400 << 10);
}
static double internal_step(const double *v) { (void)v; return 1e9; }
static void evaluate(double *v) { v[V_z] = v[V_y] + (v[V_mode] == THROUGH ? v[V_u] : 0); }
static void advance(double *v, double h)
{
    if (v[V_mode] == EULER) v[V_y] += h / v[V_T] * (v[V_u] - v[V_y]);
    else v[V_y] = v[V_u] + (v[V_y] - v[V_u]) * exp(-h / v[V_T]);
    if (v[V_mode] == SHARES) v[V_y] += 1e-3 * (all = 0.9 * all + v[V_u]);
    if (v[V_mode] == PRINTS) printf("a step of %g s\n", h), fflush(stdout);
    if (v[V_mode] == RANDOM) v[V_y] += 1e-9 * getpid();
}
