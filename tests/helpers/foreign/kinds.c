/* A foreign FMU of many kinds, FMI 2.0 or 3.0 by VERSION: x' = u - x, one Euler step each doStep.
   Real variables 0 to 4 are u, x, cost, x_start, range; 5 (FMI 3.0) is an array of three. Integers are
   seed, fault and level: 0 to 2 in FMI 2.0, whose references count anew for each type, 20 to 22 in 3.0.
   The level, the array's second element and single 30, a Float32, act as u does, all added.
   A fault makes doStep misbehave. Functions that are not here are added as stubs that refuse. */
#include <signal.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#pragma GCC visibility push(default)

typedef struct {
    double real[8];
    int64_t integer[3];
    float single;
} Model;

enum { U, X, COST, X_START, RANGE, PROFILE, SEED = 0, FAULT = 1, LEVEL = 2 };

static double input(const Model *m) {
    return m->real[U] + m->real[PROFILE + 1] + (double)m->integer[LEVEL] + m->single;
}

static void set_defaults(Model *m) {
    memset(m, 0, sizeof *m);
    m->real[X_START] = 1.0;
    m->real[PROFILE] = 0.25;
    m->real[PROFILE + 2] = 0.75;
}

static int step(Model *m, double h) {
    switch (m->integer[FAULT]) {
        case 1: return -7;
        case 2: return 9;
        case 3: exit(0);
        case 4: _exit(0);
        case 8: raise(SIGKILL); break;
        case 9: raise(SIGSEGV); break;
        case 11: return 1;
        case 12: for (;;) sleep(1);
        default: break;
    }
    m->real[X] += h * (input(m) - m->real[X]) + m->real[RANGE] * (double)m->integer[SEED];
    return 0;
}

static void refresh(Model *m) { m->real[COST] = input(m) * input(m); }

#if VERSION == 2
#include "fmi2FunctionTypes.h"

fmi2Component fmi2Instantiate(void) {
    Model *m = calloc(1, sizeof *m);
    if (m) set_defaults(m);
    return m;
}
void fmi2FreeInstance(fmi2Component c) { free(c); }
fmi2Status fmi2Reset(fmi2Component c) { return set_defaults(c), fmi2OK; }
fmi2Status fmi2SetupExperiment(void) { return fmi2OK; }
fmi2Status fmi2EnterInitializationMode(void) { return fmi2OK; }
fmi2Status fmi2ExitInitializationMode(fmi2Component c) {
    Model *m = c;
    return m->real[X] = m->real[X_START], fmi2OK;
}
fmi2Status fmi2Terminate(void) { return fmi2OK; }
fmi2Status fmi2GetReal(Model *m, const fmi2ValueReference vr[], size_t n, double v[]) {
    refresh(m);
    for (size_t i = 0; i < n; i++) v[i] = m->real[vr[i]];
    return fmi2OK;
}
fmi2Status fmi2SetReal(Model *m, const fmi2ValueReference vr[], size_t n, const double v[]) {
    for (size_t i = 0; i < n; i++) m->real[vr[i]] = v[i];
    return fmi2OK;
}
fmi2Status fmi2GetInteger(Model *m, const fmi2ValueReference vr[], size_t n, fmi2Integer v[]) {
    for (size_t i = 0; i < n; i++) v[i] = (fmi2Integer)m->integer[vr[i]];
    return fmi2OK;
}
fmi2Status fmi2SetInteger(Model *m, const fmi2ValueReference vr[], size_t n,
                          const fmi2Integer v[]) {
    for (size_t i = 0; i < n; i++) m->integer[vr[i]] = v[i];
    return fmi2OK;
}
fmi2Status fmi2GetString(Model *m, const fmi2ValueReference vr[], size_t n, fmi2String v[]) {
    for (size_t i = 0; i < n; i++) v[i] = "foreign";
    return fmi2OK;
}
fmi2Status fmi2DoStep(fmi2Component c, double t, double h, fmi2Boolean b) {
    return (fmi2Status)step(c, h);
}
const char *fmi2GetTypesPlatform(void) { return "default"; }
const char *fmi2GetVersion(void) { return "2.0"; }
#else
#include "fmi3FunctionTypes.h"

fmi3Instance fmi3InstantiateCoSimulation(void) {
    Model *m = calloc(1, sizeof *m);
    if (m) set_defaults(m);
    return m;
}
void fmi3FreeInstance(fmi3Instance c) { free(c); }
fmi3Status fmi3Reset(fmi3Instance c) { return set_defaults(c), fmi3OK; }
fmi3Status fmi3EnterInitializationMode(void) { return fmi3OK; }
fmi3Status fmi3ExitInitializationMode(fmi3Instance c) {
    Model *m = c;
    return m->real[X] = m->real[X_START], fmi3OK;
}
fmi3Status fmi3Terminate(void) { return fmi3OK; }
fmi3Status fmi3GetFloat64(Model *m, const fmi3ValueReference vr[], size_t n, double v[],
                          size_t nv) {
    refresh(m);
    for (size_t i = 0, k = 0; i < n; i++)
        for (size_t j = 0; j < (vr[i] == 5 ? 3 : 1); j++) v[k++] = m->real[vr[i] + j];
    return fmi3OK;
}
fmi3Status fmi3SetFloat64(Model *m, const fmi3ValueReference vr[], size_t n, const double v[],
                          size_t nv) {
    for (size_t i = 0, k = 0; i < n; i++)
        for (size_t j = 0; j < (vr[i] == 5 ? 3 : 1); j++) m->real[vr[i] + j] = v[k++];
    return fmi3OK;
}
fmi3Status fmi3SetInt32(Model *m, const fmi3ValueReference vr[], size_t n, const fmi3Int32 v[],
                        size_t nv) {
    for (size_t i = 0; i < n; i++) m->integer[vr[i] - 20] = v[i];
    return fmi3OK;
}
fmi3Status fmi3GetInt32(Model *m, const fmi3ValueReference vr[], size_t n, fmi3Int32 v[],
                        size_t nv) {
    for (size_t i = 0; i < n; i++) v[i] = (fmi3Int32)m->integer[vr[i] - 20];
    return fmi3OK;
}
fmi3Status fmi3SetFloat32(Model *m, const fmi3ValueReference vr[], size_t n, const float v[],
                          size_t nv) {
    return m->single = v[0], n == 1 && nv == 1 && vr[0] == 30 ? fmi3OK : fmi3Error;
}
fmi3Status fmi3GetFloat32(Model *m, const fmi3ValueReference vr[], size_t n, float v[], size_t nv) {
    return v[0] = m->single, n == 1 && nv == 1 && vr[0] == 30 ? fmi3OK : fmi3Error;
}
fmi3Status fmi3DoStep(fmi3Instance c, double t, double h, bool b, bool *event, bool *end,
                      bool *early, double *last) {
    Model *m = c;
    *event = true; /* an importer without event mode need not care */
    *end = m->integer[FAULT] == 13;
    *early = false;
    *last = t + h;
    return (fmi3Status)step(c, h);
}
const char *fmi3GetVersion(void) { return "3.0"; }
#endif
