/* The nominal model at many inputs: `learning.empirical_model.Features`, compiled.
 *
 * `sizes.h` has N_X, N_IN (states and actions), K (states and cost) and P (parameters); `nominal.h` is
 * CasADi's code. Where the loop takes that in, the compiler makes several inputs at a time of it.
 */
#include <math.h>

#include "sizes.h"

#include "nominal.h"

/* y, its derivative G by the parameters, and h at `count` inputs (s, a), a row each. */
void features_at(const double (*restrict inputs)[N_IN], const double *restrict c, long long count,
                 double (*restrict y)[K], double (*restrict G)[K][P], double (*restrict h)[K]) {
    for (long long k = 0; k < count; k++) {
        const double *arguments[] = {inputs[k], inputs[k] + N_X, c};
        double *results[] = {y[k], G[k][0], h[k]};
        features(arguments, results, 0, 0, 0);
    }
}
