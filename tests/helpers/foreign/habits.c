/* A foreign FMU with the bad habits of some real ones, FMI 2.0 or 3.0 by VERSION.

   x' = u + w - x and w' = d - w, Euler steps of doStep's length, or a part of it where there is a
   tolerance; d = sin(time), cost = (x - 2)^2 + u^2. The parameter `fault` is a sum of the numbers
   below; without any the outputs cost and d are evaluated when they are asked for. Functions that
   are not here are added as stubs that refuse. */
#include <math.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#pragma GCC visibility push(default)

enum {
    LAGGED = 1,       /* doStep computes the outputs, of state, input and time at its begin */
    EAGER = 2,        /* doStep computes the outputs, of state and time at its end */
    NO_RESET = 4,     /* a reset does nothing */
    SHY = 8,          /* a get after a set moves the state */
    NEEDS_STOP = 16,  /* no initialisation without a stop time */
    PART = 32,        /* a saved state lacks w */
    HOLDS = 64,       /* while one may go back, doStep goes half of the way */
    DEAF = 128,       /* the start value of x is not taken */
    RESTLESS = 256,   /* noise of its own, another in each instance and after each reset */
    MIXED = 512,      /* doStep computes the cost alone, as LAGGED does */
    SLEEPY = 1024,    /* two samples of dead time: x and w do not move before time 1 */
    ENABLED = 2048,   /* nothing moves unless the input `enable` is 1 */
    HALF_LOUD = 4096, /* a parameter that is set to 7 is 3 after the initialisation */
    FREE = 8192,      /* cost = (x - 2)^2, evaluated when it is asked for: no action enters */
    OWN_STEP = 16384, /* each step is one of 0.25 s, whatever it is told */
    FRAIL = 65536,    /* doStep fails where u is above 1.1 */
    STUCK = 32768,    /* FMI 3.0: doStep says that it came no further than its begin */
};

enum { U, X, COST, D, X_START, W, KEY, ENABLE, REALS };

typedef struct {
    double real[REALS], time, tolerance;
    int habits, set;
} Model;

static void set_defaults(Model *m) {
    memset(m, 0, sizeof *m);
    m->real[X_START] = 1.0;
}

static int has(const Model *m, int habit) { return (m->habits & habit) != 0; }

static void compute(Model *m, int with_d) {
    double *r = m->real;
    r[COST] = (r[X] - 2.0) * (r[X] - 2.0) + (has(m, FREE) ? 0.0 : r[U] * r[U]);
    if (with_d) r[D] = sin(m->time);
}

static int begin(Model *m, double start, bool stop_defined, bool tolerance_defined, double tolerance) {
    if (has(m, NEEDS_STOP) && !stop_defined) return 3;
    m->time = start;
    m->tolerance = tolerance_defined ? tolerance : 1.0;
    return 0;
}

static int end(Model *m) {
    static double noise;
    m->set = 0;
    if (!has(m, DEAF)) m->real[X] = m->real[X_START];
    if (has(m, RESTLESS)) m->real[W] = noise += 0.125;
    if (has(m, HALF_LOUD) && m->real[KEY] == 7.0) m->real[KEY] = 3.0;
    return 0;
}

static int step(Model *m, double h, bool no_return) {
    double *r = m->real;
    if (has(m, OWN_STEP)) h = 0.25;
    const int count = (int)ceil(1.0 / sqrt(m->tolerance));
    const double length = (has(m, HOLDS) && !no_return ? 0.5 : 1.0) * h / count;
    if (has(m, FRAIL) && r[U] > 1.1) return 3;
    if (has(m, LAGGED)) compute(m, 1);
    if (has(m, MIXED)) compute(m, 0);
    for (int i = 0; i < count; i++) {
        const int still = (has(m, SLEEPY) && m->time < 1.0) || (has(m, ENABLED) && r[ENABLE] != 1.0);
        const double dx = still ? 0.0 : r[U] + r[W] - r[X], dw = still ? 0.0 : sin(m->time) - r[W];
        r[X] += length * dx;
        r[W] += length * dw;
        m->time += h / count;
    }
    if (has(m, EAGER)) compute(m, 1);
    m->set = 0;
    return 0;
}

static double get(Model *m, unsigned vr) {
    if (has(m, SHY) && m->set) m->real[X] += 0.001;
    if (!has(m, LAGGED | EAGER | MIXED)) compute(m, 1);
    if (has(m, MIXED)) m->real[D] = sin(m->time);
    return m->real[vr];
}

static void set(Model *m, unsigned vr, double value) { m->real[vr] = value, m->set = vr == U; }

static void *save(void *old, const Model *m) {
    Model *saved = old ? old : malloc(sizeof *m);
    return memcpy(saved, m, sizeof *m);
}

static int load(Model *m, const Model *saved) {
    const double w = m->real[W];
    *m = *saved;
    if (has(m, PART)) m->real[W] = w;
    return 0;
}

static void *instance(void) {
    Model *m = calloc(1, sizeof *m);
    set_defaults(m);
    return m;
}

static int reset(Model *m) {
    if (!has(m, NO_RESET)) set_defaults(m);
    return 0;
}

#if VERSION == 2
#include "fmi2FunctionTypes.h"

const char *fmi2GetTypesPlatform(void) { return "default"; }
const char *fmi2GetVersion(void) { return "2.0"; }
fmi2Component fmi2Instantiate(void) { return instance(); }
void fmi2FreeInstance(fmi2Component c) { free(c); }
fmi2Status fmi2Reset(fmi2Component c) { return reset(c); }
fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean td, double t, double start,
                               fmi2Boolean sd, double stop) {
    return begin(c, start, sd, td, t);
}
fmi2Status fmi2EnterInitializationMode(fmi2Component c) { return fmi2OK; }
fmi2Status fmi2ExitInitializationMode(fmi2Component c) { return end(c); }
fmi2Status fmi2Terminate(fmi2Component c) { return fmi2OK; }
fmi2Status fmi2GetReal(fmi2Component c, const unsigned vr[], size_t n, double v[]) {
    for (size_t i = 0; i < n; i++) v[i] = get(c, vr[i]);
    return fmi2OK;
}
fmi2Status fmi2SetReal(fmi2Component c, const unsigned vr[], size_t n, const double v[]) {
    for (size_t i = 0; i < n; i++) set(c, vr[i], v[i]);
    return fmi2OK;
}
fmi2Status fmi2GetInteger(fmi2Component c, const unsigned vr[], size_t n, int v[]) {
    for (size_t i = 0; i < n; i++) v[i] = ((Model *)c)->habits;
    return fmi2OK;
}
fmi2Status fmi2SetInteger(fmi2Component c, const unsigned vr[], size_t n, const int v[]) {
    for (size_t i = 0; i < n; i++) ((Model *)c)->habits = v[i];
    return fmi2OK;
}
fmi2Status fmi2DoStep(fmi2Component c, double t, double h, fmi2Boolean no_return) {
    return step(c, h, no_return);
}
fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *s) { return *s = save(*s, c), fmi2OK; }
fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate s) { return load(c, s); }
fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *s) {
    return free(*s), *s = NULL, fmi2OK;
}
#else
#include "fmi3FunctionTypes.h"

const char *fmi3GetVersion(void) { return "3.0"; }
fmi3Instance fmi3InstantiateCoSimulation(void) { return instance(); }
void fmi3FreeInstance(fmi3Instance c) { free(c); }
fmi3Status fmi3Reset(fmi3Instance c) { return reset(c); }
fmi3Status fmi3EnterInitializationMode(fmi3Instance c, bool td, double t, double start, bool sd,
                                       double stop) {
    return begin(c, start, sd, td, t);
}
fmi3Status fmi3ExitInitializationMode(fmi3Instance c) { return end(c); }
fmi3Status fmi3Terminate(fmi3Instance c) { return fmi3OK; }
fmi3Status fmi3GetFloat64(fmi3Instance c, const unsigned vr[], size_t n, double v[], size_t nv) {
    for (size_t i = 0; i < n; i++) v[i] = get(c, vr[i]);
    return fmi3OK;
}
fmi3Status fmi3SetFloat64(fmi3Instance c, const unsigned vr[], size_t n, const double v[],
                          size_t nv) {
    for (size_t i = 0; i < n; i++) set(c, vr[i], v[i]);
    return fmi3OK;
}
fmi3Status fmi3GetInt32(fmi3Instance c, const unsigned vr[], size_t n, int32_t v[], size_t nv) {
    for (size_t i = 0; i < n; i++) v[i] = ((Model *)c)->habits;
    return fmi3OK;
}
fmi3Status fmi3SetInt32(fmi3Instance c, const unsigned vr[], size_t n, const int32_t v[],
                        size_t nv) {
    for (size_t i = 0; i < n; i++) ((Model *)c)->habits = v[i];
    return fmi3OK;
}
fmi3Status fmi3DoStep(fmi3Instance c, double t, double h, bool no_return, bool *event,
                      bool *terminate, bool *early, double *last) {
    *event = *terminate = *early = false;
    *last = has(c, STUCK) ? t : t + h;
    return step(c, h, no_return);
}
fmi3Status fmi3GetFMUState(fmi3Instance c, fmi3FMUState *s) { return *s = save(*s, c), fmi3OK; }
fmi3Status fmi3SetFMUState(fmi3Instance c, fmi3FMUState s) { return load(c, s); }
fmi3Status fmi3FreeFMUState(fmi3Instance c, fmi3FMUState *s) {
    return free(*s), *s = NULL, fmi3OK;
}
#endif
