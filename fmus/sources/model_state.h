/* What a plant keeps beside its variables. */
#ifndef MODEL_STATE_H
#define MODEL_STATE_H

#include "disturbance.h"

typedef struct {
    int64_t drawn;                  /* whether `draws` is that of the sample in force */
    double draws[2 * N_BLOCKS + 1]; /* one more: C has no empty array */
} ModelState;

/* Interfaces beside co-simulation. */
enum { OFFERS_MODEL_EXCHANGE = 1 };

/* Whether an input that is not finite is for the model to judge; else it is refused. */
enum { JUDGES_INPUTS = 0 };

#endif
