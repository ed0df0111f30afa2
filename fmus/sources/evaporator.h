/* The evaporation process of Wang and Cameron (1994): every equation once, in evaluation order.
 *
 * `v` holds the value of each variable at its value reference. Model time is in minutes, FMI time in
 * seconds; hence the 60 in the derivatives.
 */
#ifndef EVAPORATOR_H
#define EVAPORATOR_H

#include "variables.h"

static void evaluate(double v[N_VARIABLES]) {
    v[VR_T2] = v[VR_a] * v[VR_P2] + v[VR_b] * v[VR_X2] + v[VR_c];
    v[VR_T3] = v[VR_d] * v[VR_P2] + v[VR_e];
    v[VR_T100] = v[VR_f] * v[VR_P100] + v[VR_g];
    v[VR_UA1] = v[VR_h] * (v[VR_F1] + v[VR_F3]);
    v[VR_Q100] = v[VR_UA1] * (v[VR_T100] - v[VR_T2]);
    v[VR_F4] = (v[VR_Q100] - v[VR_F1] * v[VR_Cp] * (v[VR_T2] - v[VR_T1])) / v[VR_lambda_];
    v[VR_F2] = v[VR_F1] - v[VR_F4];
    v[VR_Q200] = v[VR_UA2] * (v[VR_T3] - v[VR_T200]) /
                 (1.0 + v[VR_UA2] / (2.0 * v[VR_Cp] * v[VR_F200]));
    v[VR_F5] = v[VR_Q200] / v[VR_lambda_];
    v[VR_F100] = v[VR_Q100] / v[VR_lambda_s];
    v[VR_economic_cost] =
        10.09 * (v[VR_F2] + v[VR_F3]) + 600.0 * v[VR_F100] + 0.6 * v[VR_F200];
    v[VR_der_X2] = (v[VR_F1] * v[VR_X1] - v[VR_F2] * v[VR_X2]) / (60.0 * v[VR_M]);
    v[VR_der_P2] = (v[VR_F4] - v[VR_F5]) / (60.0 * v[VR_C]);
}

/* One step of the classical fourth-order Runge-Kutta rule over `h` seconds. */
static void runge_kutta(double v[N_VARIABLES], double h) {
    const double x = v[VR_X2], p = v[VR_P2];
    double dx, dp;
    evaluate(v);
    dx = v[VR_der_X2];
    dp = v[VR_der_P2];
    v[VR_X2] = x + 0.5 * h * v[VR_der_X2];
    v[VR_P2] = p + 0.5 * h * v[VR_der_P2];
    evaluate(v);
    dx += 2.0 * v[VR_der_X2];
    dp += 2.0 * v[VR_der_P2];
    v[VR_X2] = x + 0.5 * h * v[VR_der_X2];
    v[VR_P2] = p + 0.5 * h * v[VR_der_P2];
    evaluate(v);
    dx += 2.0 * v[VR_der_X2];
    dp += 2.0 * v[VR_der_P2];
    v[VR_X2] = x + h * v[VR_der_X2];
    v[VR_P2] = p + h * v[VR_der_P2];
    evaluate(v);
    v[VR_X2] = x + h / 6.0 * (dx + v[VR_der_X2]);
    v[VR_P2] = p + h / 6.0 * (dp + v[VR_der_P2]);
}

#endif
