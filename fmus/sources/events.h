/* Model exchange: the time events at which a sample begins, and the state vector.
 *
 * The sample index is a discrete state: in continuous-time mode it keeps its value, also at the very
 * end of the sample, until the importer handles the time event.
 */
#ifndef EVENTS_H
#define EVENTS_H

#include "outputs.h"
#include "states.h"

#include "exchange.h"

static double next_event_time(const State *state) {
    return (double)(state->sample + 1) * state->v[VR_sampling_time];
}

static Status update_discrete_state(Instance *instance, const char *function) {
    State *state = &instance->state;
    const Grid grid = model_grid(state);
    const int64_t sample = sample_of(grid, locate(grid, state->v[VR_time]).point);
    const Status status = check_stop_time(instance, function, state->v[VR_time]);
    if (status != OK) return status;
    if (!within_reach(state, sample))
        return report(instance, ERROR,
                      "%s: disturbances with a time constant go forwards from sample %lld, by at "
                      "most %d samples at once; this is sample %lld.",
                      function, (long long)state->model.filtered, MAX_SAMPLES_PER_EVENT,
                      (long long)sample);
    move_to_sample(state, sample);
    return OK;
}

#endif
