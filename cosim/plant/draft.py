"""A draft of a scenario for a foreign FMU, from its model description."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from math import ceil, isfinite, log10
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w
from scipy.optimize import least_squares

from cosim.errors import PlantError
from cosim.plant.fmi import SHIPPED, UnpackedFmu, unpack
from cosim.plant.fmu_plant import FmuPlant
from cosim.plant.wiring import INTEGERS, REALS, has_start, refusals
from cosim.protocols import Array
from cosim.scenario import Scenario
from cosim.validation import suggestion

NO_NOISE = (
    "no noise was found (no output NAME with parameters NAME_nominal and NAME_range): the plant is "
    "taken as undisturbed"
)
HEAD = """\
# Drafted by `cosim scenario init` from the FMU's model description.
# Lines with CHECK are guesses that only you can confirm."""
COSTS = ("cost", "loss", "objective")


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
    """Text of a scenario file for an FMU, as it will stand at `target`, remarks first.

    Roles that are not given are guessed; `state` and `action` are where the search for the steady
    state begins. Raises PlantError, which says what to give, where nothing can be guessed.
    """
    archive = unpack(fmu)
    for refusal in refusals(archive):
        raise PlantError(refusal)
    known = archive.variables
    for name in (*states, *actions, *([stage_cost] if stage_cost else [])):
        if name not in known:
            raise PlantError(
                f"FMU '{archive.path.name}' has no variable '{name}'{suggestion(name, known)}"
            )
    noise = [name for name in _reals(archive, "output") if f"{name}_nominal" in known]
    cost = stage_cost or _cost(archive)
    states = list(states) or _states(archive, [*noise, cost])
    actions = list(actions) or _actions(archive, noise)
    mapping = _mapping(archive, states, noise)
    starts = [known[name] for name in mapping.get("initial_state", states)]
    x = _start(starts, state, "state")
    u = _start([known[name] for name in actions], action, "action")
    limits = [_limits(known[name], value) for name, value in zip(actions, u.tolist(), strict=True)]
    disturbance: dict[str, Any] = {"law": "none"}
    if "nominal" in mapping and "ranges" in mapping:
        disturbance["law"] = next(iter(mapping.get("law_codes", {"uniform": 1})))
        for field in ("nominal", "ranges"):
            disturbance[field] = [float(known[name].start) for name in mapping[field]]
    shipped = str(fmu) in SHIPPED
    document: dict[str, Any] = {
        "schema": 1,
        "name": Path(fmu).stem,
        "description": str(archive.description.description or archive.description.modelName),
        "sampling_time": sampling_time or _sampling_time(archive, mapping),
        "discount": 0.99,
        "plant": {
            "fmu": str(fmu) if shipped else archive.path.as_posix(),
            "states": states,
            "actions": actions,
            "disturbances": noise,
            "stage_cost": cost,
            "initial_state": x.tolist(),
            "mapping": mapping,
        },
        "disturbance": disturbance,
        "bounds": {
            "state_lower": [_number(known[name].min, -np.inf) for name in states],
            "state_upper": [_number(known[name].max, np.inf) for name in states],
            "action_lower": [low for low, _ in limits],
            "action_upper": [high for _, high in limits],
        },
        "penalty": {"linear": [1.0] * len(x), "quadratic": [1.0] * len(x)},
        "controller": _reference(x, u, 0.0),
    }
    with FmuPlant(Scenario.from_dict(document | {"disturbance": {"law": "none"}})) as plant:
        x, u, found = nearest_steady_state(plant, x, u)
        units = plant.units
    weight = 10.0 ** ceil(log10(10 * max(abs(found), 1.0)) - 0.5)
    document["penalty"]["linear"] = [weight] * len(x)
    document["plant"]["initial_state"] = x.tolist()
    document["controller"] = _reference(x, u, found)
    if shipped:
        document["controller"]["model"] = f"controllers.{str(fmu).removesuffix('_fmi3')}:model"
    else:
        with suppress(ValueError):  # it is on another drive
            path = os.path.relpath(archive.path, target.resolve().parent)
            document["plant"]["fmu"] = Path(path).as_posix()
    notes = [f"# {field}: {note}" for field, note in _comments(document, units).items()]
    return "\n".join([HEAD, *notes, "", tomli_w.dumps(document)])


def _reference(x: Array, u: Array, cost: float) -> dict[str, Any]:
    return {
        "reference_state": x.tolist(), "reference_action": u.tolist(), "reference_cost": cost,
    }  # fmt: skip


def _start(variables: Sequence[Any], given: Sequence[float], kind: str) -> Array:
    if given and len(given) != len(variables):
        names = ", ".join(variable.name for variable in variables)
        raise PlantError(f"--{kind} takes {len(variables)} numbers ({names}), not {len(given)}")
    return np.array(given or [_number(variable.start, 0.0) for variable in variables], dtype=float)


def _number(stated: str | None, otherwise: float) -> float:
    return otherwise if stated is None else float(stated)


def _limits(variable: Any, value: float) -> tuple[float, float]:
    """Range of an input: the FMU's, else its start value ± its magnitude."""
    reach = abs(value) or 1.0
    return _number(variable.min, value - reach), _number(variable.max, value + reach)


def _sampling_time(fmu: UnpackedFmu, mapping: Mapping[str, Any]) -> float:
    parameter = fmu.variables.get(mapping.get("sampling_time", ""))
    experiment = getattr(fmu.description.defaultExperiment, "stepSize", None)
    stated = getattr(parameter, "start", None) or experiment
    if not stated:
        raise PlantError(f"FMU '{fmu.path.name}' states no step size; give --sampling-time SECONDS")
    return float(stated)


def _comments(document: dict[str, Any], units: dict[str, str]) -> dict[str, str]:
    """Remark on each field and table by its dotted name."""
    plant, bounds = document["plant"], document["bounds"]
    ranges = zip(plant["states"], bounds["state_lower"], bounds["state_upper"], strict=True)
    free = [name for name, low, high in ranges if not isfinite(low) and not isfinite(high)]
    comments = {
        "sampling_time": "s; CHECK",
        "plant": "; ".join(f"{name} [{unit}]" for name, unit in units.items() if unit),
        "plant.stage_cost": "CHECK: a cost, not a profit",
        "plant.mapping": "each reset writes these; what the FMU has no parameter for is left out",
        "bounds": "CHECK: states are bounded softly, by the penalty, actions hard; from min and max"
        + (f"; CHECK: the FMU states no bound of {', '.join(free)}" if free else ""),
        "penalty": "per unit of violation and sample; CHECK: must outweigh what it saves",
        "controller": "the undisturbed plant's steady state nearest to its start values; "
        "`cosim tuning` prints the cheapest one",
    }
    if "initial_state" not in plant["mapping"]:
        comments["controller"] = "CHECK: the plant as it starts; it can start nowhere else"
    if document["disturbance"]["law"] == "none":
        comments["disturbance"] = f"CHECK: {NO_NOISE}"
    if "model" not in document["controller"]:
        comments["controller"] += '; add model = "my_plant:model", a model in CasADi'
    return comments


def _reals(fmu: UnpackedFmu, causality: str) -> list[str]:
    return [
        name
        for name, variable in fmu.variables.items()
        if variable.causality == causality and variable.type in REALS and not variable.shape
    ]


def _cost(fmu: UnpackedFmu) -> str:
    outputs = _reals(fmu, "output")
    if not outputs:
        raise PlantError(f"FMU '{fmu.path.name}' has no scalar real output to draft from")
    found = [name for name in outputs if any(word in name.lower() for word in COSTS)]
    if len(found) == 1:
        return found[0]
    which = f"{' and '.join(found)} could be" if found else "none is called a cost"
    raise PlantError(
        f"FMU '{fmu.path.name}' does not say which output is the stage cost ({which}); give "
        f"--cost NAME, one of {', '.join(outputs)}"
    )


def _states(fmu: UnpackedFmu, others: Sequence[str]) -> list[str]:
    """Continuous states, else outputs with a start parameter."""
    rates = [each for each in fmu.variables.values() if getattr(each, "derivative", None)]
    if rates:
        return list(dict.fromkeys(each.derivative.name for each in rates))
    outputs = [name for name in _reals(fmu, "output") if name not in others]
    if started := [name for name in outputs if f"{name}_start" in fmu.variables]:
        return started
    raise PlantError(
        f"FMU '{fmu.path.name}' does not say what its state is (no derivatives, no parameters "
        f"NAME_start); give --states A,B,…, of {', '.join(_reals(fmu, 'output'))}"
    )


def _actions(fmu: UnpackedFmu, noise: Sequence[str]) -> list[str]:
    """Real inputs, but for an input D_in beside an output D: it takes the disturbance's place."""
    inputs = [name for name in _reals(fmu, "input") if name.removesuffix("_in") not in noise]
    if inputs:
        return inputs
    parameters = _reals(fmu, "parameter")
    tunable = [n for n in parameters if fmu.variables[n].variability == "tunable"]
    raise PlantError(
        f"FMU '{fmu.path.name}' has no real input to act on"
        + (f"; give --actions A,B,…, of its tunable {', '.join(tunable)}" if tunable else "")
    )


def _mapping(fmu: UnpackedFmu, states: Sequence[str], noise: Sequence[str]) -> dict[str, Any]:
    """Start values that a reset can write, by the names of our own plants."""
    known = fmu.variables

    def of(name: str, types: Sequence[str]) -> bool:
        return name in known and known[name].type in types and known[name].causality == "parameter"

    table: dict[str, Any] = {}
    starts = [f"{name}_start" for name in states]
    if all(of(name, REALS) for name in starts):
        table["initial_state"] = starts
    elif all(has_start(known[name]) for name in states):
        table["initial_state"] = list(states)
    if of("seed", INTEGERS):
        table["seed"] = [name for name in ("seed", "seedHigh") if of(name, INTEGERS)]
    for name, types in (("sampling_time", REALS), ("stochastic", ("Boolean",))):
        if of(name, types):
            table[name] = name
    declared = getattr(known.get("law"), "declaredType", None)
    items = getattr(declared, "items", None) or []
    codes = {item.name: int(item.value) for item in items if item.name in ("uniform", "normal")}
    if codes and of("law", ("Enumeration",)):
        table |= {"law": "law", "law_codes": codes}
    for field, suffix in (("nominal", "_nominal"), ("ranges", "_range")):
        parameters = [f"{name}{suffix}" for name in noise]
        if parameters and all(of(name, REALS) for name in parameters):
            table[field] = parameters
    return table


DIFFERENCE = 1e-5
"""Finite differences, as a share of a variable's scale."""
LOOSE = 1e-6
"""Residual, as a share of the scales, that a search may end with."""


def nearest_steady_state(
    plant: FmuPlant, state: Array, action: Array
) -> tuple[Array, Array, float]:
    """Steady state x = Φ(x, u) of the undisturbed plant near (state (n,), action (m,)).

    Returns x, u and the stage cost there. Both x and u move in their scales, within the plant's
    ranges, by least squares in a trust region. A plant that starts where it likes is taken as it
    starts. Raises PlantError where there is no steady state.
    """
    if not plant.scenario.plant.mapping.initial_state:
        return plant.reset(0), action, plant.step(action).stage_cost
    lower, upper = plant.scenario.action_lower, plant.scenario.action_upper
    low, high = plant.state_range
    bounds = np.concatenate([low, lower]), np.concatenate([high, upper])
    start, n = np.concatenate([state, action]), len(state)
    scale: Array = np.maximum(np.abs(start), 1e-2)

    def residual(z: Array) -> Array:
        plant.reset(0, z[:n])
        return (plant.step(z[n:]).s - z[:n]) / scale[:n]

    precise = {"diff_step": DIFFERENCE, "gtol": 1e-15, "ftol": None, "xtol": None}
    start = np.clip(start, *bounds)
    with np.errstate(divide="ignore", invalid="ignore"):  # SciPy's own, of a step that is lost
        found = least_squares(residual, start, "3-point", bounds, x_scale=scale, **precise)
    z, left = found.x, float(np.max(np.abs(found.fun)))
    if left > LOOSE:
        raise PlantError(
            f"FMU '{plant.fmu_path.name}' has no steady state near its start values (a sample "
            f"still moves a state by {left:.2g} of its scale); give other start "
            "values by --state and --action"
        )
    plant.reset(0, z[:n])
    return z[:n], z[n:], plant.step(z[n:]).stage_cost
