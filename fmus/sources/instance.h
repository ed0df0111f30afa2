/* An instance: its pointer-free state, its logger, and access to variables by value reference. */
#ifndef INSTANCE_H
#define INSTANCE_H

#include <math.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "disturbance.h"
#include "evaporator.h"
#include "grid.h"

typedef enum { OK, WARNING, DISCARD, ERROR } Status; /* numbered as in FMI 2.0 and 3.0 */

typedef enum { MODEL_EXCHANGE, CO_SIMULATION } Interface;

/* Bits, so that a set of modes is one mask. */
typedef enum {
    INSTANTIATED = 1,
    INITIALIZATION = 2,
    EVENT = 4,
    CONTINUOUS_TIME = 8,
    STEP = 16,
    TERMINATED = 32
} Mode;

enum {
    ANY_MODE = 63,
    READABLE = INITIALIZATION | EVENT | CONTINUOUS_TIME | STEP | TERMINATED,
    SETTABLE = INSTANTIATED | INITIALIZATION | EVENT | CONTINUOUS_TIME | STEP
};

typedef enum { LOG_EVENTS, LOG_WARNING, LOG_DISCARD, LOG_ERROR, N_CATEGORIES } Category;

static const char *const CATEGORY_NAMES[N_CATEGORIES] = {
    "logEvents", "logStatusWarning", "logStatusDiscard", "logStatusError"};

#define STATE_MAGIC LAYOUT_DIGEST
#define STATE_VERSION 1

typedef struct {
    uint64_t magic;
    uint32_t version;
    uint32_t size;
    int32_t interface;
    int32_t mode;
    int32_t experiment_defined;
    int32_t outputs_current;
    int64_t sample; /* index k of the disturbance in force */
    int64_t drawn;  /* whether `draws` is that of `sample` */
    double start_time;
    double stop_time; /* INFINITY when the importer gave none */
    double draws[N_DISTURBANCES];
    double v[N_VARIABLES];
    uint64_t checksum; /* set in serialised states only */
} State;

typedef struct Instance Instance;
typedef void (*LogFunction)(const Instance *, Status, const char *category, const char *message);

struct Instance {
    State state;
    char *name;
    void *environment;
    void (*logger)(void);
    LogFunction log;
    unsigned categories; /* bit set of Category */
};

/* Messages hold neither '%' nor '#', which FMI 2.0 loggers would interpret. */
static Status report(const Instance *instance, Status status, const char *format, ...) {
    static const Category of[] = {LOG_EVENTS, LOG_WARNING, LOG_DISCARD, LOG_ERROR};
    char message[512];
    va_list arguments;
    if (!instance->logger || !(instance->categories & (1u << of[status]))) return status;
    va_start(arguments, format);
    vsnprintf(message, sizeof message, format, arguments);
    va_end(arguments);
    instance->log(instance, status, CATEGORY_NAMES[of[status]], message);
    return status;
}

static const char *mode_name(int mode) {
    switch (mode) {
        case INSTANTIATED: return "instantiated";
        case INITIALIZATION: return "initialization mode";
        case EVENT: return "event mode";
        case CONTINUOUS_TIME: return "continuous-time mode";
        case STEP: return "step mode";
        default: return "terminated";
    }
}

static int allowed(const Instance *instance, unsigned modes, const char *function) {
    if (!instance) return 0;
    if ((unsigned)instance->state.mode & modes) return 1;
    report(instance, ERROR, "%s: not allowed in state '%s'.", function,
           mode_name(instance->state.mode));
    return 0;
}

static char *copy_string(const char *text) {
    char *copy = malloc(strlen(text) + 1);
    if (copy) strcpy(copy, text);
    return copy;
}

static void reset_state(State *state, Interface interface) {
    memset(state, 0, sizeof *state);
    state->magic = STATE_MAGIC;
    state->version = STATE_VERSION;
    state->size = sizeof *state;
    state->interface = interface;
    state->mode = INSTANTIATED;
    state->stop_time = INFINITY;
    for (int vr = 0; vr < N_VARIABLES; vr++) state->v[vr] = VARIABLES[vr].start;
    state->v[VR_X2] = state->v[VR_X2_start];
    state->v[VR_P2] = state->v[VR_P2_start];
}

static void free_instance(Instance *instance) {
    if (!instance) return;
    free(instance->name);
    free(instance);
}

/* NULL, with a logged message, when name or token is not acceptable. */
static Instance *open_instance(const char *name, Interface interface, const char *token,
                               void *environment, void (*logger)(void), LogFunction log,
                               int logging_on) {
    Instance *instance = calloc(1, sizeof *instance);
    if (!instance) return NULL;
    instance->environment = environment;
    instance->logger = logger;
    instance->log = log;
    instance->categories = (1u << N_CATEGORIES) - 1u;
    if (!logging_on) instance->categories &= ~(1u << LOG_EVENTS);
    instance->name = copy_string(name ? name : "");
    reset_state(&instance->state, interface);
    if (!instance->name || instance->name[0] == '\0')
        report(instance, ERROR, "instantiation: the instance needs a name.");
    else if (!token || strcmp(token, MODEL_TOKEN) != 0)
        report(instance, ERROR, "instantiation: the token differs from the model's, %s.",
               MODEL_TOKEN);
    else
        return instance;
    free_instance(instance);
    return NULL;
}

static Status set_logging(Instance *instance, const char *function, int on, size_t n,
                          const char *const names[]) {
    unsigned chosen = n == 0 ? (1u << N_CATEGORIES) - 1u : 0u;
    if (n > 0 && !names) return report(instance, ERROR, "%s: null array.", function);
    for (size_t i = 0; i < n; i++) {
        int category = 0;
        while (category < N_CATEGORIES &&
               (!names[i] || strcmp(names[i], CATEGORY_NAMES[category]) != 0))
            category++;
        if (category == N_CATEGORIES)
            return report(instance, ERROR, "%s: unknown logging category at index %zu.", function,
                          i);
        chosen |= 1u << category;
    }
    if (on)
        instance->categories |= chosen;
    else
        instance->categories &= ~chosen;
    return OK;
}

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
    if (!state->drawn) {
        const uint32_t key[2] = {(uint32_t)v[VR_seed], (uint32_t)v[VR_seedHigh]};
        standard_draws(key, state->sample, (int)v[VR_law], state->draws);
        state->drawn = 1;
    }
    for (int i = 0; i < N_DISTURBANCES; i++)
        v[DISTURBANCES[i].realised] =
            v[DISTURBANCES[i].nominal] + v[DISTURBANCES[i].range] * state->draws[i];
}

static void move_to_sample(State *state, int64_t sample) {
    if (sample == state->sample && state->drawn) return;
    state->sample = sample;
    state->drawn = 0;
    state->outputs_current = 0;
}

/* Bring every calculated variable up to date. */
static void refresh(State *state) {
    if (state->outputs_current) return;
    if (state->mode & (INSTANTIATED | INITIALIZATION)) {
        const Grid grid = make_grid(state->v[VR_sampling_time]);
        state->drawn = 0;
        state->sample = sample_of(grid, locate(grid, state->v[VR_time]).point);
        state->v[VR_X2] = state->v[VR_X2_start];
        state->v[VR_P2] = state->v[VR_P2_start];
    }
    realise_disturbances(state);
    evaluate(state->v);
    state->outputs_current = 1;
}

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
    if (!isfinite(value))
        return report(instance, ERROR, "%s: the value of %s is not finite.", function,
                      variable->name);
    if (variable->kind != STATE && !(value >= variable->min && value <= variable->max))
        return report(instance, DISCARD, "%s: %s = %.17g is outside [%g, %g]; value kept at %.17g.",
                      function, variable->name, value, variable->min, variable->max,
                      instance->state.v[vr]);
    return OK;
}

static void set_value(State *state, unsigned vr, double value) {
    state->v[vr] = value;
    state->outputs_current = 0;
    if (VARIABLES[vr].kind == FIXED) state->drawn = 0;
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
