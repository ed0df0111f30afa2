"""Guesses from an FMU's model description what a scenario names: states, actions, cost, noise."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from cosim.errors import PlantError
from cosim.plant.archive import UnpackedFmu
from cosim.validation import suggestion

REALS = ("Real", "Float64", "Float32")
INTEGERS = ("Integer", "Int32", "UInt32", "Int64", "UInt64")
CODES = (*INTEGERS, "Enumeration")
COSTS = ("cost", "loss", "objective")
LAWS = ("uniform", "normal")
SEEDS = (("seed",), ("seed", "seedHigh"), ("seed", "seed_high"), ("random_seed",), ("rng_seed",))
SAMPLINGS = ("sampling_time", "sample_time", "samplingTime", "sampleTime")
SWITCHES = ("stochastic", "noise", "noisy")


@dataclass(frozen=True)
class Roles:
    """The variables of an FMU by what a scenario uses them for, with the words that led there.

    `mapping` is the table `[plant.mapping]`; `reasons` says of each field why it is as it is.
    """

    states: tuple[str, ...]
    actions: tuple[str, ...]
    disturbances: tuple[str, ...]
    stage_cost: str
    mapping: Mapping[str, Any]
    reasons: Mapping[str, str]


def guess_roles(
    fmu: UnpackedFmu,
    states: Sequence[str] = (),
    actions: Sequence[str] = (),
    stage_cost: str | None = None,
) -> Roles:
    """Guess the roles of an FMU's variables; what is given is taken as it is.

    Raises PlantError, which says what to give, where nothing or too much could be meant.
    """
    known = {variable.name: variable for variable in fmu.description.modelVariables}
    for name in (*states, *actions, *([stage_cost] if stage_cost else [])):
        if name not in known:
            raise PlantError(
                f"FMU '{fmu.path.name}' has no variable '{name}'{suggestion(name, known)}"
            )
    reasons = {}
    noise = tuple(n for n in _reals(known, "output") if f"{n}_nominal" in known)
    if noise:
        reasons["disturbances"] = "outputs that have a parameter NAME_nominal"
    cost = stage_cost or _cost(fmu, known)
    reasons["stage_cost"] = "as given" if stage_cost else "the output that is called so"
    found_states = tuple(states)
    reasons["states"] = "as given"
    if not found_states:
        found_states, reasons["states"] = _states(fmu, known, (*noise, cost))
    found_actions = tuple(actions)
    reasons["actions"] = "as given"
    if not found_actions:
        inputs = _reals(known, "input")
        # An input D_in beside an output D takes the disturbance's place: it is no actuator.
        found_actions = tuple(n for n in inputs if n.removesuffix("_in") not in noise)
        reasons["actions"] = "the real inputs"
        if len(found_actions) < len(inputs):
            reasons["actions"] += ", but for those that replace a disturbance"
    if not found_actions:
        raise PlantError(
            f"FMU '{fmu.path.name}' has no real input to act on; name tunable parameters by "
            "--actions"
        )
    mapping = _mapping(known, found_states, noise)
    return Roles(found_states, found_actions, noise, cost, mapping, reasons)


def _reals(known: Mapping[str, Any], causality: str) -> list[str]:
    return [
        name
        for name, variable in known.items()
        if variable.causality == causality and variable.type in REALS and not variable.shape
    ]


def _cost(fmu: UnpackedFmu, known: Mapping[str, Any]) -> str:
    outputs = _reals(known, "output")
    found = [name for name in outputs if any(word in name.lower() for word in COSTS)]
    if len(found) == 1:
        return found[0]
    which = f"{' and '.join(found)} could be" if found else "none is called a cost"
    raise PlantError(
        f"FMU '{fmu.path.name}' does not say which output is the stage cost ({which}); give "
        f"--cost NAME, one of {', '.join(outputs) or 'no outputs'}"
    )


def _states(
    fmu: UnpackedFmu, known: Mapping[str, Any], others: Iterable[str]
) -> tuple[tuple[str, ...], str]:
    """Continuous states, else outputs with a start parameter."""
    derived = [
        variable.derivative.name
        for variable in known.values()
        if getattr(variable, "derivative", None) is not None
    ]
    if derived:
        return tuple(dict.fromkeys(derived)), "the continuous states"
    outputs = [name for name in _reals(known, "output") if name not in others]
    started = [name for name in outputs if f"{name}_start" in known]
    if started:
        return tuple(started), "outputs that have a parameter NAME_start"
    raise PlantError(
        f"FMU '{fmu.path.name}' does not say what its state is (no derivatives, no parameters "
        f"NAME_start); give --states A,B,…, of {', '.join(outputs) or 'no outputs'}"
    )


def _mapping(
    known: Mapping[str, Any], states: Sequence[str], noise: Sequence[str]
) -> dict[str, Any]:
    """What a reset can write."""

    def of(name: str, types: Sequence[str]) -> bool:
        return name in known and known[name].type in types and known[name].causality == "parameter"

    table: dict[str, Any] = {}
    starts = [f"{name}_start" for name in states]
    if all(of(name, REALS) for name in starts):
        table["initial_state"] = starts
    elif all(known[name].initial in ("exact", "approx") for name in states):
        table["initial_state"] = list(states)
    seeds = [words for words in SEEDS if all(of(word, INTEGERS) for word in words)]
    if seeds:
        table["seed"] = list(max(seeds, key=len))
    for field, names, types in (
        ("sampling_time", SAMPLINGS, REALS),
        ("stochastic", SWITCHES, ("Boolean",)),
        ("law", ("law", "distribution"), CODES),
    ):
        if found := [name for name in names if of(name, types)]:
            table[field] = found[0]
    if codes := _law_codes(known.get(table.get("law", ""))):
        table["law_codes"] = codes
    else:
        table.pop("law", None)
    for field, suffix in (("nominal", "_nominal"), ("ranges", "_range")):
        parameters = [f"{name}{suffix}" for name in noise]
        if parameters and all(of(name, REALS) for name in parameters):
            table[field] = parameters
    return table


def _law_codes(variable: Any) -> dict[str, int]:
    """Numbers of the laws that an enumeration names as the benchmark does."""
    declared = getattr(variable, "declaredType", None)
    items = getattr(declared, "items", None) or []
    return {item.name: int(item.value) for item in items if item.name in LAWS}
