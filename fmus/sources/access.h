/* Access to variables by value reference: what is refused, and the values. */
#ifndef ACCESS_H
#define ACCESS_H

#include "outputs.h"

static Status check_arrays(const Instance *instance, const char *function, const void *vr,
                           size_t n_vr, const void *values, size_t n_values) {
    if (n_vr > 0 && (!vr || !values)) return report(instance, ERROR, "%s: null array.", function);
    if (n_vr != n_values)
        return report(instance, ERROR, "%s: %zu value references but %zu values.", function, n_vr,
                      n_values);
    return OK;
}

static Status check_reference(const Instance *instance, const char *function, unsigned vr,
                              VariableType type) {
    if (vr >= N_VARIABLES)
        return report(instance, ERROR, "%s: unknown value reference %u.", function, vr);
    if (VARIABLES[vr].type != type)
        return report(instance, ERROR, "%s: variable %s (value reference %u) has another type.",
                      function, VARIABLES[vr].name, vr);
    return OK;
}

/* In which modes the importer may give this variable a value. More than the standards demand: CasADi
 * sets states by value reference, and tunable parameters also in continuous-time mode. */
static unsigned settable_modes(const Instance *instance, unsigned vr) {
    switch (VARIABLES[vr].kind) {
        case FIXED: return INSTANTIATED | INITIALIZATION;
        case TUNABLE:
        case INPUT: return SETTABLE;
        case STATE:
            return instance->state.interface == MODEL_EXCHANGE ? EVENT | CONTINUOUS_TIME : 0;
        default: return 0;
    }
}

static Status check_value(const Instance *instance, const char *function, unsigned vr,
                          double value) {
    const VariableInfo *variable = &VARIABLES[vr];
    if (!(settable_modes(instance, vr) & (unsigned)instance->state.mode))
        return report(instance, ERROR, "%s: variable %s cannot be set in state '%s'.", function,
                      variable->name, mode_name(instance->state.mode));
    if (!isfinite(value) && JUDGES_INPUTS && variable->kind == INPUT) return OK;
    if (!isfinite(value))
        return report(instance, ERROR, "%s: the value of %s is not finite.", function,
                      variable->name);
    if (variable->kind == INPUT && saturates(&instance->state)) return OK;
    if (variable->kind != STATE && !(value >= variable->min && value <= variable->max))
        return report(instance, DISCARD, "%s: %s = %.17g is outside [%g, %g]; value kept at %.17g.",
                      function, variable->name, value, variable->min, variable->max,
                      instance->state.v[vr]);
    return OK;
}

static void set_value(State *state, unsigned vr, double value) {
    const VariableInfo *variable = &VARIABLES[vr];
    if (!isfinite(value)) value = NAN;
    if (variable->kind == INPUT && value < variable->min) value = variable->min;
    if (variable->kind == INPUT && value > variable->max) value = variable->max;
    state->v[vr] = value;
    note_change(state, vr);
}

static Status get_values(Instance *instance, const char *function, VariableType type,
                         const unsigned vr[], size_t n, double value[]) {
    Status status = check_arrays(instance, function, vr, n, value, n);
    for (size_t i = 0; status == OK && i < n; i++)
        status = check_reference(instance, function, vr[i], type);
    if (status != OK) return status;
    refresh(&instance->state);
    for (size_t i = 0; i < n; i++) value[i] = instance->state.v[vr[i]];
    return OK;
}

/* All values are checked before any is taken over: a refused call changes nothing. */
static Status set_values(Instance *instance, const char *function, VariableType type,
                         const unsigned vr[], size_t n, const double value[]) {
    Status status = check_arrays(instance, function, vr, n, value, n);
    for (size_t i = 0; status == OK && i < n; i++) {
        status = check_reference(instance, function, vr[i], type);
        if (status == OK) status = check_value(instance, function, vr[i], value[i]);
    }
    if (status != OK) return status;
    for (size_t i = 0; i < n; i++) set_value(&instance->state, vr[i], value[i]);
    return OK;
}

static Status no_such_type(const Instance *instance, const char *function, const void *vr,
                           size_t n, const void *value) {
    const Status status = check_arrays(instance, function, vr, n, value, n);
    if (status != OK || n == 0) return status;
    return report(instance, ERROR, "%s: the model has no variable of this type.", function);
}

#endif
