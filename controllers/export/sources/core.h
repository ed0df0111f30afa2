/* The controller as a sampled system: state in, action out, once a sample.
 *
 * `core_evaluate` computes the outputs of the present sample and may be called again when the inputs
 * change; `core_commit` ends the sample. A sample without a solution repeats the last action and
 * forgets the guess.
 */
#ifndef CORE_H
#define CORE_H

#include <math.h>
#include <stdint.h>
#include <string.h>

#include "problem.h"

#include "functions.h"

#include HESSIAN_RULE

#include "rti.h"

typedef struct {
    RtiGuess guess;
    RtiSolution solution; /* of the last sample that was solved */
    double action[N_U];   /* of the present sample */
    double applied[N_U];  /* of the last one */
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

static void core_reset(CoreState *state) {
    memset(state, 0, sizeof *state);
    rti_reset(&state->guess);
    memcpy(state->applied, REFERENCE_ACTION, sizeof state->applied);
    memcpy(state->action, REFERENCE_ACTION, sizeof state->action);
}

static void core_evaluate(CoreState *state, const double s[], const double theta[]) {
    state->status = rti_sample(&state->guess, theta, s, &state->solution);
    for (int i = 0; i < N_U; i++)
        state->action[i] = state->status == RTI_SOLVED
                               ? qp_clip(state->solution.u[0][i], ACTION_LOWER[i], ACTION_UPPER[i])
                               : state->applied[i];
}

static void core_commit(CoreState *state) {
    memcpy(state->applied, state->action, sizeof state->applied);
    if (state->status == RTI_SOLVED) {
        state->guess = state->solution.next;
        return;
    }
    state->failures += 1.0;
    rti_reset(&state->guess);
}

/* Whether a state could be one that the functions above leave behind. */
static inline int core_plausible(const CoreState *state) {
    for (int i = 0; i < QP_LIMITS; i++)
        if (!qp_is_mode(i, state->guess.set[i]) || !qp_is_mode(i, state->solution.next.set[i]))
            return 0;
    return all_finite(&state->guess.x[0][0], sizeof state->guess / sizeof(double)) &&
           all_finite(&state->solution.x[0][0], sizeof state->solution / sizeof(double)) &&
           all_finite(state->action, N_U) && all_finite(state->applied, N_U) &&
           state->failures >= 0.0 && state->failures < 9e15 && state->status >= 0 &&
           state->status <= RTI_INACCURATE;
}

/* Outputs in the order of the table of variables: action, value, status, residual, iterations,
 * failures, predicted states by stage, predicted actions by stage. */
static inline void core_outputs(const CoreState *state, double y[]) {
    const RtiSolution *solution = &state->solution;
    for (int i = 0; i < N_U; i++) *y++ = state->action[i];
    *y++ = solution->value;
    *y++ = (double)state->status;
    *y++ = solution->residual;
    *y++ = solution->iterations;
    *y++ = state->failures + (state->status != RTI_SOLVED);
    memcpy(y, solution->x, sizeof solution->x);
    memcpy(y + (HORIZON + 1) * N_X, solution->u, sizeof solution->u);
}

#endif
