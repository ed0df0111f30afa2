/* An extended Kalman filter, as `controllers.ExtendedKalmanFilter` has it in Python.
 *
 * Its state z is the model's, and behind it the model's uncertain parameters. A reading that arrives
 * late is one of an earlier z, so that it keeps FILTER_KEPT of them, the present one first. All
 * matrices are by rows but for CasADi's, which are by columns.
 */
#ifndef FILTER_H
#define FILTER_H

#include <math.h>
#include <string.h>

#include "filter_model.h"

enum { FILTER_ALL = FILTER_KEPT * FILTER_Z, FILTER_FIRST_SENSOR = FILTER_D + FILTER_DRIFTS };

/* σ are the known disturbances and parameters of the model. The variances are of the disturbances, of a drifting parameter's change in a sample, and of the
 * sensors; the covariance is that of all z that are kept. Doubles only, in the order in which Python
 * has them (`controllers.estimator`). */
typedef struct {
    double variances[FILTER_NOISES];
    double sigma[FILTER_SIGMA];
    double z[FILTER_KEPT][FILTER_Z];
    double covariance[FILTER_ALL][FILTER_ALL];
} Filter;

/* What `estimator_transition` makes of z and u, by TRANSITION_z_next, TRANSITION_A and TRANSITION_G. */
typedef struct {
    double stack[TRANSITION_SIZE];
} FilterStep;

/* A reading beside the expected one: what it is off by, the variance of that, the reading's slope by
 * the z that it is of, and the covariance of all z with it. */
typedef struct {
    double innovation, variance, slope[FILTER_Z], across[FILTER_ALL];
} FilterInnovation;

/* ∂z₊_i/∂z_j and ∂z₊_i/∂d_j. */
static inline double filter_A(const FilterStep *step, int i, int j) {
    return step->stack[TRANSITION_A + j * FILTER_Z + i];
}

static inline double filter_G(const FilterStep *step, int i, int j) {
    return step->stack[TRANSITION_G + j * FILTER_Z + i];
}

/* Forget every reading; the variances stay, and what is known is nominal. */
static inline void filter_reset(Filter *filter) {
    memcpy(filter->sigma, FILTER_NOMINAL, sizeof filter->sigma);
    for (int k = 0; k < FILTER_KEPT; k++)
        memcpy(filter->z[k], FILTER_START, sizeof filter->z[k]);
    memset(filter->covariance, 0, sizeof filter->covariance);
    for (int i = 0; i < FILTER_Z; i++)
        filter->covariance[i][i] = FILTER_START_DEVIATION[i] * FILTER_START_DEVIATION[i];
}

/* Whether the present z and its covariance are finite, through which all else comes. */
static inline int filter_finite(const Filter *filter) {
    double sum = 0.0;
    for (int i = 0; i < FILTER_Z; i++) {
        sum += fabs(filter->z[0][i]);
        for (int j = 0; j < FILTER_Z; j++) sum += fabs(filter->covariance[i][j]);
    }
    return isfinite(sum);
}

static void filter_step(const Filter *filter, const double u[], FilterStep *step) {
    const double *arguments[TRANSITION_ARG] = {filter->z[0], u, filter->sigma};
    double *results[TRANSITION_RES] = {step->stack}, w[TRANSITION_W + 1];
    long long int iw[TRANSITION_IW + 1];
    if (estimator_transition(arguments, results, iw, w, 0)) step->stack[0] = NAN;
}

/* Every z moves back by one sample, the oldest is forgotten. `across` is the covariance of z₊ with
 * all z before, `present` that of z₊ itself. */
static void filter_shift(double covariance[FILTER_ALL][FILTER_ALL],
                         double across[FILTER_Z][FILTER_ALL],
                         double present[FILTER_Z][FILTER_Z]) {
    enum { KEPT = FILTER_ALL - FILTER_Z };
    for (int i = FILTER_ALL - 1; i >= FILTER_Z; i--)
        memmove(covariance[i] + FILTER_Z, covariance[i - FILTER_Z], KEPT * sizeof(double));
    for (int i = 0; i < FILTER_Z; i++) {
        memcpy(covariance[i], present[i], sizeof present[i]);
        for (int j = 0; j < KEPT; j++) {
            covariance[i][FILTER_Z + j] = across[i][j];
            covariance[FILTER_Z + j][i] = across[i][j];
        }
    }
}

/* Move on by a sample whose step is known: P₊ = A P Aᵀ + G Σ Gᵀ + Σ_drift. */
static void filter_move(Filter *filter, const FilterStep *step) {
    double across[FILTER_Z][FILTER_ALL], present[FILTER_Z][FILTER_Z];
    for (int i = 0; i < FILTER_Z; i++)
        for (int j = 0; j < FILTER_ALL; j++) {
            double sum = 0.0;
            for (int k = 0; k < FILTER_Z; k++)
                sum += filter_A(step, i, k) * filter->covariance[k][j];
            across[i][j] = sum;
        }
    for (int i = 0; i < FILTER_Z; i++)
        for (int j = 0; j < FILTER_Z; j++) {
            double sum = 0.0;
            for (int k = 0; k < FILTER_Z; k++) sum += across[i][k] * filter_A(step, j, k);
            for (int k = 0; k < FILTER_D; k++)
                sum += filter_G(step, i, k) * filter->variances[k] * filter_G(step, j, k);
            present[i][j] = sum;
        }
    for (int k = 0; k < FILTER_DRIFTS; k++) {
        const int i = FILTER_Z - FILTER_DRIFTS + k;
        present[i][i] += filter->variances[FILTER_D + k];
    }
    filter_shift(filter->covariance, across, present);
    for (int k = FILTER_KEPT - 1; k > 0; k--)
        memcpy(filter->z[k], filter->z[k - 1], sizeof filter->z[k]);
    memcpy(filter->z[0], step->stack + TRANSITION_z_next, sizeof filter->z[0]);
}

/* Compare the reading of sensor i with the expected one; `filter_correct_by` takes it up. */
static void filter_innovate(const Filter *filter, int i, double reading,
                            FilterInnovation *innovation) {
    const int delay = FILTER_DELAYS[i], first = delay * FILTER_Z;
    double stack[OUTPUT_SIZE], w[OUTPUT_W + 1];
    const double *arguments[OUTPUT_ARG] = {filter->z[delay]};
    double *results[OUTPUT_RES] = {stack};
    long long int iw[OUTPUT_IW + 1];
    if (estimator_output(arguments, results, iw, w, 0)) stack[OUTPUT_y + i] = NAN;
    for (int j = 0; j < FILTER_Z; j++) innovation->slope[j] = stack[OUTPUT_C + j * FILTER_Y + i];
    for (int r = 0; r < FILTER_ALL; r++) {
        double sum = 0.0;
        for (int j = 0; j < FILTER_Z; j++)
            sum += filter->covariance[r][first + j] * innovation->slope[j];
        innovation->across[r] = sum;
    }
    double variance = 0.0;
    for (int j = 0; j < FILTER_Z; j++)
        variance += innovation->slope[j] * innovation->across[first + j];
    innovation->variance = variance + filter->variances[FILTER_FIRST_SENSOR + i];
    innovation->innovation = reading - stack[OUTPUT_y + i];
}

static void filter_correct_by(Filter *filter, const FilterInnovation *innovation) {
    double *const z = filter->z[0];
    for (int r = 0; r < FILTER_ALL; r++) {
        const double gain = innovation->across[r] / innovation->variance;
        z[r] += gain * innovation->innovation;
        /* Symmetric by its form; the sensor's variance keeps it positive semidefinite. */
        for (int j = 0; j < FILTER_ALL; j++)
            filter->covariance[r][j] -= gain * innovation->across[j];
    }
}

#endif
