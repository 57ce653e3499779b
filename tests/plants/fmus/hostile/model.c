#define _POSIX_C_SOURCE 200809L
#include <signal.h>
#include <stdlib.h>
#include <unistd.h>
enum { MEMORY = 0 };
enum { WELL, SEGFAULT, ABORTS, EXITS, HANGS, RETURNS_NAN, CHATTERS, DISCARDS, TERMINATES, FAILS, FATAL, WARNS, HALVES, CRAWLS, PENDS, FAILS_START, CRASHES_START, HANGS_START };

static const char *check(const double *v)
{
    if (v[V_mode] == FAILS_START) return "told to fail at the start";
    if (v[V_mode] == CRASHES_START) *(volatile int *)0 = 1;
    if (v[V_mode] == HANGS_START) for (;;) pause();
    return NULL;
}
__attribute__((constructor)) static void load(void)
{
    if (getenv("HOSTILE_TO_LOAD")) raise(SIGKILL);
}
static void prepare(double *v) { (void)v; }
static double internal_step(const double *v) { (void)v; return 1e9; }
static void evaluate(double *v) { (void)v; }
static void advance(double *v, double h)
{
    if (v[V_time] >= v[V_when] - 1e-12) switch ((int)v[V_mode]) {
        case SEGFAULT: *(volatile int *)0 = 1; break;
        case ABORTS: abort();
        case EXITS: exit(0);
        case HANGS: for (;;) pause();
        case RETURNS_NAN: v[V_y] = NAN; return;
        case CHATTERS: for (int i = 0; i < 200; i++) printf("chatter %d to standard output, which is the pipe of somebody else\n", i); fflush(stdout);
    }
    v[V_y] += h * v[V_u];
}
