/* The nominal model at many inputs: `learning.empirical_model.Features`, compiled.
 *
 * `sizes.h` has N_X, N_IN (states and actions), K (states and cost), P (parameters) and the work space
 * of `features`; `nominal.h` is CasADi's code. Where the loop takes that in, the compiler makes several inputs at a time of it.
 */
#include <math.h>

#include "sizes.h"

#include "nominal.h"

/* y, its derivative G by the parameters, and h at `count` inputs (s, a), a row each. */
void features_at(const double (*restrict inputs)[N_IN], const double *restrict c, long long count,
                 double (*restrict y)[K], double (*restrict G)[K][P], double (*restrict h)[K]) {
    for (long long k = 0; k < count; k++) {
        const double *arguments[FEATURES_ARG] = {inputs[k], inputs[k] + N_X, c};
        double *results[FEATURES_RES] = {y[k], G[k][0], h[k]}, w[FEATURES_W + 1];
        long long int iw[FEATURES_IW + 1];
        if (features(arguments, results, iw, w, 0)) y[k][0] = NAN;
    }
}
