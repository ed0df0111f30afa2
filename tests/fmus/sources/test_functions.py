"""Which function is allowed in which state, what is not offered; making an instance, and reset."""

from ctypes import byref, c_bool, c_double, c_int, c_size_t, c_uint32, c_uint64, c_void_p

import pytest
from fmpy.fmi1 import FMICallException
from fmpy.fmi2 import fmi2EventInfo

from fmus.evaporator import EVAPORATOR

ERROR = 3
READABLE = {"initialization", "step", "event", "continuous", "terminated"}
SETTABLE = {"instantiated", "initialization", "step", "event", "continuous"}
EXCHANGE = {"instantiated", "initialization", "event", "continuous", "terminated"}
ALL = READABLE | SETTABLE

none = (c_uint32 * 0)()
zero = c_size_t(0)
two = c_size_t(2)
doubles = (c_double * 2)(25.0, 50.0)
flag = c_int()
told = c_bool()
moment = c_double()
off, on = c_bool(False), c_bool(True)
EMPTY = (none, zero, None, zero)

# function → (states in which it is allowed, arguments that are right there)
FMI2 = {
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
STEPPED_2 = {"DoStep", "CancelStep", "GetRealStatus", "GetBooleanStatus"}
EXCHANGED_2 = {
    "EnterEventMode", "NewDiscreteStates", "EnterContinuousTimeMode", "CompletedIntegratorStep",
    "SetTime", "SetContinuousStates", "GetDerivatives", "GetEventIndicators",
    "GetContinuousStates", "GetNominalsOfContinuousStates",
}  # fmt: skip

FMI3 = {
    "SetDebugLogging": (ALL, (off, zero, None)),
    "EnterInitializationMode": ({"instantiated"}, (off, moment, moment, off, moment)),
    "ExitInitializationMode": ({"initialization"}, ()),
    "EnterEventMode": ({"continuous"}, ()),
    "Terminate": ({"step", "event", "continuous"}, ()),
    "Reset": (ALL, ()),
    "GetFMUState": (ALL, (byref(c_void_p()),)),
    "FreeFMUState": (ALL, (byref(c_void_p()),)),
    "GetDirectionalDerivative": (READABLE, (none, zero, none, zero, None, zero, None, zero)),
    "UpdateDiscreteStates": ({"event"}, (*[byref(told)] * 5, byref(moment))),
    "EvaluateDiscreteStates": ({"initialization", "event"}, ()),
    "EnterContinuousTimeMode": ({"event"}, ()),
    "CompletedIntegratorStep": ({"continuous"}, (on, byref(told), byref(told))),
    "SetTime": ({"event", "continuous"}, (moment,)),
    "SetContinuousStates": ({"continuous"}, (doubles, two)),
    "GetContinuousStateDerivatives": (READABLE, (doubles, two)),
    "GetEventIndicators": (READABLE, (doubles, zero)),
    "GetContinuousStates": (READABLE, (doubles, two)),
    "GetNominalsOfContinuousStates": (ALL, (doubles, two)),
    "GetNumberOfEventIndicators": (ALL, (byref(c_size_t()),)),
    "GetNumberOfContinuousStates": (ALL, (byref(c_size_t()),)),
    "DoStep": ({"step"}, (moment, c_double(60), on, *[byref(told)] * 3, byref(moment))),
}
TYPES = ["Float32", "Float64", "Int8", "UInt8", "Int16", "UInt16", "Int32", "UInt32", "Int64",
         "UInt64", "Boolean", "String"]  # fmt: skip
FMI3 |= {f"Get{kind}": (READABLE, EMPTY) for kind in TYPES}
FMI3 |= {f"Set{kind}": (SETTABLE, EMPTY) for kind in TYPES}
FMI3["GetBinary"] = (READABLE, (none, zero, None, None, zero))
FMI3["SetBinary"] = (SETTABLE, (none, zero, None, None, zero))
FMI3["GetClock"] = (READABLE, (none, zero, None))
FMI3["SetClock"] = (SETTABLE, (none, zero, None))
STEPPED_3 = {"DoStep"}
EXCHANGED_3 = {
    "EnterEventMode", "UpdateDiscreteStates", "EnterContinuousTimeMode", "SetTime",
    "CompletedIntegratorStep", "SetContinuousStates", "GetContinuousStateDerivatives",
    "GetEventIndicators", "GetContinuousStates", "GetNominalsOfContinuousStates",
    "GetNumberOfEventIndicators", "GetNumberOfContinuousStates",
}  # fmt: skip
TABLES = {2: (FMI2, STEPPED_2, EXCHANGED_2), 3: (FMI3, STEPPED_3, EXCHANGED_3)}


@pytest.mark.parametrize("fmi", TABLES)
def test_each_function_is_allowed_in_its_states_alone(complaint, state, fmi: int) -> None:
    functions, stepped, exchanged = TABLES[fmi]
    others = stepped if state[1] else exchanged
    complaints = []
    for function, (states, arguments) in functions.items():
        allowed = state[0] in states and function not in others
        moment.value = 0.0
        complaints += complaint(fmi, f"fmi{fmi}{function}", state, arguments, allowed)
    assert complaints == []


@pytest.mark.parametrize(
    ("function", "arguments"),
    [
        ("EnterConfigurationMode", ()),
        ("GetNumberOfVariableDependencies", (1, byref(c_size_t()))),
        ("ActivateModelPartition", (1, moment)),
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


def test_null_instance_is_an_error_without_a_crash(plant) -> None:
    fmu = plant.fmu
    name = "fmi2DoStep" if plant.version == 2 else "fmi3Terminate"
    arguments = (None, 0.0, 1.0, 1) if plant.version == 2 else (None,)
    with pytest.raises(FMICallException):
        getattr(fmu, name)(*arguments)
    fmu.fmi2FreeInstance(None) if plant.version == 2 else fmu.fmi3FreeInstance(None)


def test_reset_restores_every_default(open_fmu, version: int) -> None:
    fresh = open_fmu(version).initialise()
    used = open_fmu(version).initialise(seed=3, law=2, X2_start=30.0, a=0.6, P100=300.0, stop=600.0)
    used.step(0.0, 60.0)
    used.fmu.reset()
    used.initialise()
    names = [v.name for v in EVAPORATOR.exported(version) if v.name != "time"]
    assert used.get(*names) == fresh.get(*names)
    assert used.run(20) == fresh.run(20)
