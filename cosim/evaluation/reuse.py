"""Plants and controllers that a worker keeps from unit to unit, since building one takes long."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable

from cosim.errors import CosimError
from cosim.evaluation.provenance import code_hash
from cosim.plant import FmuPlant
from cosim.plant.archive import unpack
from cosim.protocols import Controller
from cosim.scenario import Scenario

KEPT = 4
"""Of each kind; the one that was used longest ago makes room."""
_plants: OrderedDict[str, FmuPlant] = OrderedDict()
_controllers: OrderedDict[str, Controller] = OrderedDict()


def plant(scenario: Scenario) -> FmuPlant:
    """The plant of a scenario."""
    key = f"{scenario.hash} {scenario.plant.fmu}"
    if key not in _plants:
        if len(_plants) == KEPT:
            _plants.popitem(last=False)[1].close()
        _plants[key] = FmuPlant(scenario)
    _plants.move_to_end(key)
    return _plants[key]


def controller(key: str, build: Callable[[], Controller]) -> Controller:
    """The controller of a key, built where it is not there."""
    if key not in _controllers:
        if len(_controllers) == KEPT:
            _controllers.popitem(last=False)
        _controllers[key] = build()
    _controllers.move_to_end(key)
    return _controllers[key]


def release() -> None:
    """Close what this process keeps."""
    _controllers.clear()
    while _plants:
        _plants.popitem()[1].close()


def require_code(code: str, packages: tuple[str, ...], error: type[CosimError]) -> None:
    """Raise `error` where these packages have another hash than where the work was given out."""
    if (here := code_hash(packages)) != code:
        raise error(
            f"a worker runs other code ({here}) than the work was given out with ({code}); install "
            "the same version of rti-cosim everywhere"
        )


def require_fmu(scenario: Scenario, sha256: str, error: type[CosimError]) -> None:
    """Raise `error` where a scenario's FMU is another one than where the work was given out."""
    found = unpack(scenario.plant.fmu)
    if found.sha256 != sha256:
        raise error(
            f"FMU '{found.path}' was replaced, or is another one on this worker (SHA-256 "
            f"{found.sha256[:16]}…, not {sha256[:16]}…); what is finished is stored: put the FMU "
            "back, or begin anew with it"
        )
