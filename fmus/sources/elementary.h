/* Elementary functions of our own, so that every platform computes the same bits.
 *
 * The C standard leaves log, sin, cos and exp to the library, and libraries differ in the last bit.
 * Here they are additions, multiplications and divisions of doubles (and sqrt, which IEEE 754 fixes),
 * each within 2 units in the last place: Taylor series after an exact reduction of the argument. The
 * constants of ln 2 = LN2_HIGH + LN2_LOW are those of Cody and Waite: LN2_HIGH ends in 32 zero bits.
 */
#ifndef ELEMENTARY_H
#define ELEMENTARY_H

#include <stdint.h>
#include <string.h>

#define LN2_HIGH 6.93147180369123816490e-01
#define LN2_LOW 1.90821492927058770002e-10

/* 2^n for n in [-1022, 1023] */
static double power_of_two(int n) {
    const uint64_t bits = (uint64_t)(n + 1023) << 52;
    double value;
    memcpy(&value, &bits, sizeof value);
    return value;
}

/* ln x of a normal x > 0: x = m 2^n with m in [sqrt(1/2), sqrt(2)), ln m = 2 artanh((m - 1) / (m + 1)). */
static double natural_logarithm(double x) {
    uint64_t bits;
    double m;
    memcpy(&bits, &x, sizeof bits);
    int n = (int)(bits >> 52) - 1023;
    bits = (bits & UINT64_C(0x000fffffffffffff)) | UINT64_C(0x3ff0000000000000);
    memcpy(&m, &bits, sizeof m);
    if (m > 1.4142135623730951) {
        m *= 0.5;
        n++;
    }
    const double f = m - 1.0, s = f / (2.0 + f), z = s * s;
    double series = 1.0 / 23.0;
    for (int k = 21; k >= 3; k -= 2) series = series * z + 1.0 / k;
    /* 2 s = f - s f, so that ln m = f - s (f - 2 z series) and its leading term is exact */
    const double tail = s * (f - 2.0 * z * series);
    return n * LN2_HIGH - ((tail - n * LN2_LOW) - f);
}

/* The reciprocals of 0!, 1!, … 16!. */
static const double RECIPROCAL_FACTORIAL[17] = {
    1.0,
    1.0,
    1.0 / 2.0,
    1.0 / 6.0,
    1.0 / 24.0,
    1.0 / 120.0,
    1.0 / 720.0,
    1.0 / 5040.0,
    1.0 / 40320.0,
    1.0 / 362880.0,
    1.0 / 3628800.0,
    1.0 / 39916800.0,
    1.0 / 479001600.0,
    1.0 / 6227020800.0,
    1.0 / 87178291200.0,
    1.0 / 1307674368000.0,
    1.0 / 20922789888000.0,
};

/* e^x for x in [-700, 700]: x = n ln 2 + r with |r| <= ln(2) / 2. */
static double exponential(double x) {
    const int n = (int)(x * 1.4426950408889634 + (x < 0.0 ? -0.5 : 0.5));
    const double r = (x - n * LN2_HIGH) - n * LN2_LOW;
    double series = RECIPROCAL_FACTORIAL[14];
    for (int k = 13; k >= 0; k--) series = series * r + RECIPROCAL_FACTORIAL[k];
    return series * power_of_two(n);
}

/* cos and sin of `turns` whole turns, turns in [0, 1): a quarter turn is split off exactly. */
static void cosine_and_sine(double turns, double *cosine, double *sine) {
    const int quarter = (int)(4.0 * turns + 0.5);
    const double a = (4.0 * turns - quarter) * 1.5707963267948966, z = -a * a;
    double c = RECIPROCAL_FACTORIAL[16], s = RECIPROCAL_FACTORIAL[15];
    for (int k = 14; k >= 0; k -= 2) c = c * z + RECIPROCAL_FACTORIAL[k];
    for (int k = 13; k >= 1; k -= 2) s = s * z + RECIPROCAL_FACTORIAL[k];
    s *= a;
    switch (quarter & 3) {
        case 0: *cosine = c, *sine = s; return;
        case 1: *cosine = -s, *sine = c; return;
        case 2: *cosine = -c, *sine = -s; return;
        default: *cosine = s, *sine = -c; return;
    }
}

#endif
