/* The Hessian rule Gauss–Newton: the QP holds the stage costs of θ as they are. */
#ifndef GAUSS_NEWTON_H
#define GAUSS_NEWTON_H

#include "costs.h"

static double stage_costs(const double x[], const double u[], const double costates[],
                          const double theta[], double L[], double q[]) {
    (void)x, (void)u, (void)costates;
    for (int k = 0; k < HORIZON; k++) {
        double *const block = L + k * N_W * N_W;
        symmetric(theta + THETA_B_l, N_W, 2 * DISCOUNTS[k], block);
        for (int i = 0; i < N_W * N_W; i++) block[i] *= BEND[i];
        for (int i = 0; i < N_W; i++) q[k * N_W + i] = DISCOUNTS[k] * theta[THETA_b_l + i] * SLOPE[i];
    }
    return 0.0;
}

#endif
