/* The exact Hessian: the model's curvature added, and each stage's eigenvalues lifted to a floor. They
 * are those over the ranges of states and actions, so that they have no unit. */
#ifndef EXACT_H
#define EXACT_H

#include <math.h>

#include "costs.h"
#include "rotation.h"

/* Eigenvalues on the diagonal of `matrix`, eigenvectors as columns: cyclic Jacobi rotations. */
static void eigen(double matrix[N_W][N_W], double vectors[N_W][N_W]) {
    for (int i = 0; i < N_W; i++)
        for (int j = 0; j < N_W; j++) vectors[i][j] = i == j;
    for (int sweep = 0; sweep < 50; sweep++) {
        double outside = 0.0, all = 0.0;
        for (int i = 0; i < N_W; i++)
            for (int j = 0; j < N_W; j++) {
                all += matrix[i][j] * matrix[i][j];
                if (i != j) outside += matrix[i][j] * matrix[i][j];
            }
        if (!(outside > 1e-32 * all)) return;
        for (int p = 0; p < N_W; p++)
            for (int r = p + 1; r < N_W; r++) {
                if (matrix[p][r] == 0.0) continue;
                const Rotation by = rotation_of(matrix[p][p], matrix[r][r], matrix[p][r]);
                for (int i = 0; i < N_W; i++) rotate(by, &matrix[i][p], &matrix[i][r]);
                for (int i = 0; i < N_W; i++) rotate(by, &matrix[p][i], &matrix[r][i]);
                for (int i = 0; i < N_W; i++) rotate(by, &vectors[i][p], &vectors[i][r]);
            }
    }
}

static double stage_costs(const double x[], const double u[], const double costates[],
                          const double theta[], double L[], double q[]) {
    double curved[HORIZON * N_W * N_W], constant = 0.0;
    {
        const double *arguments[CURVATURE_ARG] = {x, u, costates, theta};
        double *results[CURVATURE_RES] = {curved}, w[CURVATURE_W + 1];
        long long int iw[CURVATURE_IW + 1];
        if (curvature(arguments, results, iw, w, 0)) curved[0] = NAN;
    }
    for (int k = 0; k < HORIZON; k++) {
        double B[N_W * N_W], raw[N_W][N_W], matrix[N_W][N_W], vectors[N_W][N_W], at[N_W];
        double *const block = L + k * N_W * N_W;
        symmetric(theta + THETA_B_l, N_W, 1.0, B);
        for (int i = 0; i < N_W; i++)
            for (int j = 0; j < N_W; j++) {
                raw[i][j] = 2 * DISCOUNTS[k] * B[i * N_W + j] + curved[(k * N_W + i) * N_W + j];
                matrix[i][j] = raw[i][j] * METRIC[i * N_W + j];
            }
        eigen(matrix, vectors);
        for (int i = 0; i < N_W; i++)
            for (int j = 0; j < N_W; j++) {
                double sum = 0.0;
                for (int e = 0; e < N_W; e++) {
                    const double rise = FLOOR * DISCOUNTS[k] - matrix[e][e];
                    sum += vectors[i][e] * (rise > 0.0 ? rise : 0.0) * vectors[j][e];
                }
                raw[i][j] += sum / METRIC[i * N_W + j];
                if (isnan(matrix[i][i] + matrix[j][j])) raw[i][j] = NAN;
                block[i * N_W + j] = raw[i][j] * BEND[i * N_W + j];
            }
        for (int i = 0; i < N_X; i++) at[i] = x[k * N_X + i] - REFERENCE_STATE[i];
        for (int i = 0; i < N_U; i++) at[N_X + i] = u[k * N_U + i] - REFERENCE_ACTION[i];
        for (int i = 0; i < N_W; i++) {
            double lifted = 0.0, flat = 0.0;
            for (int j = 0; j < N_W; j++) {
                lifted += raw[i][j] * at[j];
                flat += B[i * N_W + j] * at[j];
            }
            flat *= 2 * DISCOUNTS[k];
            q[k * N_W + i] = (flat + DISCOUNTS[k] * theta[THETA_b_l + i] - lifted) * SLOPE[i];
            constant += at[i] * (lifted - flat) / 2;
        }
    }
    return constant;
}

#endif
