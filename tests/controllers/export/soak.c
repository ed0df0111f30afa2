/* Random use of a controller as plain C under sanitizers; prints the hash of all that it returned. */
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "soaked.h"

#undef NDEBUG /* what is asserted is also what is done */
#include <assert.h>

static uint64_t state_of_generator = 1;

static double random_number(void) { /* splitmix64, in [-1, 1) */
    uint64_t z = (state_of_generator += UINT64_C(0x9E3779B97F4A7C15));
    z = (z ^ (z >> 30)) * UINT64_C(0xBF58476D1CE4E5B9);
    z = (z ^ (z >> 27)) * UINT64_C(0x94D049BB133111EB);
    return (double)((z ^ (z >> 31)) >> 11) / 4503599627370496.0 - 1.0;
}

static uint64_t hash = UINT64_C(14695981039346656037); /* FNV-1a */

static void add(double value) {
    unsigned char bytes[sizeof value];
    memcpy(bytes, &value, sizeof value);
    for (size_t i = 0; i < sizeof value; i++) hash = (hash ^ bytes[i]) * UINT64_C(1099511628211);
}

int main(int count, char **arguments) {
    static const double wild[] = {NAN, INFINITY, -INFINITY, 0.0, -1.0, 1e300, -1e300, 5e-324};
    const long steps = count > 1 ? atol(arguments[1]) : 1000;
    static Soaked controller, trained;
    double state[SOAKED_STATES], action[SOAKED_ACTIONS] = {0.0};
    SoakedReport report;
    long failures = 0;
    soaked_init(&controller);
    trained = controller;
    assert(soaked_message(-1)[0] && soaked_message(1000)[0]);
    for (long k = 0; k < steps; k++) {
        state[0] = 27.0 + (k % 7 ? 2.0 : 15.0) * random_number();
        state[1] = 50.0 + (k % 7 ? 2.0 : 30.0) * random_number();
        if (k % 29 == 0) state[k % SOAKED_STATES] = wild[k / 29 % 8];
        if (k % 50 == 0) /* another theta, now and then a wild one */
            for (int i = 0; i < SOAKED_THETA; i++) {
                const double width = k % 200 ? 0.05 : 2.0;
                controller.theta[i] = trained.theta[i] * (1.0 + width * random_number());
            }
        if (k % 1000 == 500) controller.theta[k / 1000 % SOAKED_THETA] = wild[k / 1000 % 8];
        const int manual = k % 11 < 2;
        if (manual && k % 3)
            for (int i = 0; i < SOAKED_ACTIONS; i++) action[i] = 200.0 + 300.0 * random_number();
        if (manual && k % 17 == 0) action[0] = wild[k / 17 % 8];
        const int status = manual ? soaked_manual(&controller, state, action)
                                  : soaked_step(&controller, state, action);
        assert(status >= SOAKED_SOLVED && status <= SOAKED_INACCURATE);
        soaked_report(&controller, &report);
        failures += status != SOAKED_SOLVED;
        assert(report.failures == (double)failures);
        for (int i = 0; i < SOAKED_ACTIONS; i++) {
            assert(action[i] >= 100.0 && action[i] <= 400.0);
            add(action[i]);
        }
        add(status);
        add(report.value);
    }
    printf("%ld %ld %016llx\n", steps, failures, (unsigned long long)hash);
    return 0;
}
