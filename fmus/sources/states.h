/* The continuous states and their derivatives, and the disturbances. */
#ifndef STATES_H
#define STATES_H

#include "variables.h"

enum { N_STATES = 2, N_DISTURBANCES = 4 };

static const unsigned STATE_REFERENCES[N_STATES] = {VR_X2, VR_P2};
static const unsigned DERIVATIVE_REFERENCES[N_STATES] = {VR_der_X2, VR_der_P2};

static const struct {
    int realised, given, nominal, range, time_constant;
} DISTURBANCES[N_DISTURBANCES] = {
    {VR_X1, VR_X1_in, VR_X1_nominal, VR_X1_range, VR_X1_time_constant},
    {VR_F1, VR_F1_in, VR_F1_nominal, VR_F1_range, VR_F1_time_constant},
    {VR_T1, VR_T1_in, VR_T1_nominal, VR_T1_range, VR_T1_time_constant},
    {VR_T200, VR_T200_in, VR_T200_nominal, VR_T200_range, VR_T200_time_constant},
};

#endif
