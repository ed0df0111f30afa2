/* The QP of one sample condensed: dense matrices in the controls, which `qp.h` takes. */
#ifndef CONDENSED_H
#define CONDENSED_H

#include "qp.h"

typedef QpWork RtiWork;

static Qp rti_qp(const RtiPrepared *prepared, const RtiSolved *solved) {
    const Qp qp = {prepared->stack + PREPARED_H,       solved->embedded + EMBEDDED_f,
                   solved->lower,                      solved->upper,
                   prepared->stack + PREPARED_Gamma,   solved->embedded + EMBEDDED_lower,
                   solved->embedded + EMBEDDED_upper,  prepared->w,
                   prepared->W};
    return qp;
}

/* Columns of a response: to each control, to ξ_0, and to the offsets. */
enum { CONDENSED_WIDTH = QP_N + N_X + 1 };
typedef double CondensedRows[N_X][CONDENSED_WIDTH];

/* Σ_l a_l x_l, column j, with entries of a `stride` apart. */
static inline double condensed_product(const double a[], int stride, CondensedRows x, int j) {
    double sum = a[0] * x[0][j];
    for (int l = 1; l < N_X; l++) sum += a[l * stride] * x[l][j];
    return sum;
}

/* Condense: with V = (v_0, …, v_{N−1}) the states are Ξ = Γ V + Φ ξ_0 + g. A sweep forward makes the
 * responses of each ξ_k, one backward the gradients of the cost, f + F ξ_0 + H V, by costates. Apart,
 * so that its arrays and the solver's may share their place on a stack. */
static QP_APART int rti_assemble(RtiPrepared *prepared) {
    enum { OFFSET = CONDENSED_WIDTH - 1 };
    QP_SCRATCH CondensedRows response[HORIZON + 1];
    CondensedRows costates[2];
    double *const stack = prepared->stack, *const H = stack + PREPARED_H;
    memset(response, 0, sizeof response);
    for (int i = 0; i < N_X; i++) response[0][i][QP_N + i] = 1.0;
    for (int k = 0; k < HORIZON; k++)
        for (int i = 0; i < N_X; i++) {
            const int r = k * N_X + i;
            double *const row = response[k + 1][i];
            for (int j = 0; j < CONDENSED_WIDTH; j++)
                row[j] = condensed_product(stack + PREPARED_A + r * N_X, 1, response[k], j);
            memcpy(row + k * N_U, stack + PREPARED_B + r * N_U, N_U * sizeof *row);
            row[OFFSET] += stack[PREPARED_r + r];
            memcpy(stack + PREPARED_Gamma + r * QP_N, row, QP_N * sizeof *row);
            memcpy(stack + PREPARED_Phi + r * N_X, row + QP_N, N_X * sizeof *row);
            stack[PREPARED_g + r] = row[OFFSET];
        }
    for (int i = 0; i < N_X; i++) {
        double *const row = costates[HORIZON % 2][i];
        for (int j = 0; j < CONDENSED_WIDTH; j++)
            row[j] = condensed_product(prepared->L_N + i, N_X, response[HORIZON], j);
        row[OFFSET] += prepared->q_N[i];
    }
    for (int k = HORIZON - 1; k >= 0; k--) {
        const double *const L = prepared->L + k * N_W * N_W, *const q = prepared->q + k * N_W;
        const double *const A = stack + PREPARED_A + k * N_X * N_X;
        const double *const B = stack + PREPARED_B + k * N_X * N_U;
        double(*const next)[CONDENSED_WIDTH] = costates[(k + 1) % 2];
        for (int a = 0; a < N_U; a++) {
            const int r = k * N_U + a;
            double row[CONDENSED_WIDTH];
            for (int j = 0; j < CONDENSED_WIDTH; j++)
                row[j] = condensed_product(L + N_X + a, N_W, response[k], j) +
                         condensed_product(B + a, N_U, next, j);
            for (int b = 0; b < N_U; b++) row[k * N_U + b] += L[(N_X + b) * N_W + N_X + a];
            for (int j = 0; j <= r; j++) {
                H[r * QP_N + j] = row[j];
                H[j * QP_N + r] = row[j];
            }
            memcpy(stack + PREPARED_F + r * N_X, row + QP_N, N_X * sizeof *row);
            stack[PREPARED_f + r] = row[OFFSET] + q[N_X + a];
        }
        for (int i = 0; i < N_X; i++) {
            double *const row = costates[k % 2][i];
            for (int j = 0; j < CONDENSED_WIDTH; j++)
                row[j] = condensed_product(L + i, N_W, response[k], j) +
                         condensed_product(A + i, N_X, next, j);
            row[OFFSET] += q[i];
        }
    }
    return all_finite(stack, PREPARED_SIZE) ? QP_SOLVED : QP_NOT_FINITE;
}

static int rti_load(const RtiPrepared *prepared, QpWork *work) {
    Qp qp = {0}; /* the matrices alone */
    qp.H = prepared->stack + PREPARED_H;
    qp.rows = prepared->stack + PREPARED_Gamma;
    return qp_load(&qp, work);
}

/* A guess of the working set: the limits at which the guess of states and controls is. */
static double limit_reached(double value, double lower, double upper, int soft) {
    const double below = 1e-9 * (1.0 + fabs(lower)), above = 1e-9 * (1.0 + fabs(upper));
    if (value <= lower + below) return soft && value < lower - below ? -2.0 : -1.0;
    if (value >= upper - above) return soft && value > upper + above ? 2.0 : 1.0;
    return 0.0;
}

static void rti_guess(const RtiPrepared *prepared, double set[QP_LIMITS]) {
    const double *const theta = prepared->theta;
    for (int k = 0; k < HORIZON; k++) {
        const int next = k + 1 < HORIZON ? k + 1 : k; /* the guess ends at stage N − 1 */
        for (int i = 0; i < N_U; i++)
            set[k * N_U + i] = limit_reached(scaled_action(prepared->u[k][i], i),
                                             scaled_action(ACTION_LOWER[i], i),
                                             scaled_action(ACTION_UPPER[i], i), 0);
        for (int i = 0; i < N_X; i++)
            set[QP_N + k * N_X + i] = limit_reached(scaled_state(prepared->x[next][i], i),
                                                    lower_bound(theta, k * N_X + i),
                                                    upper_bound(theta, k * N_X + i), 1);
    }
}

/* Solve the QP of the state in `solved`, whose first action is enforced or not. */
static int rti_solve(const RtiPrepared *prepared, RtiWork *work, RtiSolved *solved, int enforced) {
    const double *const stack = prepared->stack, *const theta = prepared->theta;
    double set[QP_LIMITS];
    (void)enforced; /* its limits say so */
    {
        const double *arguments[EMBEDDED_ARG] = {
            solved->s,          theta,          stack + PREPARED_Phi, stack + PREPARED_g,
            stack + PREPARED_f, stack + PREPARED_F};
        double *results[EMBEDDED_RES] = {solved->embedded}, w[EMBEDDED_W + 1];
        long long int iw[EMBEDDED_IW + 1];
        embedding(arguments, results, iw, w, 0);
    }
    if (!all_finite(solved->embedded, EMBEDDED_SIZE)) return QP_NOT_FINITE;
    const Qp qp = rti_qp(prepared, solved);
    rti_guess(prepared, set);
    const QpStatus status = qp_solve(&qp, work, set);
    if (status != QP_SOLVED) return status;
    memcpy(solved->v, work->v, sizeof solved->v);
    memcpy(solved->lam, work->lam, sizeof solved->lam);
    memcpy(solved->nu, work->nu, sizeof solved->nu);
    solved->iterations = work->iterations;
    return QP_SOLVED;
}

/* How the first action moves x_1, and the limits of what it moves. */
static void rti_first_rows(const RtiPrepared *prepared, const RtiSolved *solved,
                           double rows[N_X][N_U], double low[N_X], double high[N_X]) {
    for (int i = 0; i < N_X; i++) {
        memcpy(rows[i], prepared->stack + PREPARED_Gamma + i * QP_N, sizeof rows[i]);
        low[i] = solved->embedded[EMBEDDED_lower + i];
        high[i] = solved->embedded[EMBEDDED_upper + i];
    }
}

/* Put the active set of a solution into `work`, by the branches of the proximal operators that
 * `QpSolution.active` takes; whether its gradients are independent. */
static inline int rti_activate(const Qp *qp, const RtiSolved *solved, QpWork *work) {
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

/* Solutions of the KKT system of the active set for unit right-hand sides in the first controls: see
 * `controllers.sensitivities.adjoint_directions`. QP_ITERATION_LIMIT where the active constraints'
 * gradients are dependent. */
static inline int rti_directions(const RtiPrepared *prepared, const RtiSolved *solved, RtiWork *work,
                          double dv[N_U][QP_N], double dt[N_U][QP_ROWS], double dlam[N_U][QP_ROWS]) {
    const Qp qp = rti_qp(prepared, solved);
    double moved[QP_ROWS];
    const QpStatus status = qp_load(&qp, work);
    if (status != QP_SOLVED) return status;
    if (!rti_activate(&qp, solved, work)) return QP_ITERATION_LIMIT;
    memset(dt, 0, N_U * sizeof dt[0]);
    memset(dlam, 0, N_U * sizeof dlam[0]);
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
    return QP_SOLVED;
}

#endif
