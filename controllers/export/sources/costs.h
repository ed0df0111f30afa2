/* The quadratic costs of θ, packed as upper triangles by rows; BEND and SLOPE scale their second and
 * first derivatives. */
#ifndef COSTS_H
#define COSTS_H

static void symmetric(const double packed[], int size, double scale, double matrix[]) {
    for (int i = 0; i < size; i++)
        for (int j = i; j < size; j++) {
            const double entry = scale * *packed++;
            matrix[i * size + j] = entry;
            matrix[j * size + i] = entry;
        }
}

/* ½ξᵀL_N ξ + q_Nᵀξ */
static void terminal_cost(const double theta[], double L_N[], double q_N[]) {
    symmetric(theta + THETA_B_Vf, N_X, 2 * END_DISCOUNT, L_N);
    for (int i = 0; i < N_X; i++) {
        for (int j = 0; j < N_X; j++) L_N[i * N_X + j] *= BEND[i * N_W + j];
        q_N[i] = END_DISCOUNT * theta[THETA_b_Vf + i] * SLOPE[i];
    }
}

#endif
