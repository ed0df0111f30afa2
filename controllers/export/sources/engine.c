/* The library that runs `controllers.RtiNmpc`: the phases of a sample, and whole closed loops with an
 * FMU. */
#define _POSIX_C_SOURCE 199309L
#include "fmu.h"
#include "rti_loop.h"
#include "sensitivities.h"

size_t engine_sizes(int what) {
    return what == 0 ? sizeof(RtiPrepared) : what == 1 ? sizeof(RtiSolved) : sizeof(RtiWork);
}

int engine_prepare(RtiPrepared *prepared, RtiWork *work) {
    return rti_loop_load(prepared, work);
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
            ready = rti_loop_load(prepared, work);
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

size_t engine_loop_size(void) { return sizeof(RtiLoop); }

void engine_begin(RtiLoop *loop, RtiPrepared *prepared, RtiSolved *solved, RtiWork *work) {
    rti_loop_begin(loop, prepared, solved, work);
}

/* `loop_run` with an FMU. */
long long engine_run(RtiLoop *loop, Plant *fmu, long long first, long long end, double *table,
                     int fault[2]) {
    const LoopController law = rti_loop_controller(loop);
    const LoopPlant plant = fmu_plant(fmu);
    return loop_run(&law, &plant, first, end, table, fault);
}
