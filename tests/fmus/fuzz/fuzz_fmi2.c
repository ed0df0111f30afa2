/* Random calls of the FMI 2.0 face, in random order with random arguments. */
#include "fmi2.c"

#include "fuzz.h"

static fmi2Byte bytes[sizeof(State) + 8];

static void logger(fmi2ComponentEnvironment environment, fmi2String name, fmi2Status status,
                   fmi2String category, fmi2String message, ...) {
    (void)environment;
    assert(status >= fmi2OK && status <= fmi2Error);
    assert(strcmp(name, "fuzz") == 0 || name[0] == '\0');
    check_message(category, message);
}

static const fmi2CallbackFunctions functions = {logger, NULL, NULL, NULL, NULL};

static Instance *instantiate(void) {
    const fmi2Type type = rarely() ? (fmi2Type)below(4) : (fmi2Type)below(2);
    return fmi2Instantiate(rarely() ? (below(2) ? NULL : "") : "fuzz", type,
                           rarely() ? (below(2) ? NULL : "x") : MODEL_TOKEN, NULL,
                           rarely() ? NULL : &functions, 0, (fmi2Boolean)below(2));
}

/* Walk on to a mode in which more is allowed, so that random order gets there. */
static fmi2Status walk(Instance *c) {
    switch (c ? c->state.mode : 0) {
        case INSTANTIATED:
            if (!c->state.experiment_defined)
                return fmi2SetupExperiment(c, 0, 0.0, rarely() ? any_double() : 0.0,
                                           (fmi2Boolean)rarely(), any_double());
            return fmi2EnterInitializationMode(c);
        case INITIALIZATION: return fmi2ExitInitializationMode(c);
        case EVENT: return fmi2EnterContinuousTimeMode(c);
        default: return fmi2EnterEventMode(c);
    }
}

static int any_call(Instance *c, void **state) {
    unsigned vr[MAX_VALUES], known[MAX_VALUES];
    double value[MAX_VALUES], seed[MAX_VALUES];
    int number[MAX_VALUES];
    fmi2String text[MAX_VALUES] = {"a", NULL, "b"};
    fmi2EventInfo info;
    fmi2Status status;
    size_t n = below(MAX_VALUES + 1), m = below(MAX_VALUES + 1), size;
    const unsigned *r = rarely() ? NULL : vr;
    double *x = rarely() ? NULL : value;
    int *i = rarely() ? NULL : number, *flag = rarely() ? NULL : number + 1;
    const fmi2String names[2] = {CATEGORY_NAMES[below(4)], rarely() ? "nonsense" : NULL};
    for (int k = 0; k < MAX_VALUES; k++) {
        vr[k] = any_reference();
        known[k] = any_reference();
        value[k] = any_double();
        seed[k] = any_double();
        number[k] = rarely() ? (int)next_random() : (int)below(3);
    }
    switch (below(44)) {
        case 0: case 1: case 2: case 3: return walk(c);
        case 4: status = fmi2SetDebugLogging(c, (fmi2Boolean)below(2), below(3), names);
                fmi2SetDebugLogging(c, fmi2True, 0, NULL);
                return status;
        case 5: return fmi2SetupExperiment(c, 1, value[0], value[1], number[0], value[2]);
        case 6: return fmi2EnterInitializationMode(c);
        case 7: return fmi2ExitInitializationMode(c);
        case 8: return rarely() ? fmi2Terminate(c) : fmi2OK;
        case 9: return rarely() ? fmi2Reset(c) : fmi2OK;
        case 10: case 11: return fmi2GetReal(c, r, n, x);
        case 12: return fmi2GetInteger(c, r, n, i);
        case 13: return fmi2GetBoolean(c, r, n, i);
        case 14: return fmi2GetString(c, r, n, text);
        case 15: case 16: case 17: return fmi2SetReal(c, r, rarely() ? n : n % 2, x);
        case 18: return fmi2SetInteger(c, r, n % 2, i);
        case 19: return fmi2SetBoolean(c, r, n % 2, i);
        case 20: return fmi2SetString(c, r, n, text);
        case 21: return fmi2GetFMUstate(c, rarely() ? NULL : state);
        case 22: return fmi2SetFMUstate(c, *state);
        case 23: return fmi2FreeFMUstate(c, rarely() ? NULL : state);
        case 24: return fmi2SerializedFMUstateSize(c, *state, rarely() ? NULL : &size);
        case 25: return fmi2SerializeFMUstate(c, *state, rarely() ? NULL : bytes,
                                              rarely() ? below(900) : sizeof bytes);
        case 26:
            damage((unsigned char *)bytes);
            return fmi2DeSerializeFMUstate(c, rarely() ? NULL : bytes,
                                           rarely() ? below(sizeof bytes + 1) : sizeof(State),
                                           rarely() ? NULL : state);
        case 27: case 28:
            return fmi2GetDirectionalDerivative(c, r, n % 3, known, m % 3, seed, x);
        case 29: return fmi2EnterEventMode(c);
        case 30: return fmi2NewDiscreteStates(c, rarely() ? NULL : &info);
        case 31: return fmi2CompletedIntegratorStep(c, 1, i, flag);
        case 32: return fmi2SetTime(c, rarely() ? value[0] : any_time(c) + any_step());
        case 33: return fmi2SetContinuousStates(c, x, rarely() ? n : N_STATES);
        case 34: return fmi2GetDerivatives(c, x, rarely() ? n : N_STATES);
        case 35: return fmi2GetEventIndicators(c, x, n % 2);
        case 36: return fmi2GetContinuousStates(c, x, rarely() ? n : N_STATES);
        case 37: return fmi2GetNominalsOfContinuousStates(c, x, rarely() ? n : N_STATES);
        case 38: case 39: return fmi2DoStep(c, any_time(c), any_step(), 1);
        case 40: return fmi2CancelStep(c);
        case 41: return fmi2GetRealStatus(c, (fmi2StatusKind)below(5), x);
        case 42: return fmi2GetBooleanStatus(c, (fmi2StatusKind)below(5), i);
        default: return fmi2SetRealInputDerivatives(c, r, n, number, x);
    }
}
