/* A small importer: controller_host LIBRARY VERSION STEPS.
 *
 * Gives an exported controller states at random, some far away, in manual at every fifth, and prints the running hash of each
 * sample and how many had no solution.
 */
#include "importer.h"

#include "system.h"

static void set_boolean(unsigned vr, bool value) {
    const fmi2Boolean value2 = value;
    if (version == 2)
        CHECK(FMI2(SetBoolean)(instance, &vr, 1, &value2) == fmi2OK);
    else
        CHECK(FMI3(SetBoolean)(instance, &vr, 1, &value, 1) == fmi3OK);
}

static uint64_t generator = 1;

static double random_number(void) { /* splitmix64, in [0, 1) */
    uint64_t z = (generator += UINT64_C(0x9E3779B97F4A7C15));
    z = (z ^ (z >> 30)) * UINT64_C(0xBF58476D1CE4E5B9);
    z = (z ^ (z >> 27)) * UINT64_C(0x94D049BB133111EB);
    return (double)((z ^ (z >> 31)) >> 11) / 9007199254740992.0;
}

int main(int argc, char **argv) {
    uint64_t hash = UINT64_C(14695981039346656037);
    int failures = 0;
    CHECK(argc == 4);
    open_library(argv);
    open_instance();
    initialise();
    for (int k = 0; k < atoi(argv[3]); k++) {
        const double width = k % 7 ? 0.03 : 0.5;
        for (unsigned vr = FIRST_INPUT; vr < FIRST_OUTPUT; vr++)
            if (VARIABLES[vr].type == BOOLEAN)
                set_boolean(vr, k % 5 == 0);
            else
                set(vr, VARIABLES[vr].start * (1.0 + width * (2.0 * random_number() - 1.0)));
        const int status = step(SAMPLING_TIME * k, SAMPLING_TIME);
        CHECK(status == 0 || status == 1);
        failures += status;
        hash = hash_outputs(hash);
        printf("%016" PRIx64 "\n", hash);
    }
    printf("%d\n", failures);
    close_instance();
    return 0;
}
