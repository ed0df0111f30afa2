/* An instance: its pointer-free state, its mode, its logger. */
#ifndef INSTANCE_H
#define INSTANCE_H

#include <math.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "model_state.h"
#include "variables.h"

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
#define STATE_VERSION 3

typedef struct {
    uint64_t magic;
    uint32_t version;
    uint32_t size;
    int32_t interface;
    int32_t mode;
    int32_t experiment_defined;
    int32_t outputs_current;
    int64_t sample; /* index k of the sample in force */
    double start_time;
    double stop_time; /* INFINITY when the importer gave none */
    ModelState model;
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

static void start_model(State *state); /* the model's part of a reset */

static void reset_state(State *state, Interface interface) {
    memset(state, 0, sizeof *state);
    state->magic = STATE_MAGIC;
    state->version = STATE_VERSION;
    state->size = sizeof *state;
    state->interface = interface;
    state->mode = INSTANTIATED;
    state->stop_time = INFINITY;
    for (int vr = 0; vr < N_VARIABLES; vr++) state->v[vr] = VARIABLES[vr].start;
    start_model(state);
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
    else if (interface == MODEL_EXCHANGE && !OFFERS_MODEL_EXCHANGE)
        report(instance, ERROR, "instantiation: the model is for co-simulation only.");
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

#endif
