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


def test_reset_restores_every_default(open_fmu, version: int) -> None:
    fresh = open_fmu(version).initialise()
    used = open_fmu(version).initialise(seed=3, law=2, X2_start=30.0, a=0.6, P100=300.0, stop=600.0)
    used.step(0.0, 60.0)
    used.fmu.reset()
    used.initialise()
    names = [v.name for v in EVAPORATOR.exported(version) if v.name != "time"]
    assert used.get(*names) == fresh.get(*names)
    assert used.run(20) == fresh.run(20)
