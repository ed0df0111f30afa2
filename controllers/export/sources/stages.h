/* The QP of one sample stage by stage, in operations linear in the horizon; for long ones.
 *
 *     min_v  Σ_k ½ w_kᵀL_k w_k + q_kᵀw_k + ½ ξ_NᵀL_N ξ_N + q_Nᵀξ_N + Σ_i w_i t_i + W_i t_i²
 *     s.t.   ξ_{k+1} = A_k ξ_k + B_k v_k + r_k,  lower ≤ v_k ≤ upper,  x_l − t ≤ ξ_{k+1} ≤ x_u + t
 *
 * The method of multipliers: in the place of a limit stands the Moreau envelope of its indicator, or
 * of its penalty, with weight ρ about its multiplier. What is left to minimise is convex, smooth and
 * piecewise quadratic: Newton's method with an exact line search, where each step is a Riccati
 * recursion, ends at the minimiser after finitely many. Then the multipliers move, with a larger ρ
 * for a limit that is not met much better than before.
 *
 * Limits are counted as in `qp.h`: those of the controls, then those of the states ξ_1 … ξ_N.
 */
#ifndef STAGES_H
#define STAGES_H

#include "qp_set.h"

/* ρ relative to the curvature of the cost in what is limited. */
#define STAGES_WEIGHT 1e4
/* How far from its limit a member may end, relative to 1 + |limit|. */
#define STAGES_ACCURACY 1e-13
enum { STAGES_STEPS = 1000 };

typedef struct {
    double v[QP_N], xi[(HORIZON + 1) * N_X];
    double gradient[QP_N], dv[QP_N], dxi[(HORIZON + 1) * N_X];
    double lower[QP_LIMITS], upper[QP_LIMITS];
    double scale[QP_LIMITS]; /* curvature of the cost in what is limited */
    double rho[QP_LIMITS], gap[QP_LIMITS];
    double multiplier[QP_LIMITS]; /* about which the envelopes are */
    double estimate[QP_LIMITS];   /* slopes of the envelopes */
    double weight[QP_LIMITS];     /* their second derivatives */
    QpMode mode[QP_LIMITS];
    double C[HORIZON][N_U][N_U]; /* lower Cholesky factors; their diagonal's inverse is on it */
    double K[HORIZON][N_U][N_X];
    int iterations;
} RtiWork;

typedef struct {
    const double *A, *B, *r, *L, *q;
} Stage;

static Stage stage_of(const RtiPrepared *prepared, int k) {
    const double *const stack = prepared->stack;
    const Stage stage = {stack + PREPARED_A + k * N_X * N_X, stack + PREPARED_B + k * N_X * N_U,
                         stack + PREPARED_r + k * N_X, prepared->L + k * N_W * N_W,
                         prepared->q + k * N_W};
    return stage;
}

/* x ← (C Cᵀ)⁻¹ x */
static void stages_divide(double C[N_U][N_U], double x[N_U]) {
    for (int a = 0; a < N_U; a++) {
        for (int b = 0; b < a; b++) x[a] -= C[a][b] * x[b];
        x[a] *= C[a][a];
    }
    for (int a = N_U - 1; a >= 0; a--) {
        for (int b = a + 1; b < N_U; b++) x[a] -= C[b][a] * x[b];
        x[a] *= C[a][a];
    }
}

/* Riccati recursion with the weights added: gains and factors of the stages from `first` on. With
 * `scale` it also gets the curvatures that it meets. */
static QpStatus stages_factorise(const RtiPrepared *prepared, RtiWork *work, int first,
                                 double scale[]) {
    double P[N_X][N_X];
    memcpy(P, prepared->L_N, sizeof P);
    for (int k = HORIZON - 1; k >= first; k--) {
        const Stage at = stage_of(prepared, k);
        double PA[N_X][N_X], PB[N_X][N_U], R[N_U][N_U], S[N_U][N_X];
        for (int i = 0; i < N_X; i++) {
            if (scale) scale[QP_N + k * N_X + i] = P[i][i];
            P[i][i] += work->weight[QP_N + k * N_X + i];
        }
        for (int i = 0; i < N_X; i++) {
            for (int j = 0; j < N_X; j++) {
                PA[i][j] = 0.0;
                for (int l = 0; l < N_X; l++) PA[i][j] += P[i][l] * at.A[l * N_X + j];
            }
            for (int b = 0; b < N_U; b++) {
                PB[i][b] = 0.0;
                for (int l = 0; l < N_X; l++) PB[i][b] += P[i][l] * at.B[l * N_U + b];
            }
        }
        for (int a = 0; a < N_U; a++) {
            const double *const row = at.L + (N_X + a) * N_W;
            for (int b = 0; b < N_U; b++) {
                R[a][b] = row[N_X + b];
                for (int l = 0; l < N_X; l++) R[a][b] += at.B[l * N_U + a] * PB[l][b];
            }
            for (int j = 0; j < N_X; j++) {
                S[a][j] = row[j];
                for (int l = 0; l < N_X; l++) S[a][j] += at.B[l * N_U + a] * PA[l][j];
            }
            if (scale) scale[k * N_U + a] = R[a][a];
            R[a][a] += work->weight[k * N_U + a];
        }
        for (int a = 0; a < N_U; a++) {
            for (int b = 0; b <= a; b++) {
                double sum = R[a][b];
                for (int c = 0; c < b; c++) sum -= work->C[k][a][c] * work->C[k][b][c];
                if (b < a) {
                    work->C[k][a][b] = sum * work->C[k][b][b];
                } else {
                    if (!(sum > 0.0)) return isnan(sum) ? QP_NOT_FINITE : QP_NOT_CONVEX;
                    work->C[k][a][a] = 1.0 / sqrt(sum);
                }
            }
        }
        for (int j = 0; j < N_X; j++) {
            double column[N_U];
            for (int a = 0; a < N_U; a++) column[a] = S[a][j];
            stages_divide(work->C[k], column);
            for (int a = 0; a < N_U; a++) work->K[k][a][j] = column[a];
        }
        /* By the closed loop, so that large weights cancel where they cannot be felt. */
        double loop[N_X][N_X], stage[N_W][N_X], half[N_X];
        for (int j = 0; j < N_X; j++) {
            for (int i = 0; i < N_X; i++) {
                loop[i][j] = at.A[i * N_X + j];
                for (int a = 0; a < N_U; a++)
                    loop[i][j] -= at.B[i * N_U + a] * work->K[k][a][j];
                stage[i][j] = i == j;
            }
            for (int a = 0; a < N_U; a++) stage[N_X + a][j] = -work->K[k][a][j];
        }
        double following[N_X][N_X];
        for (int j = 0; j < N_X; j++) {
            for (int l = 0; l < N_X; l++) {
                half[l] = 0.0;
                for (int i = 0; i < N_X; i++) half[l] += P[l][i] * loop[i][j];
            }
            double bent[N_W];
            for (int l = 0; l < N_W; l++) {
                bent[l] = 0.0;
                for (int i = 0; i < N_W; i++) bent[l] += at.L[l * N_W + i] * stage[i][j];
            }
            for (int i = 0; i <= j; i++) {
                double sum = 0.0;
                for (int l = 0; l < N_X; l++) sum += loop[l][i] * half[l];
                for (int l = 0; l < N_W; l++) sum += stage[l][i] * bent[l];
                following[i][j] = sum;
                following[j][i] = sum;
            }
        }
        memcpy(P, following, sizeof P);
    }
    return QP_SOLVED;
}

/* States from ξ_first on for the controls, with the offsets r or without. */
static void stages_simulate(const RtiPrepared *prepared, int first, int affine, const double v[],
                            double xi[]) {
    for (int k = first; k < HORIZON; k++) {
        const Stage at = stage_of(prepared, k);
        for (int i = 0; i < N_X; i++) {
            double sum = affine ? at.r[i] : 0.0;
            for (int j = 0; j < N_X; j++) sum += at.A[i * N_X + j] * xi[k * N_X + j];
            for (int b = 0; b < N_U; b++) sum += at.B[i * N_U + b] * v[k * N_U + b];
            xi[(k + 1) * N_X + i] = sum;
        }
    }
}

/* Gradient in the controls from stage `first` on of the stage costs, `linear` terms or not, and of
 * `rows` times the states. */
static void stages_gradient(const RtiPrepared *prepared, int first, int linear, const double v[],
                            double xi[], const double rows[], double gradient[]) {
    double chi[N_X];
    for (int i = 0; i < N_X; i++) {
        chi[i] = linear ? prepared->q_N[i] : 0.0;
        for (int j = 0; j < N_X; j++) chi[i] += prepared->L_N[i * N_X + j] * xi[HORIZON * N_X + j];
    }
    for (int k = HORIZON - 1; k >= first; k--) {
        const Stage at = stage_of(prepared, k);
        double slope[N_W];
        for (int i = 0; rows && i < N_X; i++) chi[i] += rows[k * N_X + i];
        for (int i = 0; i < N_W; i++) {
            double sum = linear ? at.q[i] : 0.0;
            for (int j = 0; j < N_X; j++) sum += at.L[i * N_W + j] * xi[k * N_X + j];
            for (int b = 0; b < N_U; b++) sum += at.L[i * N_W + N_X + b] * v[k * N_U + b];
            for (int l = 0; l < N_X; l++)
                sum += (i < N_X ? at.A[l * N_X + i] : at.B[l * N_U + i - N_X]) * chi[l];
            slope[i] = sum;
        }
        memcpy(chi, slope, sizeof chi);
        memcpy(gradient + k * N_U, slope + N_X, N_U * sizeof(double));
    }
}

/* Newton's step for the gradient in `work`: the controls dv, and the states dxi that follow. */
static void stages_step(const RtiPrepared *prepared, RtiWork *work, int first) {
    double p[N_X] = {0.0};
    for (int k = HORIZON - 1; k >= first; k--) {
        const Stage at = stage_of(prepared, k);
        double h[N_U], before[N_X];
        for (int b = 0; b < N_U; b++) {
            h[b] = work->gradient[k * N_U + b];
            for (int l = 0; l < N_X; l++) h[b] += at.B[l * N_U + b] * p[l];
        }
        for (int j = 0; j < N_X; j++) {
            before[j] = 0.0;
            for (int l = 0; l < N_X; l++) before[j] += at.A[l * N_X + j] * p[l];
            for (int b = 0; b < N_U; b++) before[j] -= work->K[k][b][j] * h[b];
        }
        memcpy(p, before, sizeof p);
        stages_divide(work->C[k], h);
        memcpy(work->dv + k * N_U, h, sizeof h);
    }
    memset(work->dxi + first * N_X, 0, N_X * sizeof(double));
    for (int k = first; k < HORIZON; k++) {
        const Stage at = stage_of(prepared, k);
        double *const dv = work->dv + k * N_U;
        for (int b = 0; b < N_U; b++) {
            dv[b] = -dv[b];
            for (int j = 0; j < N_X; j++) dv[b] -= work->K[k][b][j] * work->dxi[k * N_X + j];
        }
        for (int i = 0; i < N_X; i++) {
            double sum = 0.0;
            for (int j = 0; j < N_X; j++) sum += at.A[i * N_X + j] * work->dxi[k * N_X + j];
            for (int b = 0; b < N_U; b++) sum += at.B[i * N_U + b] * dv[b];
            work->dxi[(k + 1) * N_X + i] = sum;
        }
    }
}

/* Slope and curvature of the envelope of limit i where what is limited has the value y; returns the
 * slope. */
static double stages_envelope(const RtiPrepared *prepared, const RtiWork *work, int i, double y,
                              double *weight, QpMode *mode) {
    const double rho = work->rho[i], z = y + work->multiplier[i] / rho;
    const double beyond = z - qp_clip(z, work->lower[i], work->upper[i]);
    *mode = beyond == 0.0 ? QP_OUT : QP_AT;
    *weight = beyond == 0.0 ? 0.0 : rho;
    if (i >= QP_N && fabs(beyond) * rho > prepared->w[i - QP_N]) {
        const double w = prepared->w[i - QP_N], W = prepared->W[i - QP_N];
        *mode = QP_BEYOND;
        *weight = 2.0 * W * rho / (rho + 2.0 * W);
        return copysign(w + 2.0 * W * (rho * fabs(beyond) - w) / (rho + 2.0 * W), beyond);
    }
    return rho * beyond;
}

static double stages_value(const RtiWork *work, int i) {
    return i < QP_N ? work->v[i] : work->xi[N_X + i - QP_N];
}

/* The envelopes of the limits from stage `first` on at the present point; whether one is on another
 * branch than before. */
static int stages_look(const RtiPrepared *prepared, RtiWork *work, int first) {
    int moved = 0;
    for (int i = 0; i < QP_LIMITS; i++) {
        if (i < first * N_U || (i >= QP_N && i < QP_N + first * N_X)) continue;
        QpMode mode;
        work->estimate[i] = stages_envelope(prepared, work, i, stages_value(work, i),
                                            &work->weight[i], &mode);
        moved |= mode != work->mode[i];
        work->mode[i] = mode;
    }
    return moved;
}

/* Where along the step, of length 1 at most, what is minimised is least: at its end where no envelope
 * changes its branch on the way, which rounding of the slope does not decide. */
static double stages_length(const RtiPrepared *prepared, const RtiWork *work, int first) {
    double slope = 0.0, curvature = 0.0, low = 0.0, high = 1.0;
    for (int j = first * N_U; j < QP_N; j++) slope += work->gradient[j] * work->dv[j];
    const double steep = fabs(slope);
    for (int k = first; k < HORIZON; k++) {
        const Stage at = stage_of(prepared, k);
        double w[N_W];
        memcpy(w, work->dxi + k * N_X, N_X * sizeof(double));
        memcpy(w + N_X, work->dv + k * N_U, N_U * sizeof(double));
        for (int i = 0; i < N_W; i++)
            for (int j = 0; j < N_W; j++) curvature += w[i] * at.L[i * N_W + j] * w[j];
    }
    for (int i = 0; i < N_X; i++)
        for (int j = 0; j < N_X; j++)
            curvature += work->dxi[HORIZON * N_X + i] * prepared->L_N[i * N_X + j] * work->dxi[HORIZON * N_X + j];
    for (int trial = 0; trial < 40; trial++) {
        const double t = trial == 0 ? 1.0 : 0.5 * (low + high);
        double rise = slope + t * curvature, weight;
        int moved = 0;
        for (int i = 0; i < QP_LIMITS; i++) {
            QpMode mode;
            if (i < first * N_U || (i >= QP_N && i < QP_N + first * N_X)) continue;
            const double by = i < QP_N ? work->dv[i] : work->dxi[N_X + i - QP_N];
            const double y = stages_value(work, i) + t * by;
            rise += by * (stages_envelope(prepared, work, i, y, &weight, &mode) - work->estimate[i]);
            moved |= mode != work->mode[i];
        }
        if (trial == 0 && !moved) return t;
        if (fabs(rise) <= 1e-3 * steep || (trial == 0 && rise < 0.0)) return t;
        *(rise < 0.0 ? &low : &high) = t;
    }
    return low > 0.0 ? low : high;
}

/* Minimise over the controls from stage `first` on, the multipliers being what they are. */
static QpStatus stages_minimise(const RtiPrepared *prepared, RtiWork *work, int first) {
    stages_look(prepared, work, first);
    while (work->iterations < STAGES_STEPS) {
        work->iterations++;
        stages_gradient(prepared, first, 1, work->v, work->xi, work->estimate + QP_N,
                        work->gradient);
        for (int j = first * N_U; j < QP_N; j++) work->gradient[j] += work->estimate[j];
        const QpStatus status = stages_factorise(prepared, work, first, 0);
        if (status != QP_SOLVED) return status;
        stages_step(prepared, work, first);
        const double t = stages_length(prepared, work, first);
        double largest = 0.0;
        for (int j = first * N_U; j < QP_N; j++) {
            work->v[j] += t * work->dv[j];
            largest = qp_max(largest, fabs(work->dv[j]) / (1.0 + fabs(work->v[j])));
        }
        stages_simulate(prepared, first, 1, work->v, work->xi);
        if ((!stages_look(prepared, work, first) && t == 1.0) || largest < STAGES_ACCURACY)
            return QP_SOLVED;
    }
    return QP_ITERATION_LIMIT;
}

/* Solve from the controls in `work` on; from the second stage where the first action is enforced. */
static QpStatus stages_solve(const RtiPrepared *prepared, RtiWork *work, int first) {
    for (int i = 0; i < QP_LIMITS; i++) {
        work->rho[i] = STAGES_WEIGHT * work->scale[i];
        work->multiplier[i] = work->estimate[i] = work->weight[i] = 0.0;
        work->mode[i] = QP_OUT;
        work->gap[i] = INFINITY;
    }
    work->iterations = 0;
    stages_simulate(prepared, 0, 1, work->v, work->xi);
    /* Once all is met, once more with small weights: what they multiply is rounding. */
    for (int met = 0; met < 2;) {
        const QpStatus status = stages_minimise(prepared, work, first);
        if (status != QP_SOLVED) return status;
        int open = 0;
        for (int i = 0; i < QP_LIMITS; i++) {
            const double gap = fabs(work->estimate[i] - work->multiplier[i]) / work->rho[i];
            if (gap > STAGES_ACCURACY * (1.0 + fabs(stages_value(work, i)))) {
                open = 1;
                if (gap > 0.1 * work->gap[i]) work->rho[i] *= 10.0;
            }
            work->gap[i] = gap;
            work->multiplier[i] = work->estimate[i];
        }
        met += !open;
        for (int i = 0; !open && i < QP_LIMITS; i++) work->rho[i] = 10.0 * work->scale[i];
    }
    return QP_SOLVED;
}

static int rti_assemble(const RtiPrepared *prepared) {
    return all_finite(prepared->stack, PREPARED_H) ? QP_SOLVED : QP_NOT_FINITE;
}

/* All that does not depend on the state: whether the QP is convex, and the curvatures. */
static int rti_load(const RtiPrepared *prepared, RtiWork *work) {
    memset(work->weight, 0, sizeof work->weight);
    const QpStatus status = stages_factorise(prepared, work, 0, work->scale);
    double largest = 0.0;
    for (int i = 0; i < QP_LIMITS; i++) largest = qp_max(largest, work->scale[i]);
    for (int i = 0; i < QP_LIMITS; i++) /* a state may weigh nothing from some stage on */
        work->scale[i] = qp_max(work->scale[i], 1e-9 * largest);
    return status;
}

/* Solve the QP of the state in `solved`, with the first action enforced or not. */
static int rti_solve(const RtiPrepared *prepared, RtiWork *work, RtiSolved *solved, int enforced) {
    const double *const theta = prepared->theta;
    for (int i = 0; i < N_X; i++) work->xi[i] = scaled_state(solved->s[i], i);
    for (int j = 0; j < QP_N; j++) {
        work->lower[j] = solved->lower[j];
        work->upper[j] = solved->upper[j];
        work->v[j] = qp_clip(scaled_action(prepared->u[j / N_U][j % N_U], j % N_U), work->lower[j],
                             work->upper[j]);
    }
    for (int r = 0; r < QP_ROWS; r++) {
        work->lower[QP_N + r] = lower_bound(theta, r);
        work->upper[QP_N + r] = upper_bound(theta, r);
    }
    if (!all_finite(work->xi, N_X)) return QP_NOT_FINITE;
    const QpStatus status = stages_solve(prepared, work, enforced);
    if (status != QP_SOLVED) return status;
    memcpy(solved->lam, work->estimate + QP_N, sizeof solved->lam);
    for (int i = 0; enforced && i < N_X; i++) { /* x_1 is what it is */
        const double y = work->xi[N_X + i];
        const double beyond = y - qp_clip(y, work->lower[QP_N + i], work->upper[QP_N + i]);
        solved->lam[i] = beyond == 0.0 ? 0.0 : copysign(prepared->w[i], beyond) +
                                                   2.0 * prepared->W[i] * beyond;
    }
    for (int j = 0; j < QP_N; j++) {
        const double limit = work->estimate[j] > 0.0 ? work->upper[j] : work->lower[j];
        solved->v[j] = work->mode[j] == QP_AT ? limit : work->v[j];
        solved->nu[j] = work->estimate[j];
    }
    if (enforced) {
        stages_gradient(prepared, 0, 1, solved->v, work->xi, solved->lam, work->gradient);
        for (int j = 0; j < N_U; j++) solved->nu[j] = -work->gradient[j];
    }
    solved->iterations = work->iterations;
    return QP_SOLVED;
}

/* How the first action moves x_1, and the limits of what it moves. */
static void rti_first_rows(const RtiPrepared *prepared, const RtiSolved *solved,
                           double rows[N_X][N_U], double low[N_X], double high[N_X]) {
    const Stage at = stage_of(prepared, 0);
    for (int i = 0; i < N_X; i++) {
        double unmoved = at.r[i];
        for (int j = 0; j < N_X; j++) unmoved += at.A[i * N_X + j] * scaled_state(solved->s[j], j);
        memcpy(rows[i], at.B + i * N_U, sizeof rows[i]);
        low[i] = lower_bound(prepared->theta, i) - unmoved;
        high[i] = upper_bound(prepared->theta, i) - unmoved;
    }
}

/* Solutions of the KKT system of the active set, by the branches that `QpSolution.active` takes, for
 * unit right-hand sides in the first controls: see `controllers.sensitivities.adjoint_directions`. */
static inline int rti_directions(const RtiPrepared *prepared, const RtiSolved *solved, RtiWork *work,
                          double dv[N_U][QP_N], double dt[N_U][QP_ROWS], double dlam[N_U][QP_ROWS]) {
    int status = rti_load(prepared, work);
    if (status != QP_SOLVED) return status;
    for (int i = 0; i < N_X; i++) work->xi[i] = scaled_state(solved->s[i], i);
    stages_simulate(prepared, 0, 1, solved->v, work->xi);
    for (int i = 0; i < QP_LIMITS; i++) {
        const int r = i - QP_N;
        const double low = i < QP_N ? solved->lower[i] : lower_bound(prepared->theta, r);
        const double high = i < QP_N ? solved->upper[i] : upper_bound(prepared->theta, r);
        const double y = i < QP_N ? solved->v[i] : work->xi[N_X + r];
        const double reach =
            fabs(i < QP_N ? solved->nu[i] : solved->lam[r]) + qp_max(low - y, y - high);
        work->mode[i] = reach <= 0.0 ? QP_OUT : r >= 0 && reach > prepared->w[r] ? QP_BEYOND : QP_AT;
        work->rho[i] = 1e6 * work->scale[i];
        work->weight[i] = work->mode[i] == QP_OUT      ? 0.0
                          : work->mode[i] == QP_BEYOND ? 2.0 * prepared->W[r]
                                                       : work->rho[i];
    }
    status = stages_factorise(prepared, work, 0, 0);
    for (int a = 0; a < N_U && status == QP_SOLVED; a++) {
        double largest = INFINITY;
        memset(work->v, 0, sizeof work->v);
        memset(work->xi, 0, sizeof work->xi);
        memset(work->multiplier, 0, sizeof work->multiplier);
        for (int round = 0; round < 50 && largest > STAGES_ACCURACY; round++) {
            for (int i = 0; i < QP_LIMITS; i++)
                work->estimate[i] = work->multiplier[i] + work->weight[i] * stages_value(work, i);
            stages_gradient(prepared, 0, 0, work->v, work->xi, work->estimate + QP_N,
                            work->gradient);
            for (int j = 0; j < QP_N; j++) work->gradient[j] += work->estimate[j];
            work->gradient[a] -= 1.0;
            stages_step(prepared, work, 0);
            double change = 0.0, size = 1e-300;
            for (int j = 0; j < QP_N; j++) {
                work->v[j] += work->dv[j];
                change = qp_max(change, fabs(work->dv[j]));
                size = qp_max(size, fabs(work->v[j]));
            }
            largest = change / size;
            stages_simulate(prepared, 0, 0, work->v, work->xi);
            for (int i = 0; i < QP_LIMITS; i++)
                if (work->mode[i] == QP_AT)
                    work->multiplier[i] += work->weight[i] * stages_value(work, i);
        }
        /* Multipliers that have not settled give other derivatives: Python solves the KKT system. */
        if (!(largest <= STAGES_ACCURACY)) return QP_ITERATION_LIMIT;
        for (int j = 0; j < QP_N; j++) dv[a][j] = work->mode[j] == QP_AT ? 0.0 : work->v[j];
        for (int r = 0; r < QP_ROWS; r++) {
            const double moved = work->xi[N_X + r];
            const int beyond = work->mode[QP_N + r] == QP_BEYOND;
            dlam[a][r] = beyond ? 2.0 * prepared->W[r] * moved : work->multiplier[QP_N + r];
            dt[a][r] = beyond ? copysign(1.0, solved->lam[r]) * moved : 0.0;
        }
    }
    return status;
}

#endif
