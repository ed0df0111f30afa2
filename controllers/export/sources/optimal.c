/* A policy that is a table over a grid of states, in closed loop with an FMU: the optimal one.
 *
 * Action and value are interpolated multilinearly, with the digits of
 * `controllers.policy_table.PolicyTable`, which is the same in Python.
 */
#define _POSIX_C_SOURCE 199309L
#include "fmu.h"

/* A table. `axes` has the `sizes[i]` coordinates of each state i, one axis behind the other; `rows` an
 * action and a value W for each state of the grid, the last state running fastest. The value is W and
 * the penalty of the bounds. `fractions` is room for n_states numbers, `row` for n_actions + 1. */
typedef struct {
    size_t n_states, n_actions;
    const size_t *sizes;
    const double *axes, *rows;
    const double *action_lower, *action_upper;
    const double *state_lower, *state_upper, *linear, *quadratic;
    double *action, *fractions, *row;
} PolicyTable;

static void nothing(void *controller) { (void)controller; }

/* The last cell of an axis that begins at x or below; the first or last one for x outside. */
static size_t cell_of(const double axis[], size_t size, double x) {
    size_t low = 0, high = size - 1;
    while (high - low > 1) {
        const size_t middle = (low + high) / 2;
        if (x < axis[middle]) high = middle;
        else low = middle;
    }
    return low;
}

/* Interpolate `row` at a state; whether the state was outside of the grid. */
static int look_up(const PolicyTable *table, const double state[]) {
    const size_t n = table->n_states, width = table->n_actions + 1;
    const double *axis = table->axes;
    size_t base = 0;
    int clamped = 0;
    for (size_t i = 0; i < n; i++) {
        const size_t size = table->sizes[i];
        const size_t cell = cell_of(axis, size, state[i]);
        double fraction = (state[i] - axis[cell]) / (axis[cell + 1] - axis[cell]);
        if (!(0.0 <= fraction && fraction <= 1.0)) {
            fraction = fraction < 0.0 ? 0.0 : 1.0;
            clamped = 1;
        }
        table->fractions[i] = fraction;
        base = base * size + cell;
        axis += size;
    }
    for (size_t j = 0; j < width; j++) table->row[j] = 0.0;
    /* Bit n − 1 − i of a corner's number says whether it is at the upper end of the cell in state i. */
    for (size_t corner = 0; corner < (size_t)1 << n; corner++) {
        double weight = 1.0;
        size_t offset = 0;
        for (size_t i = 0; i < n; i++) {
            const size_t high = corner >> (n - 1 - i) & 1;
            weight *= high ? table->fractions[i] : 1.0 - table->fractions[i];
            offset = offset * table->sizes[i] + high;
        }
        if (weight == 0.0) continue;
        const double *const entries = table->rows + (base + offset) * width;
        for (size_t j = 0; j < width; j++) table->row[j] += weight * entries[j];
    }
    return clamped;
}

static double penalty(const PolicyTable *table, const double state[]) {
    double total = 0.0;
    for (size_t i = 0; i < table->n_states; i++) {
        const double x = state[i], lower = table->state_lower[i], upper = table->state_upper[i];
        if (lower <= x && x <= upper) continue;
        const double v = x < lower ? lower - x : x - upper;
        total += table->linear[i] * v + table->quadratic[i] * v * v;
    }
    return total;
}

static int feedback(void *controller, const double state[], double action[], LoopAnswer *answer) {
    const PolicyTable *const table = controller;
    const int clamped = look_up(table, state);
    for (size_t i = 0; i < table->n_actions; i++) {
        const double above = table->row[i] > table->action_lower[i] ? table->row[i] : table->action_lower[i];
        action[i] = above < table->action_upper[i] ? above : table->action_upper[i];
    }
    answer->value = table->row[table->n_actions] + penalty(table, state);
    answer->residual = 0.0;
    return clamped ? LOOP_CLAMPED : LOOP_SOLVED;
}

/* `loop_run` with an FMU. */
long long optimal_run(PolicyTable *table, Plant *fmu, long long first, long long end, double *rows,
                      int fault[2]) {
    const LoopController law = {
        nothing, feedback, table, table->action, table->n_states, table->n_actions,
    };
    const LoopPlant plant = fmu_plant(fmu);
    return loop_run(&law, &plant, first, end, rows, fault);
}
