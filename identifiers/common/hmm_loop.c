/* One pass of the scaled forward and backward recursions over a record with actions (Rabiner 1989, eq. 91 to 97).

   Tables have the state that varies fastest last: transition[a][i][j], emission[o][j] (the emission probabilities
   turned), so that inner loops run over neighbours. Sums are added to: pairs[a][i][j] of products without the factor
   transition[a][i][j], which the caller multiplies once. */
#include <math.h>
#include <string.h>

#ifdef _WIN32
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif

/* Returns the log likelihood, or minus infinity if the record is impossible. filtered (n, s) receives the scaled
   forward variables; with backward == 0 nothing else is touched. work holds 2 s. */
EXPORT double sysid_hmm_pass(long n, long s, const int *seen, const int *action, const double *start,
                             const double *transition, const double *emission, double *filtered, double *scale,
                             int backward, double *pairs, double *emitted, double *first, double *work)
{
    double total = 0.0;
    for (long k = 0; k < n; k++) {
        double *now = filtered + k * s;
        const double *e = emission + (long)seen[k] * s;
        if (k == 0) {
            memcpy(now, start, (size_t)s * sizeof(double));
        } else {
            const double *before = now - s, *t = transition + (long)action[k - 1] * s * s;
            memset(now, 0, (size_t)s * sizeof(double));
            for (long i = 0; i < s; i++) {
                const double weight = before[i], *row = t + i * s;
                for (long j = 0; j < s; j++) now[j] += weight * row[j];
            }
        }
        double sum = 0.0;
        for (long j = 0; j < s; j++) sum += (now[j] *= e[j]);
        if (!(sum > 0.0)) return -INFINITY;
        const double inverse = 1.0 / sum;
        for (long j = 0; j < s; j++) now[j] *= inverse;
        scale[k] = inverse;
        total += log(sum);
    }
    if (!backward) return total;
    double *beta = work, *ahead = work + s;
    for (long j = 0; j < s; j++) beta[j] = 1.0;
    for (long k = n - 1; k >= 0; k--) {
        const double *now = filtered + k * s;
        double *out = emitted + (long)seen[k] * s;
        for (long j = 0; j < s; j++) {
            const double gamma = now[j] * beta[j];
            out[j] += gamma;
            if (k == 0) first[j] += gamma;
        }
        if (k == 0) break;
        const double *before = now - s, *e = emission + (long)seen[k] * s;
        const double *t = transition + (long)action[k - 1] * s * s;
        double *pair = pairs + (long)action[k - 1] * s * s;
        for (long j = 0; j < s; j++) ahead[j] = e[j] * beta[j] * scale[k];
        for (long i = 0; i < s; i++) {
            const double weight = before[i], *row = t + i * s;
            double *to = pair + i * s, sum = 0.0;
            for (long j = 0; j < s; j++) {
                to[j] += weight * ahead[j];
                sum += row[j] * ahead[j];
            }
            beta[i] = sum;
        }
    }
    return total;
}

/* Adds the sums of records that lie one behind the other; filtered and scale hold the longest of them. */
EXPORT double sysid_hmm_counts(long records, const long *lengths, long s, const int *seen, const int *action,
                               const double *start, const double *transition, const double *emission,
                               double *filtered, double *scale, double *pairs, double *emitted, double *first,
                               double *work)
{
    double total = 0.0;
    for (long r = 0; r < records; seen += lengths[r], action += lengths[r], r++)
        total += sysid_hmm_pass(lengths[r], s, seen, action, start, transition, emission, filtered, scale, 1, pairs,
                                emitted, first, work);
    return total;
}
