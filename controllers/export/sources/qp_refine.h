/* Iterative refinement for a working set, and what its multipliers show to be wrong with it. */
#ifndef QP_REFINE_H
#define QP_REFINE_H

#include "qp_enter.h"

/* How often a guess of the working set is mended before it is dropped. */
enum { QP_GUESSES = 4 };

/* What a member of a guess must add to the working set, relative to its own square. */
#define QP_INDEPENDENT 1e-8

/* One step of iterative refinement for the working set; returns the size of the correction of v
 * relative to v. */
static double qp_refine(const Qp *qp, QpWork *work) {
    double r[QP_N], q[QP_N] = {0.0}, *const change = work->step, largest = 0.0, size = 1.0;
    for (int j = 0; j < QP_N; j++) r[j] = -qp->f[j];
    for (int i = 0; i < QP_N; i++)
        for (int j = 0; j < QP_N; j++) r[j] -= qp->H[i * QP_N + j] * work->v[i];
    for (int k = 0; k < work->count; k++) {
        const int i = work->member[k];
        const double lambda = work->side[i] * work->mu[i];
        if (i < QP_N)
            r[i] -= lambda;
        else
            for (int j = 0; j < work->length[i]; j++)
                r[j] -= lambda * qp->rows[(i - QP_N) * QP_N + j];
    }
    for (int j = 0; j < QP_N; j++) qp_add_rows(work, r[j], j, q);
    qp_values(qp, work, work->v, work->y);
    for (int k = 0; k < work->count; k++) {
        const int i = work->member[k];
        const double value = i < QP_N ? work->v[i] : work->y[i - QP_N];
        double sum = 0.0;
        for (int j = 0; j < work->length[i]; j++) sum += work->M[i][j] * q[j];
        change[k] = work->side[i] * (sum + value) - qp_limit(qp, work, i);
        if (work->mode[i] == QP_BEYOND)
            change[k] -= (work->mu[i] - qp->w[i - QP_N]) * qp_compliance(qp, work, i);
    }
    qp_solve_set(work, change);
    for (int k = 0; k < work->count; k++) {
        const int i = work->member[k];
        work->mu[i] += change[k];
        qp_add_rows(work, -work->side[i] * change[k], i, q);
    }
    qp_back(work, q, r);
    for (int j = 0; j < QP_N; j++) {
        work->v[j] += r[j];
        largest = qp_max(largest, fabs(r[j]));
        size = qp_max(size, fabs(work->v[j]));
    }
    for (int k = 0; k < work->count; k++) {
        const int i = work->member[k];
        if (i < QP_N) work->v[i] = work->side[i] > 0 ? qp->upper[i] : qp->lower[i];
    }
    qp_values(qp, work, work->v, work->y);
    return largest / size;
}

/* Let go of a member whose refined multiplier has the wrong sign; whether there was one. */
static int qp_release(QpWork *work) {
    double scale = 1.0;
    for (int k = 0; k < work->count; k++) scale = qp_max(scale, work->mu[work->member[k]]);
    for (int k = 0; k < work->count; k++) {
        const int i = work->member[k];
        if (work->mode[i] == QP_FIXED || work->mu[i] >= -1e-10 * scale) continue;
        work->mode[i] = QP_OUT;
        work->mu[i] = 0.0;
        qp_remove(work, k);
        return 1;
    }
    return 0;
}

/* Let every member change its mode or leave whose multiplier is none of its mode; how many there were. */
static int qp_mend(const Qp *qp, QpWork *work) {
    int changes = 0;
    for (int k = work->count - 1; k >= 0; k--) { /* a change moves only what lies behind it */
        const int i = work->member[k];
        const double mu = work->mu[i], w = i < QP_N ? INFINITY : qp->w[i - QP_N];
        if (work->mode[i] == QP_FIXED || (mu >= 0.0 && (work->mode[i] == QP_AT) == (mu <= w)))
            continue;
        work->step[k] = mu < 0.0 ? -1.0 : 1.0;
        qp_change(qp, work, k);
        changes++;
    }
    return changes;
}

/* Take a guess of the working set in and mend it; whether the multipliers are then those of an
 * optimum of the QP with these limits alone, which is where a dual method may begin. */
static int qp_adopt(const Qp *qp, QpWork *work, const double guess[QP_LIMITS]) {
    const int equations = work->count;
    for (int i = 0; i < QP_LIMITS; i++) {
        if (guess[i] == 0.0 || work->mode[i] == QP_FIXED) continue;
        work->side[i] = guess[i] > 0.0 ? 1.0 : -1.0;
        if (!isfinite(qp_limit(qp, work, i))) continue;
        work->mode[i] = fabs(guess[i]) > 1.0 ? QP_BEYOND : QP_AT;
        const double pivot = qp_project(qp, work, i);
        if (pivot > QP_INDEPENDENT * work->gram[i])
            qp_append(work, i, pivot);
        else
            work->mode[i] = QP_OUT;
    }
    if (work->count == equations) return 1;
    for (int k = 0; k < QP_GUESSES; k++, work->iterations++) {
        qp_refine(qp, work);
        if (qp_mend(qp, work) == 0) return 1;
    }
    return 0;
}

#endif
