/* A model that is driven sample by sample: when what is held in a sample, and what is calculated, is out
 * of date. The model itself, in outputs.h, defines start_model, realise and evaluate. */
#ifndef SAMPLED_H
#define SAMPLED_H

#include "deviations.h"
#include "grid.h"
#include "instance.h"

/* What a new value of a variable makes out of date. */
static void note_change(State *state, unsigned vr) {
    state->outputs_current = 0;
    if (VARIABLES[vr].kind == FIXED) state->model.drawn = 0;
}

/* Whether an input beyond its range acts at the bound. */
static int saturates(const State *state) { return state->v[VR_saturate] != 0.0; }

static Grid model_grid(const State *state) { return make_grid(state->v[VR_sampling_time]); }

static void move_to_sample(State *state, int64_t sample) {
    if (sample == state->sample && state->model.drawn) return;
    state->sample = sample;
    state->model.drawn = 0;
    state->outputs_current = 0;
}

/* Whether the part of a state that only the model knows could be its own. */
static int plausible_model(const State *state) {
    for (unsigned vr = 0; vr < N_VARIABLES; vr++)
        if (VARIABLES[vr].type != REAL && state->v[vr] != floor(state->v[vr])) return 0;
    return within_reach(state, state->sample) && plausible_deviations(state);
}

/* After a state came from bytes: what can be computed anew is not trusted. Filtered deviations cannot:
 * they stay, where the filters have come to the sample in force. */
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
        state->model.begun = 0;
        state->sample = sample_of(grid, locate(grid, state->v[VR_time]).point);
        start_model(state);
    }
    realise(state);
    evaluate(state->v);
    state->outputs_current = 1;
}

#endif
