"""A scenario for somebody's FMU, drafted from its model description, to be read and corrected."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from math import ceil, isfinite, log10
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cosim.errors import PlantError
from cosim.plant.archive import SHIPPED, UnpackedFmu, unpack
from cosim.plant.fmu_plant import FmuPlant
from cosim.plant.roles import Roles, guess_roles
from cosim.plant.steady import nearest_steady_state
from cosim.scenario import Scenario

Array = NDArray[np.float64]
SAMPLES = 500
"""Samples of the FMU's own experiment, where it states no step."""


def draft_scenario(
    fmu: str | Path,
    target: Path,
    *,
    states: Sequence[str] = (),
    actions: Sequence[str] = (),
    stage_cost: str | None = None,
    sampling_time: float | None = None,
    state: Sequence[float] = (),
    action: Sequence[float] = (),
) -> str:
    """Text of a commented scenario file for an FMU, as it will stand at `target`.

    What is not given is guessed; `state` and `action` are where the search for the steady state
    begins. Raises PlantError, which says what to give, where nothing can be guessed.
    """
    archive = unpack(fmu)
    roles = guess_roles(archive, states, actions, stage_cost)
    known = {variable.name: variable for variable in archive.description.modelVariables}
    x = _start(archive, roles.states, [_of_start(known, roles, n) for n in roles.states], state)
    u = _start(archive, roles.actions, [known[n].start for n in roles.actions], action, "action")
    document = _document(fmu, archive, roles, known, x, u, sampling_time)
    with FmuPlant(Scenario.from_dict(document | {"disturbance": {"law": "none"}})) as plant:
        reference = nearest_steady_state(plant, x, u)
        units = plant.units
    weight = 10.0 ** ceil(log10(10 * max(abs(reference[2]), 1.0)) - 0.5)
    for kind in ("linear", "quadratic"):
        document["penalty"][kind] = [weight if kind == "linear" else 1.0] * len(roles.states)
    document["plant"]["initial_state"] = reference[0].tolist()
    document["controller"] |= {
        "reference_state": reference[0].tolist(),
        "reference_action": reference[1].tolist(),
        "reference_cost": reference[2],
    }
    name = str(fmu) if str(fmu) in SHIPPED else _relative(archive.path, target)
    return _text(document, name, roles, units)


def _of_start(known: dict[str, Any], roles: Roles, name: str) -> Any:
    """Start value of a state: that of its start parameter, else its own."""
    table = roles.mapping.get("initial_state", [])
    parameter = dict(zip(roles.states, table, strict=False)).get(name, name)
    return known[parameter].start


def _start(
    fmu: UnpackedFmu,
    names: Sequence[str],
    found: Sequence[Any],
    given: Sequence[float],
    kind: str = "state",
) -> Array:
    if given:
        if len(given) != len(names):
            raise PlantError(
                f"--{kind} takes {len(names)} numbers ({', '.join(names)}), not {len(given)}"
            )
        return np.array(given, dtype=float)
    return np.array([0.0 if value is None else float(value) for value in found])


def _document(
    fmu: str | Path,
    archive: UnpackedFmu,
    roles: Roles,
    known: dict[str, Any],
    x: Array,
    u: Array,
    sampling_time: float | None,
) -> dict[str, Any]:
    limits = [
        _limits(known[name], value) for name, value in zip(roles.actions, u.tolist(), strict=True)
    ]
    ranges = [(known[name].min, known[name].max) for name in roles.states]
    mapping = roles.mapping
    disturbance: dict[str, Any] = {"law": "none"}
    if "nominal" in mapping and "ranges" in mapping:
        law = next(iter(mapping.get("law_codes", {"uniform": 1})))
        disturbance = {
            "law": law,
            "nominal": [float(known[name].start) for name in mapping["nominal"]],
            "ranges": [float(known[name].start) for name in mapping["ranges"]],
        }
    return {
        "schema": 1,
        "name": Path(fmu).stem,
        "description": str(archive.description.description or archive.description.modelName),
        "sampling_time": sampling_time or _sampling_time(archive, roles, known),
        "discount": 0.99,
        "plant": {
            "fmu": str(fmu) if str(fmu) in SHIPPED else str(archive.path),
            "states": list(roles.states),
            "actions": list(roles.actions),
            "disturbances": list(roles.disturbances),
            "stage_cost": roles.stage_cost,
            "initial_state": x.tolist(),
            "mapping": dict(mapping),
        },
        "disturbance": disturbance,
        "bounds": {
            "state_lower": [-np.inf if low is None else float(low) for low, _ in ranges],
            "state_upper": [np.inf if high is None else float(high) for _, high in ranges],
            "action_lower": [low for low, _ in limits],
            "action_upper": [high for _, high in limits],
        },
        "penalty": {"linear": [1.0] * len(x), "quadratic": [1.0] * len(x)},
        "controller": {
            "reference_state": x.tolist(),
            "reference_action": u.tolist(),
            "reference_cost": 0.0,
        },
    }


def _limits(variable: Any, value: float) -> tuple[float, float]:
    """Range of an input: what the FMU states, else as much again about its start value."""
    reach = abs(value) or 1.0
    low = value - reach if variable.min is None else float(variable.min)
    high = value + reach if variable.max is None else float(variable.max)
    return low, high


def _sampling_time(fmu: UnpackedFmu, roles: Roles, known: dict[str, Any]) -> float:
    parameter = known.get(roles.mapping.get("sampling_time", ""))
    if parameter is not None and parameter.start is not None:
        return float(parameter.start)
    experiment = fmu.description.defaultExperiment
    if getattr(experiment, "stepSize", None):
        return float(experiment.stepSize)
    if getattr(experiment, "stopTime", None):
        return float(experiment.stopTime) / SAMPLES
    raise PlantError(
        f"FMU '{fmu.path.name}' states neither a step size nor a stop time; give --sampling-time "
        "SECONDS"
    )


def _relative(path: Path, target: Path) -> str:
    try:
        return Path(os.path.relpath(path, target.resolve().parent)).as_posix()
    except ValueError:  # another drive
        return path.as_posix()


def _text(document: dict[str, Any], fmu: str, roles: Roles, units: dict[str, str]) -> str:
    plant, controller, bounds = document["plant"], document["controller"], document["bounds"]

    def named(names: Sequence[str]) -> str:
        return ", ".join(f"{n} [{units[n]}]" if units.get(n) else n for n in names)

    free = [
        name
        for name, low, high in zip(
            roles.states, bounds["state_lower"], bounds["state_upper"], strict=True
        )
        if not isfinite(low) and not isfinite(high)
    ]
    noise = document["disturbance"]
    lines = [
        "# Drafted by `cosim scenario init` from the FMU's model description.",
        "# Lines with CHECK are guesses that only you can confirm.",
        "schema = 1",
        f"name = {_value(document['name'])}",
        f"description = {_value(document['description'])}",
        f"sampling_time = {_value(document['sampling_time'])}  # s; CHECK",
        f"discount = {_value(document['discount'])}",
        "",
        "[plant]",
        f"fmu = {_value(fmu)}",
        f"states = {_value(plant['states'])}  # {roles.reasons['states']}: {named(roles.states)}",
        f"actions = {_value(plant['actions'])}  # {roles.reasons['actions']}: "
        f"{named(roles.actions)}",
        f"disturbances = {_value(plant['disturbances'])}"
        + (f"  # {roles.reasons['disturbances']}" if roles.disturbances else "  # none was found"),
        f"stage_cost = {_value(plant['stage_cost'])}  # {roles.reasons['stage_cost']}; CHECK: a "
        "cost, not a profit",
        f"initial_state = {_value(plant['initial_state'])}  # the steady state below",
        "",
        "[plant.mapping]  # what each reset writes; what the FMU has no parameter for is left out",
        *(f"{key} = {_value(value)}" for key, value in plant["mapping"].items()),
        "",
        "[disturbance]",
        *(f"{key} = {_value(value)}" for key, value in noise.items()),
        "",
        "[bounds]  # from min and max; states are bounded softly, by the penalty, actions hard",
        *(
            [f"# CHECK: the FMU states no bound of {', '.join(free)}"]
            if free
            else ["# CHECK: what a variable can be is not yet what it should be"]
        ),
        *(f"{key} = {_value(value)}" for key, value in bounds.items()),
        "",
        "[penalty]  # per unit of violation and sample; CHECK: must outweigh what it saves",
        *(f"{key} = {_value(value)}" for key, value in document["penalty"].items()),
        "",
        "[controller]",
        *(
            ['model = "controllers.evaporator:model"']
            if fmu in SHIPPED
            else ['# model = "my_plant:model"  # the controller\'s own model, in CasADi']
        ),
        "# Steady state of the undisturbed plant nearest to its start values, by stepping the FMU.",
        "# With a model, `cosim tuning` prints the cheapest one within the bounds.",
        *(f"{key} = {_value(value)}" for key, value in controller.items()),
    ]
    return "\n".join(lines) + "\n"


def _value(value: Any) -> str:
    """A value as TOML writes it."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{k} = {_value(v)}" for k, v in value.items()) + " }"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_value, value))}]"
    if isinstance(value, float):
        return repr(value) if isfinite(value) else ("inf" if value > 0 else "-inf")
    return json.dumps(value, ensure_ascii=False)
