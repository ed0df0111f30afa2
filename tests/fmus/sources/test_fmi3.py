"""FMI 3.0: which function is allowed in which state, and what the FMU does not offer."""

from __future__ import annotations

from ctypes import byref, c_bool, c_double, c_int, c_size_t, c_uint32, c_uint64, c_void_p

import pytest

ERROR = 3
READABLE = {"initialization", "step", "event", "continuous", "terminated"}
SETTABLE = {"instantiated", "initialization", "step", "event", "continuous"}
ALL = READABLE | SETTABLE

none = (c_uint32 * 0)()
zero = c_size_t(0)
two = c_size_t(2)
doubles = (c_double * 2)(25.0, 50.0)
flag = c_bool()
number = c_double()
off, on = c_bool(False), c_bool(True)
EMPTY = (none, zero, None, zero)

# function → (states in which it is allowed, arguments that are right there)
FUNCTIONS = {
    "SetDebugLogging": (ALL, (off, zero, None)),
    "EnterInitializationMode": ({"instantiated"}, (off, number, number, off, number)),
    "ExitInitializationMode": ({"initialization"}, ()),
    "EnterEventMode": ({"continuous"}, ()),
    "Terminate": ({"step", "event", "continuous"}, ()),
    "Reset": (ALL, ()),
    "GetFMUState": (ALL, (byref(c_void_p()),)),
    "FreeFMUState": (ALL, (byref(c_void_p()),)),
    "GetDirectionalDerivative": (READABLE, (none, zero, none, zero, None, zero, None, zero)),
    "GetAdjointDerivative": (READABLE, (none, zero, none, zero, None, zero, None, zero)),
    "UpdateDiscreteStates": ({"event"}, (*[byref(flag)] * 5, byref(number))),
    "EvaluateDiscreteStates": ({"initialization", "event"}, ()),
    "EnterContinuousTimeMode": ({"event"}, ()),
    "CompletedIntegratorStep": ({"continuous"}, (on, byref(flag), byref(flag))),
    "SetTime": ({"event", "continuous"}, (number,)),
    "SetContinuousStates": ({"continuous"}, (doubles, two)),
    "GetContinuousStateDerivatives": (READABLE, (doubles, two)),
    "GetEventIndicators": (READABLE, (doubles, zero)),
    "GetContinuousStates": (READABLE, (doubles, two)),
    "GetNominalsOfContinuousStates": (ALL, (doubles, two)),
    "GetNumberOfEventIndicators": (ALL, (byref(c_size_t()),)),
    "GetNumberOfContinuousStates": (ALL, (byref(c_size_t()),)),
    "DoStep": ({"step"}, (number, c_double(60), on, *[byref(flag)] * 3, byref(number))),
}
TYPES = ["Float32", "Float64", "Int8", "UInt8", "Int16", "UInt16", "Int32", "UInt32", "Int64",
         "UInt64", "Boolean", "String"]  # fmt: skip
FUNCTIONS |= {f"Get{kind}": (READABLE, EMPTY) for kind in TYPES}
FUNCTIONS |= {f"Set{kind}": (SETTABLE, EMPTY) for kind in TYPES}
FUNCTIONS["GetBinary"] = (READABLE, (none, zero, None, None, zero))
FUNCTIONS["SetBinary"] = (SETTABLE, (none, zero, None, None, zero))
FUNCTIONS["GetClock"] = (READABLE, (none, zero, None))
FUNCTIONS["SetClock"] = (SETTABLE, (none, zero, None))
CO_SIMULATION_ONLY = {"DoStep"}
EXCHANGE_ONLY = {
    "EnterEventMode", "UpdateDiscreteStates", "EnterContinuousTimeMode", "SetTime",
    "CompletedIntegratorStep", "SetContinuousStates", "GetContinuousStateDerivatives",
    "GetEventIndicators", "GetContinuousStates", "GetNominalsOfContinuousStates",
    "GetNumberOfEventIndicators", "GetNumberOfContinuousStates",
}  # fmt: skip


def test_each_function_is_allowed_in_its_states_alone(complaint, state: tuple[str, bool]) -> None:
    others = CO_SIMULATION_ONLY if state[1] else EXCHANGE_ONLY
    complaints = []
    for function, (states, arguments) in FUNCTIONS.items():
        allowed = state[0] in states and function not in others
        number.value = 0.0
        complaints += complaint(3, f"fmi3{function}", state, arguments, allowed)
    assert complaints == []


@pytest.mark.parametrize(
    ("function", "arguments"),
    [
        ("EnterConfigurationMode", ()),
        ("ExitConfigurationMode", ()),
        ("EnterStepMode", ()),
        ("GetNumberOfVariableDependencies", (1, byref(c_size_t()))),
        ("GetVariableDependencies", (1, None, None, None, None, zero)),
        ("GetOutputDerivatives", (none, zero, None, None, zero)),
        ("ActivateModelPartition", (1, number)),
        ("GetIntervalDecimal", (none, zero, None, None)),
        ("GetIntervalFraction", (none, zero, None, None, None)),
        ("GetShiftDecimal", (none, zero, None)),
        ("GetShiftFraction", (none, zero, None, None)),
        ("SetIntervalDecimal", (none, zero, None)),
        ("SetIntervalFraction", (none, zero, None, None)),
        ("SetShiftDecimal", (none, zero, None)),
        ("SetShiftFraction", (none, zero, None, None)),
    ],
)
def test_what_is_not_offered_is_refused_with_a_message(open_fmu, function, arguments) -> None:
    instance = open_fmu(3).initialise()
    call = getattr(instance.fmu.dll, f"fmi3{function}")
    assert call(instance.handle, *arguments) == ERROR
    assert instance.messages == [
        (ERROR, "logStatusError", f"fmi3{function}: not offered by this FMU.")
    ]
    assert call(None, *arguments) == ERROR


def test_time_is_a_variable(open_fmu) -> None:
    instance = open_fmu(3).initialise(start=30.0)
    instance.step(30.0, 60.0)
    assert instance.get("time") == [90.0]


def test_seed_survives_all_64_bits(open_fmu) -> None:
    instance = open_fmu(3)
    for seed in (0, 2**32, 2**64 - 1):
        instance.set(seed=seed)
        value, status = (c_uint64 * 1)(), c_int()
        instance.enter_initialisation()
        status = instance.fmu.dll.fmi3GetUInt64(
            instance.handle, (c_uint32 * 1)(29), c_size_t(1), value, c_size_t(1)
        )
        assert (status, value[0]) == (0, seed)
        instance.fmu.reset()
