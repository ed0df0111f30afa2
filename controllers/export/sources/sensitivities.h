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
    value_gradient(arguments, results, iw, w, 0);
}

/* Put the active set of a solution into `work`, by the branches of the proximal operators that
 * `QpSolution.active` takes; whether its gradients are independent. */
static int rti_activate(const Qp *qp, const RtiSolved *solved, QpWork *work) {
    qp_values(qp, work, solved->v, work->y);
    work->count = 0;
    for (int i = 0; i < QP_LIMITS; i++) {
        const int r = i - QP_N;
        const double multiplier = i < QP_N ? solved->nu[i] : solved->lam[r];
        work->mode[i] = QP_OUT;
        work->side[i] = multiplier > 0.0 ? 1.0 : -1.0;
        if (i < QP_N) {
            const double v = solved->v[i];
            if (qp_min(v - qp->lower[i], qp->upper[i] - v) < fabs(multiplier)) work->mode[i] = QP_AT;
        } else {
            const double y = work->y[r];
            const double reach =
                fabs(multiplier) + qp_max(qp->row_lower[r] - y, y - qp->row_upper[r]);
            work->mode[i] = reach > qp->w[r] ? QP_BEYOND : reach > 0.0 ? QP_AT : QP_OUT;
        }
        if (work->mode[i] == QP_OUT) continue;
        const double pivot = qp_project(qp, work, i);
        if (!(pivot > 1e-12 * work->gram[i])) return 0;
        qp_append(work, i, pivot);
    }
    return 1;
}

/* dπ/dθ (N_THETA by action), then dπ/ds (N_X by action), of a solution without an enforced action;
 * QP_ITERATION_LIMIT where the active constraints' gradients are dependent. */
static int rti_policy(const RtiPrepared *prepared, const RtiSolved *solved, QpWork *work,
                      double policy[]) {
    const double *const read = solved->read, *const stack = prepared->stack;
    const Qp qp = rti_qp(prepared, solved);
    double dv[N_U][QP_N], dt[N_U][QP_ROWS], dlam[N_U][QP_ROWS], moved[QP_ROWS];
    const QpStatus status = qp_load(&qp, work);
    if (status != QP_SOLVED) return status;
    if (!rti_activate(&qp, solved, work)) return QP_ITERATION_LIMIT;
    memset(dt, 0, sizeof dt);
    memset(dlam, 0, sizeof dlam);
    for (int a = 0; a < N_U; a++) {
        double q[QP_N] = {0.0}, *const change = work->step;
        qp_add_rows(work, 1.0, a, q);
        for (int k = 0; k < work->count; k++) {
            const int i = work->member[k];
            change[k] = 0.0;
            for (int j = 0; j < work->length[i]; j++) change[k] += work->M[i][j] * q[j];
            change[k] *= work->side[i];
        }
        qp_solve_set(work, change);
        for (int k = 0; k < work->count; k++)
            qp_add_rows(work, -work->side[work->member[k]] * change[k], work->member[k], q);
        qp_back(work, q, dv[a]);
        qp_values(&qp, work, dv[a], moved);
        for (int k = 0; k < work->count; k++) {
            const int i = work->member[k], r = i - QP_N;
            if (i < QP_N) {
                dv[a][i] = 0.0;
            } else if (work->mode[i] == QP_AT) {
                dlam[a][r] = work->side[i] * change[k];
            } else {
                dlam[a][r] = 2.0 * prepared->W[r] * moved[r];
                dt[a][r] = work->side[i] * moved[r];
            }
        }
    }
    const double *arguments[POLICY_ARG] = {
        read + READ_xi,     read + READ_t,      read + READ_chi, solved->v,     solved->lam,
        prepared->x[0],     prepared->u[0],     prepared->theta, stack + PREPARED_A,
        stack + PREPARED_B, prepared->L,        prepared->L_N,   dv[0],         dt[0],
        dlam[0]};
    double *results[POLICY_RES] = {policy}, w[POLICY_W + 1];
    long long int iw[POLICY_IW + 1];
    policy_jacobian(arguments, results, iw, w, 0);
    return QP_SOLVED;
}

#endif
