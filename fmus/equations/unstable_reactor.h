/* A stirred tank with the exothermic reaction A -> B, held at an unstable steady state by its cooling
 * jacket, whose temperature lags behind that of the coolant. Units: mol/L, K, L, min. */
#ifndef EQUATIONS_H
#define EQUATIONS_H

#include "elementary.h"
#include "variables.h"

#define SECONDS 60.0 /* in a minute */

static void evaluate(double v[N_VARIABLES]) {
    const double exponent = v[VR_E] / v[VR_T]; /* no reaction where the temperature is none */
    const double k = exponent >= 0.0 && exponent < 700.0 ? v[VR_k0] * exponential(-exponent) : 0.0;
    /* However hot it is, A has to come to the catalyst. */
    const double rate = k * v[VR_diffusion] / (k + v[VR_diffusion]) * v[VR_cA];
    const double dilution = v[VR_q] / v[VR_V];
    v[VR_der_cA] = (dilution * (v[VR_cAf] - v[VR_cA]) - rate) / SECONDS;
    v[VR_der_T] = (dilution * (v[VR_Tf] - v[VR_T]) + v[VR_heat] * rate +
                   v[VR_UA] * (v[VR_Tj] - v[VR_T])) /
                  SECONDS;
    v[VR_der_Tj] = (v[VR_coolant] * (v[VR_Tc] - v[VR_Tj]) + v[VR_jacket] * (v[VR_T] - v[VR_Tj])) /
                   SECONDS;
    const double cooling = v[VR_Tf] - v[VR_Tc];
    v[VR_cost] = v[VR_fixed_cost] +
                 v[VR_q] * (v[VR_feed_price] * v[VR_cAf] - (v[VR_cAf] - v[VR_cA])) +
                 v[VR_pump_price] * v[VR_q] * v[VR_q] + v[VR_cooling_price] * cooling * cooling;
}

#endif
