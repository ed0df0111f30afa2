/* A constraint enters the working set: dual steps, and what they change in it. */
#ifndef QP_ENTER_H
#define QP_ENTER_H

#include "qp_set.h"

/* Steps after which a QP is given up. */
#ifndef QP_ITERATIONS
#define QP_ITERATIONS (40 * QP_LIMITS)
#endif

/* Changes of a multiplier that are zero, relative to the constraints' norms. */
#define QP_ROUNDING 1e-11

/* How far v is beyond the limits of constraint i; `side` is set to the limit in question. */
static double qp_violation(const Qp *qp, QpWork *work, int i) {
    const double value = i < QP_N ? work->v[i] : work->y[i - QP_N];
    const double lower = i < QP_N ? qp->lower[i] : qp->row_lower[i - QP_N];
    const double upper = i < QP_N ? qp->upper[i] : qp->row_upper[i - QP_N];
    work->side[i] = value - upper >= lower - value ? 1.0 : -1.0;
    return qp_max(value - upper, lower - value);
}

/* The constraint outside the set that is violated most in the metric of H, or −1 where none is by
 * more than `tolerance` relative to its limit. */
static int qp_most_violated(const Qp *qp, QpWork *work, double tolerance) {
    int worst = -1;
    double most = 0.0;
    for (int i = 0; i < QP_LIMITS; i++) {
        if (work->mode[i] != QP_OUT) continue;
        const double violation = qp_violation(qp, work, i);
        if (!(violation > tolerance * (1.0 + fabs(qp_limit(qp, work, i))))) continue;
        const double merit = violation * violation / (work->gram[i] + 1e-100);
        if (merit > most) most = merit, worst = i;
    }
    return worst;
}

/* Let member k leave, or change between `at` and `beyond` its limit; whether it could. */
static int qp_change(const Qp *qp, QpWork *work, int k) {
    const int i = work->member[k];
    const QpMode before = work->mode[i];
    const double w = i < QP_N ? 0.0 : qp->w[i - QP_N];
    const int leaves = work->mode[i] == QP_AT && work->step[k] < 0.0;
    qp_remove(work, k);
    if (leaves) {
        work->mode[i] = QP_OUT;
        work->mu[i] = 0.0;
        return 1;
    }
    work->mode[i] = work->mode[i] == QP_AT ? QP_BEYOND : QP_AT;
    work->mu[i] = w;
    double pivot = qp_project(qp, work, i);
    if (!(pivot > 1e-14 * work->gram[i])) {
        /* At its limit it would depend on others that are at theirs: those hold it there. */
        work->mode[i] = QP_BEYOND;
        pivot = qp_project(qp, work, i);
    }
    qp_append(work, i, pivot);
    return work->mode[i] != before;
}

/* Raise the multiplier of p until its constraint is met, while the set changes as it must. */
static QpStatus qp_enter(const Qp *qp, QpWork *work, int p, double violation) {
    const int equation = work->mode[p] == QP_FIXED;
    char held[QP_LIMITS] = {0}; /* members that could not change since the set last did */
    if (!equation) work->mode[p] = QP_AT;
    work->mu[p] = 0.0;
    while (work->iterations < QP_ITERATIONS) {
        work->iterations += !equation; /* an equation is met by its first step */
        const double pivot = qp_project(qp, work, p);
        const int met = pivot > 1e-12 * work->gram[p];
        double *const step = work->step;
        double length = met ? violation / pivot : INFINITY;
        int blocking = -1;
        for (int k = work->count - 1; k >= 0; k--) {
            double sum = -work->z[k] / work->D[k];
            for (int j = k + 1; j < work->count; j++) sum -= work->L[k][j] * step[j];
            step[k] = sum;
        }
        if (p >= QP_N && work->mode[p] == QP_AT && qp->w[p - QP_N] - work->mu[p] < length) {
            length = qp->w[p - QP_N] - work->mu[p];
            blocking = work->count;
        }
        for (int k = 0; k < work->count; k++) {
            const int i = work->member[k];
            double room = INFINITY;
            /* Steps of rounding's size would block for ever where they cannot be taken. */
            if (work->mode[i] == QP_FIXED || held[i] ||
                fabs(step[k]) * work->norm[i] <= QP_ROUNDING * work->norm[p])
                continue;
            if (step[k] < 0.0)
                room = work->mu[i] - (work->mode[i] == QP_BEYOND ? qp->w[i - QP_N] : 0.0);
            else if (i >= QP_N && work->mode[i] == QP_AT)
                room = qp->w[i - QP_N] - work->mu[i];
            room = qp_max(room, 0.0) / fabs(step[k]);
            if (room < length) length = room, blocking = k;
        }
        if (!(length < INFINITY)) return QP_ITERATION_LIMIT;
        double direction[QP_N] = {0.0}, dv[QP_N];
        qp_add_rows(work, -work->side[p] * length, p, direction);
        for (int k = 0; k < work->count; k++) {
            const int i = work->member[k];
            work->mu[i] += length * step[k];
            qp_add_rows(work, -work->side[i] * length * step[k], i, direction);
        }
        work->mu[p] += length;
        qp_back(work, direction, dv);
        for (int j = 0; j < QP_N; j++) work->v[j] += dv[j];
        if (met) violation -= length * pivot;
        if (blocking < 0) {
            qp_append(work, p, pivot);
            return QP_SOLVED;
        }
        if (blocking == work->count) {
            work->mode[p] = QP_BEYOND;
        } else {
            const int i = work->member[blocking];
            const int changed = qp_change(qp, work, blocking);
            if (changed) memset(held, 0, sizeof held);
            held[i] = (char)!changed;
        }
    }
    return QP_ITERATION_LIMIT;
}

#endif
