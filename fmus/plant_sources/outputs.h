/* The calculated variables: the disturbances of the sample, then the plant's equations. */
#ifndef OUTPUTS_H
#define OUTPUTS_H

#include "disturbance.h"
#include "equations.h"
#include "instance.h"
#include "states.h"

/* The disturbances of the sample: nominal, or drawn anew in each and held. */
static void realise(State *state) {
    double *v = state->v;
    const int stochastic = v[VR_stochastic] != 0.0;
    if (stochastic && !state->model.drawn) {
        const uint32_t key[2] = {(uint32_t)v[VR_seed], (uint32_t)v[VR_seedHigh]};
        const double law = v[VR_law_number] != 0.0 ? v[VR_law_number] : v[VR_law];
        standard_draws(key, state->sample, (int)law, state->model.draws);
        state->model.drawn = 1;
    }
    for (int i = 0; i < N_DISTURBANCES; i++) {
        v[DISTURBANCES[i].realised] = v[DISTURBANCES[i].nominal];
        if (stochastic)
            v[DISTURBANCES[i].realised] += v[DISTURBANCES[i].range] * state->model.draws[i];
    }
}

static void start_model(State *state) {
    for (int i = 0; i < N_STATES; i++)
        state->v[STATE_REFERENCES[i]] = state->v[START_REFERENCES[i]];
}

static int has_time_events(const State *state) { return state->v[VR_stochastic] != 0.0; }

#include "sampled.h"

#endif
