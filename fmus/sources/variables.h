/* Generated from fmus/evaporator.py by `cosim fmu build --in-place`; do not edit. */
#ifndef VARIABLES_H
#define VARIABLES_H

#ifndef FMI2_FUNCTION_PREFIX
#define FMI2_FUNCTION_PREFIX evaporator_
#endif
#ifndef FMI3_FUNCTION_PREFIX
#define FMI3_FUNCTION_PREFIX evaporator_
#endif

#define MODEL_TOKEN "{56329071-43cb-5d1e-b5eb-b7f0fdfbf664}"

/* Digest of the variables' names and order: marks the layout of a serialised state. */
#define LAYOUT_DIGEST UINT64_C(0x9af9dc9b348a14f3)

enum {
    VR_time = 0,
    VR_X2 = 1,
    VR_P2 = 2,
    VR_der_X2 = 3,
    VR_der_P2 = 4,
    VR_P100 = 5,
    VR_F200 = 6,
    VR_X1_in = 7,
    VR_F1_in = 8,
    VR_T1_in = 9,
    VR_T200_in = 10,
    VR_X1 = 11,
    VR_F1 = 12,
    VR_T1 = 13,
    VR_T200 = 14,
    VR_economic_cost = 15,
    VR_F2 = 16,
    VR_F4 = 17,
    VR_F5 = 18,
    VR_F100 = 19,
    VR_T2 = 20,
    VR_T3 = 21,
    VR_T100 = 22,
    VR_UA1 = 23,
    VR_Q100 = 24,
    VR_Q200 = 25,
    VR_stochastic = 26,
    VR_override = 27,
    VR_law = 28,
    VR_seed = 29,
    VR_seedHigh = 30,
    VR_sampling_time = 31,
    VR_X1_nominal = 32,
    VR_F1_nominal = 33,
    VR_T1_nominal = 34,
    VR_T200_nominal = 35,
    VR_X1_range = 36,
    VR_F1_range = 37,
    VR_T1_range = 38,
    VR_T200_range = 39,
    VR_X2_start = 40,
    VR_P2_start = 41,
    VR_a = 42,
    VR_b = 43,
    VR_c = 44,
    VR_d = 45,
    VR_e = 46,
    VR_f = 47,
    VR_g = 48,
    VR_h = 49,
    VR_M = 50,
    VR_C = 51,
    VR_UA2 = 52,
    VR_Cp = 53,
    VR_lambda_ = 54,
    VR_lambda_s = 55,
    VR_F3 = 56,
    VR_fouling_rate = 57,
    VR_fouling_floor = 58,
    VR_cleaning_period = 59,
    VR_UA2_present = 60,
    VR_saturate = 61,
    VR_law_number = 62,
    VR_X1_time_constant = 63,
    VR_F1_time_constant = 64,
    VR_T1_time_constant = 65,
    VR_T200_time_constant = 66,
    N_VARIABLES = 67
};

typedef enum { REAL, BOOLEAN, LAW, SEED, SEED_HIGH, LAW_NUMBER } VariableType;

typedef enum { INDEPENDENT, INPUT, STATE, DERIVATIVE, OUTPUT, FIXED, TUNABLE } VariableKind;

typedef struct {
    const char *name;
    VariableType type;
    VariableKind kind;
    double start, min, max, nominal;
} VariableInfo;

static const VariableInfo VARIABLES[N_VARIABLES] = {
    {"time", REAL, INDEPENDENT, 0.0, 0.0, 0.0, 1.0},
    {"X2", REAL, STATE, 0.0, 0.0, 100.0, 25.0},
    {"P2", REAL, STATE, 0.0, 0.0, 400.0, 50.0},
    {"der(X2)", REAL, DERIVATIVE, 0.0, -1000.0, 1000.0, 0.01},
    {"der(P2)", REAL, DERIVATIVE, 0.0, -1000.0, 1000.0, 0.01},
    {"P100", REAL, INPUT, 191.71322, 100.0, 400.0, 191.71322},
    {"F200", REAL, INPUT, 215.88844, 100.0, 400.0, 215.88844},
    {"X1_in", REAL, INPUT, 5.0, 0.0, 50.0, 5.0},
    {"F1_in", REAL, INPUT, 10.0, 0.0, 100.0, 10.0},
    {"T1_in", REAL, INPUT, 40.0, -100.0, 300.0, 40.0},
    {"T200_in", REAL, INPUT, 25.0, -100.0, 300.0, 25.0},
    {"X1", REAL, OUTPUT, 0.0, -200.0, 250.0, 5.0},
    {"F1", REAL, OUTPUT, 0.0, -400.0, 500.0, 10.0},
    {"T1", REAL, OUTPUT, 0.0, -1000.0, 1200.0, 40.0},
    {"T200", REAL, OUTPUT, 0.0, -1000.0, 1200.0, 25.0},
    {"economic_cost", REAL, OUTPUT, 0.0, -1000000.0, 1000000.0, 6000.0},
    {"F2", REAL, OUTPUT, 0.0, -1000.0, 1000.0, 2.0},
    {"F4", REAL, OUTPUT, 0.0, -1000.0, 1000.0, 8.0},
    {"F5", REAL, OUTPUT, 0.0, -1000.0, 1000.0, 8.0},
    {"F100", REAL, OUTPUT, 0.0, -1000.0, 1000.0, 9.0},
    {"T2", REAL, OUTPUT, 0.0, -1000.0, 1000.0, 80.0},
    {"T3", REAL, OUTPUT, 0.0, -1000.0, 1000.0, 80.0},
    {"T100", REAL, OUTPUT, 0.0, -1000.0, 1000.0, 120.0},
    {"UA1", REAL, OUTPUT, 0.0, -1000.0, 1000.0, 10.0},
    {"Q100", REAL, OUTPUT, 0.0, -100000.0, 100000.0, 350.0},
    {"Q200", REAL, OUTPUT, 0.0, -100000.0, 100000.0, 300.0},
    {"stochastic", BOOLEAN, TUNABLE, 1.0, 0.0, 1.0, 1.0},
    {"override", BOOLEAN, TUNABLE, 0.0, 0.0, 1.0, 1.0},
    {"law", LAW, FIXED, 1.0, 1.0, 2.0, 1.0},
    {"seed", SEED, FIXED, 0.0, 0.0, 4294967295.0, 1.0},
    {"seedHigh", SEED_HIGH, FIXED, 0.0, 0.0, 4294967295.0, 1.0},
    {"sampling_time", REAL, FIXED, 60.0, 0.01, 86400.0, 60.0},
    {"X1_nominal", REAL, TUNABLE, 5.0, 0.0, 50.0, 5.0},
    {"F1_nominal", REAL, TUNABLE, 10.0, 0.1, 100.0, 10.0},
    {"T1_nominal", REAL, TUNABLE, 40.0, 0.0, 200.0, 40.0},
    {"T200_nominal", REAL, TUNABLE, 25.0, 0.0, 200.0, 25.0},
    {"X1_range", REAL, TUNABLE, 1.0, 0.0, 20.0, 1.0},
    {"F1_range", REAL, TUNABLE, 2.0, 0.0, 40.0, 2.0},
    {"T1_range", REAL, TUNABLE, 8.0, 0.0, 100.0, 8.0},
    {"T200_range", REAL, TUNABLE, 5.0, 0.0, 100.0, 5.0},
    {"X2_start", REAL, FIXED, 25.0, 0.0, 100.0, 25.0},
    {"P2_start", REAL, FIXED, 49.74297, 0.0, 400.0, 50.0},
    {"a", REAL, TUNABLE, 0.5616, 0.0, 10.0, 0.5616},
    {"b", REAL, TUNABLE, 0.3126, 0.0, 10.0, 0.3126},
    {"c", REAL, TUNABLE, 48.43, -100.0, 200.0, 48.43},
    {"d", REAL, TUNABLE, 0.507, 0.0, 10.0, 0.507},
    {"e", REAL, TUNABLE, 55.0, -100.0, 200.0, 55.0},
    {"f", REAL, TUNABLE, 0.1538, 0.0, 10.0, 0.1538},
    {"g", REAL, TUNABLE, 90.0, -100.0, 200.0, 90.0},
    {"h", REAL, TUNABLE, 0.16, 0.0, 10.0, 0.16},
    {"M", REAL, TUNABLE, 20.0, 1.0, 10000.0, 20.0},
    {"C", REAL, TUNABLE, 4.0, 0.1, 10000.0, 4.0},
    {"UA2", REAL, TUNABLE, 6.84, 0.0, 1000.0, 6.84},
    {"Cp", REAL, TUNABLE, 0.07, 0.001, 10.0, 0.07},
    {"lambda_", REAL, TUNABLE, 38.5, 1.0, 1000.0, 38.5},
    {"lambda_s", REAL, TUNABLE, 36.6, 1.0, 1000.0, 36.6},
    {"F3", REAL, TUNABLE, 50.0, 0.0, 1000.0, 50.0},
    {"fouling_rate", REAL, TUNABLE, 0.0, 0.0, 1000.0, 0.1},
    {"fouling_floor", REAL, TUNABLE, 0.7, 0.0, 1.0, 0.7},
    {"cleaning_period", REAL, TUNABLE, 6.0, 0.0, 100000.0, 6.0},
    {"UA2_present", REAL, OUTPUT, 0.0, 0.0, 1000.0, 6.84},
    {"saturate", BOOLEAN, FIXED, 0.0, 0.0, 1.0, 1.0},
    {"law_number", LAW_NUMBER, FIXED, 0.0, 0.0, 2.0, 1.0},
    {"X1_time_constant", REAL, FIXED, 0.0, 0.0, 1000000.0, 300.0},
    {"F1_time_constant", REAL, FIXED, 0.0, 0.0, 1000000.0, 300.0},
    {"T1_time_constant", REAL, FIXED, 0.0, 0.0, 1000000.0, 300.0},
    {"T200_time_constant", REAL, FIXED, 0.0, 0.0, 1000000.0, 300.0},
};

#endif
