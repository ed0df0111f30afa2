/* The RTI-NMPC as the controller of a closed loop. */
#ifndef RTI_LOOP_H
#define RTI_LOOP_H

#include "core.h"
#include "loop.h"

/* The controller between two samples. `pending` says whether there is a solution to shift, `status` how
 * the preparation ended. */
typedef struct {
    RtiPrepared *prepared;
    RtiSolved *solved;
    RtiWork *work;
    double applied[N_U];
    long long pending;
    long long status;
} RtiLoop;

/* Linearise at the reference, as if there had been no earlier sample. */
static void rti_loop_forget(RtiPrepared *prepared) {
    for (int k = 0; k < HORIZON; k++) {
        memcpy(prepared->x[k], REFERENCE_STATE, sizeof prepared->x[k]);
        memcpy(prepared->u[k], REFERENCE_ACTION, sizeof prepared->u[k]);
    }
    memset(prepared->costates, 0, sizeof prepared->costates);
}

static void rti_loop_begin(RtiLoop *loop, RtiPrepared *prepared, RtiSolved *solved, RtiWork *work) {
    loop->prepared = prepared;
    loop->solved = solved;
    loop->work = work;
    loop->pending = 0;
    loop->status = RTI_SOLVED;
    rti_loop_forget(prepared);
    memcpy(loop->applied, REFERENCE_ACTION, sizeof loop->applied);
}

/* Linearise at the guess that is there, and load the QP. */
static int rti_loop_load(RtiPrepared *prepared, RtiWork *work) {
    if (!well_posed(prepared->theta)) return RTI_ILL_POSED;
    const int status = rti_prepare(prepared);
    return status == RTI_SOLVED ? rti_load(prepared, work) : status;
}

static void rti_loop_prepare(void *controller) {
    RtiLoop *const loop = controller;
    if (loop->pending) rti_shift(loop->prepared, loop->solved);
    loop->status = rti_loop_load(loop->prepared, loop->work);
}

static int rti_loop_feedback(void *controller, const double state[], double action[],
                             LoopAnswer *answer) {
    RtiLoop *const loop = controller;
    memcpy(loop->solved->s, state, sizeof loop->solved->s);
    if (loop->status == RTI_SOLVED)
        loop->status = rti_feedback(loop->prepared, loop->work, loop->solved, 0);
    loop->pending = loop->status == RTI_SOLVED;
    if (!loop->pending) {
        rti_loop_forget(loop->prepared);
        return LOOP_FAILED;
    }
    for (int i = 0; i < N_U; i++)
        action[i] = qp_clip(rti_action(loop->solved, 0, i), ACTION_LOWER[i], ACTION_UPPER[i]);
    answer->value = loop->solved->read[READ_value];
    answer->residual = loop->solved->read[READ_residual];
    return LOOP_SOLVED;
}

static LoopController rti_loop_controller(RtiLoop *loop) {
    const LoopController law = {
        rti_loop_prepare, rti_loop_feedback, loop, loop->applied, N_X, N_U,
    };
    return law;
}

#endif
