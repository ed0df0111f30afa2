/* A small importer: host LIBRARY VERSION LAW STEPS.
 *
 * Steps the evaporator and prints the running hash of each sample; on every platform the same lines, or
 * the platform is not bit-identical.
 */
#include "importer.h"

static void set_law_and_seed(int law, int seed) {
    const unsigned vr_law = VR_law, vr_seed = VR_seed;
    const int64_t law64 = law;
    const uint64_t seed64 = (uint64_t)seed;
    if (version == 2) {
        CHECK(FMI2(SetInteger)(instance, &vr_law, 1, &law) == fmi2OK);
        CHECK(FMI2(SetInteger)(instance, &vr_seed, 1, &seed) == fmi2OK);
    } else {
        CHECK(FMI3(SetInt64)(instance, &vr_law, 1, &law64, 1) == fmi3OK);
        CHECK(FMI3(SetUInt64)(instance, &vr_seed, 1, &seed64, 1) == fmi3OK);
    }
}

static void set_stochastic(int value) {
    const unsigned vr = VR_stochastic;
    const bool flag = value != 0;
    if (version == 2)
        CHECK(FMI2(SetBoolean)(instance, &vr, 1, &value) == fmi2OK);
    else
        CHECK(FMI3(SetBoolean)(instance, &vr, 1, &flag, 1) == fmi3OK);
}

int main(int argc, char **argv) {
    uint64_t hash = UINT64_C(14695981039346656037);
    CHECK(argc == 5);
    open_library(argv);
    const char *law = argv[3];
    open_instance();
    set_law_and_seed(strstr(law, "uniform") ? 1 : 2, 7);
    set_stochastic(strcmp(law, "none") != 0);
    if (strstr(law, "fouling")) {
        set(VR_fouling_rate, 20.0);
        set(VR_cleaning_period, 0.05);
    }
    initialise();
    for (int k = 0; k < atoi(argv[4]); k++) {
        set(VR_P100, 190.0 + k * 7919 % 101 / 8.0);
        set(VR_F200, 200.0 + k * 104729 % 103 / 4.0);
        hash = hash_outputs(hash);
        CHECK(step(60.0 * k, 60.0) == 0);
        printf("%016" PRIx64 "\n", hash);
    }
    printf("%016" PRIx64 "\n", hash_outputs(hash));
    close_instance();
    return 0;
}
