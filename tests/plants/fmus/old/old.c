/* FMI 1.0, co-simulation (-DCS) or model exchange: x' = u - k x, y = x, and a step counter as integer.
   In modes 5 and 7 x begins with 2 u; in mode 7 a step ends the process if u was set between a reset and the start. */
#include <stdlib.h>
#include <string.h>
#include <math.h>
typedef void *C;
typedef unsigned int VR;
typedef char B;
typedef const char *S;
typedef struct { void (*logger)(C, S, int, S, S, ...); void *(*allocate)(size_t, size_t); void (*release)(void *); void *finished; } Callbacks;
typedef struct { B converged, references, values, terminate, upcoming; double next; } Info;
typedef struct { double x, u, k, t; int steps, up, mode, back, spoilt; B on; Callbacks callbacks; } M;
#define F(name) __attribute__((visibility("default"))) Old_fmi##name
#define I ((M *)c)
#define STEADY if (I->mode == 5 || I->mode == 7) I->x = 2 * I->u
static void fresh(M *m) { m->x = 1, m->u = 0, m->k = 2, m->t = 0, m->steps = 0, m->up = 0, m->mode = 0, m->on = 0, m->spoilt = 0; }
static M *make(S guid, Callbacks callbacks) { if (strcmp(guid, "old-1")) return NULL; M *m = calloc(1, sizeof *m); fresh(m); m->callbacks = callbacks; return m; }

S F(GetVersion)(void) { return "1.0"; }
int F(SetDebugLogging)(C c, B on) { (void)c, (void)on; return 0; }
int F(GetReal)(C c, const VR vr[], size_t n, double v[]) { for (size_t i = 0; i < n; i++) v[i] = vr[i] == 1 ? I->u : vr[i] == 3 ? I->k : vr[i] == 4 ? I->u - I->k * I->x : I->x; return 0; }
int F(SetReal)(C c, const VR vr[], size_t n, const double v[]) { for (size_t i = 0; i < n; i++) { if (vr[i] == 1) { I->u = v[i]; if (!I->up) I->spoilt = I->back; } else if (vr[i] == 3) I->k = v[i]; else if (vr[i] == 2) I->x = v[i]; else return 3; } return 0; }
int F(GetInteger)(C c, const VR vr[], size_t n, int v[]) { for (size_t i = 0; i < n; i++) v[i] = vr[i] == 6 ? I->mode : I->steps; return 0; }
int F(SetInteger)(C c, const VR vr[], size_t n, const int v[]) { for (size_t i = 0; i < n; i++) { if (vr[i] != 6) return 3; I->mode = v[i]; } return 0; }
int F(GetBoolean)(C c, const VR vr[], size_t n, B v[]) { (void)vr; for (size_t i = 0; i < n; i++) v[i] = I->on; return 0; }
int F(SetBoolean)(C c, const VR vr[], size_t n, const B v[]) { (void)vr; for (size_t i = 0; i < n; i++) I->on = v[i]; return 0; }
int F(GetString)(C c, const VR vr[], size_t n, S v[]) { (void)c, (void)vr; for (size_t i = 0; i < n; i++) v[i] = ""; return 0; }
int F(SetString)(C c, const VR vr[], size_t n, const S v[]) { (void)c, (void)vr, (void)n, (void)v; return 0; }
#ifdef CS
S F(GetTypesPlatform)(void) { return "standard32"; }
C F(InstantiateSlave)(S name, S guid, S location, S mime, double timeout, B visible, B interactive, Callbacks callbacks, B logging) { (void)name, (void)location, (void)mime, (void)timeout, (void)visible, (void)interactive, (void)logging; return make(guid, callbacks); }
int F(InitializeSlave)(C c, double t, B stop_defined, double stop) { (void)stop_defined, (void)stop; I->t = t, I->up = 1; STEADY; return I->mode == 9 ? 3 : 0; }
int F(TerminateSlave)(C c) { (void)c; return 0; }
int F(ResetSlave)(C c) { fresh(c); I->back = 1; return 0; }
void F(FreeSlaveInstance)(C c) { free(c); }
int F(SetRealInputDerivatives)(C c, const VR vr[], size_t n, const int o[], const double v[]) { (void)c, (void)vr, (void)n, (void)o, (void)v; return 3; }
int F(GetRealOutputDerivatives)(C c, const VR vr[], size_t n, const int o[], double v[]) { (void)c, (void)vr, (void)n, (void)o, (void)v; return 3; }
int F(CancelStep)(C c) { (void)c; return 3; }
int F(DoStep)(C c, double t, double h, B new_step)
{
    (void)new_step;
    if (fabs(t - I->t) > 1e-9) return 3;
    if (I->mode == 7 && I->spoilt) abort();
    if (I->mode == 2 && I->steps >= 2) { I->callbacks.logger(c, "old", 3, "error", "gave up after %d steps", I->steps); return 3; }
    const double end = t + h;
    if (I->mode == 3 && h > 0.06) h *= 0.5; /* goes half way only */
    I->x = I->u / I->k + (I->x - I->u / I->k) * exp(-I->k * h);
    I->t += h, I->steps++;
    return I->t < end - 1e-12 ? 2 : I->mode == 1;
}
int F(GetStatus)(C c, int kind, int *v) { (void)c, (void)kind, (void)v; return 2; }
int F(GetRealStatus)(C c, int kind, double *v) { (void)kind; *v = I->t; return 0; }
int F(GetIntegerStatus)(C c, int kind, int *v) { (void)c, (void)kind, (void)v; return 2; }
int F(GetBooleanStatus)(C c, int kind, B *v) { (void)c, (void)kind, (void)v; return 2; }
int F(GetStringStatus)(C c, int kind, S *v) { (void)c, (void)kind, (void)v; return 2; }
#else
S F(GetModelTypesPlatform)(void) { return "standard32"; }
C F(InstantiateModel)(S name, S guid, Callbacks callbacks, B logging) { (void)name, (void)logging; return make(guid, callbacks); }
void F(FreeModelInstance)(C c) { free(c); }
int F(SetTime)(C c, double t) { I->t = t; return 0; }
int F(SetContinuousStates)(C c, const double x[], size_t n) { (void)n; I->x = x[0]; return 0; }
int F(CompletedIntegratorStep)(C c, B *event) { I->steps++; *event = 0; return 0; }
int F(Initialize)(C c, B controlled, double tolerance, Info *info) { (void)controlled, (void)tolerance; if (I->up) return 3; I->up = 1; STEADY; memset(info, 0, sizeof *info); info->converged = 1; return 0; }
int F(GetDerivatives)(C c, double dx[], size_t n) { (void)n; dx[0] = I->u - I->k * I->x; return 0; }
int F(GetEventIndicators)(C c, double z[], size_t n) { (void)c, (void)z, (void)n; return 0; }
int F(EventUpdate)(C c, B intermediate, Info *info) { (void)c, (void)intermediate; memset(info, 0, sizeof *info); info->converged = 1; return 0; }
int F(GetContinuousStates)(C c, double x[], size_t n) { (void)n; x[0] = I->x; return 0; }
int F(GetNominalContinuousStates)(C c, double x[], size_t n) { (void)c, (void)n; x[0] = 1; return 0; }
int F(GetStateValueReferences)(C c, VR vr[], size_t n) { (void)c, (void)n; vr[0] = 2; return 0; }
int F(Terminate)(C c) { (void)c; return 0; }
#endif
