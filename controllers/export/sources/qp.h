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

#include <math.h>
#include <string.h>

/* GCC vectorises the loops below at -O3 only, clang at -O2; the bits are the same. */
#if defined(__GNUC__) && !defined(__clang__)
#pragma GCC push_options
#pragma GCC optimize("O3")
#endif

enum { QP_LIMITS = QP_N + QP_ROWS, QP_ITERATIONS = 40 * QP_LIMITS, QP_ROUNDS = 4 * QP_LIMITS };

/* How often a guess of the working set is mended before it is dropped. */
enum { QP_GUESSES = 4 };

/* Violations that are overlooked, relative to 1 + |limit|: on the way, and in the end. */
#define QP_COARSE 1e-8
#define QP_FINE 1e-12
/* Changes of a multiplier that are zero, relative to the constraints' norms. */
#define QP_ROUNDING 1e-11
/* What a member of a guess must add to the working set, relative to its own square. */
#define QP_INDEPENDENT 1e-8

typedef enum { QP_SOLVED, QP_NOT_CONVEX, QP_ITERATION_LIMIT, QP_NOT_FINITE } QpStatus;

/* A member of the working set: inactive, at its limit, beyond it (soft rows), or an equation. */
typedef enum { QP_OUT, QP_AT, QP_BEYOND, QP_FIXED } QpMode;

/* Matrices by rows. H is symmetric and its upper triangle is read. */
typedef struct {
    const double *H, *f, *lower, *upper, *rows, *row_lower, *row_upper, *w, *W;
} Qp;

/* The solution is v and the multipliers nu of the bounds and lam of the rows, positive at upper
 * limits: Hv + f + nu + Γᵀlam = 0. The rest is scratch. */
typedef struct {
    double v[QP_N], nu[QP_N], lam[QP_ROWS];
    int iterations;
    double M[QP_LIMITS][QP_N]; /* U⁻¹ a_i; the bounds first, whose rows are U⁻ᵀ */
    double gram[QP_LIMITS];    /* ‖m_i‖² */
    double norm[QP_LIMITS];    /* ‖m_i‖ */
    int length[QP_LIMITS];     /* entries of m_i after which only zeros follow */
    double y[QP_ROWS];         /* Γ v */
    double mu[QP_LIMITS];      /* multipliers of the working set by constraint, ≥ 0 */
    double side[QP_LIMITS];    /* +1: the upper limit, −1: the lower one */
    QpMode mode[QP_LIMITS];
    int count, member[QP_LIMITS];
    double L[QP_LIMITS][QP_LIMITS], D[QP_LIMITS]; /* L by columns */
    double z[QP_LIMITS], step[QP_LIMITS];
} QpWork;

/* The larger and the smaller number, in one instruction where fmax is a call. */
static double qp_max(double a, double b) { return a > b ? a : b; }
static double qp_min(double a, double b) { return a < b ? a : b; }

static double qp_limit(const Qp *qp, const QpWork *work, int i) {
    if (i < QP_N) return work->side[i] * (work->side[i] > 0 ? qp->upper[i] : qp->lower[i]);
    i -= QP_N;
    return work->side[i + QP_N] *
           (work->side[i + QP_N] > 0 ? qp->row_upper[i] : qp->row_lower[i]);
}

static double qp_compliance(const Qp *qp, const QpWork *work, int i) {
    return work->mode[i] == QP_BEYOND ? 0.5 / qp->W[i - QP_N] : 0.0;
}

/* H = U Uᵀ from the last column on, then U⁻ᵀ into the first QP_N rows of M. */
static QpStatus qp_factorise(const Qp *qp, QpWork *work) {
    double U[QP_N][QP_N], inverse[QP_N]; /* U by columns: U[k][j], j ≤ k */
    for (int k = QP_N - 1; k >= 0; k--) {
        double pivot = qp->H[k * QP_N + k];
        for (int l = k + 1; l < QP_N; l++) pivot -= U[l][k] * U[l][k];
        if (!(pivot > 0.0)) return isnan(pivot) ? QP_NOT_FINITE : QP_NOT_CONVEX;
        U[k][k] = sqrt(pivot);
        inverse[k] = 1.0 / U[k][k];
        for (int j = 0; j < k; j++) U[k][j] = qp->H[j * QP_N + k];
        for (int l = k + 1; l < QP_N; l++)
            for (int j = 0; j < k; j++) U[k][j] -= U[l][k] * U[l][j];
        for (int j = 0; j < k; j++) U[k][j] *= inverse[k];
    }
    for (int i = 0; i < QP_N; i++) {
        double *m = work->M[i];
        memset(m, 0, sizeof work->M[i]);
        m[i] = 1.0;
        for (int k = i; k >= 0; k--) {
            m[k] *= inverse[k];
            for (int j = 0; j < k; j++) m[j] -= U[k][j] * m[k];
        }
        work->length[i] = i + 1;
    }
    return QP_SOLVED;
}

/* Factorise H and transform the rows: all that does not depend on f and the limits. */
static QpStatus qp_load(const Qp *qp, QpWork *work) {
    const QpStatus status = qp_factorise(qp, work);
    if (status != QP_SOLVED) return status;
    for (int r = 0; r < QP_ROWS; r++) {
        const double *a = qp->rows + r * QP_N;
        double *m = work->M[QP_N + r];
        int length = QP_N;
        while (length > 0 && a[length - 1] == 0.0) length--;
        work->length[QP_N + r] = length;
        memset(m, 0, sizeof work->M[QP_N + r]);
        for (int j = 0; j < length; j++)
            for (int i = 0; i <= j; i++) m[i] += a[j] * work->M[j][i];
    }
    for (int i = 0; i < QP_LIMITS; i++) {
        work->gram[i] = 0.0;
        for (int j = 0; j < work->length[i]; j++) work->gram[i] += work->M[i][j] * work->M[i][j];
        work->norm[i] = sqrt(work->gram[i]);
    }
    return QP_SOLVED;
}

/* out = U⁻ᵀ p, which is the first rows of M times p. */
static void qp_back(const QpWork *work, const double p[QP_N], double out[QP_N]) {
    for (int i = 0; i < QP_N; i++) {
        double sum = 0.0;
        for (int j = 0; j <= i; j++) sum += work->M[i][j] * p[j];
        out[i] = sum;
    }
}

static void qp_add_rows(const QpWork *work, double scale, int i, double p[QP_N]) {
    for (int j = 0; j < work->length[i]; j++) p[j] += scale * work->M[i][j];
}

static void qp_values(const Qp *qp, const QpWork *work, const double v[QP_N], double y[QP_ROWS]) {
    for (int r = 0; r < QP_ROWS; r++) {
        double sum = 0.0;
        for (int j = 0; j < work->length[QP_N + r]; j++) sum += qp->rows[r * QP_N + j] * v[j];
        y[r] = sum;
    }
}

/* x ← S⁻¹ x for the working set. */
static void qp_solve_set(const QpWork *work, double x[]) {
    const int count = work->count;
    for (int k = 0; k < count; k++)
        for (int j = k + 1; j < count; j++) x[j] -= work->L[k][j] * x[k];
    for (int k = count - 1; k >= 0; k--) {
        double sum = x[k] / work->D[k];
        for (int j = k + 1; j < count; j++) sum -= work->L[k][j] * x[j];
        x[k] = sum;
    }
}

/* z = L⁻¹ S_Wp, and what p adds to the set: its pivot. */
static double qp_project(const Qp *qp, QpWork *work, int p) {
    double pivot = work->gram[p] + qp_compliance(qp, work, p);
    double *z = work->z;
    for (int k = 0; k < work->count; k++) {
        const int i = work->member[k];
        const int length = work->length[i] < work->length[p] ? work->length[i] : work->length[p];
        double sum = 0.0;
        for (int j = 0; j < length; j++) sum += work->M[i][j] * work->M[p][j];
        z[k] = work->side[i] * work->side[p] * sum;
    }
    for (int k = 0; k < work->count; k++) {
        for (int j = k + 1; j < work->count; j++) z[j] -= work->L[k][j] * z[k];
        pivot -= z[k] * z[k] / work->D[k];
    }
    return pivot;
}

/* Take p, of which z and the pivot are known, into the working set. */
static void qp_append(QpWork *work, int p, double pivot) {
    for (int k = 0; k < work->count; k++) work->L[k][work->count] = work->z[k] / work->D[k];
    work->D[work->count] = pivot;
    work->member[work->count++] = p;
}

/* Take the member at position k out: a rank-one update of the factors behind it. */
static void qp_remove(QpWork *work, int k) {
    double *const column = work->L[k];
    double alpha = work->D[k];
    const int last = --work->count;
    for (int j = k + 1; j <= last; j++) {
        const double p = column[j], pivot = work->D[j] + alpha * p * p, beta = alpha * p / pivot;
        alpha *= work->D[j] / pivot;
        work->D[j] = pivot;
        for (int r = j + 1; r <= last; r++) {
            column[r] -= p * work->L[j][r];
            work->L[j][r] += beta * column[r];
        }
    }
    for (int j = k; j < last; j++) {
        work->member[j] = work->member[j + 1];
        work->D[j] = work->D[j + 1];
        for (int r = j + 1; r < last; r++) work->L[j][r] = work->L[j + 1][r + 1];
    }
    for (int c = 0; c < k; c++)
        for (int r = k; r < last; r++) work->L[c][r] = work->L[c][r + 1];
}

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
    for (; work->iterations < QP_ITERATIONS; work->iterations++) {
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
static void qp_remember(const QpWork *work, double guess[QP_LIMITS]) {
    static const double weight[] = {0.0, 1.0, 2.0, 0.0};
    for (int i = 0; i < QP_LIMITS; i++) guess[i] = work->side[i] * weight[work->mode[i]];
}

/* Whether `guess` is one of constraint i. */
static inline int qp_is_mode(int i, double guess) {
    return guess == 0.0 || fabs(guess) == 1.0 || (i >= QP_N && fabs(guess) == 2.0);
}

static double qp_clip(double value, double lower, double upper) {
    return qp_min(qp_max(value, lower), upper);
}

/* Largest KKT residual: stationarity relative to its terms, bounds and rows by their proximal
 * operators, each zero at a solution only. */
static double qp_residual(const Qp *qp, const QpWork *work) {
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

#if defined(__GNUC__) && !defined(__clang__)
#pragma GCC pop_options
#endif

#endif
