"""FMI 2.0: which function is allowed in which state, for co-simulation and model exchange."""

from __future__ import annotations

from ctypes import byref, c_double, c_int, c_size_t, c_uint32, c_void_p

from fmpy.fmi2 import fmi2EventInfo

DISCARD, ERROR = 2, 3
READABLE = {"initialization", "step", "event", "continuous", "terminated"}
SETTABLE = {"instantiated", "initialization", "step", "event", "continuous"}
EXCHANGE = {"instantiated", "initialization", "event", "continuous", "terminated"}
ALL = READABLE | SETTABLE

none = (c_uint32 * 0)()
zero = c_size_t(0)
two = c_size_t(2)
doubles = (c_double * 2)(25.0, 50.0)
flag = c_int()

# function → (states in which it is allowed, arguments that are right there)
FUNCTIONS = {
    "SetDebugLogging": (ALL, (0, zero, None)),
    "SetupExperiment": ({"instantiated"}, (0, c_double(0), c_double(0), 0, c_double(0))),
    "EnterInitializationMode": ({"instantiated"}, ()),
    "ExitInitializationMode": ({"initialization"}, ()),
    "Terminate": ({"step", "event", "continuous"}, ()),
    "Reset": (ALL, ()),
    "GetReal": (READABLE, (none, zero, None)),
    "GetInteger": (READABLE, (none, zero, None)),
    "GetBoolean": (READABLE, (none, zero, None)),
    "GetString": (READABLE, (none, zero, None)),
    "SetReal": (SETTABLE, (none, zero, None)),
    "SetInteger": (SETTABLE, (none, zero, None)),
    "SetBoolean": (SETTABLE, (none, zero, None)),
    "SetString": (SETTABLE, (none, zero, None)),
    "GetFMUstate": (ALL, (byref(c_void_p()),)),
    "FreeFMUstate": (ALL, (byref(c_void_p()),)),
    "GetDirectionalDerivative": (READABLE, (none, zero, none, zero, None, None)),
    "EnterEventMode": ({"event", "continuous"}, ()),
    "NewDiscreteStates": ({"event"}, (byref(fmi2EventInfo()),)),
    "EnterContinuousTimeMode": ({"event"}, ()),
    "CompletedIntegratorStep": ({"continuous"}, (1, byref(flag), byref(flag))),
    "SetTime": ({"event", "continuous"}, (c_double(0),)),
    "SetContinuousStates": ({"continuous"}, (doubles, two)),
    "GetDerivatives": ({"event", "continuous", "terminated"}, (doubles, two)),
    "GetEventIndicators": (EXCHANGE - {"instantiated"}, (doubles, zero)),
    "GetContinuousStates": (EXCHANGE - {"instantiated"}, (doubles, two)),
    "GetNominalsOfContinuousStates": (EXCHANGE - {"initialization"}, (doubles, two)),
    "DoStep": ({"step"}, (c_double(0), c_double(60), 1)),
    "CancelStep": (set(), ()),
    "GetRealStatus": ({"step", "terminated"}, (2, byref(c_double()))),
    "GetBooleanStatus": ({"step", "terminated"}, (3, byref(flag))),
}
CO_SIMULATION_ONLY = {"DoStep", "CancelStep", "GetRealStatus", "GetBooleanStatus"}
EXCHANGE_ONLY = {
    "EnterEventMode", "NewDiscreteStates", "EnterContinuousTimeMode", "CompletedIntegratorStep",
    "SetTime", "SetContinuousStates", "GetDerivatives", "GetEventIndicators",
    "GetContinuousStates", "GetNominalsOfContinuousStates",
}  # fmt: skip


def test_each_function_is_allowed_in_its_states_alone(complaint, state: tuple[str, bool]) -> None:
    others = CO_SIMULATION_ONLY if state[1] else EXCHANGE_ONLY
    complaints = []
    for function, (states, arguments) in FUNCTIONS.items():
        allowed = state[0] in states and function not in others
        complaints += complaint(2, f"fmi2{function}", state, arguments, allowed)
    assert complaints == []


def test_last_successful_time(open_fmu) -> None:
    instance = open_fmu(2).initialise()
    instance.step(0.0, 90.0)
    time = c_double()
    instance.fmu.dll.fmi2GetRealStatus(instance.handle, 2, byref(time))
    assert time.value == 90.0
