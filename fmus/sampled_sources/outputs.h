/* The outputs: computed at a sample, held until the next one.
 *
 * At a sample the outputs follow the inputs without delay: a value read after an input was set there
 * is that of this sample, as the step from there will find it. After a step the outputs are those of
 * the sample that it began with, until an input is set again.
 */
#ifndef OUTPUTS_H
#define OUTPUTS_H

#include "grid.h"
#include "instance.h"
#include "system.h"

static void start_model(State *state) {
    core_reset(&state->model.core);
    state->model.due = 0;
    state->model.fresh = 0;
}

/* What a new value of a variable makes out of date. */
static void note_change(State *state, unsigned vr) {
    (void)vr;
    state->outputs_current = 0;
    state->model.fresh = 0;
}

/* An input beyond its range is refused. */
static int saturates(const State *state) {
    (void)state;
    return 0;
}

static Grid model_grid(const State *state) {
    const Grid grid = {SAMPLING_TIME, 1};
    (void)state, (void)make_grid, (void)sample_of; /* grid.h is that of plants, too */
    return grid;
}

/* Whether the part of a state that only the model knows could be its own. */
static int plausible_model(const State *state) {
    const ModelState *model = &state->model;
    return (model->due == 0 || model->due == 1) && (model->fresh == 0 || model->fresh == 1) &&
           core_plausible(&model->core);
}

/* After a state came from bytes: the outputs are part of it, since they may be held. */
static void distrust(State *state) { (void)state; }

static void evaluate_sample(State *state) {
    core_evaluate(&state->model.core, state->v + FIRST_INPUT, FIRST_OUTPUT - FIRST_INPUT,
                  state->v + FIRST_PARAMETER);
    core_outputs(&state->model.core, state->v + FIRST_OUTPUT);
    state->model.fresh = 1;
}

/* Bring every calculated variable up to date. */
static void refresh(State *state) {
    if (state->outputs_current) return;
    if (state->mode & (INSTANTIATED | INITIALIZATION)) {
        const GridPosition position = locate(model_grid(state), state->v[VR_time]);
        start_model(state);
        state->sample = position.point;
        state->model.due = position.fraction == 0.0;
        evaluate_sample(state);
    } else if (state->model.due) {
        evaluate_sample(state);
    }
    state->outputs_current = 1;
}

#endif
