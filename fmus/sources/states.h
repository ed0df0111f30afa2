/* The continuous states and their derivatives, and how many disturbances there are. */
#ifndef STATES_H
#define STATES_H

#include "variables.h"

enum { N_STATES = 2, N_DISTURBANCES = 4 };

static const unsigned STATE_REFERENCES[N_STATES] = {VR_X2, VR_P2};
static const unsigned DERIVATIVE_REFERENCES[N_STATES] = {VR_der_X2, VR_der_P2};

#endif
