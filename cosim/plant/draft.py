"""A draft of a scenario for a foreign FMU, from its model description and by stepping it."""

from __future__ import annotations

import json
import os
import textwrap
from collections import defaultdict
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from math import ceil, isfinite, log10
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w
from scipy.optimize import least_squares

from cosim.core.errors import PlantError
from cosim.core.protocols import Array
from cosim.core.scenario import Scenario, presets
from cosim.core.validation import suggestion
from cosim.plant.fmi import SHIPPED_FMUS, UnpackedFmu, number, unpack
from cosim.plant.fmu_plant import FmuPlant
from cosim.plant.probe import AFTER, OutputKind, ProbeReport, Restart, probe
from cosim.plant.starts import candidates, start_parameters
from cosim.plant.wiring import INTEGERS, NO_NUMBERS, REALS, refusals

NO_NOISE = (
    "no noise was found (no output NAME with parameters NAME_nominal and NAME_range): the plant is "
    "taken as undisturbed"
)
HEAD = """\
# Drafted by `cosim scenario init` from the FMU's model description.
# Lines with CHECK are guesses that only you can confirm."""
PARAMETERS_OF_NOISE = {
    "nominal": "_nominal",
    "ranges": "_range",
    "time_constant": "_time_constant",
}
"""Field of the scenario's disturbances, and what our own plants call its parameter after NAME."""
COSTS = ("cost", "loss", "objective")
SENSORS_PROPOSED = 12
"""Sensors that a draft proposes at most."""
INPUTS_SHOWN = 12
"""Inputs that a remark names at most."""


@dataclass(frozen=True)
class Roles:
    """Which variables of an FMU play which role in a scenario, by name.

    Attributes:
        states, actions, disturbances: of the plant.
        stage_cost: an output.
    """

    states: tuple[str, ...]
    actions: tuple[str, ...]
    disturbances: tuple[str, ...]
    stage_cost: str


def guess_roles(
    fmu: UnpackedFmu,
    states: Sequence[str] = (),
    actions: Sequence[str] = (),
    stage_cost: str | None = None,
) -> Roles:
    """The roles of an FMU's variables; what is not given is guessed from its model description.

    Args:
        fmu: The FMU.
        states: States, if known; else the continuous states, else outputs with a start parameter.
        actions: Actions, if known; else the real inputs.
        stage_cost: Stage cost, if known; else the output that is called a cost.

    Returns:
        The roles. Disturbances are the outputs D with a parameter D_nominal.

    Raises:
        PlantError: A name is unknown, or a role cannot be guessed; it says what to give.
    """
    named = [*states, *actions]
    if stage_cost:
        named.append(stage_cost)
    for name in named:
        if fmu.variable(name) is None:
            raise PlantError(
                f"FMU '{fmu.path.name}' has no variable '{name}'{suggestion(name, fmu.variables)}"
            )
    # As our own plants name them.
    noise = []
    for name in _reals(fmu, "output"):
        if f"{name}_nominal" in fmu.variables:
            noise.append(name)
    cost = stage_cost or _cost(fmu)
    return Roles(
        states=tuple(states) or tuple(_states(fmu, [*noise, cost])),
        actions=tuple(actions) or tuple(_actions(fmu, noise)),
        disturbances=tuple(noise),
        stage_cost=cost,
    )


def number_roles(
    fmu: UnpackedFmu,
    states: Sequence[str] = (),
    actions: Sequence[str] = (),
    stage_cost: str | None = None,
) -> Roles:
    """Roles to try an FMU with where nobody can guess them; of an array its first element.

    Args:
        fmu: An FMU that is not refused.
        states: States, if known; else all other numbers among the outputs, else the locals.
        actions: Actions, if known; else all numbers among the inputs, else a tunable parameter.
        stage_cost: Stage cost, if known; else the first output that is called a cost, else the
            first output.
    """
    outputs = _number_names(fmu, "output") or _number_names(fmu, "local")
    cost = stage_cost
    if not cost:
        costs = [name for name in outputs if _is_cost(name)]
        cost = costs[0] if costs else outputs[0]
    others = tuple(name for name in outputs if name != cost)
    inputs = _number_names(fmu, "input")
    # One suffices to try the FMU.
    tunable = _number_names(fmu, "parameter", "tunable")[:1]
    return Roles(
        states=tuple(states) or others or outputs,
        actions=tuple(actions) or inputs or tunable,
        disturbances=(),
        stage_cost=cost,
    )


def _number_names(
    fmu: UnpackedFmu,
    causality: str,
    variability: str = "",
) -> tuple[str, ...]:
    """Names of the numbers of a causality, and of a variability if it is given."""
    names = []
    for variable in fmu.variables.values():
        if variable.causality != causality or variable.type in NO_NUMBERS:
            continue
        if not variability or variable.variability == variability:
            first, *_ = elements(variable)
            names.append(first)
    return tuple(names)


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
    model: str | None = None,
) -> str:
    """Text of a scenario file for an FMU, with a remark above each value that needs one.

    Args:
        fmu: A shipped FMU's name, or a path.
        target: Path of the file to be; the FMU's path is written relative to it.
        states: States, if known; see `guess_roles`.
        actions: Actions, if known.
        stage_cost: Stage cost, if known.
        sampling_time: Sampling time in s; without it the FMU's own step size.
        state: Where the search for the steady state begins, (n,); without it the FMU's start.
        action: The same of the actions, (m,).
        model: The controller's model, module:factory.

    Returns:
        The text, TOML.

    Raises:
        PlantError: The FMU cannot be a plant, or something cannot be guessed; it says what to give.
    """
    archive = unpack(fmu)
    for refusal in refusals(archive):
        raise PlantError(refusal)
    roles = guess_roles(archive, states or _known_states(fmu), actions, stage_cost)
    document = first_document(fmu, archive, roles, sampling_time, action)
    document, remarks = _with_what_was_seen(document, archive)
    document, more_remarks = _with_starts(document, archive, state)
    x_start = np.array(document["plant"]["initial_state"])
    u_start = np.array(document["controller"]["reference_action"])
    # Of all start values, those of a steady state: a controller begins there.
    undisturbed = document | {"disturbance": {"law": "none"}}
    with FmuPlant(Scenario.from_dict(undisturbed)) as plant:
        x, u, cost = nearest_steady_state(plant, x_start, u_start)
        units = plant.units
    # A violation of one unit costs some ten times what a sample does, to a power of ten.
    ten_samples = 10 * max(abs(cost), 1.0)
    weight = 10.0 ** ceil(log10(ten_samples) - 0.5)
    document["penalty"]["linear"] = [weight] * len(x)
    document["plant"]["initial_state"] = x.tolist()
    document["controller"] = _reference(x, u, cost)
    if str(fmu) in SHIPPED_FMUS:
        # Of a plant's two FMUs, FMI 2.0 and 3.0, the model is one.
        plant_name = str(fmu).removesuffix("_fmi3")
        model = model or f"controllers.{plant_name}:model"
    if model is not None:
        document["controller"]["model"] = model
        # A controller's scaling wants both bounds of each state; others can do without.
        state_lower, state_upper = _all_limits(archive, roles.states, x)
        document["bounds"] |= {"state_lower": state_lower, "state_upper": state_upper}
    if str(fmu) not in SHIPPED_FMUS:
        # A file on another drive keeps its absolute path.
        with suppress(ValueError):
            path = os.path.relpath(archive.path, target.resolve().parent)
            document["plant"]["fmu"] = Path(path).as_posix()
    remarks = _remarks(document, archive, units) | remarks | more_remarks
    text = with_remarks(tomli_w.dumps(document), remarks)
    return text + _proposed_sensors(document, archive)


def _known_states(fmu: str | Path) -> tuple[str, ...]:
    """The states that a preset on this shipped FMU has: others may be hidden; () if there is none.

    The controller's model, which a draft names for a shipped FMU, has them.
    """
    if str(fmu) not in SHIPPED_FMUS:
        return ()
    for name in presets():
        plant = Scenario.load(name).plant
        if plant.fmu == str(fmu):
            return plant.states
    return ()


def first_document(
    fmu: str | Path,
    archive: UnpackedFmu,
    roles: Roles,
    sampling_time: float | None = None,
    action: Sequence[float] = (),
) -> dict[str, Any]:
    """A scenario's document with the FMU's start values, before any of its code has run.

    No start is mapped; the states' initial values are zero.

    Args:
        fmu: a shipped FMU's name, or a path.
        archive: its content.
        roles: of its variables.
        sampling_time: in s; without it the FMU's own step size.
        action: in place of the FMU's start values, (m,).
    """
    mapping = _mapping(archive, roles.disturbances)
    n = len(roles.states)
    u = _start_vector(archive, roles.actions, action, "action")
    action_lower, action_upper = _all_limits(archive, roles.actions, u)
    state_lower = []
    state_upper = []
    for name in roles.states:
        low, high = archive.range(name)
        state_lower.append(low)
        state_upper.append(high)
    if str(fmu) in SHIPPED_FMUS:
        scenario_name = str(fmu)
        fmu_entry = str(fmu)
    else:
        scenario_name = archive.path.stem
        fmu_entry = archive.path.as_posix()
    description = archive.description
    return {
        "schema": 1,
        "name": scenario_name,
        "description": str(description.description or description.modelName),
        "sampling_time": sampling_time or _sampling_time(archive, mapping),
        "discount": 0.99,
        "plant": {
            "fmu": fmu_entry,
            "states": list(roles.states),
            "actions": list(roles.actions),
            "disturbances": list(roles.disturbances),
            "stage_cost": roles.stage_cost,
            "initial_state": [0.0] * n,
            "mapping": mapping,
        },
        "disturbance": _disturbance(archive, mapping),
        "bounds": {
            "state_lower": state_lower,
            "state_upper": state_upper,
            "action_lower": action_lower,
            "action_upper": action_upper,
        },
        "penalty": {
            "linear": [1.0] * n,
            "quadratic": [1.0] * n,
        },
        "controller": _reference(np.zeros(n), u, 0.0),
    }


def _disturbance(fmu: UnpackedFmu, mapping: Mapping[str, Any]) -> dict[str, Any]:
    """The table of the disturbances, by the start values of the parameters that set them."""
    # A law has means and ranges: where one is missing nothing can be drawn.
    if "nominal" not in mapping or "ranges" not in mapping:
        return {"law": "none"}
    # The first of the FMU's laws; one without a choice of laws is taken to draw uniformly.
    law_codes = mapping.get("law_codes", {"uniform": 1})
    table: dict[str, Any] = {"law": next(iter(law_codes))}
    for field in ("nominal", "ranges", "time_constant"):
        parameters = mapping.get(field, ())
        table[field] = [start_value(fmu, name) for name in parameters]
    # All zero are none: each sample is drawn anew.
    if not any(table["time_constant"]):
        del table["time_constant"]
    return table


def _with_what_was_seen(
    document: dict[str, Any], archive: UnpackedFmu
) -> tuple[dict[str, Any], dict[str, str]]:
    """The document with what a probe of the FMU found, and remarks on it.

    Only what differs from a scenario's defaults is written: outputs that doStep computes, the
    start time and tolerance that the file states, a stop time without which it does not run.
    """
    undisturbed = document | {"disturbance": {"law": "none"}}
    report = probe(Scenario.from_dict(undisturbed))
    plant = dict(document["plant"])
    remarks: dict[str, str] = {}
    # It stands last, as a table of its own.
    mapping = plant.pop("mapping")
    kinds = set(report.kinds.values())
    if report.outputs == "after-step" and kinds & set(AFTER):
        plant["outputs"] = report.outputs
        remarks["plant.outputs"] = _outputs_remark(report)
    experiment = report.experiment
    if experiment.start_time != 0.0:
        plant["start_time"] = experiment.start_time
        remarks["plant.start_time"] = "s; the FMU's own; CHECK: the time at which a run begins"
    if experiment.stop_time is not None:
        plant["stop_time"] = experiment.stop_time
        remarks["plant.stop_time"] = (
            "s; the FMU's own, without which it does not run; CHECK: no run goes beyond it"
        )
    if experiment.tolerance is not None:
        plant["tolerance"] = experiment.tolerance
        remarks["plant.tolerance"] = "relative, of the FMU's solver; the FMU's own"
    if report.still:
        remarks["plant.actions"] = _actions_remark(report, archive)
    if report.undriven:
        remarks["plant.parameters"] = _inputs_remark(report)
    if report.restart is not Restart.RESET:
        remarks["plant.fmu"] = f"each episode: {report.restart.value}, since no reset was proven"
    plant["mapping"] = mapping
    return document | {"plant": plant}, remarks


def _actions_remark(report: ProbeReport, archive: UnpackedFmu) -> str:
    """Which actions move no state, and what may be why."""
    nothing = [name for name, moves_output in report.still.items() if not moves_output]
    alone = ""
    if nothing:
        alone = f", no output either by {', '.join(nothing)},"
    # A truth among the inputs is often a switch that enables the others.
    switches = [name for name in report.undriven if archive.variables[name].type == "Boolean"]
    enable = ""
    if switches:
        enable = f" such as {', '.join(switches)}"
    return (
        f"CHECK: no state moves by {', '.join(report.still)}{alone} as things are; an input"
        f"{enable} may have to be set by plant.parameters first"
    )


def _inputs_remark(report: ProbeReport) -> str:
    """Which inputs nobody drives."""
    pairs = [f"{name} = {start or '?'}" for name, start in report.undriven.items()]
    inputs = ", ".join(pairs[:INPUTS_SHOWN])
    n_hidden = len(pairs) - INPUTS_SHOWN
    if n_hidden > 0:
        inputs += f" and {n_hidden} more"
    return f"CHECK: nobody drives {inputs}: what plant.parameters sets in their place stays"


def _outputs_remark(report: ProbeReport) -> str:
    """Findings about the outputs that doStep computes."""
    ends = [name for name, kind in report.kinds.items() if kind is OutputKind.END]
    if not ends:
        return "doStep computes the outputs: they are read after it"
    return (
        f"doStep computes the outputs; CHECK: {', '.join(ends)} belongs to the end of a sample, so "
        "that figures that need it at its begin are refused"
    )


def _with_starts(
    document: dict[str, Any],
    archive: UnpackedFmu,
    state: Sequence[float],
) -> tuple[dict[str, Any], dict[str, str]]:
    """The document with the parameters that set the states' starts, and remarks on them."""
    states = document["plant"]["states"]
    parameters = start_parameters(Scenario.from_dict(document), archive)
    missing = [name for name in states if name not in parameters]
    remarks = {}
    if missing and parameters:
        pairs = [f"{parameter} for {name}" for name, parameter in parameters.items()]
        remarks["plant.mapping"] = (
            f"CHECK: no start was found for {', '.join(missing)}, so that an episode starts where "
            f"the FMU does; what was found may go into plant.parameters: {', '.join(pairs)}"
        )
    # Where no parameter sets a state's start, its own start value tells where it begins.
    starts = [parameters.get(name, name) for name in states]
    initial_state = _start_vector(archive, starts, state, "state")
    plant = dict(document["plant"])
    plant["initial_state"] = initial_state.tolist()
    # The starts of some states alone are of no use: an episode begins at all of them.
    if not missing:
        plant["mapping"] = {"initial_state": starts} | plant["mapping"]
    return document | {"plant": plant}, remarks


def _reference(
    x: Array,
    u: Array,
    cost: float,
) -> dict[str, Any]:
    return {
        "reference_state": x.tolist(),
        "reference_action": u.tolist(),
        "reference_cost": cost,
    }


def _start_vector(
    fmu: UnpackedFmu,
    names: Sequence[str],
    values: Sequence[float],
    option: str,
) -> Array:
    """The values of an option, else the FMU's start values."""
    if not values:
        values = [start_value(fmu, name) for name in names]
    elif len(values) != len(names):
        raise PlantError(
            f"--{option} takes {len(names)} numbers ({', '.join(names)}), not {len(values)}"
        )
    return np.array(values, dtype=float)


def start_value(fmu: UnpackedFmu, name: str) -> float:
    """Start value of a variable or an array's element.

    Args:
        fmu: states it.
        name: of the variable, or of the element, ``NAME[i,j]``.

    Returns:
        The value; 0 where the FMU states none.
    """
    variable = fmu.variable(name)
    if variable is None:
        return 0.0
    stated = str(variable.start or "").split()
    if not stated:
        return 0.0
    # One number is that of every element.
    if not variable.shape or len(stated) == 1:
        return number(stated[0], 0.0)
    # The elements stand row by row.
    brackets = name.removeprefix(variable.name)
    words = brackets.removeprefix("[").removesuffix("]").split(",")
    index = [int(word) for word in words]
    element = int(np.ravel_multi_index(index, variable.shape))
    return number(stated[element], 0.0)


def limits_of(
    fmu: UnpackedFmu,
    name: str,
    value: float,
) -> tuple[float, float]:
    """Range of a variable: the FMU's, and where it states none, `value` ± its magnitude.

    A bound that is no bound (`UnpackedFmu.range`) counts as not stated.

    Args:
        fmu: states the range.
        name: of the variable.
        value: its start value, or that of a steady state.
    """
    low, high = fmu.range(name)
    # A start value may lie beyond the range, and then neither bound would hold it.
    centre = min(max(value, low), high)
    reach = abs(centre) or 1.0
    lower = low if isfinite(low) else centre - reach
    upper = high if isfinite(high) else centre + reach
    return lower, upper


def _all_limits(
    fmu: UnpackedFmu,
    names: Sequence[str],
    values: Array,
) -> tuple[list[float], list[float]]:
    """Lower and upper limits of variables (`limits_of`) about their values."""
    lower = []
    upper = []
    for name, value in zip(names, values.tolist(), strict=True):
        low, high = limits_of(fmu, name, value)
        lower.append(low)
        upper.append(high)
    return lower, upper


def _sampling_time(fmu: UnpackedFmu, mapping: Mapping[str, Any]) -> float:
    # The grid of the FMU's own disturbances, if it has one, is the sampling time.
    stated = start_value(fmu, mapping.get("sampling_time", ""))
    if not stated:
        experiment = fmu.description.defaultExperiment
        stated = number(getattr(experiment, "stepSize", None), 0.0)
    if not stated > 0:
        raise PlantError(f"FMU '{fmu.path.name}' states no step size; give --sampling-time SECONDS")
    return stated


def _remarks(
    document: dict[str, Any],
    fmu: UnpackedFmu,
    units: Mapping[str, str],
) -> dict[str, str]:
    """Remark on each field and table by its dotted name."""
    plant = document["plant"]
    with_units = [f"{name} [{unit}]" for name, unit in units.items() if unit]
    remarks = {
        "sampling_time": "s; CHECK",
        "plant": "; ".join(with_units),
        "plant.stage_cost": "CHECK: a cost, not a profit",
        "plant.mapping": "each reset writes these; what the FMU has no parameter for is left out",
        "bounds": "CHECK: states are bounded softly, by the penalty, actions hard; from min and "
        "max",
        "penalty": "per unit of violation and sample; CHECK: must outweigh what it saves",
        "controller": "the undisturbed plant's steady state nearest to its start values; "
        "`cosim tuning` prints the cheapest one",
    }
    remarks |= _remarks_of_limits(document, fmu)
    if "initial_state" not in plant["mapping"]:
        remarks["controller"] = "CHECK: the plant as it starts; it can start nowhere else"
    if document["disturbance"]["law"] == "none":
        remarks["disturbance"] = f"CHECK: {NO_NOISE}"
    elif "law" not in plant["mapping"]:
        remarks["disturbance"] = "CHECK: the FMU has no choice of laws; this one is a guess"
    elif "time_constant" in plant["mapping"] and "time_constant" not in document["disturbance"]:
        example = [300.0] * len(plant["disturbances"])
        remarks["disturbance"] = (
            "CHECK: drawn anew each sample; what disturbs a plant mostly has a memory, in s for "
            f"each disturbance: time_constant = {example}"
        )
    if "model" not in document["controller"]:
        remarks["controller"] += '; add model = "my_plant:model", a model in CasADi'
    return remarks


def _proposed_sensors(
    document: Mapping[str, Any],
    fmu: UnpackedFmu,
) -> str:
    """Sensors of the states and the other outputs as comments: which there are, only a user knows.

    Args:
        document: of the draft, at its steady state.
        fmu: the FMU.
    """
    plant = document["plant"]
    values = dict(zip(plant["states"], plant["initial_state"], strict=True))
    taken = {*plant["disturbances"], plant["stage_cost"]}
    for name in _reals(fmu, "output"):
        if name not in taken:
            values.setdefault(name, start_value(fmu, name))
    lines = [
        "",
        "# CHECK: without sensors a controller is given each state, exactly, at each sample.",
        "# What is measured instead, an estimator makes a state of: take away the # of those that",
        "# there are. A slow one has every = 15 and delay = 15, in samples.",
    ]
    for name, value in list(values.items())[:SENSORS_PROPOSED]:
        # A transmitter's error is about a hundredth of what it reads.
        deviation = float(f"{abs(value) / 100:.1g}")
        unit = fmu.unit(name)
        remark = f" # {unit}; CHECK" if unit else " # CHECK"
        lines += [
            "#",
            "# [[sensor]]",
            f"# variable = {json.dumps(name)}",
            f"# deviation = {deviation}{remark}",
        ]
    return "\n".join([*lines, ""])


def with_remarks(text: str, remarks: Mapping[str, str]) -> str:
    """TOML text with each remark as a comment above the key or table of its dotted name.

    Args:
        text: TOML.
        remarks: by dotted name; one on a key that the text does not have stands above its table.
    """
    # Dotted name of the key or table of each line.
    names = []
    table = ""
    for line in text.splitlines():
        if line.startswith("["):
            table = line.strip("[]")
            names.append(table)
        else:
            key = line.partition(" =")[0]
            names.append(f"{table}.{key}" if table else key)
    above: dict[str, list[str]] = defaultdict(list)
    for name, remark in remarks.items():
        place = name
        if name not in names:
            place, _, _ = name.rpartition(".")
        # A comment of 100 columns; a name with a hyphen stays whole, so that one can search it.
        for words in textwrap.wrap(remark, 98, break_on_hyphens=False):
            above[place].append(f"# {words}")
    lines = [HEAD, ""]
    for name, line in zip(names, text.splitlines(), strict=True):
        # Once: a key may stand in the text again, in a list of tables.
        lines += above.pop(name, [])
        lines.append(line)
    return "\n".join([*lines, ""])


def _reals(fmu: UnpackedFmu, causality: str) -> list[str]:
    """Names of the scalar reals of a causality."""
    names = []
    for name, variable in fmu.variables.items():
        is_scalar_real = variable.type in REALS and not variable.shape
        if variable.causality == causality and is_scalar_real:
            names.append(name)
    return names


def _cost(fmu: UnpackedFmu) -> str:
    """The one output that is called a cost."""
    outputs = _reals(fmu, "output")
    if not outputs:
        raise PlantError(f"FMU '{fmu.path.name}' has no scalar real output to draft from")
    costs = [name for name in outputs if _is_cost(name)]
    if len(costs) == 1:
        return costs[0]
    which = "none is called a cost"
    if costs:
        which = f"{' and '.join(costs)} could be"
    raise PlantError(
        f"FMU '{fmu.path.name}' does not say which output is the stage cost ({which}); give "
        f"--cost NAME, one of {', '.join(outputs)}"
    )


def _is_cost(name: str) -> bool:
    return any(word in name.lower() for word in COSTS)


def _states(fmu: UnpackedFmu, others: Sequence[str]) -> list[str]:
    """Continuous states, else outputs with a start parameter."""
    # FMI marks the rate of a continuous state, which names it.
    continuous = []
    for variable in fmu.variables.values():
        if getattr(variable, "derivative", None) is not None:
            continuous += elements(variable.derivative)
    if continuous:
        # Two rates may name one array.
        return list(dict.fromkeys(continuous))
    outputs = _reals(fmu, "output")
    started = []
    for name in outputs:
        if name not in others and any(candidates(fmu, name)):
            started.append(name)
    if started:
        return started
    raise PlantError(
        f"FMU '{fmu.path.name}' does not say what its state is (no derivatives, no start "
        f"parameters); give --states A,B,…, of {', '.join(outputs)}"
    )


def elements(variable: Any) -> list[str]:
    """Name of a variable, or of each element of an array, `NAME[i,j]`, row by row."""
    if not variable.shape:
        return [str(variable.name)]
    indices = np.ndindex(*variable.shape)
    names = []
    for index in indices:
        positions = ",".join(map(str, index))
        names.append(f"{variable.name}[{positions}]")
    return names


def _actions(fmu: UnpackedFmu, noise: Sequence[str]) -> list[str]:
    """Real inputs, but for an input D_in beside an output D: it takes the disturbance's place."""
    inputs = []
    for name in _reals(fmu, "input"):
        if name.removesuffix("_in") not in noise:
            inputs.append(name)
    if inputs:
        return inputs
    # Most tunable parameters are no actuators: which of them is, the user has to say.
    tunable = []
    for name in _reals(fmu, "parameter"):
        if fmu.variables[name].variability == "tunable":
            tunable.append(name)
    cure = ""
    if tunable:
        cure = f"; give --actions A,B,…, of its tunable {', '.join(tunable)}"
    raise PlantError(f"FMU '{fmu.path.name}' has no real input to act on{cure}")


def _mapping(fmu: UnpackedFmu, noise: Sequence[str]) -> dict[str, Any]:
    """What a reset can write beside the states' starts, by the names of our own plants."""
    known = fmu.variables

    def is_parameter(name: str, types: Sequence[str]) -> bool:
        variable = known.get(name)
        if variable is None or variable.shape:
            return False
        return variable.type in types and variable.causality == "parameter"

    table: dict[str, Any] = {}
    if is_parameter("seed", INTEGERS):
        words = ["seed"]
        if is_parameter("seedHigh", INTEGERS):
            words.append("seedHigh")
        table["seed"] = words
    if is_parameter("sampling_time", REALS):
        table["sampling_time"] = "sampling_time"
    if is_parameter("stochastic", ("Boolean",)):
        table["stochastic"] = "stochastic"
    declared = getattr(known.get("law"), "declaredType", None)
    items = getattr(declared, "items", None) or []
    codes = {}
    for item in items:
        # The laws that a scenario knows.
        if item.name in ("uniform", "normal"):
            codes[item.name] = int(item.value)
    if codes and is_parameter("law", ("Enumeration",)):
        table["law"] = "law"
        table["law_codes"] = codes
    # Means and ranges of all disturbances, or of none: a scenario has an entry for each.
    for field, suffix in PARAMETERS_OF_NOISE.items():
        parameters = [f"{name}{suffix}" for name in noise]
        if parameters and all(is_parameter(name, REALS) for name in parameters):
            table[field] = parameters
    return table


def _remarks_of_limits(document: dict[str, Any], fmu: UnpackedFmu) -> dict[str, str]:
    """Remark on each list of bounds of which the FMU does not state all."""
    plant = document["plant"]
    remarks = {}
    # Without a model a state may well have one bound alone, or none.
    has_model = "model" in document["controller"]
    half_bounded = _half_bounded(fmu, plant["states"])
    unbounded = [name for name in half_bounded if not any(map(isfinite, fmu.range(name)))]
    if has_model and half_bounded:
        remarks["bounds.state_lower"] = _guessed_limits(half_bounded, "steady")
    elif unbounded:
        remarks["bounds.state_lower"] = f"CHECK: the FMU states no bound of {', '.join(unbounded)}"
    # An action is sampled between two.
    open_ended = _half_bounded(fmu, plant["actions"])
    if open_ended:
        remarks["bounds.action_lower"] = _guessed_limits(open_ended, "start")
    return remarks


def _half_bounded(fmu: UnpackedFmu, names: Sequence[str]) -> list[str]:
    """Those of the variables that the FMU does not bound on both sides."""
    return [name for name in names if not all(map(isfinite, fmu.range(name)))]


def _guessed_limits(names: Sequence[str], value: str) -> str:
    """Remark on the limits of variables, which are about their `value`."""
    return (
        f"CHECK: the FMU does not bound {', '.join(names)} on both sides; what is missing "
        f"is its {value} value ± its magnitude"
    )


DIFFERENCE = 1e-5
"""Finite differences, as a share of a variable's scale."""
LOOSE = 1e-6
"""Residual, as a share of the scales, that a search may end with."""


def nearest_steady_state(
    plant: FmuPlant,
    state: Array,
    action: Array,
) -> tuple[Array, Array, float]:
    """Steady state x = Φ(x, u) of the undisturbed plant near a state and an action.

    Both x and u move in their scales, within the plant's ranges, by least squares in a trust
    region. A plant that starts where it likes is taken as it starts.

    Args:
        plant: The plant, without noise.
        state: Where the search begins, (n,).
        action: The same of the actions, (m,).

    Returns:
        x, u and the stage cost there.

    Raises:
        PlantError: There is no steady state near the start.
    """
    # A plant that cannot start elsewhere cannot be searched.
    if not plant.scenario.plant.mapping.initial_state:
        x = plant.reset(0)
        cost = plant.step(action).stage_cost
        return x, action, cost
    n = len(state)
    low, high = plant.state_range
    lower = np.concatenate([low, plant.scenario.action_lower])
    upper = np.concatenate([high, plant.scenario.action_upper])
    start = np.concatenate([state, action])
    # A variable that starts at zero has a scale, too.
    scale: Array = np.maximum(np.abs(start), 1e-2)

    def residual(z: Array) -> Array:
        """Change of the states in a sample, in their scales, (n,)."""
        x = z[:n]
        u = z[n:]
        plant.reset(0, x)
        movement = plant.step(u).s - x
        return movement / scale[:n]

    start = np.clip(start, lower, upper)
    # SciPy's own warnings, of a step that is lost.
    with np.errstate(divide="ignore", invalid="ignore"):
        result = least_squares(
            residual,
            start,
            jac="3-point",
            bounds=(lower, upper),
            x_scale=scale,
            diff_step=DIFFERENCE,
            # It ends where the gradient vanishes, and not where its steps are short.
            gtol=1e-15,
            ftol=None,
            xtol=None,
        )
    z = result.x
    errors = np.abs(result.fun)
    residual_left = float(np.max(errors))
    if residual_left > LOOSE:
        raise PlantError(
            f"FMU '{plant.fmu_path.name}' has no steady state near its start values (a sample "
            f"still moves a state by {residual_left:.2g} of its scale); give other start "
            "values by --state and --action"
        )
    x = z[:n]
    u = z[n:]
    plant.reset(0, x)
    cost = plant.step(u).stage_cost
    return x, u, cost
