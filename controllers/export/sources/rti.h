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
#include "qp_set.h"
#include "rotation.h"

enum { RTI_SOLVED = QP_SOLVED, RTI_ILL_POSED = QP_NOT_FINITE + 1, RTI_INACCURATE };

/* A QP without its state. Given: the point of linearisation (states x_0 … x_{N−1}, actions, costates
 * χ_1 … χ_N) and θ, behind which are the values σ of signals, N_VARYING for each of the stages 0 … N
 * (`controllers.stage_symbols`). `stack` has what `controllers.preparation` makes of it. Doubles only, in the order
 * in which Python has them (`controllers.rti.nmpc`). */
typedef struct {
    double x[HORIZON][N_X], u[HORIZON][N_U];
    double L[HORIZON * N_W * N_W], q[HORIZON * N_W], L_N[N_X * N_X], q_N[N_X], theta[N_GIVEN];
    double stack[PREPARED_SIZE];
    double costates[HORIZON][N_X];
    double w[QP_ROWS], W[QP_ROWS], constant;
} RtiPrepared;

/* A state, the solution of its QP, and what CasADi's `readout` and `embedding` make of them. The
 * iterations are the solver's; `gradient` is dV/dθ or dQ/dθ where it was asked for. The QP is in units
 * of SCALE_STATE and SCALE_ACTION, what is read out in the model's. */
typedef struct {
    double s[N_X], v[QP_N], lam[QP_ROWS], nu[QP_N], lower[QP_N], upper[QP_N], constant;
    double read[READ_SIZE];
    double embedded[EMBEDDED_SIZE];
    double iterations, gradient[N_THETA];
} RtiSolved;

/* Action i of stage k, in the model's units. */
static double rti_action(const RtiSolved *solved, int k, int i) {
    return solved->v[k * N_U + i] * SCALE_ACTION[i] + REFERENCE_ACTION[i];
}

/* The QP's variables and rows that stand for an action and a state. */
static double scaled_action(double action, int i) {
    return (action - REFERENCE_ACTION[i]) / SCALE_ACTION[i];
}

static double scaled_state(double state, int i) {
    return (state - REFERENCE_STATE[i]) / SCALE_STATE[i];
}

/* Make the solution, its first stage dropped and its last control repeated, the next guess. */
static void rti_shift(RtiPrepared *prepared, const RtiSolved *solved) {
    memcpy(prepared->x, solved->read + READ_next_x, sizeof prepared->x);
    memcpy(prepared->u, solved->read + READ_next_u, sizeof prepared->u);
    memcpy(prepared->costates, solved->read + READ_next_chi, sizeof prepared->costates);
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

/* How far a signal moves a bound of row r, which is of stage 1 + r / N_X; the signals by state. */
static inline double moved(const double theta[], int r, const double signals[],
                           const double nominal[]) {
    const int i = r % N_X, stage = 1 + r / N_X;
    if (N_VARYING == 0 || signals[i] < 0.0) return 0.0;
    return theta[N_THETA + stage * N_VARYING + (int)signals[i]] - nominal[i];
}

/* The bounds of the states 1 … N, by row. */
static inline double lower_bound(const double theta[], int r) {
    const double bound = theta[THETA_x_l + r % N_X] + moved(theta, r, LOWER_SIGNALS, LOWER_NOMINAL);
    return scaled_state(bound, r % N_X);
}

static inline double upper_bound(const double theta[], int r) {
    const double bound = theta[THETA_x_u + r % N_X] + moved(theta, r, UPPER_SIGNALS, UPPER_NOMINAL);
    return scaled_state(bound, r % N_X);
}

#include QP_RULE

/* What a function of stage k is given in the place of θ: (θ, σ_k, γᵏ) in `room`, or θ as it is. */
static inline const double *stage_given(const double theta[], int k, double room[]) {
    if (N_VARYING == 0) return theta;
    memcpy(room, theta, N_THETA * sizeof *room);
    memcpy(room + N_THETA, theta + N_THETA + k * N_VARYING, N_VARYING * sizeof *room);
    room[N_THETA + N_VARYING] = DISCOUNTS[k];
    return room;
}

#if SIGNAL_COSTS
/* What signals change of the linear terms of the costs, and of their constant. */
static void rti_signal_costs(RtiPrepared *prepared) {
    double changes[SIGNAL_SIZE], w[SIGNAL_W + 1];
    const double *arguments[SIGNAL_ARG] = {prepared->x[0], prepared->u[0], prepared->theta};
    double *results[SIGNAL_RES] = {changes};
    long long int iw[SIGNAL_IW + 1];
    if (signal_costs(arguments, results, iw, w, 0)) changes[0] = NAN;
    for (int i = 0; i < HORIZON * N_W; i++) prepared->q[i] += changes[SIGNAL_q + i];
    for (int i = 0; i < N_X; i++) prepared->q_N[i] += changes[SIGNAL_q_N + i];
    prepared->constant += changes[SIGNAL_constant];
}
#endif

/* A_k, B_k and r_k of all stages. Apart, so that CasADi's code has one caller: the loop takes it in,
 * and the compiler makes several stages at a time of it. */
static QP_APART void rti_linearise(RtiPrepared *prepared) {
    double *const A = prepared->stack + PREPARED_A, *const B = prepared->stack + PREPARED_B;
    double *const r = prepared->stack + PREPARED_r;
    for (int k = 0; k < HORIZON; k++) {
        /* In arrays of its own: gcc 12 has lost results that go through pointers into a larger one. */
        double by_state[N_X * N_X], by_action[N_X * N_U], offset[N_X];
        double room[N_THETA + N_VARYING + 1];
        const double *arguments[LINEARISE_ARG] = {prepared->x[k], prepared->u[k],
                                                  stage_given(prepared->theta, k, room)};
        double *results[LINEARISE_RES] = {by_state, by_action, offset};
        double w[LINEARISE_W + 1];
        long long int iw[LINEARISE_IW + 1];
        /* A function inside the model, such as a root finder, may fail. */
        if (linearise(arguments, results, iw, w, 0)) offset[0] = NAN;
        memcpy(A + k * N_X * N_X, by_state, sizeof by_state);
        memcpy(B + k * N_X * N_U, by_action, sizeof by_action);
        memcpy(r + k * N_X, offset, sizeof offset);
    }
}

/* Linearise; `rti_load` is what the QP's solver does beforehand. */
static int rti_prepare(RtiPrepared *prepared) {
    const double *const theta = prepared->theta;
    for (int k = 0; k < HORIZON; k++)
        for (int i = 0; i < N_X; i++) {
            const double price = STATE_PRICE[i], steep = SCALE_STATE[i] / STATE_PRICE[i];
            prepared->w[k * N_X + i] = SLACK_DISCOUNTS[k] * (SLACK_LINEAR(theta)[i] / price);
            prepared->W[k * N_X + i] = SLACK_DISCOUNTS[k] * (SLACK_QUADRATIC(theta)[i] * steep);
        }
    prepared->constant = stage_costs(prepared->x[0], prepared->u[0], prepared->costates[0], theta,
                                     prepared->L, prepared->q);
    terminal_cost(theta, prepared->L_N, prepared->q_N);
#if SIGNAL_COSTS
    rti_signal_costs(prepared);
#endif
    rti_linearise(prepared);
    return rti_assemble(prepared);
}

/* Of all multipliers of Q(s, a) at a kink, those that make dQ/da as small as they can: see
 * `controllers.qp.multipliers_at_kink`. Least squares by one-sided Jacobi rotations. */
static void rti_kink(const RtiPrepared *prepared, RtiSolved *solved) {
    double rows[N_X][N_U], low[N_X], high[N_X];
    double G[N_X][N_U], V[N_X][N_X], total[N_U], chosen[N_X];
    int near[N_X], inside[N_U], count = 0;
    rti_first_rows(prepared, solved, rows, low, high);
    for (int i = 0; i < N_X; i++) {
        double y = 0.0;
        for (int j = 0; j < N_U; j++) y += rows[i][j] * solved->v[j];
        if (qp_min(fabs(y - low[i]), fabs(y - high[i])) < 1e-8 * (1.0 + fabs(y))) near[count++] = i;
    }
    if (count == 0) return;
    for (int j = 0; j < N_U; j++) {
        const double v = solved->v[j], width = 1e-8 * (1.0 + fabs(v));
        inside[j] = v > scaled_action(ACTION_LOWER[j], j) + width &&
                    v < scaled_action(ACTION_UPPER[j], j) - width;
        total[j] = solved->nu[j];
        for (int c = 0; c < count; c++) {
            G[c][j] = inside[j] ? rows[near[c]][j] : 0.0;
            total[j] += solved->lam[near[c]] * rows[near[c]][j];
        }
    }
    for (int c = 0; c < count; c++)
        for (int d = 0; d < count; d++) V[c][d] = c == d;
    for (int sweep = 0, turned = 1; turned && sweep < 30; sweep++) {
        turned = 0;
        for (int c = 0; c < count; c++)
            for (int d = c + 1; d < count; d++) {
                double cc = 0.0, dd = 0.0, cd = 0.0;
                for (int j = 0; j < N_U; j++) {
                    cc += G[c][j] * G[c][j];
                    dd += G[d][j] * G[d][j];
                    cd += G[c][j] * G[d][j];
                }
                if (!(fabs(cd) > 1e-16 * sqrt(cc * dd))) continue;
                const Rotation by = rotation_of(cc, dd, cd);
                for (int j = 0; j < N_U; j++) rotate(by, &G[c][j], &G[d][j]);
                for (int j = 0; j < count; j++) rotate(by, &V[c][j], &V[d][j]);
                turned = 1;
            }
    }
    double largest = 0.0, squares[N_X];
    for (int c = 0; c < count; c++) {
        squares[c] = chosen[c] = 0.0;
        for (int j = 0; j < N_U; j++) squares[c] += G[c][j] * G[c][j];
        largest = qp_max(largest, squares[c]);
    }
    for (int c = 0; c < count; c++) {
        double along = 0.0;
        if (!(squares[c] > 1e-30 * largest)) continue;
        for (int j = 0; j < N_U; j++) along += G[c][j] * total[j];
        for (int d = 0; d < count; d++) chosen[d] += V[c][d] * along / squares[c];
    }
    for (int c = 0; c < count; c++) {
        const int i = near[c];
        double y = 0.0;
        for (int j = 0; j < N_U; j++) y += rows[i][j] * solved->v[j];
        const int over = fabs(y - high[i]) < fabs(y - low[i]);
        solved->lam[i] =
            qp_clip(chosen[c], over ? 0.0 : -prepared->w[i], over ? prepared->w[i] : 0.0);
        for (int j = 0; j < N_U; j++) total[j] -= solved->lam[i] * rows[i][j];
    }
    memcpy(solved->nu, total, sizeof total);
}

/* V(s) and π(s) of a prepared QP for the state in `solved`, or Q(s, a) where `a` is given. */
static int rti_feedback(const RtiPrepared *prepared, RtiWork *work, RtiSolved *solved,
                        const double a[]) {
    const double *const stack = prepared->stack;
    for (int k = 0; k < QP_N; k++) {
        solved->lower[k] = scaled_action(ACTION_LOWER[k % N_U], k % N_U);
        solved->upper[k] = scaled_action(ACTION_UPPER[k % N_U], k % N_U);
    }
    for (int i = 0; a && i < N_U; i++) solved->lower[i] = solved->upper[i] = scaled_action(a[i], i);
    if (a && !all_finite(a, N_U)) return QP_NOT_FINITE;
    const int status = rti_solve(prepared, work, solved, a != 0);
    if (status != QP_SOLVED) return status;
    if (a) rti_kink(prepared, solved);
    solved->constant = prepared->constant;
    {
        const double *arguments[READ_ARG] = {
            solved->s,          solved->v,          solved->lam,        solved->nu,
            solved->lower,      solved->upper,      stack + PREPARED_A, stack + PREPARED_B,
            stack + PREPARED_r, prepared->L,        prepared->q,        prepared->L_N,
            prepared->q_N,      &solved->constant,  prepared->theta};
        double *results[READ_RES] = {solved->read}, w[READ_W + 1];
        long long int iw[READ_IW + 1];
        readout(arguments, results, iw, w, 0);
    }
    if (!all_finite(solved->read, READ_SIZE)) return QP_NOT_FINITE;
    return solved->read[READ_residual] <= RTI_RESIDUAL ? RTI_SOLVED : RTI_INACCURATE;
}

#endif
