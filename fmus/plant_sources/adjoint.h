/* Adjoint derivatives of a model that offers none. */
#ifndef ADJOINT_H
#define ADJOINT_H

#include "access.h"

static Status adjoint_derivative(Instance *instance, const char *function,
                                 const unsigned unknown[], size_t n_unknown,
                                 const unsigned known[], size_t n_known, const double seed[],
                                 double sensitivity[]) {
    (void)unknown, (void)n_unknown, (void)known, (void)n_known, (void)seed, (void)sensitivity;
    return report(instance, ERROR, "%s: derivatives are not offered.", function);
}

#endif
