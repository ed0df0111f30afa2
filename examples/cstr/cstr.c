/* Isothermal stirred-tank reactor A -> B as an FMI 2.0 co-simulation FMU (Diehl, Amrit, Rawlings,
   IEEE TAC 56(3), 2011): V = 10 L, k = 1.2 /min; the feed's concentration is drawn each sample. */
#include <stdint.h>
#include <stdlib.h>

#include "fmi2FunctionTypes.h"

#pragma GCC visibility push(default)

enum { Q, CA, CB, CAF, COST, CA_START, CB_START, RANGE, TS, N };

typedef struct { double r[N]; fmi2Integer seed; } Reactor;

static void draw(Reactor *p, double t) { /* splitmix64 of seed and sample number */
    uint64_t z = ((uint64_t)(uint32_t)p->seed << 32) + (uint64_t)(t / p->r[TS] + 1e-6) + 1;
    z *= 0x9e3779b97f4a7c15u;
    z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9u;
    z = (z ^ (z >> 27)) * 0x94d049bb133111ebu;
    double uniform = (double)((z ^ (z >> 31)) >> 11) / 9007199254740992.0;
    p->r[CAF] = 1.0 + p->r[RANGE] * (2.0 * uniform - 1.0);
}
fmi2Status fmi2Reset(fmi2Component c) {
    *(Reactor *)c = (Reactor){.r = {[Q] = 12, [CA_START] = .5, [CB_START] = .5, [TS] = 30}};
    return fmi2OK;
}
fmi2Component fmi2Instantiate(void) { /* arguments that are not read are not declared */
    Reactor *p = calloc(1, sizeof *p);
    return p && fmi2Reset(p) == fmi2OK ? p : NULL;
}
fmi2Status fmi2ExitInitializationMode(fmi2Component c) {
    Reactor *p = c;
    p->r[CA] = p->r[CA_START], p->r[CB] = p->r[CB_START], draw(p, 0.0);
    return fmi2OK;
}
fmi2Status fmi2DoStep(fmi2Component c, fmi2Real t, fmi2Real h, fmi2Boolean no_set_before) {
    double *r = ((Reactor *)c)->r, dt = h / 60.0 / 1000.0; /* implicit Euler */
    for (int i = 0; i < 1000; i++) {
        r[CA] = (r[CA] + dt * r[Q] / 10 * r[CAF]) / (1 + dt * (r[Q] / 10 + 1.2));
        r[CB] = (r[CB] + dt * 1.2 * r[CA]) / (1 + dt * r[Q] / 10);
    }
    draw(c, t + h);
    return fmi2OK;
}
fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2Real v[]) {
    double *r = ((Reactor *)c)->r;
    r[COST] = r[Q] / 2 - 2 * r[Q] * r[CB];
    for (size_t i = 0; i < n; i++) v[i] = r[vr[i]];
    return fmi2OK;
}
fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference *vr, size_t n, const double v[]) {
    for (size_t i = 0; i < n; i++) ((Reactor *)c)->r[vr[i]] = v[i];
    return fmi2OK;
}
fmi2Status fmi2SetInteger(fmi2Component c, const fmi2ValueReference *vr, size_t n, const int v[]) {
    return ((Reactor *)c)->seed = v[0], fmi2OK;
}
void fmi2FreeInstance(fmi2Component c) { free(c); }
const char *fmi2GetTypesPlatform(void) { return "default"; }
const char *fmi2GetVersion(void) { return "2.0"; }

#define ACCEPT(name) fmi2Status name(void) { return fmi2OK; }
#define REFUSE(name) fmi2Status name(void) { return fmi2Error; }
ACCEPT(fmi2SetupExperiment) ACCEPT(fmi2EnterInitializationMode) ACCEPT(fmi2Terminate)
ACCEPT(fmi2SetDebugLogging) REFUSE(fmi2GetInteger) REFUSE(fmi2GetBoolean) REFUSE(fmi2GetString)
REFUSE(fmi2SetBoolean) REFUSE(fmi2SetString) REFUSE(fmi2CancelStep) REFUSE(fmi2GetFMUstate)
REFUSE(fmi2SetFMUstate) REFUSE(fmi2FreeFMUstate) REFUSE(fmi2GetStatus) REFUSE(fmi2GetRealStatus)
REFUSE(fmi2GetIntegerStatus) REFUSE(fmi2GetBooleanStatus) REFUSE(fmi2GetStringStatus)
REFUSE(fmi2SerializedFMUstateSize) REFUSE(fmi2SerializeFMUstate) REFUSE(fmi2DeSerializeFMUstate)
REFUSE(fmi2GetDirectionalDerivative) REFUSE(fmi2SetRealInputDerivatives)
REFUSE(fmi2GetRealOutputDerivatives)
