/* The RTI-NMPC in closed loop with an empirical model: `learning.rollout.Rollout`, compiled.
 *
 * `sizes.h` has K (states and cost) and the work space of `nominal`, CasADi's code for y(s, a; c) and
 * h(s, a). Controller and loop are the package's own C (`rti_loop.h`).
 */
#define _POSIX_C_SOURCE 199309L
#include "rti_loop.h"

#include "sizes.h"

int nominal(const double **arguments, double **results, long long int *iw, double *w, int memory);

/* Without signals there is no size of what they give. */
#ifndef N_SIGNALS
#define N_SIGNALS 0
#endif

/* Inputs of the model: state, action, and what signals give of the model. */
enum { N_INPUTS = N_W + N_SIGNALS };

/* An empirical model: `c` and `W`, a row (1, s, a, v) an output, are its coefficients. Sample k meets the
 * residual picks[k], beside what persists of the `error` before, and the signals of its row. `output` is
 * y(s, a, v; c) + W (1, s, a, v) with the error, and h. */
typedef struct {
    double inputs[N_INPUTS], output[2 * K], error[K];
    const double *c, *W, *persistence, *residuals, *signals;
    const int32_t *picks;
} Empirical;

static int empirical_step(void *plant, long long sample, int *status) {
    Empirical *const model = plant;
    double *const predicted = model->output, *const h = model->output + K;
    (void)status;
    if (!all_finite(model->inputs, N_X)) return NOT_FINITE;
    for (int i = 0; i < N_SIGNALS; i++)
        model->inputs[N_W + i] = model->signals[sample * N_SIGNALS + i];
    const double *arguments[NOMINAL_ARG] = {model->inputs, model->inputs + N_X, model->c};
    double *results[NOMINAL_RES] = {predicted, h};
    double w[NOMINAL_W + 1];
    long long int iw[NOMINAL_IW + 1];
    if (nominal(arguments, results, iw, w, 0)) predicted[0] = NAN;
    for (int i = 0; i < K; i++) {
        const double *const row = model->W + i * (N_INPUTS + 1);
        predicted[i] += row[0];
        for (int j = 0; j < N_INPUTS; j++) predicted[i] += row[1 + j] * model->inputs[j];
    }
    const double *const residual = model->residuals + (int64_t)model->picks[sample] * K;
    double persists[K] = {0.0};
    for (int i = 0; i < K; i++) {
        for (int j = 0; j < K; j++) persists[i] += model->persistence[i * K + j] * model->error[j];
        predicted[i] += h[i] * persists[i];
    }
    for (int i = 0; i < K; i++) model->error[i] = persists[i] + residual[i];
    for (int i = 0; i < N_X; i++) model->inputs[i] = predicted[i] + h[i] * residual[i];
    return OK;
}

/* The controller, which is told before each sample what is known of the signals: `stages` has a row of
 * N_VARYING values for each of the stages 0 … N, all of a sample in a row. */
typedef struct {
    RtiLoop loop;
    const double *stages;
    long long sample;
} Informed;

static void informed_prepare(void *controller) {
    enum { KNOWN = N_GIVEN - N_THETA };
    Informed *const informed = controller;
    if (KNOWN > 0)
        memcpy(informed->loop.prepared->theta + N_THETA, informed->stages + informed->sample * KNOWN,
               KNOWN * sizeof(double));
    informed->sample++;
    rti_loop_prepare(&informed->loop);
}

size_t rollout_columns(void) { return N_W + 2 * K + LOOP_COLUMNS; }

/* `steps` samples from the state `start`, a row of `table` each (`loop_run`). Returns the number of the
 * samples before one whose state is not finite, else `steps`. */
int rollout(const double theta[], const double start[], const double c[], const double W[],
            const double persistence[], const double residuals[], const int32_t picks[],
            const double stages[], const double signals[], int steps, double *table) {
    QP_SCRATCH RtiPrepared prepared;
    QP_SCRATCH RtiSolved solved;
    QP_SCRATCH RtiWork work;
    Empirical model = {
        .c = c, .W = W, .persistence = persistence, .residuals = residuals, .picks = picks,
        .signals = signals,
    };
    const LoopPlant plant = {
        empirical_step, &model, model.inputs + N_X, model.inputs, model.output, 2 * K,
    };
    Informed informed = {.stages = stages};
    int fault[2];
    memcpy(model.inputs, start, N_X * sizeof *start);
    memcpy(prepared.theta, theta, N_THETA * sizeof *theta);
    rti_loop_begin(&informed.loop, &prepared, &solved, &work);
    LoopController law = rti_loop_controller(&informed.loop);
    law.prepare = informed_prepare;
    return (int)loop_run(&law, &plant, 0, steps, table, fault);
}
