/* The library that runs `controllers.ExtendedKalmanFilter`: its two phases, with derivatives by the
 * logarithms of its variances where they are wanted. */
#include <stddef.h>

#include "filter.h"
#include "filter_sensitivities.h"

/* The filter, what goes in, and what a correction says of the readings: `standardised` has the
 * innovations over their expected deviations, NaN where no reading came. Doubles only, in the order in
 * which Python has them. */
typedef struct {
    double action[FILTER_U], y[FILTER_Y], standardised[FILTER_Y], log_likelihood;
    Filter filter;
} FilterMemory;

size_t filter_sizes(int what) {
    return what == 0 ? sizeof(FilterMemory) : sizeof(FilterSlopes);
}

/* Go on by a sample under `action`; whether what is predicted is finite. `slopes` may be null. */
int filter_predict(FilterMemory *memory, FilterSlopes *slopes) {
    FilterStep step;
    filter_step(&memory->filter, memory->action, &step);
    if (slopes) filter_slopes_move(slopes, &memory->filter, memory->action, &step);
    filter_move(&memory->filter, &step);
    return filter_finite(&memory->filter);
}

/* Take up the readings `y`, NaN where there is none; 0, and nothing is done, where one is infinite. */
int filter_correct(FilterMemory *memory, FilterSlopes *slopes) {
    Filter *const filter = &memory->filter;
    for (int i = 0; i < FILTER_Y; i++)
        if (isinf(memory->y[i])) return 0;
    /* One after the other: their noises are independent, so that nothing is inverted. */
    for (int i = 0; i < FILTER_Y; i++) {
        memory->standardised[i] = NAN;
        if (isnan(memory->y[i])) continue;
        FilterInnovation found;
        filter_innovate(filter, i, memory->y[i], &found);
        memory->standardised[i] = found.innovation / sqrt(found.variance);
        memory->log_likelihood -= (found.innovation * found.innovation / found.variance +
                                   log(6.283185307179586 * found.variance)) / 2.0;
        if (slopes) filter_slopes_correct_by(slopes, filter, i, &found);
        filter_correct_by(filter, &found);
    }
    return 1;
}
