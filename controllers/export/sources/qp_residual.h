/* How far a solution is from optimal. */
#ifndef QP_RESIDUAL_H
#define QP_RESIDUAL_H

#include "qp_set.h"

/* Largest KKT residual: stationarity relative to its terms, bounds and rows by their proximal
 * operators, each zero at a solution only. */
static inline double qp_residual(const Qp *qp, const QpWork *work) {
    double curvature[QP_N] = {0.0}, pull[QP_N] = {0.0}, y[QP_ROWS];
    double stationarity = 0.0, scale = 1.0, largest = 0.0;
    for (int i = 0; i < QP_N; i++)
        for (int j = 0; j < QP_N; j++) curvature[j] += qp->H[i * QP_N + j] * work->v[i];
    for (int r = 0; r < QP_ROWS; r++)
        for (int j = 0; j < work->length[QP_N + r]; j++)
            pull[j] += work->lam[r] * qp->rows[r * QP_N + j];
    qp_values(qp, work, work->v, y);
    for (int j = 0; j < QP_N; j++) {
        const double sum = curvature[j] + qp->f[j] + work->nu[j] + pull[j];
        stationarity = qp_max(stationarity, fabs(sum));
        scale = qp_max(scale, qp_max(fabs(qp->f[j]), qp_max(fabs(curvature[j]), fabs(pull[j]))));
        largest = qp_max(largest, fabs(work->v[j] - qp_clip(work->v[j] + work->nu[j], qp->lower[j],
                                                          qp->upper[j])));
    }
    for (int r = 0; r < QP_ROWS; r++) {
        const double shifted = y[r] + work->lam[r];
        const double nearest = qp_clip(shifted, qp->row_lower[r], qp->row_upper[r]);
        const double beyond = shifted - nearest;
        const double shrunk = qp_max(fabs(beyond) - qp->w[r], 0.0) / (1.0 + 2.0 * qp->W[r]);
        largest = qp_max(largest, fabs(y[r] - nearest - copysign(shrunk, beyond)));
    }
    return qp_max(largest, stationarity / scale);
}

#endif
