/* The calculated variables: what is held in a sample, then the model's equations. */
#ifndef OUTPUTS_H
#define OUTPUTS_H

#include "disturbance.h"
#include "evaporator.h"
#include "fouling.h"
#include "grid.h"
#include "instance.h"

static const struct {
    int realised, given, nominal, range;
} DISTURBANCES[N_DISTURBANCES] = {
    {VR_X1, VR_X1_in, VR_X1_nominal, VR_X1_range},
    {VR_F1, VR_F1_in, VR_F1_nominal, VR_F1_range},
    {VR_T1, VR_T1_in, VR_T1_nominal, VR_T1_range},
    {VR_T200, VR_T200_in, VR_T200_nominal, VR_T200_range},
};

/* The realised disturbances at the current time and inputs. */
static void realise_disturbances(State *state) {
    double *v = state->v;
    if (v[VR_override] != 0.0) {
        for (int i = 0; i < N_DISTURBANCES; i++)
            v[DISTURBANCES[i].realised] = v[DISTURBANCES[i].given];
        return;
    }
    if (v[VR_stochastic] == 0.0) {
        for (int i = 0; i < N_DISTURBANCES; i++)
            v[DISTURBANCES[i].realised] = v[DISTURBANCES[i].nominal];
        return;
    }
    if (!state->model.drawn) {
        const uint32_t key[2] = {(uint32_t)v[VR_seed], (uint32_t)v[VR_seedHigh]};
        const double law = v[VR_law_number] != 0.0 ? v[VR_law_number] : v[VR_law];
        standard_draws(key, state->sample, (int)law, state->model.draws);
        state->model.drawn = 1;
    }
    for (int i = 0; i < N_DISTURBANCES; i++)
        v[DISTURBANCES[i].realised] =
            v[DISTURBANCES[i].nominal] + v[DISTURBANCES[i].range] * state->model.draws[i];
}

/* All that is held in a sample: the realised disturbances and the condenser's present state. */
static void realise(State *state) {
    realise_disturbances(state);
    foul(state->v, state->sample);
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
