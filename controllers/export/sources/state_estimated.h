/* The state as the extended Kalman filter estimates it. The inputs are the readings y, and behind them
 * whether each of them is fresh: one that is not, or that is not finite, is not taken up. */
#ifndef STATE_ESTIMATED_H
#define STATE_ESTIMATED_H

#include "filter.h"

enum { OBSERVER_INPUTS = 2 * FILTER_Y };

/* A sample may be computed several times, from other readings: it begins from `before`, the filter
 * before the readings of the present sample. */
typedef struct {
    Filter before, corrected;
} Observer;

static inline void observer_reset(Observer *observer) {
    memcpy(observer->before.variances, FILTER_VARIANCES, sizeof observer->before.variances);
    filter_reset(&observer->before);
    observer->corrected = observer->before;
}

/* The estimate of the present state. */
static inline const double *observer_take(Observer *observer, const double inputs[],
                                          const double theta[]) {
    const double *const fresh = inputs + FILTER_Y;
    Filter *const filter = &observer->corrected;
    *filter = observer->before;
    (void)theta;
#if FILTER_IN_THETA
    for (int i = 0; i < FILTER_NOISES; i++) filter->variances[i] = exp(theta[THETA_noise + i]);
#endif
    for (int i = 0; i < FILTER_SIGNALS; i++)
        filter->sigma[i] = theta[N_THETA + FILTER_ROWS[i]];
    for (int i = 0; i < FILTER_Y; i++) {
        if (fresh[i] == 0.0 || !isfinite(inputs[i])) continue;
        FilterInnovation innovation;
        filter_innovate(filter, i, inputs[i], &innovation);
        filter_correct_by(filter, &innovation);
    }
    return filter->z[0];
}

/* Tighten the bounds in θ by deviations of the present estimate, as `controllers.estimator.Margins`. */
static inline void observer_tighten(const Observer *observer, double theta[]) {
    (void)observer, (void)theta;
#if FILTER_MARGIN
    for (int i = 0; i < N_X; i++) {
        /* Rounding may leave less than nothing of the variance of a state that is known. */
        const double variance = observer->corrected.covariance[i][i];
        const double deviation = sqrt(variance > 0.0 ? variance : 0.0);
        const double *const factors = theta + THETA_margin;
        theta[THETA_x_l + i] += fmin(factors[i] * deviation, FILTER_MOST_MARGIN[i]);
        theta[THETA_x_u + i] -= fmin(factors[N_X + i] * deviation, FILTER_MOST_MARGIN[i]);
    }
#endif
}

static inline int observer_plausible(const Observer *observer) {
    return all_finite(&observer->before.z[0][0], FILTER_ALL) &&
           all_finite(&observer->before.covariance[0][0], FILTER_ALL * FILTER_ALL) &&
           all_finite(observer->before.variances, FILTER_NOISES);
}

/* Predict the next state. What is not finite makes it forget every reading. */
static inline void observer_commit(Observer *observer, const double action[]) {
    Filter *const filter = &observer->before;
    FilterStep step;
    *filter = observer->corrected;
    filter_step(filter, action, &step);
    filter_move(filter, &step);
    if (!filter_finite(filter)) observer_reset(observer);
}

/* Outputs behind the controller's own: the estimates of the state and of the uncertain parameters. */
static inline void observer_outputs(const Observer *observer, double y[]) {
    memcpy(y, observer->corrected.z[0], sizeof observer->corrected.z[0]);
}

#endif
