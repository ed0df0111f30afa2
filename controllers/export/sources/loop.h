/* The closed loop of the RTI-NMPC and a plant, with its rule of a failed solve.
 *
 * Every closed loop in C is this one: the plant is a function. Its counterpart in Python is
 * `cosim.core.loop`.
 */
#ifndef LOOP_H
#define LOOP_H

#include <stddef.h>
#include <time.h>

#include "core.h"

/* What may fail in a sample of a plant; the functions are FMI's. */
enum { OK, FAILED_SET, FAILED_GET, FAILED_STEP, ENDED, NOT_FINITE };

/* A plant. `step` lets sample number `sample` pass under the action `input`, from `state` to the next
 * one, writes `output`, which a row of the table keeps, and returns OK or what failed; `status` gets
 * FMI's own where the plant is an FMU. */
typedef struct {
    int (*step)(void *plant, long long sample, int *status);
    void *plant;
    double *input;
    const double *state, *output;
    size_t n_outputs;
} LoopPlant;

/* The controller of a loop between two calls. `pending` says whether there is a solution to shift. */
typedef struct {
    RtiPrepared *prepared;
    RtiSolved *solved;
    RtiWork *work;
    double applied[N_U];
    long long pending;
} Loop;

/* Columns of a row behind the plant's outputs: value, residual, whether the controller failed, and the
 * seconds of preparation, feedback and plant. */
enum { LOOP_COLUMNS = 6 };

static double seconds(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
}

/* Linearise at the reference, as if there had been no earlier sample. */
static void loop_forget(RtiPrepared *prepared) {
    for (int k = 0; k < HORIZON; k++) {
        memcpy(prepared->x[k], REFERENCE_STATE, sizeof prepared->x[k]);
        memcpy(prepared->u[k], REFERENCE_ACTION, sizeof prepared->u[k]);
    }
    memset(prepared->costates, 0, sizeof prepared->costates);
}

static void loop_begin(Loop *loop, RtiPrepared *prepared, RtiSolved *solved, RtiWork *work) {
    loop->prepared = prepared;
    loop->solved = solved;
    loop->work = work;
    loop->pending = 0;
    loop_forget(prepared);
    memcpy(loop->applied, REFERENCE_ACTION, sizeof loop->applied);
}

static int loop_prepare(RtiPrepared *prepared, RtiWork *work) {
    if (!well_posed(prepared->theta)) return RTI_ILL_POSED;
    const int status = rti_prepare(prepared);
    return status == RTI_SOLVED ? rti_load(prepared, work) : status;
}

/* Samples `first` to `end` of a loop, a row of `table` each: state, action, the plant's outputs and the
 * LOOP_COLUMNS. After a failed solve the last action is applied once more, and the guess is forgotten.
 * Returns the sample at which the plant failed, whose row is not complete, or `end`; `fault` gets what
 * failed there and FMI's status. */
static long long loop_run(Loop *loop, const LoopPlant *plant, long long first, long long end,
                          double *table, int fault[2]) {
    for (long long sample = first; sample < end; sample++) {
        const double begin = seconds();
        if (loop->pending) rti_shift(loop->prepared, loop->solved);
        int status = loop_prepare(loop->prepared, loop->work);
        const double middle = seconds();
        memcpy(loop->solved->s, plant->state, sizeof loop->solved->s);
        if (status == RTI_SOLVED)
            status = rti_feedback(loop->prepared, loop->work, loop->solved, 0);
        const double solved = seconds();

        const int failed = status != RTI_SOLVED;
        loop->pending = !failed;
        if (failed) loop_forget(loop->prepared);
        for (int i = 0; !failed && i < N_U; i++)
            loop->applied[i] =
                qp_clip(rti_action(loop->solved, 0, i), ACTION_LOWER[i], ACTION_UPPER[i]);

        memcpy(table, plant->state, N_X * sizeof *table);
        memcpy(table + N_X, loop->applied, N_U * sizeof *table);
        table += N_W;
        memcpy(plant->input, loop->applied, N_U * sizeof *table);
        const double before = seconds();
        fault[0] = plant->step(plant->plant, sample, &fault[1]);
        const double after = seconds();
        if (fault[0] != OK) return sample;

        memcpy(table, plant->output, plant->n_outputs * sizeof *table);
        table += plant->n_outputs;
        table[0] = failed ? NAN : loop->solved->read[READ_value];
        table[1] = failed ? NAN : loop->solved->read[READ_residual];
        table[2] = failed;
        table[3] = middle - begin;
        table[4] = solved - middle;
        table[5] = after - before;
        table += LOOP_COLUMNS;
    }
    return end;
}

#endif
