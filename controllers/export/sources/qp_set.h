/* The QP of `qp.h`, a working set of its constraints, and the factors of both. */
#ifndef QP_SET_H
#define QP_SET_H

#include <math.h>
#include <string.h>

enum { QP_LIMITS = QP_N + QP_ROWS };

/* Large arrays are on the stack; where that is small, `static` puts them beside it, for one solver at
 * a time. */
#ifndef QP_SCRATCH
#define QP_SCRATCH
#endif

/* A function whose arrays leave the stack when it returns. */
#ifdef __GNUC__
#define QP_APART __attribute__((noinline))
#else
#define QP_APART
#endif

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

static double qp_clip(double value, double lower, double upper) {
    return qp_min(qp_max(value, lower), upper);
}

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
    QP_SCRATCH double U[QP_N][QP_N], inverse[QP_N]; /* U by columns: U[k][j], j ≤ k */
    for (int k = QP_N - 1; k >= 0; k--) {
        double pivot = qp->H[k * QP_N + k];
        for (int l = k + 1; l < QP_N; l++) pivot -= U[l][k] * U[l][k];
        if (!(pivot > 0.0)) return isnan(pivot) ? QP_NOT_FINITE : QP_NOT_CONVEX;
        U[k][k] = sqrt(pivot);
        inverse[k] = 1.0 / U[k][k];
        for (int j = 0; j < k; j++) U[k][j] = qp->H[j * QP_N + k];
        for (int j = 0; j < k; j++) {
            for (int l = k + 1; l < QP_N; l++) U[k][j] -= U[l][k] * U[l][j];
            U[k][j] *= inverse[k];
        }
    }
    memset(work->M, 0, sizeof work->M);
    for (int i = 0; i < QP_N; i++) {
        work->M[i][i] = 1.0;
        work->length[i] = i + 1;
    }
    for (int k = QP_N - 1; k >= 0; k--) /* the rows inside: none waits for another */
        for (int i = k; i < QP_N; i++) {
            const double entry = work->M[i][k] *= inverse[k];
            for (int j = 0; j < k; j++) work->M[i][j] -= U[k][j] * entry;
        }
    return QP_SOLVED;
}

/* Factorise H and transform the rows: all that does not depend on f and the limits. */
static QpStatus qp_load(const Qp *qp, QpWork *work) {
    const QpStatus status = qp_factorise(qp, work);
    if (status != QP_SOLVED) return status;
    for (int r = 0; r < QP_ROWS; r++) {
        const double *a = qp->rows + r * QP_N;
        int length = QP_N;
        while (length > 0 && a[length - 1] == 0.0) length--;
        work->length[QP_N + r] = length;
    }
    for (int j = 0; j < QP_N; j++)
        for (int r = 0; r < QP_ROWS; r++) {
            const double entry = qp->rows[r * QP_N + j];
            if (j >= work->length[QP_N + r]) continue;
            for (int i = 0; i <= j; i++) work->M[QP_N + r][i] += entry * work->M[j][i];
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

#endif
