/* What a small importer needs, for FMI 2.0 and 3.0 and for Windows and the rest.
 *
 * `variables.h` is that of the FMU's sources. `hash_outputs` goes on with an FNV-1a hash of the bits of
 * every state, derivative and output.
 */
#ifndef IMPORTER_H
#define IMPORTER_H

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

/* Open the library argv[1] for FMI version argv[2]. */
static void open_library(char **argv) {
    library = OPEN(argv[1]);
    CHECK(library);
    version = atoi(argv[2]);
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

/* The status: 0 OK, 1 warning, … in both versions. */
static int step(double time, double size) {
    bool event, end, early;
    double last;
    if (version == 2) return FMI2(DoStep)(instance, time, size, 1);
    return FMI3(DoStep)(instance, time, size, true, &event, &end, &early, &last);
}

/* How many values FMI 3.0 gives for a reference: 1, an array's length, or 0 for its further elements; found by trying. */
static size_t count_of(unsigned vr) {
    static size_t counts[N_VARIABLES]; /* one more than the count */
    double values[N_VARIABLES];
    if (counts[vr]) return counts[vr] - 1;
    for (counts[vr] = 2; counts[vr] <= N_VARIABLES; counts[vr]++)
        if (FMI3(GetFloat64)(instance, &vr, 1, values, counts[vr] - 1) == fmi3OK)
            return counts[vr] - 1;
    counts[vr] = 1;
    return 0;
}

static uint64_t hash_outputs(uint64_t hash) {
    for (unsigned vr = 0; vr < N_VARIABLES; vr++) {
        const VariableKind kind = VARIABLES[vr].kind;
        double values[N_VARIABLES];
        size_t count = 1;
        if (kind != STATE && kind != DERIVATIVE && kind != OUTPUT) continue;
        if (version == 2)
            CHECK(FMI2(GetReal)(instance, &vr, 1, values) == fmi2OK);
        else if ((count = count_of(vr)) > 0)
            CHECK(FMI3(GetFloat64)(instance, &vr, 1, values, count) == fmi3OK);
        for (size_t i = 0; i < count * sizeof *values; i++)
            hash = (hash ^ ((const unsigned char *)values)[i]) * UINT64_C(1099511628211);
    }
    return hash;
}

static void close_instance(void) {
    if (version == 2)
        FMI2(FreeInstance)(instance);
    else
        FMI3(FreeInstance)(instance);
}

#endif
