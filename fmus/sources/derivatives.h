/* Directional derivatives of every calculated variable: the tangent of evaporator.h, line by line. */
#ifndef DERIVATIVES_H
#define DERIVATIVES_H

#include "access.h"

typedef struct {
    int source[2];    /* value references that the realised disturbance depends on */
    double factor[2]; /* and its partial derivatives */
} DisturbancePartials;

static DisturbancePartials disturbance_partials(const State *state, int i) {
    const int override = state->v[VR_override] != 0.0;
    const int stochastic = !override && state->v[VR_stochastic] != 0.0;
    DisturbancePartials partials;
    partials.source[0] = override ? DISTURBANCES[i].given : DISTURBANCES[i].nominal;
    partials.source[1] = DISTURBANCES[i].range;
    partials.factor[0] = 1.0;
    partials.factor[1] = stochastic ? state->model.deviations[i] : 0.0;
    return partials;
}

/* Before the simulation starts the states are their start parameters. */
static int states_are_parameters(const State *state) {
    return (state->mode & (INSTANTIATED | INITIALIZATION)) != 0;
}

/* Partial derivatives of Q200 = UA2 (T3 - T200) / (1 + UA2 / (2 Cp F200)), UA2 the present one. */
typedef struct {
    double UA2, T3, Cp, F200;
} CondenserPartials;

static CondenserPartials condenser_partials(const double *v) {
    const double UA2 = v[VR_UA2_present];
    const double r = UA2 / (2.0 * v[VR_Cp] * v[VR_F200]);
    const double s = 1.0 / (1.0 + r);
    const double difference = v[VR_T3] - v[VR_T200];
    CondenserPartials partials;
    partials.UA2 = difference * s * s;
    partials.T3 = UA2 * s;
    partials.Cp = UA2 * difference * s * s * r / v[VR_Cp];
    partials.F200 = UA2 * difference * s * s * r / v[VR_F200];
    return partials;
}

/* d holds the seeds of the known variables; on return also the tangents of all others. */
static void tangent(const State *state, double d[N_VARIABLES]) {
    const double *v = state->v;
    const CondenserPartials q = condenser_partials(v);
    const FoulingPartials u = fouling_partials(v, state->sample);
    if (states_are_parameters(state)) {
        d[VR_X2] = d[VR_X2_start];
        d[VR_P2] = d[VR_P2_start];
    }
    for (int i = 0; i < N_DISTURBANCES; i++) {
        const DisturbancePartials p = disturbance_partials(state, i);
        d[DISTURBANCES[i].realised] =
            p.factor[0] * d[p.source[0]] + p.factor[1] * d[p.source[1]];
    }
    d[VR_UA2_present] = u.UA2 * d[VR_UA2] + u.fouling_rate * d[VR_fouling_rate] +
                        u.fouling_floor * d[VR_fouling_floor] +
                        u.cleaning_period * d[VR_cleaning_period] +
                        u.sampling_time * d[VR_sampling_time];
    d[VR_T2] = v[VR_a] * d[VR_P2] + d[VR_a] * v[VR_P2] + v[VR_b] * d[VR_X2] +
               d[VR_b] * v[VR_X2] + d[VR_c];
    d[VR_T3] = v[VR_d] * d[VR_P2] + d[VR_d] * v[VR_P2] + d[VR_e];
    d[VR_T100] = v[VR_f] * d[VR_P100] + d[VR_f] * v[VR_P100] + d[VR_g];
    d[VR_UA1] = v[VR_h] * (d[VR_F1] + d[VR_F3]) + d[VR_h] * (v[VR_F1] + v[VR_F3]);
    d[VR_Q100] =
        v[VR_UA1] * (d[VR_T100] - d[VR_T2]) + d[VR_UA1] * (v[VR_T100] - v[VR_T2]);
    d[VR_F4] = (d[VR_Q100] - v[VR_F1] * v[VR_Cp] * (d[VR_T2] - d[VR_T1]) -
                (d[VR_F1] * v[VR_Cp] + v[VR_F1] * d[VR_Cp]) * (v[VR_T2] - v[VR_T1]) -
                v[VR_F4] * d[VR_lambda_]) /
               v[VR_lambda_];
    d[VR_F2] = d[VR_F1] - d[VR_F4];
    d[VR_Q200] = q.UA2 * d[VR_UA2_present] + q.T3 * (d[VR_T3] - d[VR_T200]) +
                 q.Cp * d[VR_Cp] + q.F200 * d[VR_F200];
    d[VR_F5] = (d[VR_Q200] - v[VR_F5] * d[VR_lambda_]) / v[VR_lambda_];
    d[VR_F100] = (d[VR_Q100] - v[VR_F100] * d[VR_lambda_s]) / v[VR_lambda_s];
    d[VR_economic_cost] =
        10.09 * (d[VR_F2] + d[VR_F3]) + 600.0 * d[VR_F100] + 0.6 * d[VR_F200];
    d[VR_der_X2] = (v[VR_F1] * d[VR_X1] + d[VR_F1] * v[VR_X1] - v[VR_F2] * d[VR_X2] -
                    d[VR_F2] * v[VR_X2]) /
                       (60.0 * v[VR_M]) -
                   v[VR_der_X2] * d[VR_M] / v[VR_M];
    d[VR_der_P2] =
        (d[VR_F4] - d[VR_F5]) / (60.0 * v[VR_C]) - v[VR_der_P2] * d[VR_C] / v[VR_C];
}

/* A known is a real input, state or parameter; an unknown a state, derivative or output. */
static Status check_derivative_arguments(const Instance *instance, const char *function,
                                         const unsigned unknown[], size_t n_unknown,
                                         const unsigned known[], size_t n_known) {
    for (size_t i = 0; i < n_unknown; i++) {
        const Status status = check_reference(instance, function, unknown[i], REAL);
        if (status != OK) return status;
        const VariableKind kind = VARIABLES[unknown[i]].kind;
        if (kind != STATE && kind != DERIVATIVE && kind != OUTPUT)
            return report(instance, ERROR, "%s: %s is not an unknown.", function,
                          VARIABLES[unknown[i]].name);
    }
    for (size_t i = 0; i < n_known; i++) {
        const Status status = check_reference(instance, function, known[i], REAL);
        if (status != OK) return status;
        const VariableKind kind = VARIABLES[known[i]].kind;
        if (kind != STATE && kind != INPUT && kind != FIXED && kind != TUNABLE)
            return report(instance, ERROR, "%s: %s is not a known.", function,
                          VARIABLES[known[i]].name);
    }
    return OK;
}

/* sensitivity = (d unknown / d known) seed */
static Status directional_derivative(Instance *instance, const char *function,
                                     const unsigned unknown[], size_t n_unknown,
                                     const unsigned known[], size_t n_known, const double seed[],
                                     double sensitivity[]) {
    double d[N_VARIABLES] = {0.0};
    const Status status =
        check_derivative_arguments(instance, function, unknown, n_unknown, known, n_known);
    if (status != OK) return status;
    refresh(&instance->state);
    for (size_t i = 0; i < n_known; i++) d[known[i]] += seed[i];
    tangent(&instance->state, d);
    for (size_t i = 0; i < n_unknown; i++) sensitivity[i] = d[unknown[i]];
    return OK;
}

#endif
