/* The controller as a sampled system: what is measured in, action out, once a sample.
 *
 * `core_act` computes the outputs of the present sample and may be called again when the state or the
 * manual action changes; `core_commit` ends the sample. A sample without a solution repeats the last
 * action and forgets the guess. In manual the QP has the operator's action for its first, Q(s, a), so
 * that the next guess is what follows from it.
 */
#ifndef CORE_H
#define CORE_H

#include <math.h>
#include <stdint.h>
#include <string.h>

#include "problem.h"

#include "linearise.h"
#include "functions.h"

#include HESSIAN_RULE

#include "rti.h"

/* What makes a state of the inputs: measured as it is, or estimated. */
#include OBSERVER_RULE

/* Where a QP is linearised. */
typedef struct {
    double x[HORIZON][N_X], u[HORIZON][N_U], costates[HORIZON][N_X];
} CoreGuess;

/* What a sample found: predicted x_0 … x_N and u_0 … u_{N−1}, and the guess for the next sample. */
typedef struct {
    double x[HORIZON + 1][N_X], u[HORIZON][N_U];
    CoreGuess next;
    double value, residual, iterations;
} CoreSolution;

typedef struct {
    CoreGuess guess;
    CoreSolution solution; /* of the last sample that was solved */
    Observer observer;
    double action[N_U];    /* of the present sample */
    double applied[N_U];   /* of the last one */
    double failures; /* among the samples before the present one */
    int64_t status; /* of the present sample */
} CoreState;

static const char *const CORE_MESSAGES[] = {
    "solved",
    "the QP is not strictly convex",
    "the QP solver reached its iteration limit",
    "the QP is not finite",
    "theta is not well posed: x_l must be below x_u and slack weights positive",
    "the QP was solved too inaccurately",
};

static void core_keep(CoreGuess *guess, const RtiPrepared *prepared) {
    memcpy(guess->x, prepared->x, sizeof guess->x);
    memcpy(guess->u, prepared->u, sizeof guess->u);
    memcpy(guess->costates, prepared->costates, sizeof guess->costates);
}

static void core_forget(CoreGuess *guess) {
    memset(guess, 0, sizeof *guess);
    for (int k = 0; k < HORIZON; k++) {
        memcpy(guess->x[k], REFERENCE_STATE, sizeof guess->x[k]);
        memcpy(guess->u[k], REFERENCE_ACTION, sizeof guess->u[k]);
    }
}

/* Apart, so that the solver's arrays take the place of CasADi's work vector. */
static QP_APART int core_solve(const RtiPrepared *prepared, RtiSolved *solved, const double a[]) {
    QP_SCRATCH RtiWork work;
    const int status = rti_load(prepared, &work);
    return status == RTI_SOLVED ? rti_feedback(prepared, &work, solved, a) : status;
}

/* V(s) and π(s) of the QP at the guess, or Q(s, a) where `a` is given; anything but RTI_SOLVED leaves
 * `solution` alone. */
static int core_sample(const CoreGuess *guess, const double theta[], const Observer *observer,
                       const double s[], const double a[], CoreSolution *solution) {
    QP_SCRATCH RtiPrepared prepared;
    QP_SCRATCH RtiSolved solved;
    if (!well_posed(theta)) return RTI_ILL_POSED;
    if (N_VARYING > 0 && !all_finite(theta + N_THETA, N_GIVEN - N_THETA)) return QP_NOT_FINITE;
    memcpy(prepared.x, guess->x, sizeof prepared.x);
    memcpy(prepared.u, guess->u, sizeof prepared.u);
    memcpy(prepared.costates, guess->costates, sizeof prepared.costates);
    memcpy(prepared.theta, theta, sizeof prepared.theta);
    observer_tighten(observer, prepared.theta);
    memcpy(solved.s, s, sizeof solved.s);
    int status = rti_prepare(&prepared);
    if (status != RTI_SOLVED) return status;
    status = core_solve(&prepared, &solved, a);
    if (status != RTI_SOLVED) return status;
    for (int k = 0; k <= HORIZON; k++)
        for (int i = 0; i < N_X; i++)
            solution->x[k][i] = solved.read[READ_xi + k * N_X + i] + REFERENCE_STATE[i];
    for (int k = 0; k < HORIZON; k++)
        for (int i = 0; i < N_U; i++)
            solution->u[k][i] = rti_action(&solved, k, i);
    rti_shift(&prepared, &solved);
    core_keep(&solution->next, &prepared);
    solution->value = solved.read[READ_value];
    solution->residual = solved.read[READ_residual];
    solution->iterations = solved.iterations;
    return RTI_SOLVED;
}

static void core_reset(CoreState *state) {
    memset(state, 0, sizeof *state);
    core_forget(&state->guess);
    observer_reset(&state->observer);
    memcpy(state->applied, REFERENCE_ACTION, sizeof state->applied);
    memcpy(state->action, REFERENCE_ACTION, sizeof state->action);
}

/* `inputs` are the observer's, `theta` is (θ, σ); `manual` is the operator's action, which acts within its bounds whatever the status is, or null in
 * automatic. An entry that is not finite holds the last one. */
static void core_act(CoreState *state, const double inputs[], const double manual[],
                     const double theta[]) {
    const double *const s = observer_take(&state->observer, inputs, theta);
    double a[N_U];
    for (int i = 0; i < N_U; i++)
        a[i] = manual && isfinite(manual[i]) ? qp_clip(manual[i], ACTION_LOWER[i], ACTION_UPPER[i])
                                             : state->applied[i];
    state->status = core_sample(&state->guess, theta, &state->observer, s, manual ? a : 0,
                                &state->solution);
    for (int i = 0; !manual && state->status == RTI_SOLVED && i < N_U; i++)
        a[i] = qp_clip(state->solution.u[0][i], ACTION_LOWER[i], ACTION_UPPER[i]);
    memcpy(state->action, a, sizeof a);
}

/* (θ, σ) of θ and what is known of the signals: of each its present value and those ahead, as many as
 * KNOWN_COUNTS says. Beyond its last known value a signal keeps that. */
static inline void core_given(const double theta[], const double known[], double given[]) {
    memcpy(given, theta, N_THETA * sizeof *given);
    for (int row = 0; row < N_VARYING; row++) {
        const int last = KNOWN_COUNTS[row] - 1;
        for (int k = 0; k <= HORIZON; k++)
            given[N_THETA + k * N_VARYING + row] = known[k < last ? k : last];
        known += KNOWN_COUNTS[row];
    }
}

/* The n inputs of the table of variables: the observer's, what is known of signals, whether the action
 * is manual, the manual action, and what is measured, for the last entries of theta; one that is not
 * finite leaves theta's own. */
static inline void core_evaluate(CoreState *state, const double inputs[], int n,
                                 const double theta[]) {
    const double *const known = inputs + OBSERVER_INPUTS, *const manual = known + N_KNOWN + 1;
    double given[N_GIVEN];
    core_given(theta, known, given);
    for (int i = OBSERVER_INPUTS + N_KNOWN + 1 + N_U; i < n; i++)
        if (isfinite(inputs[i])) given[N_THETA - n + i] = inputs[i];
    core_act(state, inputs, known[N_KNOWN] != 0.0 ? manual : 0, given);
}

static void core_commit(CoreState *state) {
    memcpy(state->applied, state->action, sizeof state->applied);
    observer_commit(&state->observer, state->applied);
    if (state->status == RTI_SOLVED) {
        state->guess = state->solution.next;
        return;
    }
    state->failures += 1.0;
    core_forget(&state->guess);
}

/* Whether a state could be one that the functions above leave behind. */
static inline int core_plausible(const CoreState *state) {
    return all_finite(&state->guess.x[0][0], sizeof state->guess / sizeof(double)) &&
           all_finite(&state->solution.x[0][0], sizeof state->solution / sizeof(double)) &&
           all_finite(state->action, N_U) && all_finite(state->applied, N_U) &&
           observer_plausible(&state->observer) && state->failures >= 0.0 &&
           state->failures < 9e15 && state->status >= 0 && state->status <= RTI_INACCURATE;
}

/* Outputs in the order of the table of variables: action, value, status, residual, iterations,
 * failures, predicted states by stage, predicted actions by stage, the observer's. */
static inline void core_outputs(const CoreState *state, double y[]) {
    const CoreSolution *solution = &state->solution;
    for (int i = 0; i < N_U; i++) *y++ = state->action[i];
    *y++ = solution->value;
    *y++ = (double)state->status;
    *y++ = solution->residual;
    *y++ = solution->iterations;
    *y++ = state->failures + (state->status != RTI_SOLVED);
    memcpy(y, solution->x, sizeof solution->x);
    memcpy(y + (HORIZON + 1) * N_X, solution->u, sizeof solution->u);
    observer_outputs(&state->observer, y + (HORIZON + 1) * N_X + HORIZON * N_U);
}

#endif
