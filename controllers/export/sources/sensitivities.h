/* Derivatives of a solved QP: dV/dθ or dQ/dθ, dπ/dθ and dπ/ds, as in `controllers.sensitivities`. */
#ifndef SENSITIVITIES_H
#define SENSITIVITIES_H

#include "rti.h"

/* dV/dθ, or dQ/dθ where the action was enforced. */
static void rti_gradient(const RtiPrepared *prepared, RtiSolved *solved) {
    const double *const read = solved->read;
    const double *arguments[GRADIENT_ARG] = {
        read + READ_xi, read + READ_t,    read + READ_chi, solved->v,
        solved->lam,    prepared->x[0], prepared->u[0],  prepared->theta};
    double *results[GRADIENT_RES] = {solved->gradient}, w[GRADIENT_W + 1];
    long long int iw[GRADIENT_IW + 1];
    if (value_gradient(arguments, results, iw, w, 0)) solved->gradient[0] = NAN;
}

/* dπ/dθ (N_THETA by action), then dπ/ds (N_X by action), of a solution without an enforced action;
 * QP_ITERATION_LIMIT where the active constraints' gradients are dependent. */
static int rti_policy(const RtiPrepared *prepared, const RtiSolved *solved, RtiWork *work,
                      double policy[]) {
    const double *const read = solved->read, *const stack = prepared->stack;
    double dv[N_U][QP_N], dt[N_U][QP_ROWS], dlam[N_U][QP_ROWS];
    const int status = rti_directions(prepared, solved, work, dv, dt, dlam);
    if (status != QP_SOLVED) return status;
    const double *arguments[POLICY_ARG] = {
        read + READ_xi,     read + READ_t,      read + READ_chi, solved->v,     solved->lam,
        prepared->x[0],     prepared->u[0],     prepared->theta, stack + PREPARED_A,
        stack + PREPARED_B, prepared->L,        prepared->L_N,   dv[0],         dt[0],
        dlam[0]};
    double *results[POLICY_RES] = {policy}, w[POLICY_W + 1];
    long long int iw[POLICY_IW + 1];
    if (policy_jacobian(arguments, results, iw, w, 0)) policy[0] = NAN;
    return QP_SOLVED;
}

#endif
