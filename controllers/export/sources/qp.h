/* A dual active-set method for the condensed QP of one sample, without a byte of allocation.
 *
 *     min_v  ½ vᵀH v + fᵀv + Σ_i w_i t_i + W_i t_i²
 *     s.t.   lower ≤ v ≤ upper,   row_lower − t ≤ Γ v ≤ row_upper + t,   t ≥ 0
 *
 * Goldfarb and Idnani's method with the slack eliminated: the multiplier μ of a soft row may grow
 * beyond w, and the row is then violated by t = (μ − w)/2W. So a member of the working set is at its
 * limit (nᵀv = b) or beyond it (nᵀv = b + (μ − w)/2W), and a dual step ends where a multiplier
 * reaches 0 (the member leaves), w (it changes between the two), or where the constraint that enters
 * is met. A full step raises the dual function strictly, so no working set comes twice.
 *
 * With H = U Uᵀ, U upper triangular, and m_i = U⁻¹ a_i, the working set's matrix is S = M Mᵀ + C, C
 * the compliances 1/2W of the rows beyond their limits; it is kept as L D Lᵀ. A guess of the working
 * set, say that of a QP like it, is mended until its multipliers are such as a full step leaves, or
 * dropped after a few rounds. The last word is iterative refinement with the QP's own data.
 *
 * The including file defines QP_N (variables) and QP_ROWS. Only sqrt is taken from libm, so every
 * platform with IEEE doubles has the same bits.
 */
#ifndef QP_H
#define QP_H

/* GCC vectorises the loops below at -O3 only, clang at -O2; the bits are the same. */
#if defined(__GNUC__) && !defined(__clang__)
#pragma GCC push_options
#pragma GCC optimize("O3")
#endif

#include "qp_refine.h"
#include "qp_residual.h"

enum { QP_ROUNDS = 4 * QP_LIMITS };

/* Violations that are overlooked, relative to 1 + |limit|: on the way, and in the end. */
#define QP_COARSE 1e-8
#define QP_FINE 1e-12

/* From the optimum without limits to that with the equations alone. */
static QpStatus qp_begin(const Qp *qp, QpWork *work) {
    double y[QP_N] = {0.0};
    work->count = 0;
    for (int i = 0; i < QP_LIMITS; i++) {
        work->mode[i] = QP_OUT;
        work->mu[i] = 0.0;
        work->side[i] = 1.0;
    }
    for (int j = 0; j < QP_N; j++) qp_add_rows(work, -qp->f[j], j, y);
    qp_back(work, y, work->v);
    for (int i = 0; i < QP_N; i++) {
        if (qp->lower[i] != qp->upper[i]) continue;
        const double violation = qp_violation(qp, work, i);
        work->mode[i] = QP_FIXED;
        const QpStatus status = qp_enter(qp, work, i, violation);
        if (status != QP_SOLVED) return status;
    }
    return QP_SOLVED;
}

static QpStatus qp_active_set(const Qp *qp, QpWork *work) {
    /* At first to a tolerance above the rounding of many steps, then one step between refinements:
     * twins (a bound and a row with one limit) would otherwise take turns for ever. */
    for (int k = 0; k < 4 * QP_LIMITS; k++) {
        qp_values(qp, work, work->v, work->y);
        const int p = qp_most_violated(qp, work, QP_COARSE);
        if (p < 0) break;
        const QpStatus status = qp_enter(qp, work, p, qp_violation(qp, work, p));
        if (status != QP_SOLVED) return status;
    }
    for (int round = 0; round < QP_ROUNDS; round++) {
        /* A correction leaves its own size times rounding: one is enough where it is small. */
        for (int k = 0; k < 4 && qp_refine(qp, work) > 1e-10; k++) continue;
        if (qp_release(work)) continue;
        const int p = qp_most_violated(qp, work, QP_FINE);
        if (p < 0) return QP_SOLVED;
        const QpStatus status = qp_enter(qp, work, p, qp_violation(qp, work, p));
        if (status != QP_SOLVED) return status;
    }
    return QP_ITERATION_LIMIT;
}

/* Solve the QP whose matrices were loaded, beginning with a guess of its working set: by constraint
 * 0 where it is out, ±1 at its upper or lower limit, ±2 beyond it. The solution does not depend on
 * the guess but for rounding. */
static QpStatus qp_solve(const Qp *qp, QpWork *work, const double guess[QP_LIMITS]) {
    work->iterations = 0;
    QpStatus status = qp_begin(qp, work);
    if (status == QP_SOLVED && qp_adopt(qp, work, guess)) {
        status = qp_active_set(qp, work);
    } else if (status == QP_SOLVED) {
        status = qp_begin(qp, work);
        if (status == QP_SOLVED) status = qp_active_set(qp, work);
    }
    for (int i = 0; i < QP_N; i++) work->nu[i] = work->side[i] * work->mu[i];
    for (int r = 0; r < QP_ROWS; r++) work->lam[r] = work->side[QP_N + r] * work->mu[QP_N + r];
    return status;
}

/* The working set of the solution, as a guess for a QP like it. */
static inline void qp_remember(const QpWork *work, double guess[QP_LIMITS]) {
    static const double weight[] = {0.0, 1.0, 2.0, 0.0};
    for (int i = 0; i < QP_LIMITS; i++) guess[i] = work->side[i] * weight[work->mode[i]];
}

#if defined(__GNUC__) && !defined(__clang__)
#pragma GCC pop_options
#endif

#endif
