/* The FMI 2.0 face of a model: co-simulation, and model exchange where it offers that. */
#include "variables.h"

#include "fmi2Functions.h"

#include "derivatives.h"
#include "events.h"
#include "simulation.h"
#include "snapshot.h"

#define ENTER(modes)                                                        \
    Instance *const instance = (Instance *)c;                               \
    if (!allowed(instance, (modes), __func__)) return fmi2Error

#define ENTER_AS(required, modes)                                           \
    ENTER(modes);                                                           \
    if (!offers(instance, (required), __func__)) return fmi2Error

#define TRY(call)                                                           \
    do {                                                                    \
        const Status status_ = (call);                                      \
        if (status_ != OK) return (fmi2Status)status_;                      \
    } while (0)

static void log_fmi2(const Instance *instance, Status status, const char *category,
                     const char *message) {
    ((fmi2CallbackLogger)instance->logger)(instance->environment, instance->name,
                                           (fmi2Status)status, category, message);
}

const char *fmi2GetTypesPlatform(void) { return fmi2TypesPlatform; }

const char *fmi2GetVersion(void) { return fmi2Version; }

fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean loggingOn, size_t nCategories,
                               const fmi2String categories[]) {
    ENTER(ANY_MODE);
    return (fmi2Status)set_logging(instance, __func__, loggingOn, nCategories, categories);
}

fmi2Component fmi2Instantiate(fmi2String instanceName, fmi2Type fmuType, fmi2String fmuGUID,
                              fmi2String fmuResourceLocation,
                              const fmi2CallbackFunctions *functions, fmi2Boolean visible,
                              fmi2Boolean loggingOn) {
    (void)fmuResourceLocation;
    (void)visible;
    if (!functions) return NULL;
    if (fmuType != fmi2ModelExchange && fmuType != fmi2CoSimulation) return NULL;
    return open_instance(instanceName, fmuType == fmi2CoSimulation ? CO_SIMULATION : MODEL_EXCHANGE,
                         fmuGUID, functions->componentEnvironment,
                         (void (*)(void))functions->logger, log_fmi2, loggingOn);
}

void fmi2FreeInstance(fmi2Component c) { free_instance((Instance *)c); }

fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean toleranceDefined, fmi2Real tolerance,
                               fmi2Real startTime, fmi2Boolean stopTimeDefined,
                               fmi2Real stopTime) {
    (void)toleranceDefined;
    (void)tolerance;
    ENTER(INSTANTIATED);
    return (fmi2Status)set_experiment(instance, __func__, startTime, stopTimeDefined, stopTime);
}

fmi2Status fmi2EnterInitializationMode(fmi2Component c) {
    ENTER(INSTANTIATED);
    if (!instance->state.experiment_defined)
        return (fmi2Status)report(instance, ERROR, "%s: call fmi2SetupExperiment first.", __func__);
    instance->state.mode = INITIALIZATION;
    return fmi2OK;
}

fmi2Status fmi2ExitInitializationMode(fmi2Component c) {
    ENTER(INITIALIZATION);
    return (fmi2Status)leave_initialization(instance, __func__);
}

fmi2Status fmi2Terminate(fmi2Component c) {
    ENTER(EVENT | CONTINUOUS_TIME | STEP);
    refresh(&instance->state);
    instance->state.mode = TERMINATED;
    return fmi2OK;
}

fmi2Status fmi2Reset(fmi2Component c) {
    ENTER(ANY_MODE);
    reset_state(&instance->state, (Interface)instance->state.interface);
    return fmi2OK;
}

/* Getting and setting variable values */

static int is_half_of_seed(unsigned vr) {
    return VARIABLES[vr].type == SEED || VARIABLES[vr].type == SEED_HIGH;
}

/* Integers: the law, as an enumeration and as a number, and the halves of the seed. */
static Status check_integer(const Instance *instance, const char *function, unsigned vr) {
    if (vr < N_VARIABLES && (is_half_of_seed(vr) || VARIABLES[vr].type == LAW_NUMBER)) return OK;
    return check_reference(instance, function, vr, LAW);
}

/* The seed's bits are kept. */
static double integer_value(unsigned vr, int32_t value) {
    return is_half_of_seed(vr) ? (double)(uint32_t)value : (double)value;
}

fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                       fmi2Real value[]) {
    ENTER(READABLE);
    TRY(check_arrays(instance, __func__, vr, nvr, value, nvr));
    for (size_t i = 0; i < nvr; i++) /* the time is a variable in FMI 3.0 alone */
        if (vr[i] == VR_time)
            return (fmi2Status)report(instance, ERROR, "%s: unknown value reference %u.", __func__,
                                      vr[i]);
    return (fmi2Status)get_values(instance, __func__, REAL, vr, nvr, value);
}

fmi2Status fmi2GetInteger(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                          fmi2Integer value[]) {
    ENTER(READABLE);
    TRY(check_arrays(instance, __func__, vr, nvr, value, nvr));
    for (size_t i = 0; i < nvr; i++) TRY(check_integer(instance, __func__, vr[i]));
    for (size_t i = 0; i < nvr; i++)
        value[i] = (fmi2Integer)(int32_t)(uint32_t)instance->state.v[vr[i]];
    return fmi2OK;
}

fmi2Status fmi2GetBoolean(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                          fmi2Boolean value[]) {
    ENTER(READABLE);
    TRY(check_arrays(instance, __func__, vr, nvr, value, nvr));
    for (size_t i = 0; i < nvr; i++) TRY(check_reference(instance, __func__, vr[i], BOOLEAN));
    for (size_t i = 0; i < nvr; i++)
        value[i] = instance->state.v[vr[i]] != 0.0 ? fmi2True : fmi2False;
    return fmi2OK;
}

fmi2Status fmi2GetString(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                         fmi2String value[]) {
    ENTER(READABLE);
    return (fmi2Status)no_such_type(instance, __func__, vr, nvr, value);
}

fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                       const fmi2Real value[]) {
    ENTER(SETTABLE);
    return (fmi2Status)set_values(instance, __func__, REAL, vr, nvr, value);
}

fmi2Status fmi2SetInteger(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                          const fmi2Integer value[]) {
    ENTER(SETTABLE);
    TRY(check_arrays(instance, __func__, vr, nvr, value, nvr));
    for (size_t i = 0; i < nvr; i++) {
        TRY(check_integer(instance, __func__, vr[i]));
        TRY(check_value(instance, __func__, vr[i], integer_value(vr[i], value[i])));
    }
    for (size_t i = 0; i < nvr; i++)
        set_value(&instance->state, vr[i], integer_value(vr[i], value[i]));
    return fmi2OK;
}

fmi2Status fmi2SetBoolean(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                          const fmi2Boolean value[]) {
    ENTER(SETTABLE);
    TRY(check_arrays(instance, __func__, vr, nvr, value, nvr));
    for (size_t i = 0; i < nvr; i++) {
        TRY(check_reference(instance, __func__, vr[i], BOOLEAN));
        TRY(check_value(instance, __func__, vr[i], value[i] ? 1.0 : 0.0));
    }
    for (size_t i = 0; i < nvr; i++) set_value(&instance->state, vr[i], value[i] ? 1.0 : 0.0);
    return fmi2OK;
}

fmi2Status fmi2SetString(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                         const fmi2String value[]) {
    ENTER(SETTABLE);
    return (fmi2Status)no_such_type(instance, __func__, vr, nvr, value);
}

/* Getting and setting the internal state */

fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *FMUstate) {
    ENTER(ANY_MODE);
    return (fmi2Status)take_snapshot(instance, __func__, FMUstate);
}

fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate FMUstate) {
    ENTER(ANY_MODE);
    return (fmi2Status)restore_snapshot(instance, __func__, FMUstate);
}

fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *FMUstate) {
    ENTER(ANY_MODE);
    return (fmi2Status)free_snapshot(instance, __func__, FMUstate);
}

fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, fmi2FMUstate FMUstate, size_t *size) {
    ENTER(ANY_MODE);
    return (fmi2Status)serialised_size(instance, __func__, FMUstate, size);
}

fmi2Status fmi2SerializeFMUstate(fmi2Component c, fmi2FMUstate FMUstate,
                                 fmi2Byte serializedState[], size_t size) {
    ENTER(ANY_MODE);
    return (fmi2Status)serialise(instance, __func__, FMUstate, (unsigned char *)serializedState,
                                 size);
}

fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte serializedState[], size_t size,
                                   fmi2FMUstate *FMUstate) {
    ENTER(ANY_MODE);
    return (fmi2Status)deserialise(instance, __func__, (const unsigned char *)serializedState, size,
                                   FMUstate);
}

/* Partial derivatives */

fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference vUnknown_ref[],
                                        size_t nUnknown, const fmi2ValueReference vKnown_ref[],
                                        size_t nKnown, const fmi2Real dvKnown[],
                                        fmi2Real dvUnknown[]) {
    ENTER(READABLE);
    TRY(check_arrays(instance, __func__, vUnknown_ref, nUnknown, dvUnknown, nUnknown));
    TRY(check_arrays(instance, __func__, vKnown_ref, nKnown, dvKnown, nKnown));
    return (fmi2Status)directional_derivative(instance, __func__, vUnknown_ref, nUnknown,
                                              vKnown_ref, nKnown, dvKnown, dvUnknown);
}

/* Model exchange */

fmi2Status fmi2EnterEventMode(fmi2Component c) {
    ENTER_AS(MODEL_EXCHANGE, EVENT | CONTINUOUS_TIME);
    instance->state.mode = EVENT;
    return fmi2OK;
}

fmi2Status fmi2NewDiscreteStates(fmi2Component c, fmi2EventInfo *eventInfo) {
    ENTER_AS(MODEL_EXCHANGE, EVENT);
    if (!eventInfo) return (fmi2Status)report(instance, ERROR, "%s: null argument.", __func__);
    TRY(update_discrete_state(instance, __func__));
    eventInfo->newDiscreteStatesNeeded = fmi2False;
    eventInfo->terminateSimulation = fmi2False;
    eventInfo->nominalsOfContinuousStatesChanged = fmi2False;
    eventInfo->valuesOfContinuousStatesChanged = fmi2False;
    eventInfo->nextEventTimeDefined = has_time_events(&instance->state) ? fmi2True : fmi2False;
    eventInfo->nextEventTime = next_event_time(&instance->state);
    return fmi2OK;
}

fmi2Status fmi2EnterContinuousTimeMode(fmi2Component c) {
    ENTER_AS(MODEL_EXCHANGE, EVENT);
    instance->state.mode = CONTINUOUS_TIME;
    return fmi2OK;
}

fmi2Status fmi2CompletedIntegratorStep(fmi2Component c,
                                       fmi2Boolean noSetFMUStatePriorToCurrentPoint,
                                       fmi2Boolean *enterEventMode,
                                       fmi2Boolean *terminateSimulation) {
    (void)noSetFMUStatePriorToCurrentPoint;
    ENTER_AS(MODEL_EXCHANGE, CONTINUOUS_TIME);
    if (!enterEventMode || !terminateSimulation)
        return (fmi2Status)report(instance, ERROR, "%s: null argument.", __func__);
    TRY(complete_step(instance, __func__));
    *enterEventMode = fmi2False;
    *terminateSimulation = fmi2False;
    return fmi2OK;
}

fmi2Status fmi2SetTime(fmi2Component c, fmi2Real time) {
    ENTER_AS(MODEL_EXCHANGE, EVENT | CONTINUOUS_TIME);
    return (fmi2Status)set_time(instance, __func__, time);
}

fmi2Status fmi2SetContinuousStates(fmi2Component c, const fmi2Real x[], size_t nx) {
    ENTER_AS(MODEL_EXCHANGE, CONTINUOUS_TIME);
    return (fmi2Status)set_continuous_states(instance, __func__, x, nx);
}

fmi2Status fmi2GetDerivatives(fmi2Component c, fmi2Real derivatives[], size_t nx) {
    ENTER_AS(MODEL_EXCHANGE, EVENT | CONTINUOUS_TIME | TERMINATED);
    return (fmi2Status)get_vector(instance, __func__, DERIVATIVE_REFERENCES, derivatives, nx);
}

fmi2Status fmi2GetEventIndicators(fmi2Component c, fmi2Real eventIndicators[], size_t ni) {
    ENTER_AS(MODEL_EXCHANGE, INITIALIZATION | EVENT | CONTINUOUS_TIME | TERMINATED);
    (void)eventIndicators;
    if (ni == 0) return fmi2OK;
    return (fmi2Status)report(instance, ERROR, "%s: there are no event indicators.", __func__);
}

fmi2Status fmi2GetContinuousStates(fmi2Component c, fmi2Real x[], size_t nx) {
    ENTER_AS(MODEL_EXCHANGE, INITIALIZATION | EVENT | CONTINUOUS_TIME | TERMINATED);
    return (fmi2Status)get_vector(instance, __func__, STATE_REFERENCES, x, nx);
}

fmi2Status fmi2GetNominalsOfContinuousStates(fmi2Component c, fmi2Real x_nominal[], size_t nx) {
    ENTER_AS(MODEL_EXCHANGE, INSTANTIATED | EVENT | CONTINUOUS_TIME | TERMINATED);
    return (fmi2Status)get_nominals(instance, __func__, x_nominal, nx);
}

/* Co-simulation */

fmi2Status fmi2DoStep(fmi2Component c, fmi2Real currentCommunicationPoint,
                      fmi2Real communicationStepSize,
                      fmi2Boolean noSetFMUStatePriorToCurrentPoint) {
    (void)noSetFMUStatePriorToCurrentPoint;
    ENTER_AS(CO_SIMULATION, STEP);
    return (fmi2Status)do_step(instance, __func__, currentCommunicationPoint,
                               communicationStepSize);
}

fmi2Status fmi2CancelStep(fmi2Component c) {
    ENTER_AS(CO_SIMULATION, ANY_MODE);
    return (fmi2Status)report(instance, ERROR, "%s: no step is in progress.", __func__);
}

fmi2Status fmi2SetRealInputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                                       const fmi2Integer order[], const fmi2Real value[]) {
    (void)vr, (void)nvr, (void)order, (void)value;
    ENTER_AS(CO_SIMULATION, ANY_MODE);
    return (fmi2Status)report(instance, ERROR, "%s: inputs are not interpolated.", __func__);
}

fmi2Status fmi2GetRealOutputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                                        const fmi2Integer order[], fmi2Real value[]) {
    (void)vr, (void)nvr, (void)order, (void)value;
    ENTER_AS(CO_SIMULATION, ANY_MODE);
    return (fmi2Status)report(instance, ERROR, "%s: output derivatives are not offered.", __func__);
}

static fmi2Status no_status(fmi2Component c, const char *function) {
    const Instance *instance = (const Instance *)c;
    if (!instance) return fmi2Error;
    return (fmi2Status)report(instance, DISCARD, "%s: no such status: doStep is synchronous.",
                              function);
}

fmi2Status fmi2GetStatus(fmi2Component c, const fmi2StatusKind s, fmi2Status *value) {
    (void)s, (void)value;
    return no_status(c, __func__);
}

fmi2Status fmi2GetRealStatus(fmi2Component c, const fmi2StatusKind s, fmi2Real *value) {
    if (s != fmi2LastSuccessfulTime || !value) return no_status(c, __func__);
    ENTER_AS(CO_SIMULATION, STEP | TERMINATED);
    *value = instance->state.v[VR_time];
    return fmi2OK;
}

fmi2Status fmi2GetIntegerStatus(fmi2Component c, const fmi2StatusKind s, fmi2Integer *value) {
    (void)s, (void)value;
    return no_status(c, __func__);
}

fmi2Status fmi2GetBooleanStatus(fmi2Component c, const fmi2StatusKind s, fmi2Boolean *value) {
    if (s != fmi2Terminated || !value) return no_status(c, __func__);
    ENTER_AS(CO_SIMULATION, STEP | TERMINATED);
    *value = fmi2False;
    return fmi2OK;
}

fmi2Status fmi2GetStringStatus(fmi2Component c, const fmi2StatusKind s, fmi2String *value) {
    (void)s, (void)value;
    return no_status(c, __func__);
}
