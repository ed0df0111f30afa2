/* What a plant keeps beside its variables. */
#ifndef MODEL_STATE_H
#define MODEL_STATE_H

#include "disturbance.h"

typedef struct {
    int64_t drawn;    /* whether `deviations` is that of the sample in force */
    int64_t begun;    /* whether the filters have begun, in the first sample of the simulation */
    int64_t filtered; /* the sample that `deviations` belongs to, once they have begun */
    double deviations[2 * N_BLOCKS + 1]; /* one more: C has no empty array */
} ModelState;

/* Interfaces beside co-simulation. */
enum { OFFERS_MODEL_EXCHANGE = 1 };

/* Whether an input that is not finite is for the model to judge; else it is refused. */
enum { JUDGES_INPUTS = 0 };

#endif
