/* How far a solution is from optimal. */
#ifndef QP_RESIDUAL_H
#define QP_RESIDUAL_H

#include "qp_set.h"

/* Largest KKT residual: stationarity relative to its terms, bounds and rows by their proximal
 * operators, each zero at a solution only: see `controllers.qp.QpSolution.residual`. */
static inline double qp_residual(const Qp *qp, const QpWork *work) {
    double curvature[QP_N] = {0.0}, pull[QP_N] = {0.0}, y[QP_ROWS], largest = 0.0;
    for (int i = 0; i < QP_N; i++)
        for (int j = 0; j < QP_N; j++) curvature[j] += qp->H[i * QP_N + j] * work->v[i];
    for (int r = 0; r < QP_ROWS; r++)
        for (int j = 0; j < work->length[QP_N + r]; j++)
            pull[j] += work->lam[r] * qp->rows[r * QP_N + j];
    qp_values(qp, work, work->v, y);
    for (int j = 0; j < QP_N; j++) {
        const double sum = curvature[j] + qp->f[j] + work->nu[j] + pull[j];
        double size = qp_max(1e-30, fabs(qp->H[j * QP_N + j]));
        size = qp_max(size, qp_max(fabs(work->nu[j]), fabs(qp->f[j])));
        size = qp_max(size, qp_max(fabs(curvature[j]), fabs(pull[j])));
        const double moved = work->v[j] + work->nu[j] / size;
        largest = qp_max(largest, fabs(sum) / size);
        largest = qp_max(largest, fabs(work->v[j] - qp_clip(moved, qp->lower[j], qp->upper[j])));
    }
    for (int r = 0; r < QP_ROWS; r++) {
        const double moved = y[r] + work->lam[r] / qp->w[r];
        const double nearest = qp_clip(moved, qp->row_lower[r], qp->row_upper[r]);
        const double beyond = moved - nearest;
        const double shrunk = qp_max(fabs(beyond) - 1.0, 0.0) / (1.0 + 2.0 * qp->W[r] / qp->w[r]);
        const double gap = fabs(y[r] - nearest - copysign(shrunk, beyond));
        largest = qp_max(largest, gap / (1.0 + fabs(y[r])));
    }
    return largest;
}

#endif
