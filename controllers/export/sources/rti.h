/* One sample of the RTI-NMPC: linearise along the guess, condense, embed the state, solve, read out.
 *
 * What `controllers.RtiNmpc` does in `prepare` and `feedback`, with the same CasADi functions as C.
 * The including file has read `problem.h` (sizes, constants), `functions.h` (CasADi's code) and a
 * Hessian rule that defines `stage_costs`.
 */
#ifndef RTI_H
#define RTI_H

#define QP_N (HORIZON * N_U)
#define QP_ROWS (HORIZON * N_X)
#include "qp.h"

enum { RTI_SOLVED = QP_SOLVED, RTI_ILL_POSED = QP_NOT_FINITE + 1, RTI_INACCURATE };

/* The largest KKT residual of a QP that counts as solved. */
#define RTI_RESIDUAL 1e-6

/* Where the next QP is linearised: states x_0 … x_{N−1}, actions, costates χ_1 … χ_N; and the
 * working set that its solver begins with. */
typedef struct {
    double x[HORIZON][N_X], u[HORIZON][N_U], costates[HORIZON][N_X];
    double set[QP_LIMITS];
} RtiGuess;

/* What a sample found: predicted x_0 … x_N and u_0 … u_{N−1}, and the guess for the next sample. */
typedef struct {
    double x[HORIZON + 1][N_X], u[HORIZON][N_U];
    RtiGuess next;
    double value, residual, iterations;
} RtiSolution;

static void rti_reset(RtiGuess *guess) {
    memset(guess, 0, sizeof *guess);
    for (int k = 0; k < HORIZON; k++) {
        memcpy(guess->x[k], REFERENCE_STATE, sizeof guess->x[k]);
        memcpy(guess->u[k], REFERENCE_ACTION, sizeof guess->u[k]);
    }
}

/* Whether every entry is finite: of ∞ − ∞ the sum of magnitudes says so too. */
static int all_finite(const double values[], int count) {
    double sum = 0.0;
    for (int i = 0; i < count; i++) sum += fabs(values[i]);
    return isfinite(sum);
}

static int well_posed(const double theta[]) {
    for (int i = 0; i < N_X; i++) {
        if (!(theta[THETA_x_l + i] < theta[THETA_x_u + i])) return 0;
        if (!(SLACK_LINEAR(theta)[i] > 0.0 && SLACK_QUADRATIC(theta)[i] > 0.0)) return 0;
    }
    return 1;
}

/* V(s) and π(s) of the QP at the guess; anything but RTI_SOLVED leaves `solution` alone. */
static int rti_sample(const RtiGuess *guess, const double theta[], const double s[],
                      RtiSolution *solution) {
    QP_SCRATCH double L[HORIZON * N_W * N_W], q[HORIZON * N_W], L_N[N_X * N_X], q_N[N_X];
    QP_SCRATCH double prepared[PREPARED_SIZE], embedded[EMBEDDED_SIZE], read[READ_SIZE];
    QP_SCRATCH double lower[QP_N], upper[QP_N], w[QP_ROWS], W[QP_ROWS];
    const double *const x = guess->x[0], *const u = guess->u[0];
    if (!well_posed(theta)) return RTI_ILL_POSED;
    const double constant = stage_costs(guess->x[0], guess->u[0], guess->costates[0], theta, L, q);
    terminal_cost(theta, L_N, q_N);
    {
        const double *arguments[PREPARED_ARG] = {x, u, L, q, L_N, q_N, theta};
        QP_SCRATCH double w[PREPARED_W + 1];
        double *results[PREPARED_RES] = {prepared};
        long long int iw[PREPARED_IW + 1];
        preparation(arguments, results, iw, w, 0);
    }
    if (!all_finite(prepared, PREPARED_SIZE)) return QP_NOT_FINITE;
    {
        const double *arguments[EMBEDDED_ARG] = {s, theta, prepared + PREPARED_Phi, prepared + PREPARED_g,
                                                 prepared + PREPARED_f, prepared + PREPARED_F};
        double *results[EMBEDDED_RES] = {embedded}, w[EMBEDDED_W + 1];
        long long int iw[EMBEDDED_IW + 1];
        embedding(arguments, results, iw, w, 0);
    }
    if (!all_finite(embedded, EMBEDDED_SIZE)) return QP_NOT_FINITE;
    for (int k = 0; k < HORIZON; k++) {
        for (int i = 0; i < N_U; i++) {
            lower[k * N_U + i] = ACTION_LOWER[i] - REFERENCE_ACTION[i];
            upper[k * N_U + i] = ACTION_UPPER[i] - REFERENCE_ACTION[i];
        }
        for (int i = 0; i < N_X; i++) {
            w[k * N_X + i] = SLACK_DISCOUNTS[k] * SLACK_LINEAR(theta)[i];
            W[k * N_X + i] = SLACK_DISCOUNTS[k] * SLACK_QUADRATIC(theta)[i];
        }
    }
    const Qp qp = {prepared + PREPARED_H,     embedded + EMBEDDED_f, lower, upper,
                   prepared + PREPARED_Gamma, embedded + EMBEDDED_lower,
                   embedded + EMBEDDED_upper, w,                     W};
    QP_SCRATCH QpWork work; /* here, so that it takes the place of CasADi's work vector */
    QpStatus status = qp_load(&qp, &work);
    if (status == QP_SOLVED) status = qp_solve(&qp, &work, guess->set);
    if (status != QP_SOLVED) return status;
    {
        const double *arguments[READ_ARG] = {s, work.v, work.lam, prepared + PREPARED_A,
                                             prepared + PREPARED_B, prepared + PREPARED_r, L, q, L_N,
                                             q_N, &constant, theta};
        double *results[READ_RES] = {read}, w[READ_W + 1];
        long long int iw[READ_IW + 1];
        readout(arguments, results, iw, w, 0);
    }
    if (!all_finite(read, READ_SIZE)) return QP_NOT_FINITE;
    const double residual = qp_residual(&qp, &work);
    if (!(residual <= RTI_RESIDUAL)) return RTI_INACCURATE;
    for (int k = 0; k <= HORIZON; k++)
        for (int i = 0; i < N_X; i++)
            solution->x[k][i] = read[READ_xi + k * N_X + i] + REFERENCE_STATE[i];
    for (int k = 0; k < HORIZON; k++)
        for (int i = 0; i < N_U; i++)
            solution->u[k][i] = work.v[k * N_U + i] + REFERENCE_ACTION[i];
    memcpy(solution->next.x, read + READ_next_x, sizeof solution->next.x);
    memcpy(solution->next.u, read + READ_next_u, sizeof solution->next.u);
    memcpy(solution->next.costates, read + READ_next_chi, sizeof solution->next.costates);
    qp_remember(&work, solution->next.set);
    solution->value = read[READ_value];
    solution->residual = residual;
    solution->iterations = work.iterations;
    return RTI_SOLVED;
}

#endif
