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
        standard_draws(key, state->sample, (int)v[VR_law], state->model.draws);
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

static void move_to_sample(State *state, int64_t sample) {
    if (sample == state->sample && state->model.drawn) return;
    state->sample = sample;
    state->model.drawn = 0;
    state->outputs_current = 0;
}

static void start_model(State *state) {
    state->v[VR_X2] = state->v[VR_X2_start];
    state->v[VR_P2] = state->v[VR_P2_start];
}

/* What a new value of a variable makes out of date. */
static void note_change(State *state, unsigned vr) {
    state->outputs_current = 0;
    if (VARIABLES[vr].kind == FIXED) state->model.drawn = 0;
}

static Grid model_grid(const State *state) { return make_grid(state->v[VR_sampling_time]); }

/* Whether the part of a state that only the model knows could be its own. */
static int plausible_model(const State *state) {
    for (unsigned vr = 0; vr < N_VARIABLES; vr++)
        if (VARIABLES[vr].type != REAL && state->v[vr] != floor(state->v[vr])) return 0;
    return 1;
}

/* After a state came from bytes: what can be computed anew is not trusted. */
static void distrust(State *state) {
    state->outputs_current = 0;
    state->model.drawn = 0;
}

/* Bring every calculated variable up to date. */
static void refresh(State *state) {
    if (state->outputs_current) return;
    if (state->mode & (INSTANTIATED | INITIALIZATION)) {
        const Grid grid = model_grid(state);
        state->model.drawn = 0;
        state->sample = sample_of(grid, locate(grid, state->v[VR_time]).point);
        start_model(state);
    }
    realise(state);
    evaluate(state->v);
    state->outputs_current = 1;
}

#endif
