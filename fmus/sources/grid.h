/* The time grid: each sample [k Ts, (k + 1) Ts) is cut into equal integration steps.
 *
 * A time is a point m (number of whole integration steps since time zero) and the fraction of the step
 * after it. Clocks that drift by rounding (t += h) are snapped to the grid.
 */
#ifndef GRID_H
#define GRID_H

#include <math.h>
#include <stdint.h>

/* s; the error of the evaporator's 60 s sample is then below 5e-10 relative for X2 in [5, 100] %,
 * P2 in [30, 90] kPa, inputs and disturbances in their default ranges. */
#define MAX_INTEGRATION_STEP 1.0

/* A plant that is too fast for a step is integrated in parts of it, this many at most. */
#define MAX_PARTS 16384

typedef struct {
    double step;           /* length of an integration step, s */
    int64_t steps;         /* integration steps in a sample */
} Grid;

typedef struct {
    int64_t point;
    double fraction; /* in [0, 1), exactly 0 on the grid */
} GridPosition;

static Grid make_grid(double sampling_time) {
    Grid grid;
    grid.steps = (int64_t)ceil(sampling_time / MAX_INTEGRATION_STEP - 1e-9);
    if (grid.steps < 1) grid.steps = 1;
    grid.step = sampling_time / (double)grid.steps;
    return grid;
}

/* Times beyond this many integration steps cannot be told apart well enough. */
#define MAX_GRID_POINT 1e12
#define MAX_TIME 1e13 /* s */

static int on_grid_range(Grid grid, double time) {
    return fabs(time / grid.step) <= MAX_GRID_POINT;
}

static GridPosition locate(Grid grid, double time) {
    const double s = time / grid.step;
    const double nearest = floor(s + 0.5);
    const double tolerance = fmin(1e-3, 1e-9 * fmax(1.0, fabs(s)));
    GridPosition position;
    if (fabs(s - nearest) <= tolerance) {
        position.point = (int64_t)nearest;
        position.fraction = 0.0;
    } else {
        position.point = (int64_t)floor(s);
        position.fraction = s - floor(s);
    }
    return position;
}

static int64_t sample_of(Grid grid, int64_t point) {
    const int64_t quotient = point / grid.steps;
    return point % grid.steps < 0 ? quotient - 1 : quotient;
}

#endif
