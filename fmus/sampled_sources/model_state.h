/* What a sampled system keeps beside its variables.
 *
 * `core.h` is the system's own: it defines CoreState, core_reset, core_evaluate, core_outputs,
 * core_commit, core_plausible and CORE_MESSAGES, and knows nothing of FMI.
 */
#ifndef MODEL_STATE_H
#define MODEL_STATE_H

#include "core.h"

typedef struct {
    CoreState core;
    int64_t due;   /* whether a sample begins at the present time */
    int64_t fresh; /* whether that sample was computed from the present inputs */
} ModelState;

/* Interfaces beside co-simulation. */
enum { OFFERS_MODEL_EXCHANGE = 0 };

/* An input that is not finite reaches the core as NaN: a sensor may fail while the loop goes on. */
enum { JUDGES_INPUTS = 1 };

#endif
