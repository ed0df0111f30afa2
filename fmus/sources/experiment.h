/* The experiment: start and stop time, the end of the initialisation, what a step may be. */
#ifndef EXPERIMENT_H
#define EXPERIMENT_H

#include "outputs.h"

static double time_tolerance(double time) { return 1e-9 * fmax(1.0, fabs(time)); }

static Status set_experiment(Instance *instance, const char *function, double start_time,
                             int stop_defined, double stop_time) {
    if (!isfinite(start_time) || fabs(start_time) > MAX_TIME)
        return report(instance, ERROR, "%s: start time %g is not usable.", function, start_time);
    if (stop_defined && !(isfinite(stop_time) && stop_time >= start_time))
        return report(instance, ERROR, "%s: stop time %g is before the start time %g.", function,
                      stop_time, start_time);
    instance->state.experiment_defined = 1;
    instance->state.start_time = start_time;
    instance->state.stop_time = stop_defined ? stop_time : INFINITY;
    instance->state.v[VR_time] = start_time;
    instance->state.outputs_current = 0;
    return OK;
}

static Status check_time(const Instance *instance, const char *function, double time) {
    if (!isfinite(time)) return report(instance, ERROR, "%s: the time is not finite.", function);
    if (!on_grid_range(model_grid(&instance->state), time))
        return report(instance, ERROR, "%s: time %g is out of range.", function, time);
    return OK;
}

static Status check_stop_time(const Instance *instance, const char *function, double time) {
    const double stop_time = instance->state.stop_time;
    if (time <= stop_time + time_tolerance(stop_time)) return OK;
    return report(instance, ERROR, "%s: time %.17g is past the stop time %.17g.", function, time,
                  stop_time);
}

static Status leave_initialization(Instance *instance, const char *function) {
    State *state = &instance->state;
    const Status status = check_time(instance, function, state->v[VR_time]);
    if (status != OK) return status;
    refresh(state);
    state->mode = state->interface == CO_SIMULATION ? STEP : EVENT;
    return OK;
}

/* Whether a co-simulation step from `time` by `h` may be taken at all. */
static Status check_step(const Instance *instance, const char *function, double time, double h) {
    const double now = instance->state.v[VR_time];
    Status status;
    if (!isfinite(time) || !isfinite(h) || !(h > 0.0))
        return report(instance, ERROR, "%s: communication point %g with step size %g.", function,
                      time, h);
    if (fabs(time - now) > time_tolerance(time))
        return report(instance, ERROR,
                      "%s: the communication point is %.17g but the instance is at %.17g.",
                      function, time, now);
    status = check_time(instance, function, time + h);
    return status == OK ? check_stop_time(instance, function, time + h) : status;
}

#endif
