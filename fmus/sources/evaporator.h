/* The evaporation process of Wang and Cameron (1994): every equation once, in evaluation order.
 *
 * `v` holds the value of each variable at its value reference. Model time is in minutes, FMI time in
 * seconds; hence the 60 in the derivatives.
 */
#ifndef EVAPORATOR_H
#define EVAPORATOR_H

#include <math.h>
#include <stdint.h>

#include "variables.h"

static void evaluate(double v[N_VARIABLES]) {
    v[VR_T2] = v[VR_a] * v[VR_P2] + v[VR_b] * v[VR_X2] + v[VR_c];
    v[VR_T3] = v[VR_d] * v[VR_P2] + v[VR_e];
    v[VR_T100] = v[VR_f] * v[VR_P100] + v[VR_g];
    v[VR_UA1] = v[VR_h] * (v[VR_F1] + v[VR_F3]);
    v[VR_Q100] = v[VR_UA1] * (v[VR_T100] - v[VR_T2]);
    v[VR_F4] = (v[VR_Q100] - v[VR_F1] * v[VR_Cp] * (v[VR_T2] - v[VR_T1])) / v[VR_lambda_];
    v[VR_F2] = v[VR_F1] - v[VR_F4];
    v[VR_Q200] = v[VR_UA2_present] * (v[VR_T3] - v[VR_T200]) /
                 (1.0 + v[VR_UA2_present] / (2.0 * v[VR_Cp] * v[VR_F200]));
    v[VR_F5] = v[VR_Q200] / v[VR_lambda_];
    v[VR_F100] = v[VR_Q100] / v[VR_lambda_s];
    v[VR_economic_cost] =
        10.09 * (v[VR_F2] + v[VR_F3]) + 600.0 * v[VR_F100] + 0.6 * v[VR_F200];
    v[VR_der_X2] = (v[VR_F1] * v[VR_X1] - v[VR_F2] * v[VR_X2]) / (60.0 * v[VR_M]);
    v[VR_der_P2] = (v[VR_F4] - v[VR_F5]) / (60.0 * v[VR_C]);
}

/* With inputs and disturbances held, F4 and F5 are affine in the states, hence per second
 *     dX2/dt = x0 - (x1 + xx X2 + xp P2) X2,    dP2/dt = p0 - px X2 - pp P2. */
typedef struct {
    double x0, x1, xx, xp, p0, px, pp;
} Rates;

static Rates held_rates(const double v[N_VARIABLES]) {
    const double UA1 = v[VR_h] * (v[VR_F1] + v[VR_F3]);
    const double T100 = v[VR_f] * v[VR_P100] + v[VR_g];
    const double heat = v[VR_F1] * v[VR_Cp];
    const double slope = (UA1 + heat) / v[VR_lambda_]; /* F4 = offset - slope T2 */
    const double offset = (UA1 * T100 + heat * v[VR_T1]) / v[VR_lambda_];
    const double UA2 = v[VR_UA2_present];
    const double condenser = UA2 / (1.0 + UA2 / (2.0 * v[VR_Cp] * v[VR_F200])) /
                             v[VR_lambda_]; /* F5 = condenser (T3 - T200) */
    const double F4_at_zero = offset - slope * v[VR_c];
    const double m = 1.0 / (60.0 * v[VR_M]), n = 1.0 / (60.0 * v[VR_C]);
    Rates rates;
    rates.x0 = v[VR_F1] * v[VR_X1] * m;
    rates.x1 = (v[VR_F1] - F4_at_zero) * m;
    rates.xx = slope * v[VR_b] * m;
    rates.xp = slope * v[VR_a] * m;
    rates.p0 = (F4_at_zero - condenser * (v[VR_e] - v[VR_T200])) * n;
    rates.px = slope * v[VR_b] * n;
    rates.pp = (slope * v[VR_a] + condenser * v[VR_d]) * n;
    return rates;
}

/* Bound of both eigenvalues' size, per second, for X2 up to 100 % and P2 up to 400 kPa: the larger
 * entry on the diagonal of the Jacobian, and the root of the product of the others. */
static double fastest_rate(Rates r) {
    const double X2 = VARIABLES[VR_X2].max, P2 = VARIABLES[VR_P2].max;
    const double diagonal = fabs(r.x1) + 2.0 * fabs(r.xx) * X2 + fabs(r.xp) * P2;
    return fmax(diagonal, fabs(r.pp)) + sqrt(fabs(r.xp * r.px) * X2);
}

static Rates scaled(Rates rates, double h) {
    const Rates result = {rates.x0 * h, rates.x1 * h, rates.xx * h, rates.xp * h,
                          rates.p0 * h, rates.px * h, rates.pp * h};
    return result;
}

static double increment_X2(Rates r, double x, double p) {
    return r.x0 - (r.x1 + r.xx * x + r.xp * p) * x;
}

static double increment_P2(Rates r, double x, double p) { return r.p0 - r.px * x - r.pp * p; }

/* `n` steps of the classical fourth-order Runge-Kutta rule, each over `h` seconds. The first two
 * stages are halved increments, so that no multiplication stands between them and the next state. */
static void runge_kutta(double v[N_VARIABLES], Rates rates, double h, int64_t n) {
    const Rates full = scaled(rates, h), half = scaled(rates, 0.5 * h);
    double x = v[VR_X2], p = v[VR_P2];
    for (int64_t i = 0; i < n; i++) {
        const double x1 = increment_X2(half, x, p), p1 = increment_P2(half, x, p);
        const double x2 = increment_X2(half, x + x1, p + p1);
        const double p2 = increment_P2(half, x + x1, p + p1);
        const double x3 = increment_X2(full, x + x2, p + p2);
        const double p3 = increment_P2(full, x + x2, p + p2);
        const double x4 = increment_X2(full, x + x3, p + p3);
        const double p4 = increment_P2(full, x + x3, p + p3);
        x += (2.0 * (x1 + 2.0 * x2 + x3) + x4) * (1.0 / 6.0);
        p += (2.0 * (p1 + 2.0 * p2 + p3) + p4) * (1.0 / 6.0);
    }
    v[VR_X2] = x;
    v[VR_P2] = p;
}

#endif
