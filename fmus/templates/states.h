/* Generated from the table of {{ model.name }}; do not edit. */
#ifndef STATES_H
#define STATES_H

#include "variables.h"

enum { N_STATES = {{ states|length }}, N_DISTURBANCES = {{ drawn|length }} };

static const unsigned STATE_REFERENCES[N_STATES] = { {%- for x in states %}VR_{{ x }}{{ ", " if not loop.last else "" }}{% endfor -%} };
static const unsigned DERIVATIVE_REFERENCES[N_STATES] = { {%- for x in states %}VR_der_{{ x }}{{ ", " if not loop.last else "" }}{% endfor -%} };
static const unsigned START_REFERENCES[N_STATES] = { {%- for x in states %}VR_{{ x }}_start{{ ", " if not loop.last else "" }}{% endfor -%} };

/* The last row is none: C has no empty array. */
static const struct {
    int realised, nominal, range, time_constant;
} DISTURBANCES[N_DISTURBANCES + 1] = {
{% for d in drawn %}
    {VR_{{ d }}, VR_{{ d }}_nominal, VR_{{ d }}_range, VR_{{ d }}_time_constant},
{% endfor %}
    {0, 0, 0, 0},
};

#endif
