/* Random use of a sampled system's FMI 2.0 face under sanitizers; no allocation while it steps. */
#include <stdlib.h>

static long allocations;
static void *counted_malloc(size_t size) { allocations++; return malloc(size); }
static void *counted_calloc(size_t n, size_t size) { allocations++; return calloc(n, size); }
#define malloc counted_malloc
#define calloc counted_calloc
#include "fmi2.c"
#undef malloc
#undef calloc

#undef NDEBUG /* what is asserted is also what is done */
#include <assert.h>

static uint64_t state_of_generator = 1;

static double random_number(void) { /* splitmix64, in [0, 1) */
    uint64_t z = (state_of_generator += UINT64_C(0x9E3779B97F4A7C15));
    z = (z ^ (z >> 30)) * UINT64_C(0xBF58476D1CE4E5B9);
    z = (z ^ (z >> 27)) * UINT64_C(0x94D049BB133111EB);
    return (double)((z ^ (z >> 31)) >> 11) / 9007199254740992.0;
}

static void silent(fmi2ComponentEnvironment e, fmi2String i, fmi2Status s, fmi2String c,
                   fmi2String m, ...) {
    (void)e, (void)i, (void)s, (void)c, (void)m;
}

int main(int count, char **arguments) {
    const fmi2CallbackFunctions functions = {silent, NULL, NULL, NULL, NULL};
    const long steps = count > 1 ? atol(arguments[1]) : 1000;
    fmi2Component c = fmi2Instantiate("soak", fmi2CoSimulation, MODEL_TOKEN, NULL, &functions, 0, 0);
    fmi2FMUstate saved = NULL, copy = NULL;
    static fmi2Byte bytes[sizeof(State)];
    assert(c && fmi2SetupExperiment(c, 0, 0, 0, 0, 0) == fmi2OK);
    assert(fmi2EnterInitializationMode(c) == fmi2OK && fmi2ExitInitializationMode(c) == fmi2OK);
    assert(fmi2GetFMUstate(c, &saved) == fmi2OK && fmi2GetFMUstate(c, &copy) == fmi2OK);
    uint64_t hash = UINT64_C(14695981039346656037); /* FNV-1a of all values read */
    allocations = 0;
    long failures = 0;
    double time = 0.0;
    for (long k = 0; k < steps; k++) {
        double values[N_VARIABLES];
        fmi2ValueReference references[N_VARIABLES];
        unsigned reals = 0; /* reals but the time */
        for (unsigned vr = 1; vr < N_VARIABLES; vr++)
            if (VARIABLES[vr].type == REAL) references[reals++] = vr;
        for (unsigned vr = FIRST_INPUT; vr < FIRST_OUTPUT; vr++) {
            const double start = VARIABLES[vr].start, width = k % 7 ? 0.1 : 10.0;
            const double value = start * (1.0 + width * (2.0 * random_number() - 1.0));
            const fmi2Boolean manual = k % 11 == 0;
            if (VARIABLES[vr].type == BOOLEAN)
                fmi2SetBoolean(c, &vr, 1, &manual);
            else
                fmi2SetReal(c, &vr, 1, &value);
        }
        if (k % 50 == 0) /* another θ, now and then a wild one */
            for (unsigned vr = FIRST_PARAMETER; vr < N_VARIABLES; vr++) {
                const double wild = k % 200 ? 0.05 : 2.0;
                const double value =
                    VARIABLES[vr].start * (1.0 + wild * (2.0 * random_number() - 1.0));
                fmi2SetReal(c, &vr, 1, &value);
            }
        const double part = k % 5 ? 1.0 : 0.5;
        for (double done = 0.0; done < 1.0; done += part) {
            const fmi2Status status = fmi2DoStep(c, time, part * SAMPLING_TIME, 1);
            assert(status == fmi2OK || status == fmi2Warning);
            failures += status == fmi2Warning;
            time += part * SAMPLING_TIME;
        }
        assert(fmi2GetReal(c, references, reals, values) == fmi2OK);
        for (unsigned i = 0; i < reals; i++) assert(isfinite(values[i]));
        for (size_t i = 0; i < sizeof(double) * reals; i++)
            hash = (hash ^ ((const unsigned char *)values)[i]) * UINT64_C(1099511628211);
        if (k % 3 == 0) {
            assert(fmi2GetFMUstate(c, &saved) == fmi2OK);
            assert(fmi2SerializeFMUstate(c, saved, bytes, sizeof bytes) == fmi2OK);
            assert(fmi2DeSerializeFMUstate(c, bytes, sizeof bytes, &copy) == fmi2OK);
            assert(fmi2SetFMUstate(c, copy) == fmi2OK);
        }
    }
    assert(allocations == 0);
    fmi2FreeFMUstate(c, &saved);
    fmi2FreeFMUstate(c, &copy);
    fmi2FreeInstance(c);
    printf("%ld %ld %016llx\n", steps, failures, (unsigned long long)hash);
    return 0;
}
