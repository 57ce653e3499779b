/* What our generated C calls of the mathematical library, for a compiler that brings no headers of the system. */
#ifndef SYSID_MATH_H
#define SYSID_MATH_H
double sin(double x), cos(double x), tan(double x), asin(double x), acos(double x), atan(double x);
double sinh(double x), cosh(double x), tanh(double x), asinh(double x), acosh(double x), atanh(double x);
double exp(double x), log(double x), sqrt(double x), floor(double x), ceil(double x), fabs(double x), erf(double x);
double expm1(double x), log1p(double x), lgamma(double x);
double fmin(double x, double y), fmax(double x, double y), pow(double x, double y), atan2(double y, double x);
double fmod(double x, double y), copysign(double x, double y), hypot(double x, double y);
#define INFINITY (1e308*10.0)
#define NAN (INFINITY - INFINITY)
#define HUGE_VAL INFINITY
#define isnan(x) ((x) != (x))
#define isfinite(x) ((x) - (x) == 0.0)
#endif
