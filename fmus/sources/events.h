/* Model exchange: the time events at which a sample begins, and the state vector.
 *
 * The sample index is a discrete state: in continuous-time mode it keeps its value, also at the very
 * end of the sample, until the importer handles the time event.
 */
#ifndef EVENTS_H
#define EVENTS_H

#include "access.h"
#include "simulation.h"

enum { N_STATES = 2 };

static const unsigned STATE_REFERENCES[N_STATES] = {VR_X2, VR_P2};
static const unsigned DERIVATIVE_REFERENCES[N_STATES] = {VR_der_X2, VR_der_P2};

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

static int offers(const Instance *instance, Interface required, const char *function) {
    if (instance->state.interface == (int32_t)required) return 1;
    report(instance, ERROR, "%s: the instance was made for %s.", function,
           required == CO_SIMULATION ? "model exchange" : "co-simulation");
    return 0;
}

/* A solver may try times past the stop time; the solution must not go there. */
static Status complete_step(const Instance *instance, const char *function) {
    return check_stop_time(instance, function, instance->state.v[VR_time]);
}

static Status set_time(Instance *instance, const char *function, double time) {
    const Status status = check_time(instance, function, time);
    if (status != OK) return status;
    instance->state.v[VR_time] = time;
    return OK;
}

static Status check_vector(const Instance *instance, const char *function, const void *vector,
                           size_t n) {
    if (n == N_STATES && vector) return OK;
    return report(instance, ERROR, "%s: needs an array of %d, got %zu.", function, N_STATES, n);
}

static Status set_continuous_states(Instance *instance, const char *function, const double x[],
                                    size_t n) {
    const Status status = check_vector(instance, function, x, n);
    if (status != OK) return status;
    return set_values(instance, function, REAL, STATE_REFERENCES, n, x);
}

static Status get_vector(Instance *instance, const char *function, const unsigned references[],
                         double value[], size_t n) {
    const Status status = check_vector(instance, function, value, n);
    if (status != OK) return status;
    return get_values(instance, function, REAL, references, n, value);
}

static Status get_nominals(const Instance *instance, const char *function, double value[],
                           size_t n) {
    const Status status = check_vector(instance, function, value, n);
    if (status != OK) return status;
    for (size_t i = 0; i < n; i++) value[i] = VARIABLES[STATE_REFERENCES[i]].nominal;
    return OK;
}

#endif
