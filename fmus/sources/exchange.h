/* Model exchange for any model that names its states: time, state vector, what is refused.
 *
 * The including file defines N_STATES, STATE_REFERENCES and DERIVATIVE_REFERENCES.
 */
#ifndef EXCHANGE_H
#define EXCHANGE_H

#include "access.h"
#include "experiment.h"

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
