"""Making an instance, its logger, and reset."""

from __future__ import annotations

import pytest
from fmpy.fmi1 import FMICallException

from fmus.evaporator import EVAPORATOR

DISCARD, ERROR = 2, 3


def test_null_instance_is_an_error_without_a_crash(plant) -> None:
    fmu = plant.fmu
    name = "fmi2DoStep" if plant.version == 2 else "fmi3Terminate"
    arguments = (None, 0.0, 1.0, 1) if plant.version == 2 else (None,)
    with pytest.raises(FMICallException):
        getattr(fmu, name)(*arguments)
    fmu.fmi2FreeInstance(None) if plant.version == 2 else fmu.fmi3FreeInstance(None)


def test_logging_can_be_muted_by_category_and_an_unknown_category_is_refused(
    refused, plant
) -> None:
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
    names = [v.name for v in EVAPORATOR.exported(version) if v.name != "time"]
    assert used.get(*names) == fresh.get(*names)
    assert used.run(20) == fresh.run(20)


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
