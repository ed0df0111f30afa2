/* The library that runs `controllers.RtiNmpc`: the phases of a sample, and whole closed loops with an
 * FMU. */
#define _POSIX_C_SOURCE 199309L
#include "loop.h"
#include "sensitivities.h"

size_t engine_sizes(int what) {
    return what == 0 ? sizeof(RtiPrepared) : what == 1 ? sizeof(RtiSolved) : sizeof(RtiWork);
}

int engine_prepare(RtiPrepared *prepared, RtiWork *work) {
    return loop_prepare(prepared, work);
}

int engine_feedback(const RtiPrepared *prepared, RtiWork *work, RtiSolved *solved, const double a[]) {
    const int status = rti_feedback(prepared, work, solved, a);
    if (status == RTI_SOLVED) rti_gradient(prepared, solved);
    return status;
}

/* π and V, or Q of the actions `enforced` (or null), of `count` QPs, a row each: state, θ, point of
 * linearisation. `failed`, and nothing written, where there is no solution. `slopes`, unless it is null, gets dV/ds,
 * dV/dθ, dQ/da, dπ/dθ and dπ/ds as far as a row has them; `failed` is −1 where the active constraints'
 * gradients are dependent. A QP's preparation serves the rows behind it that have its θ and point. */
void engine_batch(RtiPrepared *prepared, RtiSolved *solved, RtiWork *work, long long count,
                  const double (*s)[N_X], const double (*enforced)[N_U],
                  const double (*theta)[N_THETA], const double (*x)[HORIZON][N_X],
                  const double (*u)[HORIZON][N_U], double (*actions)[N_U], double values[],
                  double slopes[], int failed[]) {
    enum { VALUE = N_X + N_THETA + N_U, POLICY = N_U * (N_THETA + N_X) };
    int ready = RTI_SOLVED;
    for (long long k = 0; k < count; k++) {
        if (k == 0 || memcmp(prepared->theta, theta[k], sizeof theta[k]) ||
            memcmp(prepared->x, x[k], sizeof x[k]) || memcmp(prepared->u, u[k], sizeof u[k])) {
            memcpy(prepared->theta, theta[k], sizeof theta[k]);
            memcpy(prepared->x, x[k], sizeof x[k]);
            memcpy(prepared->u, u[k], sizeof u[k]);
            ready = loop_prepare(prepared, work);
        }
        const double *const a = enforced ? enforced[k] : 0;
        double *const slope = slopes ? slopes + k * (VALUE + POLICY) : 0;
        memcpy(solved->s, s[k], sizeof solved->s);
        failed[k] = ready != RTI_SOLVED ? ready : rti_feedback(prepared, work, solved, a);
        if (failed[k]) continue;
        for (int i = 0; i < N_U; i++) actions[k][i] = rti_action(solved, 0, i);
        values[k] = solved->read[READ_value];
        if (!slope) continue;
        rti_gradient(prepared, solved);
        memcpy(slope, solved->read + READ_chi, N_X * sizeof(double));
        memcpy(slope + N_X, solved->gradient, sizeof solved->gradient);
        for (int i = 0; a && i < N_U; i++) slope[N_X + N_THETA + i] = -solved->nu[i] * (COST_SCALE / SCALE_ACTION[i]);
        if (!a && rti_policy(prepared, solved, work, slope + VALUE) != QP_SOLVED) failed[k] = -1;
    }
}

int engine_policy(const RtiPrepared *prepared, const RtiSolved *solved, RtiWork *work,
                  double policy[]) {
    return rti_policy(prepared, solved, work, policy);
}

/* An FMU instance, as `cosim.plant.fmi` hands it over: the FMI functions of its version that set and
 * get reals and make a step; value references and values of what the scenario wires. */
typedef struct {
    int version;
    void (*set)(void), (*get)(void), (*step)(void);
    void *component;
    const unsigned *inputs, *outputs, *states;
    size_t n_inputs, n_outputs, n_states;
    double *input, *output, *state;
    double start_time, step_size;
    int order;     /* when the outputs are read, of the enumeration below */
    int no_return; /* whether no snapshot can take the FMU back to before its present time */
} Plant;

/* `cosim.plant.fmi.Order` says which FMU takes which. */
enum { SET_GET_STEP, GET_SET_STEP, SET_STEP_GET };

static int refused(int status) { return status != 0 && status != 1; }

static int plant_get(const Plant *plant, const unsigned references[], size_t count, double values[]) {
    typedef int (*Get2)(void *, const unsigned *, size_t, double *);
    typedef int (*Get3)(void *, const unsigned *, size_t, double *, size_t);
    return plant->version == 2
               ? ((Get2)plant->get)(plant->component, references, count, values)
               : ((Get3)plant->get)(plant->component, references, count, values, count);
}

/* Write the inputs, step, read the states, and the outputs before or after the step as `order` says;
 * `status` gets FMI's own. */
static int plant_step(void *instance, long long sample, int *status) {
    typedef int (*Set2)(void *, const unsigned *, size_t, const double *);
    typedef int (*Set3)(void *, const unsigned *, size_t, const double *, size_t);
    typedef int (*Step2)(void *, double, double, int);
    typedef int (*Step3)(void *, double, double, _Bool, _Bool *, _Bool *, _Bool *, double *);
    const Plant *const plant = instance;
    const double time = plant->start_time + (double)sample * plant->step_size;
    _Bool event = 0, terminate = 0, early = 0;
    double last = INFINITY; /* where the FMU does not say how far it came */
    if (plant->order == GET_SET_STEP) {
        *status = plant_get(plant, plant->outputs, plant->n_outputs, plant->output);
        if (refused(*status)) return FAILED_GET;
    }
    *status = plant->version == 2
                  ? ((Set2)plant->set)(plant->component, plant->inputs, plant->n_inputs, plant->input)
                  : ((Set3)plant->set)(plant->component, plant->inputs, plant->n_inputs,
                                       plant->input, plant->n_inputs);
    if (refused(*status)) return FAILED_SET;
    if (plant->order == SET_GET_STEP) {
        *status = plant_get(plant, plant->outputs, plant->n_outputs, plant->output);
        if (refused(*status)) return FAILED_GET;
    }
    *status = plant->version == 2
                  ? ((Step2)plant->step)(plant->component, time, plant->step_size, plant->no_return)
                  : ((Step3)plant->step)(plant->component, time, plant->step_size,
                                         plant->no_return, &event, &terminate, &early, &last);
    if (refused(*status)) return FAILED_STEP;
    if (terminate || early || last < time + 0.5 * plant->step_size) return ENDED;
    if (plant->order == SET_STEP_GET) {
        *status = plant_get(plant, plant->outputs, plant->n_outputs, plant->output);
        if (refused(*status)) return FAILED_GET;
    }
    *status = plant_get(plant, plant->states, plant->n_states, plant->state);
    if (refused(*status)) return FAILED_GET;
    return all_finite(plant->state, (int)plant->n_states) && isfinite(plant->output[0]) ? OK
                                                                                       : NOT_FINITE;
}

size_t engine_loop_size(void) { return sizeof(Loop); }

void engine_begin(Loop *loop, RtiPrepared *prepared, RtiSolved *solved, RtiWork *work) {
    loop_begin(loop, prepared, solved, work);
}

/* `loop_run` with an FMU, whose outputs are the stage cost and the disturbance. */
long long engine_run(Loop *loop, Plant *fmu, long long first, long long end, double *table,
                     int fault[2]) {
    const LoopPlant plant = {plant_step, fmu, fmu->input, fmu->state, fmu->output, fmu->n_outputs};
    return loop_run(loop, &plant, first, end, table, fault);
}
