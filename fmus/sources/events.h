/* Model exchange: the time events at which a sample begins, and the state vector.
 *
 * The sample index is a discrete state: in continuous-time mode it keeps its value, also at the very
 * end of the sample, until the importer handles the time event.
 */
#ifndef EVENTS_H
#define EVENTS_H

#include "outputs.h"

enum { N_STATES = 2 };

static const unsigned STATE_REFERENCES[N_STATES] = {VR_X2, VR_P2};
static const unsigned DERIVATIVE_REFERENCES[N_STATES] = {VR_der_X2, VR_der_P2};

#include "exchange.h"

static int has_time_events(const State *state) {
    const int draws = state->v[VR_stochastic] != 0.0 && state->v[VR_override] == 0.0;
    return draws || fouls(state->v);
}

static double next_event_time(const State *state) {
    return (double)(state->sample + 1) * state->v[VR_sampling_time];
}

static Status update_discrete_state(Instance *instance, const char *function) {
    State *state = &instance->state;
    const Grid grid = make_grid(state->v[VR_sampling_time]);
    const Status status = check_stop_time(instance, function, state->v[VR_time]);
    if (status != OK) return status;
    move_to_sample(state, sample_of(grid, locate(grid, state->v[VR_time]).point));
    return OK;
}

#endif
