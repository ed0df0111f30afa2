/* The whole seed in one variable, as FMI 3.0 has it. */
#ifndef SEED_H
#define SEED_H

#include "outputs.h"

static uint64_t seed_value(const State *state) {
    return ((uint64_t)state->v[VR_seedHigh] << 32) | (uint64_t)state->v[VR_seed];
}

static void set_seed(State *state, uint64_t seed) {
    state->v[VR_seed] = (double)(seed & UINT32_MAX);
    state->v[VR_seedHigh] = (double)(seed >> 32);
    note_change(state, VR_seed);
}

#endif
