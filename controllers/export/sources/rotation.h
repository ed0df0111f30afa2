/* Jacobi's rotations: of two entries, and the one that makes a product vanish. */
#ifndef ROTATION_H
#define ROTATION_H

#include <math.h>

typedef struct {
    double cosine, sine;
} Rotation;

/* That of a symmetric matrix [aa, ab; ab, bb], ab not 0, or of two vectors with these products. */
static Rotation rotation_of(double aa, double bb, double ab) {
    const double ratio = (bb - aa) / (2.0 * ab);
    const double t = copysign(1.0, ratio) / (fabs(ratio) + sqrt(1.0 + ratio * ratio));
    const double cosine = 1.0 / sqrt(1.0 + t * t);
    const Rotation found = {cosine, cosine * t};
    return found;
}

static void rotate(Rotation by, double *first, double *second) {
    const double a = *first, b = *second;
    *first = by.cosine * a - by.sine * b;
    *second = by.sine * a + by.cosine * b;
}

#endif
