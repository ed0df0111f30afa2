/* The experiment: initialisation and the co-simulation step. */
#ifndef SIMULATION_H
#define SIMULATION_H

#include "outputs.h"

/* Integration steps in one call: half a year of seconds, at most about two seconds of computing. */
#define MAX_STEPS_PER_CALL 16777216

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
    if (!on_grid_range(make_grid(instance->state.v[VR_sampling_time]), time))
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

/* Integrate between two positions of one sample, in which inputs, disturbances and fouling are constant. */
static void integrate(double v[N_VARIABLES], Grid grid, GridPosition from, GridPosition to) {
    const Rates rates = held_rates(v);
    int64_t whole = to.point - from.point;
    if (whole == 0) {
        runge_kutta(v, rates, (to.fraction - from.fraction) * grid.step, 1);
        return;
    }
    if (from.fraction > 0.0) {
        runge_kutta(v, rates, (1.0 - from.fraction) * grid.step, 1);
        whole--;
    }
    runge_kutta(v, rates, grid.step, whole);
    if (to.fraction > 0.0) runge_kutta(v, rates, to.fraction * grid.step, 1);
}

/* Go through the samples between two positions. */
static void advance(State *state, Grid grid, GridPosition from, GridPosition to) {
    int64_t sample = sample_of(grid, from.point);
    for (;;) {
        const GridPosition next = {(sample + 1) * grid.steps, 0.0};
        const int last = to.point < next.point;
        move_to_sample(state, sample);
        if (to.point == from.point && to.fraction == from.fraction) return;
        realise(state);
        integrate(state->v, grid, from, last ? to : next);
        if (last) return;
        from = next;
        sample++;
    }
}

static Status do_step(Instance *instance, const char *function, double time, double h) {
    State *state = &instance->state;
    const Grid grid = make_grid(state->v[VR_sampling_time]);
    const double end = time + h;
    State before;
    Status status;
    if (!isfinite(time) || !isfinite(h) || !(h > 0.0))
        return report(instance, ERROR, "%s: communication point %g with step size %g.", function,
                      time, h);
    if (fabs(time - state->v[VR_time]) > time_tolerance(time))
        return report(instance, ERROR,
                      "%s: the communication point is %.17g but the instance is at %.17g.",
                      function, time, state->v[VR_time]);
    status = check_time(instance, function, end);
    if (status == OK) status = check_stop_time(instance, function, end);
    if (status != OK) return status;
    const GridPosition from = locate(grid, time), to = locate(grid, end);
    if (to.point - from.point > MAX_STEPS_PER_CALL)
        return report(instance, DISCARD, "%s: step size %g s needs more than %d integration steps.",
                      function, h, MAX_STEPS_PER_CALL);
    before = *state;
    advance(state, grid, from, to);
    if (!isfinite(state->v[VR_X2]) || !isfinite(state->v[VR_P2])) {
        *state = before;
        return report(instance, ERROR, "%s: the states left the finite numbers.", function);
    }
    state->v[VR_time] = end;
    state->outputs_current = 0;
    return OK;
}

#endif
