/* A sampled system offers no model exchange: it has no states there and no events. */
#ifndef EVENTS_H
#define EVENTS_H

#include "outputs.h"

enum { N_STATES = 0 };

static const unsigned STATE_REFERENCES[1] = {0};
static const unsigned DERIVATIVE_REFERENCES[1] = {0};

#include "exchange.h"

static int has_time_events(const State *state) {
    (void)state;
    return 0;
}

static double next_event_time(const State *state) { return state->v[VR_time]; }

static Status update_discrete_state(Instance *instance, const char *function) {
    return report(instance, ERROR, "%s: not offered by this FMU.", function);
}

#endif
