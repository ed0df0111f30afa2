/* Derivatives of the filter by the logarithms of its variances, as
 * `controllers.estimator_sensitivities` has them: each step of the filter differentiated. */
#ifndef FILTER_SENSITIVITIES_H
#define FILTER_SENSITIVITIES_H

#include "filter.h"

/* By each variance: of all z, of their covariance, and of the likelihood of the readings. */
typedef struct {
    double z[FILTER_NOISES][FILTER_KEPT][FILTER_Z];
    double covariance[FILTER_NOISES][FILTER_ALL][FILTER_ALL];
    double log_likelihood[FILTER_NOISES];
} FilterSlopes;

/* Of what `filter_move` does, before it is done. */
static void filter_slopes_move(FilterSlopes *slopes, const Filter *filter, const double u[],
                               const FilterStep *step) {
    for (int q = 0; q < FILTER_NOISES; q++) {
        double (*const slope)[FILTER_ALL] = slopes->covariance[q];
        FilterStep moved;
        {
            const double *arguments[TRANSITION_BY_Z_ARG] = {filter->z[0], u, filter->sigma,
                                                                slopes->z[q][0]};
            double *results[TRANSITION_BY_Z_RES] = {moved.stack}, w[TRANSITION_BY_Z_W + 1];
            long long int iw[TRANSITION_BY_Z_IW + 1];
            if (estimator_transition_by_z(arguments, results, iw, w, 0)) moved.stack[0] = NAN;
        }
        double across[FILTER_Z][FILTER_ALL], present[FILTER_Z][FILTER_Z];
        double through_A[FILTER_Z][FILTER_Z], through_G[FILTER_Z][FILTER_Z];
        for (int i = 0; i < FILTER_Z; i++)
            for (int j = 0; j < FILTER_ALL; j++) {
                double sum = 0.0;
                for (int k = 0; k < FILTER_Z; k++) {
                    sum += filter_A(&moved, i, k) * filter->covariance[k][j];
                    sum += filter_A(step, i, k) * slope[k][j];
                }
                across[i][j] = sum;
            }
        /* A P, and G' Σ Gᵀ. */
        for (int i = 0; i < FILTER_Z; i++)
            for (int j = 0; j < FILTER_Z; j++) {
                double sum = 0.0, noise = 0.0;
                for (int k = 0; k < FILTER_Z; k++)
                    sum += filter_A(step, i, k) * filter->covariance[k][j];
                for (int k = 0; k < FILTER_D; k++)
                    noise += filter_G(&moved, i, k) * filter->variances[k] * filter_G(step, j, k);
                through_A[i][j] = sum;
                through_G[i][j] = noise;
            }
        for (int i = 0; i < FILTER_Z; i++)
            for (int j = 0; j < FILTER_Z; j++) {
                double sum = through_G[i][j] + through_G[j][i];
                for (int k = 0; k < FILTER_Z; k++) {
                    sum += across[i][k] * filter_A(step, j, k);
                    sum += through_A[i][k] * filter_A(&moved, j, k);
                }
                /* A variance is the derivative of itself by its logarithm. */
                if (q < FILTER_D)
                    sum += filter->variances[q] * filter_G(step, i, q) * filter_G(step, j, q);
                present[i][j] = sum;
            }
        if (FILTER_D <= q && q < FILTER_FIRST_SENSOR) {
            const int drifting = FILTER_Z - FILTER_DRIFTS + q - FILTER_D;
            present[drifting][drifting] += filter->variances[q];
        }
        filter_shift(slope, across, present);
        for (int k = FILTER_KEPT - 1; k > 0; k--)
            memcpy(slopes->z[q][k], slopes->z[q][k - 1], sizeof slopes->z[q][k]);
        memcpy(slopes->z[q][0], moved.stack + TRANSITION_z_next, sizeof slopes->z[q][0]);
    }
}

/* Of what `filter_correct_by` does with a reading of sensor i, before it is done. */
static void filter_slopes_correct_by(FilterSlopes *slopes, const Filter *filter, int i,
                                     const FilterInnovation *innovation) {
    const int delay = FILTER_DELAYS[i], first = delay * FILTER_Z;
    const double variance = innovation->variance, error = innovation->innovation;
    const double share = error / variance;
    for (int q = 0; q < FILTER_NOISES; q++) {
        double moved[OUTPUT_SIZE], across[FILTER_ALL], by_variance = 0.0;
        {
            const double *arguments[OUTPUT_BY_Z_ARG] = {filter->z[delay], slopes->z[q][delay]};
            double *results[OUTPUT_BY_Z_RES] = {moved}, w[OUTPUT_BY_Z_W + 1];
            long long int iw[OUTPUT_BY_Z_IW + 1];
            if (estimator_output_by_z(arguments, results, iw, w, 0)) moved[OUTPUT_y + i] = NAN;
        }
        const double reading = moved[OUTPUT_y + i];
        const double *const slope = moved + OUTPUT_C + i; /* every FILTER_Y-th entry */
        for (int r = 0; r < FILTER_ALL; r++) {
            double sum = 0.0;
            for (int j = 0; j < FILTER_Z; j++) {
                sum += slopes->covariance[q][r][first + j] * innovation->slope[j];
                sum += filter->covariance[r][first + j] * slope[j * FILTER_Y];
            }
            across[r] = sum;
        }
        for (int j = 0; j < FILTER_Z; j++) {
            by_variance += slope[j * FILTER_Y] * innovation->across[first + j];
            by_variance += across[first + j] * innovation->slope[j];
        }
        if (q == FILTER_FIRST_SENSOR + i) by_variance += filter->variances[q];

        double *const z = slopes->z[q][0];
        for (int r = 0; r < FILTER_ALL; r++) {
            const double gain = innovation->across[r] / variance;
            const double by_gain = (across[r] - by_variance * gain) / variance;
            z[r] += by_gain * error - reading * gain;
            for (int j = 0; j < FILTER_ALL; j++)
                slopes->covariance[q][r][j] -= by_gain * innovation->across[j] + gain * across[j];
        }
        /* Of −(e²/v + log 2πv)/2; the innovation moves against the expected reading. */
        slopes->log_likelihood[q] += share * reading;
        slopes->log_likelihood[q] += (share * share - 1.0 / variance) * by_variance / 2.0;
    }
}

#endif
