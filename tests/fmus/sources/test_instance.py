"""Access to variables: what is refused, with which status and message, and that nothing changes."""

from __future__ import annotations

import math
import re
from ctypes import c_double, c_uint32

import pytest
from fmpy.fmi1 import FMICallException

from fmus.variables import BY_NAME, VARIABLES, Kind, Type, value_reference

DISCARD, ERROR = 2, 3
REAL_SETTABLE = [v.name for v in VARIABLES if v.settable and v.type is Type.REAL]


def refused(plant, call) -> tuple[int, str]:
    """Status and logged message of a refused call; exactly one message is logged."""
    before = len(plant.messages)
    with pytest.raises(FMICallException) as caught:
        call()
    (status, category, text), *more = plant.messages[before:]
    assert not more
    assert status == caught.value.status
    assert category == {DISCARD: "logStatusDiscard", ERROR: "logStatusError"}[status]
    assert not re.search("[%#]", text)
    return status, text


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("name", ["P100", "X1_in", "a", "X2_start"])
def test_non_finite_value_is_an_error(plant, name: str, value: float) -> None:
    before = plant.initialise().get(name) if name != "X2_start" else None
    status, text = refused(plant, lambda: plant.set(**{name: value}))
    assert status == ERROR
    assert f"the value of {name} is not finite" in text
    assert before is None or plant.get(name) == before


@pytest.mark.parametrize(
    ("name", "value"), [("P100", 99.9), ("P100", 400.1), ("F200", 0.0), ("F200", 1e9)]
)
def test_input_out_of_range_is_discarded(plant, name: str, value: float) -> None:
    plant.initialise()
    before = plant.run(0)
    status, text = refused(plant, lambda: plant.set(**{name: value}))
    assert status == DISCARD
    assert f"{name} = " in text
    assert "outside [100, 400]" in text
    assert plant.run(0) == before


@pytest.mark.parametrize("name", REAL_SETTABLE)
def test_range_of_the_model_description_is_enforced(plant, name: str) -> None:
    variable = BY_NAME[name]
    plant.set(**{name: variable.min})
    plant.set(**{name: variable.max})
    for value in (math.nextafter(variable.min, -math.inf), math.nextafter(variable.max, math.inf)):
        assert refused(plant, lambda v=value: plant.set(**{name: v}))[0] == DISCARD


@pytest.mark.parametrize("law", [0, 3, -1])
def test_unknown_law_is_discarded(plant, law: int) -> None:
    assert refused(plant, lambda: plant.set(law=law))[0] == DISCARD


@pytest.mark.parametrize("reference", [len(VARIABLES), 10_000, 2**32 - 1])
def test_unknown_value_reference_is_an_error(plant, reference: int) -> None:
    plant.initialise()
    suffix = "Real" if plant.version == 2 else "Float64"
    status, text = refused(plant, lambda: getattr(plant.fmu, f"get{suffix}")([reference]))
    assert status == ERROR
    assert f"unknown value reference {reference}" in text
    status, text = refused(plant, lambda: getattr(plant.fmu, f"set{suffix}")([reference], [1.0]))
    assert status == ERROR


def test_variable_of_another_type_is_an_error(plant) -> None:
    plant.initialise()
    status, text = refused(plant, lambda: plant.fmu.getBoolean([value_reference("X2")]))
    assert status == ERROR
    assert "X2" in text
    assert "another type" in text


@pytest.mark.parametrize("kind", [Kind.STATE, Kind.DERIVATIVE, Kind.OUTPUT])
def test_calculated_variable_cannot_be_set(plant, kind: Kind) -> None:
    plant.initialise()
    for variable in (v for v in VARIABLES if v.kind is kind):
        suffix = "Real" if plant.version == 2 else "Float64"
        setter = getattr(plant.fmu, f"set{suffix}")
        reference = value_reference(variable.name)
        status, text = refused(plant, lambda s=setter, r=reference: s([r], [1.0]))
        assert status == ERROR
        assert f"{variable.name} cannot be set" in text


def test_fixed_parameter_cannot_be_set_after_initialisation(plant) -> None:
    plant.initialise()
    for name, value in {"X2_start": 26.0, "sampling_time": 6.0, "seed": 1, "law": 2}.items():
        status, text = refused(plant, lambda n=name, v=value: plant.set(**{n: v}))
        assert status == ERROR
        assert "step mode" in text


def test_refused_call_with_several_values_changes_none_of_them(plant) -> None:
    plant.initialise()
    before = plant.get("P100", "F200")
    suffix = "Real" if plant.version == 2 else "Float64"
    references = [value_reference("P100"), value_reference("F200")]
    setter = getattr(plant.fmu, f"set{suffix}")
    assert refused(plant, lambda: setter(references, [300.0, math.nan]))[0] == ERROR
    assert plant.get("P100", "F200") == before


def test_instance_goes_on_after_a_refused_call(open_fmu, version: int) -> None:
    disturbed, clean = open_fmu(version).initialise(), open_fmu(version).initialise()
    for k in range(3):
        refused(disturbed, lambda: disturbed.set(P100=math.nan))
        refused(disturbed, lambda k=k: disturbed.step(60.0 * k, math.nan))
        disturbed.step(60.0 * k, 60.0)
        clean.step(60.0 * k, 60.0)
    assert disturbed.run(0) == clean.run(0)


def test_null_array_is_an_error(plant) -> None:
    plant.initialise()
    fmu, null = plant.fmu, None
    reference = (c_uint32 * 1)(value_reference("X2"))
    if plant.version == 2:
        calls = [
            lambda: fmu.fmi2GetReal(fmu.component, reference, 1, null),
            lambda: fmu.fmi2GetReal(fmu.component, null, 1, (c_double * 1)()),
            lambda: fmu.fmi2GetString(fmu.component, null, 1, null),
        ]
    else:
        calls = [
            lambda: fmu.fmi3GetFloat64(fmu.component, reference, 1, null, 1),
            lambda: fmu.fmi3GetFloat64(fmu.component, null, 1, (c_double * 1)(), 1),
            lambda: fmu.fmi3GetString(fmu.component, null, 1, null, 1),
        ]
    for call in calls:
        status, text = refused(plant, call)
        assert status == ERROR
        assert "null array" in text


def test_null_instance_is_an_error_without_a_crash(plant) -> None:
    fmu = plant.fmu
    name = "fmi2DoStep" if plant.version == 2 else "fmi3Terminate"
    arguments = (None, 0.0, 1.0, 1) if plant.version == 2 else (None,)
    with pytest.raises(FMICallException):
        getattr(fmu, name)(*arguments)
    fmu.fmi2FreeInstance(None) if plant.version == 2 else fmu.fmi3FreeInstance(None)


def test_value_array_of_another_length_is_an_error(open_fmu) -> None:
    plant = open_fmu(3).initialise()
    fmu = plant.fmu
    reference = (c_uint32 * 1)(value_reference("X2"))
    status, text = refused(
        plant, lambda: fmu.fmi3GetFloat64(fmu.component, reference, 1, (c_double * 2)(), 2)
    )
    assert status == ERROR
    assert "1 value references but 2 values" in text


def test_logging_can_be_muted_by_category_and_an_unknown_category_is_refused(plant) -> None:
    plant.fmu.setDebugLogging(False, ["logStatusDiscard"])
    with pytest.raises(FMICallException):
        plant.set(P100=0.0)
    assert plant.messages == []
    plant.fmu.setDebugLogging(True, [])
    assert refused(plant, lambda: plant.set(P100=0.0))[0] == DISCARD
    status, text = refused(plant, lambda: plant.fmu.setDebugLogging(True, ["nonsense"]))
    assert status == ERROR
    assert "unknown logging category" in text


def test_reset_restores_every_default(open_fmu, version: int) -> None:
    fresh = open_fmu(version).initialise()
    used = open_fmu(version).initialise(seed=3, law=2, X2_start=30.0, a=0.6, P100=300.0, stop=600.0)
    used.step(0.0, 60.0)
    used.fmu.reset()
    used.initialise()
    names = [v.name for v in VARIABLES if version == 2 or v.type is not Type.SEED_HIGH]
    names.remove("time")
    assert used.get(*names) == fresh.get(*names)
    assert used.run(20) == fresh.run(20)


def test_start_parameters_act_until_initialisation_ends(plant) -> None:
    plant.enter_initialisation()
    assert plant.get("X2") == [25.0]
    plant.set(X2_start=30.0)
    assert plant.get("X2") == [30.0]


@pytest.mark.parametrize(("name", "token"), [(b"", None), (b"test", b"{wrong}"), (b"test", b"")])
def test_instantiation_with_a_bad_name_or_token_fails_with_a_message(plant, name, token) -> None:
    fmu, messages = plant.fmu, plant.messages
    fmu.instanceName = name.decode()
    fmu.guid = fmu.guid if token is None else token.decode()
    good, log = fmu.component, plant._log2 if plant.version == 2 else plant._log3
    plant._log2 = lambda _, name, status, category, text: messages.append((status, text))
    with pytest.raises(Exception, match="Failed to instantiate"):
        if plant.version == 2:
            fmu.instantiate(callbacks=callbacks2(messages))
        else:
            fmu.instantiate(logMessage=log)
    fmu.component = good
    assert len(messages) == 1
    assert messages[0][0] == ERROR


def callbacks2(messages: list):
    from fmpy import fmi2

    callbacks = fmi2.fmi2CallbackFunctions()
    callbacks.logger = fmi2.fmi2CallbackLoggerTYPE(
        lambda _, name, status, category, text: messages.append((status, text.decode()))
    )
    return callbacks
