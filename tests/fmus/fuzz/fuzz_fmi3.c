/* Random calls of the FMI 3.0 face, in random order with random arguments. */
#include "fmi3.c"

#include "fuzz.h"

static fmi3Byte bytes[sizeof(State) + 8];

static void logger(fmi3InstanceEnvironment environment, fmi3Status status, fmi3String category,
                   fmi3String message) {
    (void)environment;
    assert(status >= fmi3OK && status <= fmi3Error);
    check_message(category, message);
}

static Instance *stepping; /* which of the instances is inside a step */

/* Inside a step a state can be read and nothing else can be done. */
static void told(fmi3InstanceEnvironment environment, fmi3Float64 time, fmi3Boolean set,
                 fmi3Boolean get, fmi3Boolean finished, fmi3Boolean may_return,
                 fmi3Boolean *returns, fmi3Float64 *early) {
    fmi3Float64 x = NAN;
    (void)environment, (void)returns, (void)early;
    assert(isfinite(time) && !set && get && finished && !may_return);
    if (!rarely()) return;
    assert(fmi3GetFloat64(stepping, STATE_REFERENCES, 1, &x, 1) == fmi3OK && isfinite(x));
    assert(fmi3Reset(stepping) == fmi3Error && fmi3Terminate(stepping) == fmi3Error);
    assert(fmi3SetFloat64(stepping, STATE_REFERENCES, 1, &x, 1) == fmi3Error);
}

static Instance *instantiate(void) {
    const char *name = rarely() ? (below(2) ? NULL : "") : "fuzz";
    const char *token = rarely() ? (below(2) ? NULL : "x") : MODEL_TOKEN;
    const fmi3ValueReference required = any_reference();
    if (below(2))
        return fmi3InstantiateModelExchange(name, token, NULL, false, below(2), NULL, logger);
    if (rarely())
        fmi3InstantiateScheduledExecution(name, token, NULL, false, false, NULL, logger, NULL, NULL,
                                          NULL);
    return fmi3InstantiateCoSimulation(name, token, NULL, false, below(2), rarely(), below(2),
                                       &required, (size_t)rarely(), NULL, logger, below(2) ? told : NULL);
}

static fmi3Status walk(Instance *c) {
    switch (c ? c->state.mode : 0) {
        case INSTANTIATED:
            return fmi3EnterInitializationMode(c, false, 0.0, rarely() ? any_double() : 0.0,
                                               rarely(), any_double());
        case INITIALIZATION: return fmi3ExitInitializationMode(c);
        case EVENT: return fmi3EnterContinuousTimeMode(c);
        default: return fmi3EnterEventMode(c);
    }
}

static int any_call(Instance *c, void **state) {
    unsigned vr[MAX_VALUES], known[MAX_VALUES];
    double value[MAX_VALUES], seed[MAX_VALUES];
    int64_t number[MAX_VALUES];
    uint64_t natural[MAX_VALUES];
    bool truth[MAX_VALUES], *flag = rarely() ? NULL : truth;
    int32_t word[MAX_VALUES] = {0};
    fmi3String text[MAX_VALUES] = {"a", NULL, "b"};
    size_t n = below(MAX_VALUES + 1), size, k = rarely() ? below(MAX_VALUES + 1) : n;
    const size_t few = n % 3, few_k = rarely() ? k : few;
    const unsigned *r = rarely() ? NULL : vr;
    double *x = rarely() ? NULL : value;
    fmi3Status status;
    const fmi3String names[2] = {CATEGORY_NAMES[below(4)], rarely() ? "nonsense" : NULL};
    for (int j = 0; j < MAX_VALUES; j++) {
        vr[j] = any_reference();
        known[j] = any_reference();
        value[j] = any_double();
        seed[j] = any_double();
        number[j] = rarely() ? (int64_t)next_random() : (int64_t)below(3);
        natural[j] = next_random();
        truth[j] = below(2);
    }
    switch (below(46)) {
        case 0: case 1: case 2: case 3: return walk(c);
        case 4: status = fmi3SetDebugLogging(c, below(2), below(3), names);
                fmi3SetDebugLogging(c, true, 0, NULL);
                return status;
        case 5: return fmi3EnterInitializationMode(c, true, value[0], value[1], truth[0], value[2]);
        case 6: return fmi3ExitInitializationMode(c);
        case 7: return fmi3EvaluateDiscreteStates(c);
        case 8: return rarely() ? fmi3Terminate(c) : fmi3OK;
        case 9: return rarely() ? fmi3Reset(c) : fmi3OK;
        case 10: case 11: return fmi3GetFloat64(c, r, n, x, k);
        case 12: return fmi3GetInt64(c, r, n, number, k);
        case 13: return fmi3GetUInt64(c, r, n, natural, k);
        case 14: return fmi3GetBoolean(c, r, n, truth, k);
        case 15: return fmi3GetString(c, r, n, text, k);
        case 16: case 17: case 18: return fmi3SetFloat64(c, r, few % 2, x, few_k % 2);
        case 19: return fmi3SetInt64(c, r, few % 2, number, few_k % 2);
        case 20: return fmi3SetUInt64(c, r, few % 2, natural, few_k % 2);
        case 21: return fmi3SetBoolean(c, r, few % 2, truth, few_k % 2);
        case 22: return fmi3SetInt32(c, r, n, word, k);
        case 23: return fmi3GetFMUState(c, rarely() ? NULL : state);
        case 24: return fmi3SetFMUState(c, *state);
        case 25: return fmi3FreeFMUState(c, rarely() ? NULL : state);
        case 26: return fmi3SerializedFMUStateSize(c, *state, rarely() ? NULL : &size);
        case 27: return fmi3SerializeFMUState(c, *state, rarely() ? NULL : bytes,
                                              rarely() ? below(900) : sizeof bytes);
        case 28:
            damage(bytes);
            return fmi3DeserializeFMUState(c, rarely() ? NULL : bytes,
                                           rarely() ? below(sizeof bytes + 1) : sizeof(State),
                                           rarely() ? NULL : state);
        case 29: case 30:
            return fmi3GetDirectionalDerivative(c, r, few, known, few, seed, few_k, x, few);
        case 31: case 32:
            return fmi3GetAdjointDerivative(c, r, few, known, few, seed, few_k, x, few);
        case 33: return fmi3EnterEventMode(c);
        case 34: return fmi3UpdateDiscreteStates(c, flag, truth, truth, truth, truth, x);
        case 35: return fmi3CompletedIntegratorStep(c, true, flag, truth);
        case 36: return fmi3SetTime(c, rarely() ? value[0] : any_time(c) + any_step());
        case 37: return fmi3SetContinuousStates(c, x, rarely() ? n : N_STATES);
        case 38: return fmi3GetContinuousStateDerivatives(c, x, rarely() ? n : N_STATES);
        case 39: return fmi3GetEventIndicators(c, x, n % 2);
        case 40: return fmi3GetContinuousStates(c, x, rarely() ? n : N_STATES);
        case 41: return fmi3GetNominalsOfContinuousStates(c, x, rarely() ? n : N_STATES);
        case 42: return fmi3GetNumberOfContinuousStates(c, rarely() ? NULL : &size);
        case 43: case 44:
            stepping = c;
            return fmi3DoStep(c, any_time(c), any_step(), true, flag, truth, truth, x);
        default: return fmi3GetIntervalDecimal(c, r, n, x, NULL);
    }
}
