/* What both fuzzers share: random arguments, and what must hold after each call. */
#ifndef FUZZ_H
#define FUZZ_H

#include <assert.h>
#include <float.h>
#include <time.h>

enum { POOL = 4, MAX_VALUES = N_STATES > 8 ? N_STATES : 8 };

static uint64_t random_state;
static int messages;

static uint64_t next_random(void) { /* splitmix64 */
    uint64_t z = (random_state += UINT64_C(0x9E3779B97F4A7C15));
    z = (z ^ (z >> 30)) * UINT64_C(0xBF58476D1CE4E5B9);
    z = (z ^ (z >> 27)) * UINT64_C(0x94D049BB133111EB);
    return z ^ (z >> 31);
}

static unsigned below(unsigned n) { return (unsigned)(next_random() % n); }

static int rarely(void) { return below(16) == 0; }

static double any_double(void) {
    static const double special[] = {0.0,  -0.0,    1.0,     -1.0,    NAN,     INFINITY, -INFINITY,
                                     60.0, DBL_MAX, -DBL_MAX, DBL_MIN, 4.9e-324, 1e9,      100.0,
                                     400.0, 1e-9};
    double value;
    uint64_t bits;
    switch (below(4)) {
        case 0: return special[below(sizeof special / sizeof *special)];
        case 1: return 100.0 + 300.0 * (double)below(1000) / 999.0;
        case 2: return (double)below(100) / 7.0;
        default:
            bits = next_random();
            memcpy(&value, &bits, sizeof value);
            return value;
    }
}

static unsigned any_reference(void) {
    switch (below(12)) {
        case 0: return N_VARIABLES + below(3);
        case 1: return (unsigned)next_random();
        default: return below(N_VARIABLES);
    }
}

/* Mostly a sensible step: long ones are legal but would eat the time of the fuzzer. */
static double any_step(void) {
    double h;
    if (!rarely()) return (double)(1 + below(7200)) / (below(2) ? 1.0 : 7.0);
    h = any_double();
    return h > 1e5 && h < 2e7 ? 60.0 : h;
}

static double any_time(const Instance *instance) {
    return rarely() || !instance ? any_double() : instance->state.v[VR_time];
}

/* Flip a bit, or forge: change a value and make the checksum right again. */
static void damage(unsigned char bytes[sizeof(State)]) {
    State state;
    switch (below(3)) {
        case 0: bytes[below(sizeof(State))] ^= (unsigned char)(1 << below(8)); return;
        case 1:
            memcpy(&state, bytes, sizeof state);
            if (below(2)) state.v[below(2) ? STATE_REFERENCES[0] : below(N_VARIABLES)] = any_double();
            if (rarely()) state.mode = (int32_t)next_random();
            if (rarely()) state.sample = (int64_t)next_random();
            if (rarely()) state.stop_time = any_double();
            state.checksum = checksum(&state);
            memcpy(bytes, &state, sizeof state);
            return;
        default: return;
    }
}

/* A logged message is readable, and a refused call changes nothing. */
static void check_message(const char *category, const char *message) {
    int known = 0;
    for (int i = 0; i < N_CATEGORIES; i++) known |= strcmp(category, CATEGORY_NAMES[i]) == 0;
    assert(known);
    assert(message[0] && !strchr(message, '%') && !strchr(message, '#'));
    messages++;
}

static void check_call(const Instance *instance, const State *before, int status, int logged) {
    assert(status >= OK && status <= ERROR);
    if (status < DISCARD || !instance) return;
    assert(logged > 0);
    assert(memcmp(before, &instance->state, sizeof *before) == 0);
}

static void check_state(const Instance *instance) {
    const State *state = &instance->state;
    assert(state->magic == STATE_MAGIC && state->version == STATE_VERSION);
    for (unsigned vr = 0; vr < N_VARIABLES; vr++)
        if (VARIABLES[vr].kind == INPUT || VARIABLES[vr].kind == STATE ||
            VARIABLES[vr].kind == FIXED || VARIABLES[vr].kind == TUNABLE)
            assert(isfinite(state->v[vr]));
    assert(isfinite(state->v[VR_time]));
}

/* The face's part: a new instance, and one random call that may use or change a state handle. */
static Instance *instantiate(void);
static int any_call(Instance *instance, void **state);

static void fuzz_once(Instance *instances[POOL], void *states[POOL]) {
    Instance **slot = &instances[below(POOL)];
    Instance *instance = rarely() && rarely() ? NULL : *slot;
    const int logged = messages;
    State before;
    int status;
    if (!*slot || (rarely() && rarely())) {
        free_instance(*slot);
        *slot = instantiate();
        return;
    }
    if (instance) before = instance->state;
    status = any_call(instance, &states[below(POOL)]);
    check_call(instance, &before, status, messages - logged);
    if (instance) check_state(instance);
}

/* Arguments: random seed, number of calls, seconds; ends at whichever comes first. */
int main(int count, char **arguments) {
    Instance *instances[POOL] = {NULL};
    void *states[POOL] = {NULL};
    const time_t end = time(NULL) + (count > 3 ? atol(arguments[3]) : 10);
    const long calls = count > 2 ? atol(arguments[2]) : 100000;
    long done = 0;
    random_state = count > 1 ? strtoull(arguments[1], NULL, 10) : 1;
    while (done < calls && (done % 256 || time(NULL) < end)) {
        fuzz_once(instances, states);
        done++;
    }
    for (int k = 0; k < POOL; k++) {
        free(states[k]);
        free_instance(instances[k]);
    }
    printf("%ld calls, %d messages\n", done, messages);
    return 0;
}

#endif
