/* Copies of the state: handles in memory, and bytes that another process can read. */
#ifndef SNAPSHOT_H
#define SNAPSHOT_H

#include <stddef.h>

#include "grid.h"
#include "instance.h"

/* FNV-1a over all bytes before the checksum itself. */
static uint64_t checksum(const State *state) {
    const unsigned char *byte = (const unsigned char *)state;
    uint64_t hash = UINT64_C(14695981039346656037);
    for (size_t i = 0; i < offsetof(State, checksum); i++)
        hash = (hash ^ byte[i]) * UINT64_C(1099511628211);
    return hash;
}

static Status take_snapshot(Instance *instance, const char *function, void **handle) {
    if (!handle) return report(instance, ERROR, "%s: null handle.", function);
    if (!*handle) *handle = malloc(sizeof(State));
    if (!*handle) return report(instance, ERROR, "%s: out of memory.", function);
    memcpy(*handle, &instance->state, sizeof(State));
    return OK;
}

static Status check_snapshot(const Instance *instance, const char *function, const State *saved) {
    if (!saved) return report(instance, ERROR, "%s: null state.", function);
    if (saved->magic != STATE_MAGIC || saved->version != STATE_VERSION ||
        saved->size != sizeof(State))
        return report(instance, ERROR, "%s: not a state of this FMU.", function);
    if (saved->interface != instance->state.interface)
        return report(instance, ERROR,
                      "%s: the state is of the other interface (co-simulation, model exchange).",
                      function);
    return OK;
}

static Status restore_snapshot(Instance *instance, const char *function, const void *handle) {
    const Status status = check_snapshot(instance, function, handle);
    if (status == OK) memcpy(&instance->state, handle, sizeof(State));
    return status;
}

static Status free_snapshot(Instance *instance, const char *function, void **handle) {
    if (!handle) return report(instance, ERROR, "%s: null handle.", function);
    free(*handle);
    *handle = NULL;
    return OK;
}

static Status serialised_size(const Instance *instance, const char *function, const void *handle,
                              size_t *size) {
    const Status status = check_snapshot(instance, function, handle);
    if (status != OK) return status;
    if (!size) return report(instance, ERROR, "%s: null argument.", function);
    *size = sizeof(State);
    return OK;
}

static Status serialise(const Instance *instance, const char *function, const void *handle,
                        unsigned char *bytes, size_t size) {
    State copy;
    const Status status = check_snapshot(instance, function, handle);
    if (status != OK) return status;
    if (!bytes || size < sizeof(State))
        return report(instance, ERROR, "%s: the buffer must hold %zu bytes.", function,
                      sizeof(State));
    memcpy(&copy, handle, sizeof copy);
    copy.checksum = checksum(&copy);
    memcpy(bytes, &copy, sizeof copy);
    return OK;
}

/* Whether every value is one that the FMU itself could have stored. */
static int plausible(const State *state) {
    const int32_t mode = state->mode;
    if (mode != INSTANTIATED && mode != INITIALIZATION && mode != TERMINATED &&
        mode != (state->interface == CO_SIMULATION ? STEP : EVENT) &&
        !(mode == CONTINUOUS_TIME && state->interface == MODEL_EXCHANGE))
        return 0;
    if (state->sample > INT64_C(10000000000000) || state->sample < -INT64_C(10000000000000))
        return 0;
    if (!isfinite(state->start_time) || isnan(state->stop_time)) return 0;
    for (unsigned vr = 0; vr < N_VARIABLES; vr++) {
        const VariableInfo *variable = &VARIABLES[vr];
        const double value = state->v[vr];
        if (isnan(value) && JUDGES_INPUTS && variable->kind == INPUT) continue;
        if (!isfinite(value)) return 0;
        if ((variable->kind == INPUT || variable->kind == FIXED || variable->kind == TUNABLE) &&
            !(value >= variable->min && value <= variable->max))
            return 0;
    }
    return plausible_model(state) && on_grid_range(model_grid(state), state->v[VR_time]);
}

static Status deserialise(Instance *instance, const char *function, const unsigned char *bytes,
                          size_t size, void **handle) {
    State copy;
    Status status;
    if (!bytes || !handle) return report(instance, ERROR, "%s: null argument.", function);
    if (size != sizeof(State))
        return report(instance, ERROR, "%s: %zu bytes, but a serialised state has %zu.", function,
                      size, sizeof(State));
    memcpy(&copy, bytes, sizeof copy);
    status = check_snapshot(instance, function, &copy);
    if (status != OK) return status;
    if (copy.checksum != checksum(&copy) || !plausible(&copy))
        return report(instance, ERROR, "%s: the serialised state is corrupt.", function);
    distrust(&copy);
    copy.checksum = 0;
    if (!*handle) *handle = malloc(sizeof(State));
    if (!*handle) return report(instance, ERROR, "%s: out of memory.", function);
    memcpy(*handle, &copy, sizeof copy);
    return OK;
}

#endif
