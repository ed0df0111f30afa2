/* The RTI-NMPC in closed loop with an empirical model: `learning.empirical_model.Rollout`, compiled.
 *
 * `sizes.h` has K (states and cost) and the work space of `nominal`, CasADi's code for y(s, a; c) and
 * h(s, a). The controller is the package's own C (`core.h`).
 */
#include "core.h"

#include "sizes.h"

#define N_IN (N_X + N_U)

int nominal(const double **arguments, double **results, long long int *iw, double *w, int memory);

/* From a state `start`, `steps` samples, of which each meets the residual that `picks` names. `c` and
 * `W`, a row (1, s, a) an output, are the model's coefficients. Results, a row a sample: `inputs`
 * (s, a), `predicted` y(s, a; c) + W (1, s, a), and h. The samples before one whose state is not finite
 * are returned as their number, else `steps`. */
int rollout(const double theta[], const double start[], const double c[], const double W[],
            const double residuals[], const int32_t picks[], int steps, double *inputs,
            double *predicted, double *h) {
    CoreState state;
    core_reset(&state);
    memcpy(inputs, start, N_X * sizeof *start);
    for (int step = 0; step < steps; step++, inputs += N_IN, predicted += K, h += K) {
        double w[NOMINAL_W + 1];
        if (!all_finite(inputs, N_X)) return step;
        core_act(&state, inputs, 0, theta);
        core_commit(&state);
        memcpy(inputs + N_X, state.applied, sizeof state.applied);
        const double *arguments[NOMINAL_ARG] = {inputs, inputs + N_X, c};
        double *results[NOMINAL_RES] = {predicted, h};
        long long int iw[NOMINAL_IW + 1];
        if (nominal(arguments, results, iw, w, 0)) predicted[0] = NAN;
        for (int i = 0; i < K; i++) {
            predicted[i] += W[i * (N_IN + 1)];
            for (int j = 0; j < N_IN; j++) predicted[i] += W[i * (N_IN + 1) + 1 + j] * inputs[j];
        }
        if (step + 1 < steps)
            for (int i = 0; i < N_X; i++)
                inputs[N_IN + i] = predicted[i] + h[i] * residuals[(int64_t)picks[step] * K + i];
    }
    return steps;
}
