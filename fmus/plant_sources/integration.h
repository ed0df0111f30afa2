/* A plant's integration within a sample, in which inputs and disturbances are constant. */
#ifndef INTEGRATION_H
#define INTEGRATION_H

#include "equations.h"
#include "grid.h"
#include "states.h"

/* One step of the classical fourth-order Runge-Kutta rule over `h` seconds. */
static void runge_kutta(double v[N_VARIABLES], double h) {
    static const double at[4] = {0.0, 0.5, 0.5, 1.0}, weight[4] = {1.0, 2.0, 2.0, 1.0};
    double x[N_STATES], slope[N_STATES] = {0.0}, sum[N_STATES] = {0.0};
    for (int i = 0; i < N_STATES; i++) x[i] = v[STATE_REFERENCES[i]];
    for (int stage = 0; stage < 4; stage++) {
        for (int i = 0; i < N_STATES; i++)
            v[STATE_REFERENCES[i]] = x[i] + at[stage] * h * slope[i];
        evaluate(v);
        for (int i = 0; i < N_STATES; i++) {
            slope[i] = v[DERIVATIVE_REFERENCES[i]];
            sum[i] += weight[stage] * slope[i];
        }
    }
    for (int i = 0; i < N_STATES; i++) v[STATE_REFERENCES[i]] = x[i] + h / 6.0 * sum[i];
}

static void integrate(double v[N_VARIABLES], Grid grid, GridPosition from, GridPosition to) {
    int64_t whole = to.point - from.point;
    if (whole == 0) {
        runge_kutta(v, (to.fraction - from.fraction) * grid.step);
        return;
    }
    if (from.fraction > 0.0) {
        runge_kutta(v, (1.0 - from.fraction) * grid.step);
        whole--;
    }
    for (int64_t i = 0; i < whole; i++) runge_kutta(v, grid.step);
    if (to.fraction > 0.0) runge_kutta(v, to.fraction * grid.step);
}

#endif
