/* The calculated variables: what is held in a sample, then the model's equations. */
#ifndef OUTPUTS_H
#define OUTPUTS_H

#include "deviations.h"
#include "evaporator.h"
#include "fouling.h"
#include "grid.h"
#include "instance.h"

/* All that is held in a sample: the realised disturbances and the condenser's present state. */
static void realise(State *state) {
    double *v = state->v;
    realise_disturbances(state);
    for (int i = 0; v[VR_override] != 0.0 && i < N_DISTURBANCES; i++)
        v[DISTURBANCES[i].realised] = v[DISTURBANCES[i].given];
    foul(v, state->sample);
}

static void start_model(State *state) {
    state->v[VR_X2] = state->v[VR_X2_start];
    state->v[VR_P2] = state->v[VR_P2_start];
}

/* Whether the next sample changes anything that the importer has to wait for. */
static int has_time_events(const State *state) {
    const int draws = state->v[VR_stochastic] != 0.0 && state->v[VR_override] == 0.0;
    return draws || fouls(state->v);
}

#include "sampled.h"

#endif
