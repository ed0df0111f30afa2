/* The deviations of the sample in force from the nominal disturbances, in units of their ranges.
 *
 * With time constant 0 a deviation is the sample's draw w_k. With T > 0 it is the draws, filtered:
 *
 *     x_k = phi x_(k-1) + sqrt(1 - phi^2) w_k,   phi = exp(-Ts / T),   x_k = w_k in the first sample
 *
 * Each x_k has the mean and the variance of w_k, and the autocorrelation over n samples is phi^n. The
 * filter goes on in every sample, whether its value is used or not: x_k is a function of the seed, the
 * law, the grid, the time constants and the first sample alone, not of the calls that came before.
 */
#ifndef DEVIATIONS_H
#define DEVIATIONS_H

#include <math.h>

#include "disturbance.h"
#include "elementary.h"
#include "instance.h"
#include "states.h"

/* Samples that one event of model exchange may pass over: at most about two seconds of computing. */
#define MAX_SAMPLES_PER_EVENT 16777216

/* phi of a disturbance; below 1e-300 it is zero. */
static double memory(const double *v, int i) {
    const double T = v[DISTURBANCES[i].time_constant];
    const double samples = T > 0.0 ? v[VR_sampling_time] / T : INFINITY;
    return samples < 700.0 ? exponential(-samples) : 0.0;
}

/* Whether any disturbance is filtered. */
static int is_coloured(const double *v) {
    for (int i = 0; i < N_DISTURBANCES; i++)
        if (memory(v, i) > 0.0) return 1;
    return 0;
}

/* The draws of a sample. */
static void draw(const double *v, int64_t sample, double draws[2 * N_BLOCKS + 1]) {
    const uint32_t key[2] = {(uint32_t)v[VR_seed], (uint32_t)v[VR_seedHigh]};
    const double law = v[VR_law_number] != 0.0 ? v[VR_law_number] : v[VR_law];
    standard_draws(key, sample, (int)law, draws);
}

/* Bring the filters to the sample in force, draw by draw. */
static void filter_draws(const double *v, int64_t sample, ModelState *model) {
    double phi[N_DISTURBANCES + 1], gain[N_DISTURBANCES + 1], w[2 * N_BLOCKS + 1];
    for (int i = 0; i < N_DISTURBANCES; i++) {
        phi[i] = memory(v, i);
        gain[i] = sqrt(1.0 - phi[i] * phi[i]);
    }
    while (model->filtered < sample) {
        model->filtered++;
        draw(v, model->filtered, w);
        for (int i = 0; i < N_DISTURBANCES; i++)
            model->deviations[i] =
                phi[i] > 0.0 ? phi[i] * model->deviations[i] + gain[i] * w[i] : w[i];
    }
}

/* Make `deviations` those of the sample in force. */
static void deviate(State *state) {
    ModelState *model = &state->model;
    if (model->drawn) return;
    if (model->begun && is_coloured(state->v)) {
        filter_draws(state->v, state->sample, model);
    } else {
        draw(state->v, state->sample, model->deviations);
        model->filtered = state->sample;
        model->begun = 1;
    }
    model->drawn = 1;
}

/* The realised disturbances: nominal, or drawn in each sample and held. */
static void realise_disturbances(State *state) {
    double *v = state->v;
    const int stochastic = v[VR_stochastic] != 0.0;
    if (stochastic || is_coloured(v)) deviate(state);
    for (int i = 0; i < N_DISTURBANCES; i++) {
        v[DISTURBANCES[i].realised] = v[DISTURBANCES[i].nominal];
        if (stochastic)
            v[DISTURBANCES[i].realised] += v[DISTURBANCES[i].range] * state->model.deviations[i];
    }
}

/* Whether the filters can be brought to this sample: forwards, and soon. */
static int within_reach(const State *state, int64_t sample) {
    const int64_t filtered = state->model.filtered;
    if (!state->model.begun || !is_coloured(state->v)) return 1;
    /* One back: a clock that is behind by rounding. */
    if (sample < filtered) return sample == filtered - 1;
    /* Unsigned: the difference of two numbers of 64 bits may be none with a sign. */
    return (uint64_t)sample - (uint64_t)filtered <= (uint64_t)MAX_SAMPLES_PER_EVENT;
}

/* Whether each deviation is one that the filters can have: with |w| < 9 (sqrt(106 ln 2) is the largest
 * normal draw), |x| <= gain / (1 - phi) max |w|. */
static int plausible_deviations(const State *state) {
    for (int i = 0; i < N_DISTURBANCES; i++) {
        const double phi = memory(state->v, i);
        const double most = 9.0 * sqrt((1.0 + phi) / (1.0 - phi));
        if (!(fabs(state->model.deviations[i]) <= most)) return 0;
    }
    return 1;
}

#endif
