/* One variable of each kind: arrays, small and large integers, booleans, an enumeration, texts. */
#include <string.h>
enum { MEMORY = 0 };
static const char *check(const double *v) { (void)v; return NULL; }
static void prepare(double *v) { (void)v; }
static double internal_step(const double *v) { (void)v; return HUGE_VAL; }
static void advance(double *v, double h) { (void)v, (void)h; }
static void evaluate(double *v) { (void)v; }
