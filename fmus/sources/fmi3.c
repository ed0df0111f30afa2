/* The FMI 3.0 face of a model: co-simulation, and model exchange where it offers that. */
#include "variables.h"

#include "fmi3Functions.h"

#include "derivatives.h"
#include "events.h"
#include "seed.h"
#include "simulation.h"
#include "snapshot.h"

/* An instance with what FMI 3.0 alone gives it: whom to tell of intermediate values. */
typedef struct {
    Instance shared; /* first: the rest of the sources knows this part alone */
    fmi3IntermediateUpdateCallback intermediate_update;
} Fmi3Instance;

/* Inside a step, while the importer is told of an intermediate value: it may read, no more. */
enum { INTERMEDIATE_UPDATE = 64 };

static int allowed_here(const Instance *instance, unsigned modes, const char *function) {
    if (!instance || instance->state.mode != INTERMEDIATE_UPDATE || (modes & INTERMEDIATE_UPDATE))
        return allowed(instance, modes | INTERMEDIATE_UPDATE, function);
    report(instance, ERROR, "%s: not allowed in state 'intermediate update mode'.", function);
    return 0;
}

#define ENTER(modes)                                                        \
    Instance *const self = (Instance *)instance;                            \
    if (!allowed_here(self, (modes), __func__)) return fmi3Error

#define ENTER_AS(required, modes)                                           \
    ENTER(modes);                                                           \
    if (!offers(self, (required), __func__)) return fmi3Error

#define TRY(call)                                                           \
    do {                                                                    \
        const Status status_ = (call);                                      \
        if (status_ != OK) return (fmi3Status)status_;                      \
    } while (0)

#define REFUSE(...) return (fmi3Status)report(self, ERROR, __VA_ARGS__)

static void log_fmi3(const Instance *instance, Status status, const char *category,
                     const char *message) {
    ((fmi3LogMessageCallback)instance->logger)(instance->environment, (fmi3Status)status, category,
                                               message);
}

const char *fmi3GetVersion(void) { return fmi3Version; }

fmi3Status fmi3SetDebugLogging(fmi3Instance instance, fmi3Boolean loggingOn, size_t nCategories,
                               const fmi3String categories[]) {
    ENTER(ANY_MODE | INTERMEDIATE_UPDATE);
    return (fmi3Status)set_logging(self, __func__, loggingOn, nCategories, categories);
}

fmi3Instance fmi3InstantiateModelExchange(fmi3String instanceName, fmi3String instantiationToken,
                                          fmi3String resourcePath, fmi3Boolean visible,
                                          fmi3Boolean loggingOn,
                                          fmi3InstanceEnvironment instanceEnvironment,
                                          fmi3LogMessageCallback logMessage) {
    (void)resourcePath, (void)visible;
    return open_instance(instanceName, MODEL_EXCHANGE, instantiationToken, instanceEnvironment,
                         (void (*)(void))logMessage, log_fmi3, loggingOn);
}

/* Whether the variables have values inside a step: a model's states and outputs. */
static int are_intermediate(const Instance *instance, const char *function,
                            const fmi3ValueReference references[], size_t n) {
    for (size_t i = 0; i < n; i++) {
        const VariableKind kind = references && references[i] < N_VARIABLES && N_STATES > 0
                                      ? VARIABLES[references[i]].kind
                                      : FIXED;
        if (kind == STATE || kind == OUTPUT) continue;
        report(instance, ERROR, "%s: a required variable has no intermediate values.", function);
        return 0;
    }
    return 1;
}

fmi3Instance fmi3InstantiateCoSimulation(
    fmi3String instanceName, fmi3String instantiationToken, fmi3String resourcePath,
    fmi3Boolean visible, fmi3Boolean loggingOn, fmi3Boolean eventModeUsed,
    fmi3Boolean earlyReturnAllowed, const fmi3ValueReference requiredIntermediateVariables[],
    size_t nRequiredIntermediateVariables, fmi3InstanceEnvironment instanceEnvironment,
    fmi3LogMessageCallback logMessage, fmi3IntermediateUpdateCallback intermediateUpdate) {
    (void)resourcePath, (void)visible, (void)earlyReturnAllowed;
    Instance *const opened =
        open_instance(instanceName, CO_SIMULATION, instantiationToken, instanceEnvironment,
                      (void (*)(void))logMessage, log_fmi3, loggingOn);
    Fmi3Instance *const self = opened ? realloc(opened, sizeof *self) : NULL;
    if (!self) {
        free_instance(opened);
        return NULL;
    }
    self->intermediate_update = N_STATES > 0 ? intermediateUpdate : NULL;
    if (eventModeUsed)
        report(&self->shared, ERROR, "%s: event mode is not offered.", __func__);
    else if (are_intermediate(&self->shared, __func__, requiredIntermediateVariables,
                              nRequiredIntermediateVariables))
        return self;
    free_instance(&self->shared);
    return NULL;
}

fmi3Instance fmi3InstantiateScheduledExecution(
    fmi3String instanceName, fmi3String instantiationToken, fmi3String resourcePath,
    fmi3Boolean visible, fmi3Boolean loggingOn, fmi3InstanceEnvironment instanceEnvironment,
    fmi3LogMessageCallback logMessage, fmi3ClockUpdateCallback clockUpdate,
    fmi3LockPreemptionCallback lockPreemption, fmi3UnlockPreemptionCallback unlockPreemption) {
    (void)instanceName, (void)instantiationToken, (void)resourcePath, (void)visible;
    (void)loggingOn, (void)clockUpdate, (void)lockPreemption, (void)unlockPreemption;
    if (logMessage)
        logMessage(instanceEnvironment, fmi3Error, CATEGORY_NAMES[LOG_ERROR],
                   "fmi3InstantiateScheduledExecution: scheduled execution is not offered.");
    return NULL;
}

void fmi3FreeInstance(fmi3Instance instance) { free_instance((Instance *)instance); }

fmi3Status fmi3EnterInitializationMode(fmi3Instance instance, fmi3Boolean toleranceDefined,
                                       fmi3Float64 tolerance, fmi3Float64 startTime,
                                       fmi3Boolean stopTimeDefined, fmi3Float64 stopTime) {
    (void)toleranceDefined, (void)tolerance;
    ENTER(INSTANTIATED);
    TRY(set_experiment(self, __func__, startTime, stopTimeDefined, stopTime));
    self->state.mode = INITIALIZATION;
    return fmi3OK;
}

fmi3Status fmi3ExitInitializationMode(fmi3Instance instance) {
    ENTER(INITIALIZATION);
    return (fmi3Status)leave_initialization(self, __func__);
}

fmi3Status fmi3EnterEventMode(fmi3Instance instance) {
    ENTER_AS(MODEL_EXCHANGE, CONTINUOUS_TIME);
    self->state.mode = EVENT;
    return fmi3OK;
}

fmi3Status fmi3Terminate(fmi3Instance instance) {
    ENTER(EVENT | CONTINUOUS_TIME | STEP);
    refresh(&self->state);
    self->state.mode = TERMINATED;
    return fmi3OK;
}

fmi3Status fmi3Reset(fmi3Instance instance) {
    ENTER(ANY_MODE);
    reset_state(&self->state, (Interface)self->state.interface);
    return fmi3OK;
}

/* Getting and setting variable values */

#define GETTER_ARGUMENTS(Type)                                                     \
    fmi3Instance instance, const fmi3ValueReference valueReferences[],             \
        size_t nValueReferences, fmi3##Type values[], size_t nValues

#define SETTER_ARGUMENTS(Type)                                                     \
    fmi3Instance instance, const fmi3ValueReference valueReferences[],             \
        size_t nValueReferences, const fmi3##Type values[], size_t nValues

#define CHECK_ARRAYS \
    TRY(check_arrays(self, __func__, valueReferences, nValueReferences, values, nValues))

fmi3Status fmi3GetFloat64(GETTER_ARGUMENTS(Float64)) {
    ENTER(READABLE | INTERMEDIATE_UPDATE);
    CHECK_ARRAYS;
    return (fmi3Status)get_values(self, __func__, REAL, valueReferences, nValues, values);
}

fmi3Status fmi3SetFloat64(SETTER_ARGUMENTS(Float64)) {
    ENTER(SETTABLE);
    CHECK_ARRAYS;
    return (fmi3Status)set_values(self, __func__, REAL, valueReferences, nValues, values);
}

fmi3Status fmi3GetUInt64(GETTER_ARGUMENTS(UInt64)) {
    ENTER(READABLE | INTERMEDIATE_UPDATE);
    CHECK_ARRAYS;
    for (size_t i = 0; i < nValues; i++)
        TRY(check_reference(self, __func__, valueReferences[i], SEED));
    for (size_t i = 0; i < nValues; i++) values[i] = seed_value(&self->state);
    return fmi3OK;
}

fmi3Status fmi3SetUInt64(SETTER_ARGUMENTS(UInt64)) {
    ENTER(SETTABLE);
    CHECK_ARRAYS;
    for (size_t i = 0; i < nValues; i++) {
        TRY(check_reference(self, __func__, valueReferences[i], SEED));
        TRY(check_value(self, __func__, valueReferences[i], 0.0));
    }
    for (size_t i = 0; i < nValues; i++) set_seed(&self->state, values[i]);
    return fmi3OK;
}

fmi3Status fmi3GetInt64(GETTER_ARGUMENTS(Int64)) {
    ENTER(READABLE | INTERMEDIATE_UPDATE);
    CHECK_ARRAYS;
    for (size_t i = 0; i < nValues; i++)
        TRY(check_reference(self, __func__, valueReferences[i], LAW));
    for (size_t i = 0; i < nValues; i++) values[i] = (int64_t)self->state.v[valueReferences[i]];
    return fmi3OK;
}

fmi3Status fmi3SetInt64(SETTER_ARGUMENTS(Int64)) {
    ENTER(SETTABLE);
    CHECK_ARRAYS;
    for (size_t i = 0; i < nValues; i++) {
        TRY(check_reference(self, __func__, valueReferences[i], LAW));
        TRY(check_value(self, __func__, valueReferences[i], (double)values[i]));
    }
    for (size_t i = 0; i < nValues; i++)
        set_value(&self->state, valueReferences[i], (double)values[i]);
    return fmi3OK;
}

fmi3Status fmi3GetBoolean(GETTER_ARGUMENTS(Boolean)) {
    ENTER(READABLE | INTERMEDIATE_UPDATE);
    CHECK_ARRAYS;
    for (size_t i = 0; i < nValues; i++)
        TRY(check_reference(self, __func__, valueReferences[i], BOOLEAN));
    for (size_t i = 0; i < nValues; i++) values[i] = self->state.v[valueReferences[i]] != 0.0;
    return fmi3OK;
}

fmi3Status fmi3SetBoolean(SETTER_ARGUMENTS(Boolean)) {
    ENTER(SETTABLE);
    CHECK_ARRAYS;
    for (size_t i = 0; i < nValues; i++) {
        TRY(check_reference(self, __func__, valueReferences[i], BOOLEAN));
        TRY(check_value(self, __func__, valueReferences[i], values[i] ? 1.0 : 0.0));
    }
    for (size_t i = 0; i < nValues; i++)
        set_value(&self->state, valueReferences[i], values[i] ? 1.0 : 0.0);
    return fmi3OK;
}

#define NO_SUCH_TYPE(Type)                                                                   \
    fmi3Status fmi3Get##Type(GETTER_ARGUMENTS(Type)) {                                       \
        ENTER(READABLE);                                                                     \
        CHECK_ARRAYS;                                                                        \
        return (fmi3Status)no_such_type(self, __func__, valueReferences, nValues, values);   \
    }                                                                                        \
    fmi3Status fmi3Set##Type(SETTER_ARGUMENTS(Type)) {                                       \
        ENTER(SETTABLE);                                                                     \
        CHECK_ARRAYS;                                                                        \
        return (fmi3Status)no_such_type(self, __func__, valueReferences, nValues, values);   \
    }

NO_SUCH_TYPE(Float32)
NO_SUCH_TYPE(Int8)
NO_SUCH_TYPE(UInt8)
NO_SUCH_TYPE(Int16)
NO_SUCH_TYPE(UInt16)
NO_SUCH_TYPE(Int32)
NO_SUCH_TYPE(UInt32)
NO_SUCH_TYPE(String)

fmi3Status fmi3GetBinary(fmi3Instance instance, const fmi3ValueReference valueReferences[],
                         size_t nValueReferences, size_t valueSizes[], fmi3Binary values[],
                         size_t nValues) {
    (void)valueSizes;
    ENTER(READABLE);
    CHECK_ARRAYS;
    return (fmi3Status)no_such_type(self, __func__, valueReferences, nValues, values);
}

fmi3Status fmi3SetBinary(fmi3Instance instance, const fmi3ValueReference valueReferences[],
                         size_t nValueReferences, const size_t valueSizes[],
                         const fmi3Binary values[], size_t nValues) {
    (void)valueSizes;
    ENTER(SETTABLE);
    CHECK_ARRAYS;
    return (fmi3Status)no_such_type(self, __func__, valueReferences, nValues, values);
}

fmi3Status fmi3GetClock(fmi3Instance instance, const fmi3ValueReference valueReferences[],
                        size_t nValueReferences, fmi3Clock values[]) {
    ENTER(READABLE);
    return (fmi3Status)no_such_type(self, __func__, valueReferences, nValueReferences, values);
}

fmi3Status fmi3SetClock(fmi3Instance instance, const fmi3ValueReference valueReferences[],
                        size_t nValueReferences, const fmi3Clock values[]) {
    ENTER(SETTABLE);
    return (fmi3Status)no_such_type(self, __func__, valueReferences, nValueReferences, values);
}

/* Getting and setting the internal state */

fmi3Status fmi3GetFMUState(fmi3Instance instance, fmi3FMUState *FMUState) {
    ENTER(ANY_MODE);
    return (fmi3Status)take_snapshot(self, __func__, FMUState);
}

fmi3Status fmi3SetFMUState(fmi3Instance instance, fmi3FMUState FMUState) {
    ENTER(ANY_MODE);
    return (fmi3Status)restore_snapshot(self, __func__, FMUState);
}

fmi3Status fmi3FreeFMUState(fmi3Instance instance, fmi3FMUState *FMUState) {
    ENTER(ANY_MODE);
    return (fmi3Status)free_snapshot(self, __func__, FMUState);
}

fmi3Status fmi3SerializedFMUStateSize(fmi3Instance instance, fmi3FMUState FMUState, size_t *size) {
    ENTER(ANY_MODE);
    return (fmi3Status)serialised_size(self, __func__, FMUState, size);
}

fmi3Status fmi3SerializeFMUState(fmi3Instance instance, fmi3FMUState FMUState,
                                 fmi3Byte serializedState[], size_t size) {
    ENTER(ANY_MODE);
    return (fmi3Status)serialise(self, __func__, FMUState, serializedState, size);
}

fmi3Status fmi3DeserializeFMUState(fmi3Instance instance, const fmi3Byte serializedState[],
                                   size_t size, fmi3FMUState *FMUState) {
    ENTER(ANY_MODE);
    return (fmi3Status)deserialise(self, __func__, serializedState, size, FMUState);
}

/* Partial derivatives */

fmi3Status fmi3GetDirectionalDerivative(fmi3Instance instance, const fmi3ValueReference unknowns[],
                                        size_t nUnknowns, const fmi3ValueReference knowns[],
                                        size_t nKnowns, const fmi3Float64 seed[], size_t nSeed,
                                        fmi3Float64 sensitivity[], size_t nSensitivity) {
    ENTER(READABLE);
    TRY(check_arrays(self, __func__, unknowns, nUnknowns, sensitivity, nSensitivity));
    TRY(check_arrays(self, __func__, knowns, nKnowns, seed, nSeed));
    return (fmi3Status)directional_derivative(self, __func__, unknowns, nUnknowns, knowns, nKnowns,
                                              seed, sensitivity);
}

/* Discrete states and model exchange */

fmi3Status fmi3UpdateDiscreteStates(fmi3Instance instance, fmi3Boolean *discreteStatesNeedUpdate,
                                    fmi3Boolean *terminateSimulation,
                                    fmi3Boolean *nominalsOfContinuousStatesChanged,
                                    fmi3Boolean *valuesOfContinuousStatesChanged,
                                    fmi3Boolean *nextEventTimeDefined,
                                    fmi3Float64 *nextEventTime) {
    ENTER(EVENT);
    if (!discreteStatesNeedUpdate || !terminateSimulation || !nominalsOfContinuousStatesChanged ||
        !valuesOfContinuousStatesChanged || !nextEventTimeDefined || !nextEventTime)
        REFUSE("%s: null argument.", __func__);
    TRY(update_discrete_state(self, __func__));
    *discreteStatesNeedUpdate = false;
    *terminateSimulation = false;
    *nominalsOfContinuousStatesChanged = false;
    *valuesOfContinuousStatesChanged = false;
    *nextEventTimeDefined = has_time_events(&self->state);
    *nextEventTime = next_event_time(&self->state);
    return fmi3OK;
}

fmi3Status fmi3EvaluateDiscreteStates(fmi3Instance instance) {
    ENTER(INITIALIZATION | EVENT);
    return fmi3OK;
}

fmi3Status fmi3EnterContinuousTimeMode(fmi3Instance instance) {
    ENTER_AS(MODEL_EXCHANGE, EVENT);
    self->state.mode = CONTINUOUS_TIME;
    return fmi3OK;
}

fmi3Status fmi3CompletedIntegratorStep(fmi3Instance instance,
                                       fmi3Boolean noSetFMUStatePriorToCurrentPoint,
                                       fmi3Boolean *enterEventMode,
                                       fmi3Boolean *terminateSimulation) {
    (void)noSetFMUStatePriorToCurrentPoint;
    ENTER_AS(MODEL_EXCHANGE, CONTINUOUS_TIME);
    if (!enterEventMode || !terminateSimulation) REFUSE("%s: null argument.", __func__);
    TRY(complete_step(self, __func__));
    *enterEventMode = false;
    *terminateSimulation = false;
    return fmi3OK;
}

fmi3Status fmi3SetTime(fmi3Instance instance, fmi3Float64 time) {
    ENTER_AS(MODEL_EXCHANGE, EVENT | CONTINUOUS_TIME);
    return (fmi3Status)set_time(self, __func__, time);
}

fmi3Status fmi3SetContinuousStates(fmi3Instance instance, const fmi3Float64 continuousStates[],
                                   size_t nContinuousStates) {
    ENTER_AS(MODEL_EXCHANGE, CONTINUOUS_TIME);
    return (fmi3Status)set_continuous_states(self, __func__, continuousStates, nContinuousStates);
}

fmi3Status fmi3GetContinuousStateDerivatives(fmi3Instance instance, fmi3Float64 derivatives[],
                                             size_t nContinuousStates) {
    ENTER_AS(MODEL_EXCHANGE, READABLE);
    return (fmi3Status)get_vector(self, __func__, DERIVATIVE_REFERENCES, derivatives,
                                  nContinuousStates);
}

fmi3Status fmi3GetEventIndicators(fmi3Instance instance, fmi3Float64 eventIndicators[],
                                  size_t nEventIndicators) {
    (void)eventIndicators;
    ENTER_AS(MODEL_EXCHANGE, READABLE);
    if (nEventIndicators == 0) return fmi3OK;
    REFUSE("%s: there are no event indicators.", __func__);
}

fmi3Status fmi3GetContinuousStates(fmi3Instance instance, fmi3Float64 continuousStates[],
                                   size_t nContinuousStates) {
    ENTER_AS(MODEL_EXCHANGE, READABLE);
    return (fmi3Status)get_vector(self, __func__, STATE_REFERENCES, continuousStates,
                                  nContinuousStates);
}

fmi3Status fmi3GetNominalsOfContinuousStates(fmi3Instance instance, fmi3Float64 nominals[],
                                             size_t nContinuousStates) {
    ENTER_AS(MODEL_EXCHANGE, ANY_MODE);
    return (fmi3Status)get_nominals(self, __func__, nominals, nContinuousStates);
}

fmi3Status fmi3GetNumberOfEventIndicators(fmi3Instance instance, size_t *nEventIndicators) {
    ENTER_AS(MODEL_EXCHANGE, ANY_MODE);
    if (!nEventIndicators) REFUSE("%s: null argument.", __func__);
    *nEventIndicators = 0;
    return fmi3OK;
}

fmi3Status fmi3GetNumberOfContinuousStates(fmi3Instance instance, size_t *nContinuousStates) {
    ENTER_AS(MODEL_EXCHANGE, ANY_MODE);
    if (!nContinuousStates) REFUSE("%s: null argument.", __func__);
    *nContinuousStates = N_STATES;
    return fmi3OK;
}

/* Co-simulation */

#ifndef MAX_STEPS_PER_CALL
#define MAX_STEPS_PER_CALL 0 /* a model without states has no step in parts */
#endif

/* A step by the points of the integration's grid, at each of which the importer is told: the very same
 * arithmetic, and none of it where a part fails. */
static Status do_step_in_parts(Fmi3Instance *instance, const char *function, double time, double h) {
    Instance *const self = &instance->shared;
    State *const state = &self->state;
    const State before = *state;
    const Grid grid = model_grid(state);
    const double end = time + h;
    Status status = check_step(self, function, time, h);
    if (status != OK) return status;
    const GridPosition last = locate(grid, end);
    int64_t point = locate(grid, time).point;
    if (last.point - point > MAX_STEPS_PER_CALL) return do_step(self, function, time, h);
    for (int ends = 0; !ends; time = state->v[VR_time]) {
        fmi3Boolean returns_early = false;
        fmi3Float64 early_time = end;
        ends = ++point > last.point || (point == last.point && last.fraction == 0.0);
        const double next = ends ? end : (double)point * grid.step;
        status = do_step(self, function, time, next - time);
        if (status != OK) {
            *state = before;
            return status;
        }
        state->v[VR_time] = next;
        state->mode = INTERMEDIATE_UPDATE;
        instance->intermediate_update(self->environment, next, false, true, true, false,
                                      &returns_early, &early_time);
        state->mode = STEP;
    }
    return OK;
}

fmi3Status fmi3DoStep(fmi3Instance instance, fmi3Float64 currentCommunicationPoint,
                      fmi3Float64 communicationStepSize,
                      fmi3Boolean noSetFMUStatePriorToCurrentPoint,
                      fmi3Boolean *eventHandlingNeeded, fmi3Boolean *terminateSimulation,
                      fmi3Boolean *earlyReturn, fmi3Float64 *lastSuccessfulTime) {
    (void)noSetFMUStatePriorToCurrentPoint;
    ENTER_AS(CO_SIMULATION, STEP);
    if (!eventHandlingNeeded || !terminateSimulation || !earlyReturn || !lastSuccessfulTime)
        REFUSE("%s: null argument.", __func__);
    *eventHandlingNeeded = false;
    *terminateSimulation = false;
    *earlyReturn = false;
    *lastSuccessfulTime = self->state.v[VR_time];
    Fmi3Instance *const whole = (Fmi3Instance *)instance;
    const Status status =
        whole->intermediate_update
            ? do_step_in_parts(whole, __func__, currentCommunicationPoint, communicationStepSize)
            : do_step(self, __func__, currentCommunicationPoint, communicationStepSize);
    *lastSuccessfulTime = self->state.v[VR_time];
    return (fmi3Status)status;
}

/* Not offered: each is refused with a message */

static fmi3Status refuse(fmi3Instance instance, const char *function) {
    const Instance *const self = (const Instance *)instance;
    if (!self) return fmi3Error;
    REFUSE("%s: not offered by this FMU.", function);
}

fmi3Status fmi3EnterConfigurationMode(fmi3Instance instance) { return refuse(instance, __func__); }

fmi3Status fmi3ExitConfigurationMode(fmi3Instance instance) { return refuse(instance, __func__); }

fmi3Status fmi3EnterStepMode(fmi3Instance instance) { return refuse(instance, __func__); }

fmi3Status fmi3GetNumberOfVariableDependencies(fmi3Instance instance,
                                               fmi3ValueReference valueReference,
                                               size_t *nDependencies) {
    (void)valueReference, (void)nDependencies;
    return refuse(instance, __func__);
}

fmi3Status fmi3GetVariableDependencies(fmi3Instance instance, fmi3ValueReference dependent,
                                       size_t elementIndicesOfDependent[],
                                       fmi3ValueReference independents[],
                                       size_t elementIndicesOfIndependents[],
                                       fmi3DependencyKind dependencyKinds[],
                                       size_t nDependencies) {
    (void)dependent, (void)elementIndicesOfDependent, (void)independents;
    (void)elementIndicesOfIndependents, (void)dependencyKinds, (void)nDependencies;
    return refuse(instance, __func__);
}

fmi3Status fmi3GetOutputDerivatives(fmi3Instance instance,
                                    const fmi3ValueReference valueReferences[],
                                    size_t nValueReferences, const fmi3Int32 orders[],
                                    fmi3Float64 values[], size_t nValues) {
    (void)valueReferences, (void)nValueReferences, (void)orders, (void)values, (void)nValues;
    return refuse(instance, __func__);
}

fmi3Status fmi3GetAdjointDerivative(fmi3Instance instance, const fmi3ValueReference unknowns[],
                                    size_t nUnknowns, const fmi3ValueReference knowns[],
                                    size_t nKnowns, const fmi3Float64 seed[], size_t nSeed,
                                    fmi3Float64 sensitivity[], size_t nSensitivity) {
    (void)unknowns, (void)nUnknowns, (void)knowns, (void)nKnowns, (void)seed, (void)nSeed;
    (void)sensitivity, (void)nSensitivity;
    return refuse(instance, __func__);
}

fmi3Status fmi3ActivateModelPartition(fmi3Instance instance, fmi3ValueReference clockReference,
                                      fmi3Float64 activationTime) {
    (void)clockReference, (void)activationTime;
    return refuse(instance, __func__);
}

#define CLOCK_ARGUMENTS                                                                       \
    fmi3Instance instance, const fmi3ValueReference valueReferences[], size_t nValueReferences

fmi3Status fmi3GetIntervalDecimal(CLOCK_ARGUMENTS, fmi3Float64 intervals[],
                                  fmi3IntervalQualifier qualifiers[]) {
    (void)valueReferences, (void)nValueReferences, (void)intervals, (void)qualifiers;
    return refuse(instance, __func__);
}

fmi3Status fmi3GetIntervalFraction(CLOCK_ARGUMENTS, fmi3UInt64 counters[],
                                   fmi3UInt64 resolutions[], fmi3IntervalQualifier qualifiers[]) {
    (void)valueReferences, (void)nValueReferences, (void)counters, (void)resolutions;
    (void)qualifiers;
    return refuse(instance, __func__);
}

fmi3Status fmi3GetShiftDecimal(CLOCK_ARGUMENTS, fmi3Float64 shifts[]) {
    (void)valueReferences, (void)nValueReferences, (void)shifts;
    return refuse(instance, __func__);
}

fmi3Status fmi3GetShiftFraction(CLOCK_ARGUMENTS, fmi3UInt64 counters[], fmi3UInt64 resolutions[]) {
    (void)valueReferences, (void)nValueReferences, (void)counters, (void)resolutions;
    return refuse(instance, __func__);
}

fmi3Status fmi3SetIntervalDecimal(CLOCK_ARGUMENTS, const fmi3Float64 intervals[]) {
    (void)valueReferences, (void)nValueReferences, (void)intervals;
    return refuse(instance, __func__);
}

fmi3Status fmi3SetIntervalFraction(CLOCK_ARGUMENTS, const fmi3UInt64 counters[],
                                   const fmi3UInt64 resolutions[]) {
    (void)valueReferences, (void)nValueReferences, (void)counters, (void)resolutions;
    return refuse(instance, __func__);
}

fmi3Status fmi3SetShiftDecimal(CLOCK_ARGUMENTS, const fmi3Float64 shifts[]) {
    (void)valueReferences, (void)nValueReferences, (void)shifts;
    return refuse(instance, __func__);
}

fmi3Status fmi3SetShiftFraction(CLOCK_ARGUMENTS, const fmi3UInt64 counters[],
                                const fmi3UInt64 resolutions[]) {
    (void)valueReferences, (void)nValueReferences, (void)counters, (void)resolutions;
    return refuse(instance, __func__);
}
