/* A small importer: host LIBRARY VERSION LAW STEPS.
 *
 * Steps the evaporator and prints, for each sample, a running FNV-1a hash of the bits of every state,
 * derivative and output; on every platform the same lines, or the platform is not bit-identical.
 */
#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#ifdef _WIN32
/* windows.h would redefine names of variables.h */
__declspec(dllimport) void *LoadLibraryA(const char *);
__declspec(dllimport) void *GetProcAddress(void *, const char *);
#define OPEN(path) LoadLibraryA(path)
#define FIND(library, name) GetProcAddress(library, name)
#else
#include <dlfcn.h>
#define OPEN(path) dlopen(path, RTLD_NOW)
#define FIND(library, name) dlsym(library, name)
#endif

#include "fmi2FunctionTypes.h"
#include "fmi3FunctionTypes.h"
#include "variables.h"

static void *library, *instance;
static int version;

#define CHECK(condition)                                                                 \
    do {                                                                                 \
        if (!(condition)) {                                                              \
            fprintf(stderr, "%s:%d: %s\n", __FILE__, __LINE__, #condition);              \
            exit(1);                                                                     \
        }                                                                                \
    } while (0)

static void *function(const char *name) {
    void *found = FIND(library, name);
    if (!found) fprintf(stderr, "no function %s\n", name), exit(1);
    return found;
}

#define FMI2(Name) ((fmi2##Name##TYPE *)function("fmi2" #Name))
#define FMI3(Name) ((fmi3##Name##TYPE *)function("fmi3" #Name))

static void log2_(fmi2ComponentEnvironment e, fmi2String n, fmi2Status s, fmi2String c,
                  fmi2String message, ...) {
    (void)e, (void)n, (void)s, (void)c, fprintf(stderr, "%s\n", message);
}

static void log3(fmi3InstanceEnvironment e, fmi3Status s, fmi3String c, fmi3String message) {
    (void)e, (void)s, (void)c, fprintf(stderr, "%s\n", message);
}

static void set(unsigned vr, double value) {
    if (version == 2)
        CHECK(FMI2(SetReal)(instance, &vr, 1, &value) == fmi2OK);
    else
        CHECK(FMI3(SetFloat64)(instance, &vr, 1, &value, 1) == fmi3OK);
}

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

static void open_instance(void) {
    static const fmi2CallbackFunctions callbacks = {log2_, calloc, free, NULL, NULL};
    if (version == 2)
        instance = FMI2(Instantiate)("host", fmi2CoSimulation, MODEL_TOKEN, "", &callbacks, 0, 0);
    else
        instance = FMI3(InstantiateCoSimulation)("host", MODEL_TOKEN, "", false, false, false,
                                                 false, NULL, 0, NULL, log3, NULL);
    CHECK(instance);
}

static void initialise(void) {
    if (version == 2) {
        CHECK(FMI2(SetupExperiment)(instance, 0, 0.0, 0.0, 0, 0.0) == fmi2OK);
        CHECK(FMI2(EnterInitializationMode)(instance) == fmi2OK);
        CHECK(FMI2(ExitInitializationMode)(instance) == fmi2OK);
    } else {
        CHECK(FMI3(EnterInitializationMode)(instance, false, 0.0, 0.0, false, 0.0) == fmi3OK);
        CHECK(FMI3(ExitInitializationMode)(instance) == fmi3OK);
    }
}

static void step(double time, double size) {
    bool event, end, early;
    double last;
    if (version == 2)
        CHECK(FMI2(DoStep)(instance, time, size, 1) == fmi2OK);
    else
        CHECK(FMI3(DoStep)(instance, time, size, true, &event, &end, &early, &last) == fmi3OK);
}

static uint64_t hash_outputs(uint64_t hash) {
    for (unsigned vr = 0; vr < N_VARIABLES; vr++) {
        const VariableKind kind = VARIABLES[vr].kind;
        double value;
        unsigned char byte[sizeof value];
        if (kind != STATE && kind != DERIVATIVE && kind != OUTPUT) continue;
        if (version == 2)
            CHECK(FMI2(GetReal)(instance, &vr, 1, &value) == fmi2OK);
        else
            CHECK(FMI3(GetFloat64)(instance, &vr, 1, &value, 1) == fmi3OK);
        memcpy(byte, &value, sizeof value);
        for (size_t i = 0; i < sizeof value; i++)
            hash = (hash ^ byte[i]) * UINT64_C(1099511628211);
    }
    return hash;
}

int main(int argc, char **argv) {
    uint64_t hash = UINT64_C(14695981039346656037);
    CHECK(argc == 5);
    library = OPEN(argv[1]);
    CHECK(library);
    version = atoi(argv[2]);
    const char *law = argv[3];
    open_instance();
    set_law_and_seed(strcmp(law, "uniform") == 0 ? 1 : 2, 7);
    set_stochastic(strcmp(law, "none") != 0);
    if (strcmp(law, "drifting") == 0) {
        set(VR_fouling_rate, 20.0);
        set(VR_cleaning_period, 0.05);
    }
    initialise();
    for (int k = 0; k < atoi(argv[4]); k++) {
        set(VR_P100, 190.0 + k * 7919 % 101 / 8.0);
        set(VR_F200, 200.0 + k * 104729 % 103 / 4.0);
        hash = hash_outputs(hash);
        step(60.0 * k, 60.0);
        printf("%016" PRIx64 "\n", hash);
    }
    printf("%016" PRIx64 "\n", hash_outputs(hash));
    if (version == 2)
        FMI2(FreeInstance)(instance);
    else
        FMI3(FreeInstance)(instance);
    return 0;
}
