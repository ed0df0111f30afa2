/* The standardised disturbances of sample k: one Philox block for each two of them.
 *
 * key = (seed, seedHigh); counter = (low word of k, high word of k, block, 0). Words 0 and 1 of a
 * block give U of its first disturbance, words 2 and 3 that of its second. They are a function of
 * (seed, law, k) alone: the calls that came before do not matter.
 */
#ifndef DISTURBANCE_H
#define DISTURBANCE_H

#include <math.h>

#include "elementary.h"
#include "philox.h"
#include "states.h"

enum { LAW_UNIFORM = 1, LAW_NORMAL = 2, N_BLOCKS = (N_DISTURBANCES + 1) / 2 };

static void standard_draws(const uint32_t key[2], int64_t sample, int law,
                           double draws[2 * N_BLOCKS]) {
    for (uint32_t block = 0; block < N_BLOCKS; block++) {
        const uint64_t k = (uint64_t)sample;
        const uint32_t counter[4] = {(uint32_t)k, (uint32_t)(k >> 32), block, 0};
        uint32_t word[4];
        philox(key, counter, word);
        const double u = uniform53(word[0], word[1]);
        const double w = uniform53(word[2], word[3]);
        double *draw = draws + 2 * block;
        if (law == LAW_NORMAL) { /* Box and Muller; 1 - u is never 0 */
            const double radius = sqrt(-2.0 * natural_logarithm(1.0 - u));
            cosine_and_sine(w, &draw[0], &draw[1]);
            draw[0] *= radius;
            draw[1] *= radius;
        } else {
            draw[0] = 2.0 * u - 1.0;
            draw[1] = 2.0 * w - 1.0;
        }
    }
}

#endif
