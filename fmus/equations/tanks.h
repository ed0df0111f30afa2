/* The quadruple tank of Johansson (2000), with water drawn from the lower tanks. Units: cm, s, V. */
#ifndef EQUATIONS_H
#define EQUATIONS_H

#include <math.h>

#include "variables.h"

#define GRAVITY 981.0

/* Torricelli's outflow of a tank through its hole, cm3/s; none from an empty one. */
static double outflow(double hole, double level) {
    return level > 0.0 ? hole * sqrt(2.0 * GRAVITY * level) : 0.0;
}

static void evaluate(double v[N_VARIABLES]) {
    const double out1 = outflow(v[VR_a1], v[VR_h1]), out2 = outflow(v[VR_a2], v[VR_h2]);
    const double out3 = outflow(v[VR_a3], v[VR_h3]), out4 = outflow(v[VR_a4], v[VR_h4]);
    const double pump1 = v[VR_k1] * v[VR_v1], pump2 = v[VR_k2] * v[VR_v2];
    v[VR_der_h1] = (out3 + v[VR_split1] * pump1 - out1 - v[VR_d1]) / v[VR_A1];
    v[VR_der_h2] = (out4 + v[VR_split2] * pump2 - out2 - v[VR_d2]) / v[VR_A2];
    v[VR_der_h3] = ((1.0 - v[VR_split2]) * pump2 - out3) / v[VR_A3];
    v[VR_der_h4] = ((1.0 - v[VR_split1]) * pump1 - out4) / v[VR_A4];
    v[VR_cost] = v[VR_v1] * v[VR_v1] + v[VR_v2] * v[VR_v2];
}

#endif
