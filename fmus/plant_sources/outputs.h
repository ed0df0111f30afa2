/* The calculated variables: the disturbances of the sample, then the plant's equations. */
#ifndef OUTPUTS_H
#define OUTPUTS_H

#include "deviations.h"
#include "equations.h"
#include "instance.h"
#include "states.h"

/* All that is held in a sample. */
static void realise(State *state) { realise_disturbances(state); }

static void start_model(State *state) {
    for (int i = 0; i < N_STATES; i++)
        state->v[STATE_REFERENCES[i]] = state->v[START_REFERENCES[i]];
}

static int has_time_events(const State *state) { return state->v[VR_stochastic] != 0.0; }

#include "sampled.h"

#endif
