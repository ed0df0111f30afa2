/* The evaporator's integration within a sample. */
#ifndef INTEGRATION_H
#define INTEGRATION_H

#include "evaporator.h"
#include "grid.h"

/* Of the fastest rate over a step: X2 and P2 then err by less than 1e-5 of what they change. */
#define LARGEST_PROGRESS 0.2

/* Into how many parts a step of `h` seconds is cut, so that each is short beside the plant's time
 * constants: one, but for parameters that make it several times as fast as it ships. */
static double parts_of(Rates rates, double h) {
    const double progress = h * fastest_rate(rates);
    return progress <= LARGEST_PROGRESS ? 1.0 : ceil(progress / LARGEST_PROGRESS);
}

/* Integrate between two positions of one sample, in which inputs, disturbances and fouling are held.
 *
 * Returns 0 where the plant is too fast for the grid. */
static int integrate(double v[N_VARIABLES], Grid grid, GridPosition from, GridPosition to) {
    const Rates rates = held_rates(v);
    const double wanted = parts_of(rates, grid.step);
    if (!(wanted <= MAX_PARTS)) return 0;
    const int64_t parts = (int64_t)wanted;
    const double part = grid.step / wanted;
    int64_t whole = to.point - from.point;
    if (whole == 0) {
        runge_kutta(v, rates, (to.fraction - from.fraction) * part, parts);
        return 1;
    }
    if (from.fraction > 0.0) {
        runge_kutta(v, rates, (1.0 - from.fraction) * part, parts);
        whole--;
    }
    runge_kutta(v, rates, part, whole * parts);
    if (to.fraction > 0.0) runge_kutta(v, rates, to.fraction * part, parts);
    return 1;
}

#endif
