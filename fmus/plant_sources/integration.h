/* A plant's integration within a sample, in which inputs and disturbances are constant.
 *
 * The rule is Runge and Kutta's of fourth order. A step of the grid whose error is too large is taken
 * in halves, quarters and so on: how fast a plant is shows in its states alone.
 */
#ifndef INTEGRATION_H
#define INTEGRATION_H

#include "equations.h"
#include "grid.h"
#include "states.h"

/* Of a step, as a share of a state's value; an estimate that is far above the error itself. */
#define LARGEST_ERROR 1e-6
/* A state is taken for no smaller than this share of its nominal value. */
#define SMALLEST_SIZE 1e-3
/* A step with so small a share of the largest error is doubled: its error grows by 2^4 at least. */
#define DOUBLED_BELOW 0.02

/* Step over `h` seconds, from states at which `v` is evaluated to states at which it is evaluated.
 *
 * The derivative at the end, in place of the fourth stage's, makes a rule of third order. The
 * difference of both rules is the error.
 *
 * Returns the largest error of a state as a share of its value. */
static double runge_kutta(double v[N_VARIABLES], double h) {
    static const double at[4] = {0.0, 0.5, 0.5, 1.0}, weight[4] = {1.0, 2.0, 2.0, 1.0};
    double x[N_STATES], slope[N_STATES], sum[N_STATES];
    double largest = 0.0;
    for (int i = 0; i < N_STATES; i++) {
        x[i] = v[STATE_REFERENCES[i]];
        slope[i] = v[DERIVATIVE_REFERENCES[i]];
        sum[i] = slope[i];
    }
    for (int stage = 1; stage < 4; stage++) {
        for (int i = 0; i < N_STATES; i++)
            v[STATE_REFERENCES[i]] = x[i] + at[stage] * h * slope[i];
        evaluate(v);
        for (int i = 0; i < N_STATES; i++) {
            slope[i] = v[DERIVATIVE_REFERENCES[i]];
            sum[i] += weight[stage] * slope[i];
        }
    }
    for (int i = 0; i < N_STATES; i++) v[STATE_REFERENCES[i]] = x[i] + h / 6.0 * sum[i];
    evaluate(v);
    for (int i = 0; i < N_STATES; i++) {
        const unsigned state = STATE_REFERENCES[i];
        const double error = h / 6.0 * fabs(v[DERIVATIVE_REFERENCES[i]] - slope[i]);
        const double reached = fmax(fabs(x[i]), fabs(v[state]));
        const double size = fmax(reached, SMALLEST_SIZE * VARIABLES[state].nominal);
        if (!isfinite(error)) return INFINITY;
        largest = fmax(largest, error / size);
    }
    return largest;
}

/* Go over `h` seconds, a step of the grid at most, in parts as small as their error asks for.
 *
 * Returns 0 where MAX_PARTS do not suffice; the states are then somewhere on the way. */
static int cross(double v[N_VARIABLES], double h) {
    double before[N_VARIABLES];
    int64_t parts = 1, left = 1; /* of the step; those that lie ahead */
    while (left > 0) {
        memcpy(before, v, sizeof before);
        const double error = runge_kutta(v, h / (double)parts);
        if (error <= LARGEST_ERROR) {
            left--;
            if (error < DOUBLED_BELOW * LARGEST_ERROR && parts > 1 && left % 2 == 0) {
                parts /= 2;
                left /= 2;
            }
            continue;
        }
        if (parts == MAX_PARTS) return 0;
        memcpy(v, before, sizeof before);
        parts *= 2;
        left *= 2;
    }
    return 1;
}

/* Integrate between two positions of one sample; returns 0 where the plant is too fast. */
static int integrate(double v[N_VARIABLES], Grid grid, GridPosition from, GridPosition to) {
    int64_t whole = to.point - from.point;
    evaluate(v);
    if (whole == 0) return cross(v, (to.fraction - from.fraction) * grid.step);
    if (from.fraction > 0.0) {
        if (!cross(v, (1.0 - from.fraction) * grid.step)) return 0;
        whole--;
    }
    for (int64_t i = 0; i < whole; i++)
        if (!cross(v, grid.step)) return 0;
    return to.fraction > 0.0 ? cross(v, to.fraction * grid.step) : 1;
}

#endif
