/* A first-order tank as an FMI 2.0 co-simulation FMU that owes nothing to fmus/: tau x' = u - x.
   Without HAS_STATE it cannot save its state. The parameter `fault` makes doStep misbehave:
   1 returns NaN, 2 an error, 3 a fatal error, 4 prints to standard output, 5 crashes. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "fmi2Functions.h"

typedef struct {
    double real[5]; /* u, x, cost, tau, x_start */
    int fault;
    fmi2CallbackFunctions callbacks;
    char name[64];
} Tank;

static const double defaults[5] = {0.0, 0.0, 0.0, 2.0, 1.0};

static void set_defaults(Tank *t) {
    memcpy(t->real, defaults, sizeof defaults);
    t->fault = 0;
}

static fmi2Status complain(Tank *t, fmi2Status status, const char *message) {
    if (t->callbacks.logger)
        t->callbacks.logger(t->callbacks.componentEnvironment, t->name, status, "tank", "tank: %s",
                            message);
    return status;
}

const char *fmi2GetTypesPlatform(void) { return "default"; }
const char *fmi2GetVersion(void) { return "2.0"; }
fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean on, size_t n, const fmi2String k[]) {
    return fmi2OK;
}
fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid, fmi2String resources,
                              const fmi2CallbackFunctions *callbacks, fmi2Boolean visible,
                              fmi2Boolean logging) {
    Tank *t = calloc(1, sizeof *t);
    t->callbacks = *callbacks;
    snprintf(t->name, sizeof t->name, "%s", name);
    set_defaults(t);
    return t;
}
void fmi2FreeInstance(fmi2Component c) { free(c); }
fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean td, fmi2Real tol, fmi2Real start,
                               fmi2Boolean sd, fmi2Real stop) {
    return fmi2OK;
}
fmi2Status fmi2EnterInitializationMode(fmi2Component c) { return fmi2OK; }
fmi2Status fmi2ExitInitializationMode(fmi2Component c) {
    ((Tank *)c)->real[1] = ((Tank *)c)->real[4];
    return fmi2OK;
}
fmi2Status fmi2Terminate(fmi2Component c) { return fmi2OK; }
fmi2Status fmi2Reset(fmi2Component c) {
    set_defaults(c);
    return fmi2OK;
}
fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2Real v[]) {
    Tank *t = c;
    t->real[2] = t->real[0] * t->real[0];
    for (size_t i = 0; i < n; i++) v[i] = t->real[vr[i]];
    return fmi2OK;
}
fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                       const fmi2Real v[]) {
    for (size_t i = 0; i < n; i++) ((Tank *)c)->real[vr[i]] = v[i];
    return fmi2OK;
}
fmi2Status fmi2GetInteger(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                          fmi2Integer v[]) {
    for (size_t i = 0; i < n; i++) v[i] = ((Tank *)c)->fault;
    return fmi2OK;
}
fmi2Status fmi2SetInteger(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                          const fmi2Integer v[]) {
    for (size_t i = 0; i < n; i++) ((Tank *)c)->fault = v[i];
    return fmi2OK;
}
fmi2Status fmi2DoStep(fmi2Component c, fmi2Real time, fmi2Real h, fmi2Boolean no_set) {
    Tank *t = c;
    double *r = t->real;
    if (t->fault == 2) return complain(t, fmi2Error, "out of water");
    if (t->fault == 3) return complain(t, fmi2Fatal, "burst");
    if (t->fault == 4) puts("a chatty FMU"), fflush(stdout);
    if (t->fault == 5) abort();
    r[1] = t->fault == 1 ? NAN : r[0] + (r[1] - r[0]) * exp(-h / r[3]);
    return fmi2OK;
}

#ifdef HAS_STATE
fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *s) {
    if (!*s) *s = malloc(sizeof(Tank));
    memcpy(*s, c, sizeof(Tank));
    return fmi2OK;
}
fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate s) {
    memcpy(c, s, sizeof(Tank));
    return fmi2OK;
}
fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *s) {
    free(*s);
    *s = NULL;
    return fmi2OK;
}
#else
fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *s) { return fmi2Error; }
fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate s) { return fmi2Error; }
fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *s) { return fmi2Error; }
#endif

#define REFUSED(name, ...) \
    fmi2Status name(fmi2Component c, ##__VA_ARGS__) { return fmi2Error; }
REFUSED(fmi2GetBoolean, const fmi2ValueReference vr[], size_t n, fmi2Boolean v[])
REFUSED(fmi2SetBoolean, const fmi2ValueReference vr[], size_t n, const fmi2Boolean v[])
REFUSED(fmi2GetString, const fmi2ValueReference vr[], size_t n, fmi2String v[])
REFUSED(fmi2SetString, const fmi2ValueReference vr[], size_t n, const fmi2String v[])
REFUSED(fmi2SerializedFMUstateSize, fmi2FMUstate s, size_t *size)
REFUSED(fmi2SerializeFMUstate, fmi2FMUstate s, fmi2Byte b[], size_t size)
REFUSED(fmi2DeSerializeFMUstate, const fmi2Byte b[], size_t size, fmi2FMUstate *s)
REFUSED(fmi2GetDirectionalDerivative, const fmi2ValueReference a[], size_t na,
        const fmi2ValueReference b[], size_t nb, const fmi2Real v[], fmi2Real w[])
REFUSED(fmi2SetRealInputDerivatives, const fmi2ValueReference vr[], size_t n,
        const fmi2Integer o[], const fmi2Real v[])
REFUSED(fmi2GetRealOutputDerivatives, const fmi2ValueReference vr[], size_t n,
        const fmi2Integer o[], fmi2Real v[])
REFUSED(fmi2CancelStep)
REFUSED(fmi2GetStatus, const fmi2StatusKind k, fmi2Status *v)
REFUSED(fmi2GetRealStatus, const fmi2StatusKind k, fmi2Real *v)
REFUSED(fmi2GetIntegerStatus, const fmi2StatusKind k, fmi2Integer *v)
REFUSED(fmi2GetBooleanStatus, const fmi2StatusKind k, fmi2Boolean *v)
REFUSED(fmi2GetStringStatus, const fmi2StatusKind k, fmi2String *v)
