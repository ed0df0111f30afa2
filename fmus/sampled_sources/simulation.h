/* The co-simulation step: to the next sample at most. */
#ifndef SIMULATION_H
#define SIMULATION_H

#include "experiment.h"

static Status do_step(Instance *instance, const char *function, double time, double h) {
    State *state = &instance->state;
    ModelState *model = &state->model;
    const Grid grid = model_grid(state);
    Status status = check_step(instance, function, time, h);
    if (status != OK) return status;
    const GridPosition from = locate(grid, time), to = locate(grid, time + h);
    if (to.point > from.point + 1 || (to.point == from.point + 1 && to.fraction > 0.0))
        return report(instance, ERROR,
                      "%s: a step from %.17g s by %.17g s passes over a sample: steps must end at "
                      "or before the next multiple of the sampling time, %.17g s.",
                      function, time, h, SAMPLING_TIME);
    if (model->due) {
        if (!model->fresh) evaluate_sample(state);
        if (model->core.status != 0)
            status = report(instance, WARNING, "%s: no solution at %.17g s: %s; the action is held.",
                            function, time, CORE_MESSAGES[model->core.status]);
        core_commit(&model->core);
    }
    model->due = to.fraction == 0.0;
    model->fresh = 0;
    state->sample = to.point;
    state->v[VR_time] = time + h;
    state->outputs_current = 1;
    return status;
}

#endif
