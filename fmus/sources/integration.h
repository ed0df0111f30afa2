/* The evaporator's integration within a sample. */
#ifndef INTEGRATION_H
#define INTEGRATION_H

#include "evaporator.h"
#include "grid.h"

/* Integrate between two positions of one sample, in which inputs, disturbances and fouling are constant. */
static void integrate(double v[N_VARIABLES], Grid grid, GridPosition from, GridPosition to) {
    const Rates rates = held_rates(v);
    int64_t whole = to.point - from.point;
    if (whole == 0) {
        runge_kutta(v, rates, (to.fraction - from.fraction) * grid.step, 1);
        return;
    }
    if (from.fraction > 0.0) {
        runge_kutta(v, rates, (1.0 - from.fraction) * grid.step, 1);
        whole--;
    }
    runge_kutta(v, rates, grid.step, whole);
    if (to.fraction > 0.0) runge_kutta(v, rates, to.fraction * grid.step, 1);
}

#endif
