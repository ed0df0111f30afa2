/* A heated tank whose product is measured behind a pipe: a dead time, as eight equal lags in a row.
 * Units: kg, degC, min; kW for the duty. */
#ifndef EQUATIONS_H
#define EQUATIONS_H

#include "variables.h"

#define SECONDS 60.0 /* in a minute */
#define CP 4.18 /* kJ/(kg.K), of water */

/* The lags in the order of the flow; the last is the measured temperature. */
static const struct {
    unsigned value, rate;
} PIPE[] = {
    {VR_pipe1, VR_der_pipe1}, {VR_pipe2, VR_der_pipe2}, {VR_pipe3, VR_der_pipe3},
    {VR_pipe4, VR_der_pipe4}, {VR_pipe5, VR_der_pipe5}, {VR_pipe6, VR_der_pipe6},
    {VR_pipe7, VR_der_pipe7}, {VR_T, VR_der_T},
};

enum { LAGS = sizeof PIPE / sizeof PIPE[0] };

static void evaluate(double v[N_VARIABLES]) {
    const double heating = SECONDS * v[VR_Q] / CP; /* kg K/min */
    const double lag = v[VR_dead_time] / LAGS;     /* s */
    /* From an empty tank nothing flows but what comes in; its last kilogram stays to be heated. */
    const double outflow = v[VR_M] <= 0.0 && v[VR_F] > v[VR_Fin] ? v[VR_Fin] : v[VR_F];
    const double content = v[VR_M] > 1.0 ? v[VR_M] : 1.0;
    v[VR_der_M] = (v[VR_Fin] - outflow) / SECONDS;
    v[VR_der_tank] = (v[VR_Fin] * (v[VR_Tin] - v[VR_tank]) + heating) / (SECONDS * content);
    double inflow = v[VR_tank];
    for (int i = 0; i < LAGS; i++) {
        v[PIPE[i].rate] = (inflow - v[PIPE[i].value]) / lag;
        inflow = v[PIPE[i].value];
    }
    v[VR_cost] = v[VR_heat_price] * v[VR_Q] + v[VR_holding_price] * v[VR_M];
}

#endif
