/* An FMU as the plant of a closed loop: the functions of its instance are called directly. */
#ifndef FMU_H
#define FMU_H

#include "loop.h"

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

/* Whether the stage cost and every state are finite. */
static int plant_finite(const Plant *plant) {
    int finite = isfinite(plant->output[0]);
    for (size_t i = 0; i < plant->n_states; i++) finite = finite && isfinite(plant->state[i]);
    return finite;
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
    return plant_finite(plant) ? OK : NOT_FINITE;
}

/* The plant of a loop, whose outputs are the stage cost and the disturbance. */
static LoopPlant fmu_plant(Plant *fmu) {
    const LoopPlant plant = {
        plant_step, fmu, fmu->input, fmu->state, fmu->output, fmu->n_outputs,
    };
    return plant;
}

#endif
