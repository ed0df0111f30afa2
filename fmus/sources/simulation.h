/* The co-simulation step: integration from sample to sample. */
#ifndef SIMULATION_H
#define SIMULATION_H

#include "experiment.h"
#include "integration.h"
#include "states.h"

/* Steps of the grid in one call: half a year of seconds, at most about two seconds of computing. */
#define MAX_STEPS_PER_CALL 16777216

/* Go through the samples between two positions; returns 0 where the plant is too fast. */
static int advance(State *state, Grid grid, GridPosition from, GridPosition to) {
    int64_t sample = sample_of(grid, from.point);
    for (;;) {
        const GridPosition next = {(sample + 1) * grid.steps, 0.0};
        const int last = to.point < next.point;
        move_to_sample(state, sample);
        if (to.point == from.point && to.fraction == from.fraction) return 1;
        realise(state);
        if (!integrate(state->v, grid, from, last ? to : next)) return 0;
        if (last) return 1;
        from = next;
        sample++;
    }
}

static Status do_step(Instance *instance, const char *function, double time, double h) {
    State *state = &instance->state;
    const Grid grid = model_grid(state);
    const double end = time + h;
    State before;
    const Status status = check_step(instance, function, time, h);
    if (status != OK) return status;
    const GridPosition from = locate(grid, time), to = locate(grid, end);
    if (to.point - from.point > MAX_STEPS_PER_CALL)
        return report(instance, DISCARD, "%s: step size %g s needs more than %d integration steps.",
                      function, h, MAX_STEPS_PER_CALL);
    before = *state;
    if (!advance(state, grid, from, to)) {
        *state = before;
        return report(instance, ERROR,
                      "%s: the states change too fast between %g s and %g s, or grow without "
                      "bound: steps of %.2g s do not follow them.",
                      function, time, end, grid.step / MAX_PARTS);
    }
    for (int i = 0; i < N_STATES; i++) {
        if (isfinite(state->v[STATE_REFERENCES[i]])) continue;
        *state = before;
        return report(instance, ERROR, "%s: the states left the finite numbers.", function);
    }
    state->v[VR_time] = end;
    state->outputs_current = 0;
    return OK;
}

#endif
