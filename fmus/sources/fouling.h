/* The condenser fouls and is cleaned: its present heat transfer and the partial derivatives of that.
 *
 *     UA2_present = UA2 (floor + (1 - floor) exp(-rate tau)),   tau = k Ts - n period
 *
 * with k Ts the start of the sample and n the number of whole cleaning periods before it: held in the
 * sample as the disturbances are, and a function of the clock, not of the calls that came before.
 */
#ifndef FOULING_H
#define FOULING_H

#include <math.h>

#include "elementary.h"
#include "variables.h"

#define SECONDS_PER_DAY 86400.0

typedef struct {
    double UA2, fouling_rate, fouling_floor, cleaning_period, sampling_time;
} FoulingPartials;

static int fouls(const double *v) {
    return v[VR_fouling_rate] != 0.0 && v[VR_fouling_floor] != 1.0;
}

/* Whole cleaning periods before the sample; a start of the sample that rounding puts before the
 * cleaning counts as the cleaning. Period 0: never cleaned. */
static double cleanings(const double *v, double sample) {
    const double periods =
        sample * v[VR_sampling_time] / (SECONDS_PER_DAY * v[VR_cleaning_period]);
    return v[VR_cleaning_period] == 0.0 ? 0.0 : floor(periods + 1e-9);
}

/* Days since the last cleaning, never negative. */
static double days_since_cleaning(const double *v, double sample) {
    const double days = sample * v[VR_sampling_time] / SECONDS_PER_DAY -
                        cleanings(v, sample) * v[VR_cleaning_period];
    return days > 0.0 ? days : 0.0;
}

/* exp(-rate tau); beyond the 700th power nothing of the clean surface is left. */
static double clean_share(const double *v, double sample) {
    const double exponent = v[VR_fouling_rate] * days_since_cleaning(v, sample);
    return exponent < 700.0 ? exponential(-exponent) : 0.0;
}

static void foul(double v[N_VARIABLES], int64_t sample) {
    v[VR_UA2_present] =
        fouls(v) ? v[VR_UA2] * (v[VR_fouling_floor] +
                                (1.0 - v[VR_fouling_floor]) * clean_share(v, (double)sample))
                 : v[VR_UA2];
}

static FoulingPartials fouling_partials(const double *v, int64_t sample) {
    const double k = (double)sample;
    const double days = days_since_cleaning(v, k), share = clean_share(v, k);
    const double loss = v[VR_UA2] * (1.0 - v[VR_fouling_floor]) * share; /* -d / d(rate tau) */
    const double per_day = days > 0.0 ? loss * v[VR_fouling_rate] : 0.0;
    FoulingPartials partials;
    partials.UA2 = fouls(v) ? v[VR_fouling_floor] + (1.0 - v[VR_fouling_floor]) * share : 1.0;
    partials.fouling_rate = -loss * days;
    partials.fouling_floor = v[VR_UA2] * (1.0 - share);
    partials.cleaning_period = per_day * cleanings(v, k);
    partials.sampling_time = -per_day * k / SECONDS_PER_DAY;
    return partials;
}

#endif
