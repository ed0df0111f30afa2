/* Adjoint derivatives of every known variable: the statements of evaporator.h in reverse. */
#ifndef ADJOINT_H
#define ADJOINT_H

#include "derivatives.h"

/* s holds the seeds of the unknowns; on return also the adjoints of all known variables. */
static void adjoint(const State *state, double s[N_VARIABLES]) {
    const double *v = state->v;
    const CondenserPartials q = condenser_partials(v);
    const FoulingPartials u = fouling_partials(v, state->sample);
    double y;
    y = s[VR_der_P2] / (60.0 * v[VR_C]);
    s[VR_F4] += y;
    s[VR_F5] -= y;
    s[VR_C] -= s[VR_der_P2] * v[VR_der_P2] / v[VR_C];
    y = s[VR_der_X2] / (60.0 * v[VR_M]);
    s[VR_F1] += y * v[VR_X1];
    s[VR_X1] += y * v[VR_F1];
    s[VR_F2] -= y * v[VR_X2];
    s[VR_X2] -= y * v[VR_F2];
    s[VR_M] -= s[VR_der_X2] * v[VR_der_X2] / v[VR_M];
    y = s[VR_economic_cost];
    s[VR_F2] += 10.09 * y;
    s[VR_F3] += 10.09 * y;
    s[VR_F100] += 600.0 * y;
    s[VR_F200] += 0.6 * y;
    y = s[VR_F100] / v[VR_lambda_s];
    s[VR_Q100] += y;
    s[VR_lambda_s] -= y * v[VR_F100];
    y = s[VR_F5] / v[VR_lambda_];
    s[VR_Q200] += y;
    s[VR_lambda_] -= y * v[VR_F5];
    y = s[VR_Q200];
    s[VR_UA2_present] += q.UA2 * y;
    s[VR_T3] += q.T3 * y;
    s[VR_T200] -= q.T3 * y;
    s[VR_Cp] += q.Cp * y;
    s[VR_F200] += q.F200 * y;
    s[VR_F1] += s[VR_F2];
    s[VR_F4] -= s[VR_F2];
    y = s[VR_F4] / v[VR_lambda_];
    s[VR_Q100] += y;
    s[VR_F1] -= y * v[VR_Cp] * (v[VR_T2] - v[VR_T1]);
    s[VR_Cp] -= y * v[VR_F1] * (v[VR_T2] - v[VR_T1]);
    s[VR_T2] -= y * v[VR_F1] * v[VR_Cp];
    s[VR_T1] += y * v[VR_F1] * v[VR_Cp];
    s[VR_lambda_] -= y * v[VR_F4];
    y = s[VR_Q100];
    s[VR_UA1] += y * (v[VR_T100] - v[VR_T2]);
    s[VR_T100] += y * v[VR_UA1];
    s[VR_T2] -= y * v[VR_UA1];
    y = s[VR_UA1];
    s[VR_h] += y * (v[VR_F1] + v[VR_F3]);
    s[VR_F1] += y * v[VR_h];
    s[VR_F3] += y * v[VR_h];
    y = s[VR_T100];
    s[VR_f] += y * v[VR_P100];
    s[VR_P100] += y * v[VR_f];
    s[VR_g] += y;
    y = s[VR_T3];
    s[VR_d] += y * v[VR_P2];
    s[VR_P2] += y * v[VR_d];
    s[VR_e] += y;
    y = s[VR_T2];
    s[VR_a] += y * v[VR_P2];
    s[VR_P2] += y * v[VR_a];
    s[VR_b] += y * v[VR_X2];
    s[VR_X2] += y * v[VR_b];
    s[VR_c] += y;
    y = s[VR_UA2_present];
    s[VR_UA2] += u.UA2 * y;
    s[VR_fouling_rate] += u.fouling_rate * y;
    s[VR_fouling_floor] += u.fouling_floor * y;
    s[VR_cleaning_period] += u.cleaning_period * y;
    s[VR_sampling_time] += u.sampling_time * y;
    for (int i = 0; i < N_DISTURBANCES; i++) {
        const DisturbancePartials p = disturbance_partials(state, i);
        for (int j = 0; j < 2; j++)
            s[p.source[j]] += p.factor[j] * s[DISTURBANCES[i].realised];
    }
    if (states_are_parameters(state)) {
        s[VR_X2_start] += s[VR_X2];
        s[VR_P2_start] += s[VR_P2];
        s[VR_X2] = s[VR_P2] = 0.0;
    }
}

/* sensitivity = (d unknown / d known)^T seed */
static Status adjoint_derivative(Instance *instance, const char *function,
                                 const unsigned unknown[], size_t n_unknown,
                                 const unsigned known[], size_t n_known, const double seed[],
                                 double sensitivity[]) {
    double s[N_VARIABLES] = {0.0};
    const Status status =
        check_derivative_arguments(instance, function, unknown, n_unknown, known, n_known);
    if (status != OK) return status;
    refresh(&instance->state);
    for (size_t i = 0; i < n_unknown; i++) s[unknown[i]] += seed[i];
    adjoint(&instance->state, s);
    for (size_t i = 0; i < n_known; i++) sensitivity[i] = s[known[i]];
    return OK;
}

#endif
