/* The closed loop of a controller and a plant, with its rule of a failed solve.
 *
 * Every closed loop in C is this one: controller and plant are functions. Its counterpart in Python is
 * `cosim.core.loop`.
 */
#ifndef LOOP_H
#define LOOP_H

#include <math.h>
#include <stddef.h>
#include <string.h>
#include <time.h>

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

/* How a controller came to its action: `cosim.core.simulation.LOOP_STATUSES` has their names. */
enum { LOOP_SOLVED, LOOP_FAILED, LOOP_CLAMPED };

/* What a controller says beside its action. */
typedef struct {
    double value, residual;
} LoopAnswer;

/* A controller. `prepare` does what needs no state. `feedback` writes the action for a state, within the
 * actuators' bounds, and its answer, and returns a status; after a failed solve it writes neither, and
 * the controller forgets what led there. `action` is that of the last sample, and before the first one
 * the reference. */
typedef struct {
    void (*prepare)(void *controller);
    int (*feedback)(void *controller, const double state[], double action[], LoopAnswer *answer);
    void *controller;
    double *action;
    size_t n_states, n_actions;
} LoopController;

/* Columns of a row behind the plant's outputs: value, residual, the controller's status, and the seconds
 * of preparation, feedback and plant. */
enum { LOOP_COLUMNS = 6 };

static double seconds(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
}

/* Samples `first` to `end` of a loop, a row of `table` each: state, action, the plant's outputs and the
 * LOOP_COLUMNS. After a failed solve the last action is applied once more. Returns the sample at which
 * the plant failed, whose row is not complete, or `end`; `fault` gets what failed there and FMI's
 * status. */
static long long loop_run(const LoopController *law, const LoopPlant *plant, long long first,
                          long long end, double *table, int fault[2]) {
    const size_t state_size = law->n_states * sizeof *table;
    const size_t action_size = law->n_actions * sizeof *table;
    for (long long sample = first; sample < end; sample++) {
        const double begin = seconds();
        law->prepare(law->controller);
        const double prepared = seconds();
        LoopAnswer answer = {NAN, NAN};
        const int status = law->feedback(law->controller, plant->state, law->action, &answer);
        const double solved = seconds();

        memcpy(table, plant->state, state_size);
        table += law->n_states;
        memcpy(table, law->action, action_size);
        table += law->n_actions;
        memcpy(plant->input, law->action, action_size);
        const double before = seconds();
        fault[0] = plant->step(plant->plant, sample, &fault[1]);
        const double after = seconds();
        if (fault[0] != OK) return sample;

        memcpy(table, plant->output, plant->n_outputs * sizeof *table);
        table += plant->n_outputs;
        table[0] = answer.value;
        table[1] = answer.residual;
        table[2] = status;
        table[3] = prepared - begin;
        table[4] = solved - prepared;
        table[5] = after - before;
        table += LOOP_COLUMNS;
    }
    return end;
}

#endif
