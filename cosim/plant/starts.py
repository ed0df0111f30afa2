"""Which parameter sets where a state starts: guessed by its name, then proven on the FMU."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterator, Sequence

from cosim.core.errors import PlantError
from cosim.core.scenario import Scenario
from cosim.plant.fmi import Order, Reading, UnpackedFmu, number
from cosim.plant.wiring import REALS, Wiring, has_start

START_WORDS = ("start", "init", "initial", "ini", "initialvalue", "startvalue", "t0", "0")
"""Words that tools add to a state's name: `c_start` (Modelica), `T0` (20-sim), `xInit`."""
PROBED = 1e-3
"""Share of a state's scale by which a probe moves its start."""
AGREES = 1e-6
"""Share of that move by which the initial state may miss the value that was asked for."""


def start_parameters(scenario: Scenario, fmu: UnpackedFmu) -> dict[str, str]:
    """The variable that sets each state's start, by the state's name.

    A guess counts only if the FMU, initialised with it, starts at the value that was asked for. A
    state for which no guess does is left out. This runs the FMU's native code.

    Args:
        scenario: Names the states, actions and stage cost; its mapping is not used.
        fmu: The scenario's FMU.

    Returns:
        By state a parameter, or the state itself where its own start value can be set.

    Raises:
        PlantError: The FMU does not run as this scenario's plant.
    """
    states = scenario.plant.states
    # Where the FMU starts by itself.
    values_at_start = _initial_states(scenario, fmu, {}, ())
    initial = dict(zip(states, values_at_start, strict=True))
    parameters: dict[str, str] = {}
    values: dict[str, float] = {}
    for state in states:
        for candidate in candidates(fmu, state):
            # One that sets another state's start already.
            if candidate in parameters.values():
                continue
            # Another start than its own: a parameter without effect would seem to set that.
            value = _start_that_moves(fmu, state, candidate, initial[state])
            if _starts_at(scenario, fmu, {state: candidate}, {state: value}):
                parameters[state] = candidate
                values[state] = value
                break
    # One parameter may move another state as well: all of them together must do as asked.
    if len(parameters) > 1 and not _starts_at(scenario, fmu, parameters, values):
        return {}
    return parameters


def candidates(fmu: UnpackedFmu, state: str) -> Iterator[str]:
    """Names of variables that may set a state's start, the likeliest first.

    The start of `reactor.medium.T[2]` may be `reactor.medium.T_start[2]`, `reactor.T_start[2]`, or
    `T_start[2]`, with any of `START_WORDS`; last comes the state's own start value.

    Args:
        fmu: has the variables.
        state: name of the state.
    """
    path, base, index = split_name(state)
    # Settable variables by where they stand, path and index, with their bases.
    settable: dict[tuple[str, str], list[tuple[str, str]]] = defaultdict(list)
    for name, variable in fmu.variables.items():
        if name == state:
            continue
        if variable.causality not in ("parameter", "structuralParameter"):
            continue
        if variable.type in REALS and not variable.shape:
            other_path, other_base, other_index = split_name(name)
            settable[other_path, other_index].append((name, other_base))
    # From the state's own component outwards.
    while True:
        beside = settable[path, index]
        for word in START_WORDS:
            for name, other_base in beside:
                if _has_word(other_base, base, word):
                    yield name
        if not path:
            break
        component = path.removesuffix(".")
        path, _, _ = split_name(component)
    variable = fmu.variable(state)
    if variable is not None and has_start(variable):
        yield state


def split_name(name: str) -> tuple[str, str, str]:
    """Path with its last dot, base and index of a variable: `a[1].`, `T` and `[2]` of `a[1].T[2]`.

    Dots inside brackets and quotes part nothing.
    """
    # What is quoted, what is in brackets, a dot, other text, or a sign that closes nothing.
    pieces = re.findall(r"'[^']*'|\[[^\]]*\]|\.|[^.'\[]+|.", name)
    path: list[str] = []
    rest: list[str] = []
    for piece in pieces:
        rest.append(piece)
        if piece == ".":
            path += rest
            rest = []
    index = ""
    # A name may begin with a bracket.
    if len(rest) > 1 and rest[-1].startswith("["):
        index = rest.pop()
    return "".join(path), "".join(rest), index


def _has_word(
    name: str,
    base: str,
    word: str,
) -> bool:
    """Whether a name is the base with the word added: `T_start`, `TStart`, `startT`, `start_T`."""
    plain = name.replace("_", "").lower()
    stem = base.replace("_", "").lower()
    if plain == stem + word:
        return True
    return plain == word + stem and word.isalpha()


def _starting_by(
    scenario: Scenario,
    parameters: dict[str, str],
    values: Sequence[float],
) -> Scenario:
    """The scenario with these states alone, or with all of them and no start to be set."""
    plant = scenario.plant
    kept = []
    for i, name in enumerate(plant.states):
        if not parameters or name in parameters:
            kept.append(i)
    document = scenario.to_dict()
    # Every list with an entry for each state.
    for table, field in (
        ("plant", "states"),
        ("plant", "initial_state"),
        ("bounds", "state_lower"),
        ("bounds", "state_upper"),
        ("penalty", "linear"),
        ("penalty", "quadratic"),
        ("controller", "reference_state"),
    ):
        entries = document[table][field]
        document[table][field] = [entries[i] for i in kept]
    table_of_plant = document["plant"]
    names = []
    if parameters:
        table_of_plant["initial_state"] = list(values)
        for i in kept:
            state = plant.states[i]
            names.append(parameters[state])
    # Nothing else is set: no noise may move the start.
    table_of_plant["mapping"] = {"initial_state": names}
    table_of_plant["disturbances"] = []
    document["disturbance"] = {"law": "none"}
    return Scenario.from_dict(document)


def _initial_states(
    scenario: Scenario,
    fmu: UnpackedFmu,
    parameters: dict[str, str],
    values: Sequence[float],
) -> list[float]:
    """States of a new instance whose parameters have these values, after its initialisation."""
    wiring = Wiring(_starting_by(scenario, parameters, values), fmu)
    instance = wiring.interface(
        fmu,
        (wiring.inputs, wiring.outputs, wiring.states),
        wiring.starts,
        scenario.sampling_time,
        Reading(Order.SET_STEP_GET),
        wiring.experiment,
        None,
    )
    try:
        instance.initialise(started=False)
        return list(instance.states)
    finally:
        instance.close([])


def _starts_at(
    scenario: Scenario,
    fmu: UnpackedFmu,
    parameters: dict[str, str],
    values: dict[str, float],
) -> bool:
    """Whether the FMU starts at these values of the states once the parameters have them."""
    names = [name for name in scenario.plant.states if name in parameters]
    asked = [values[name] for name in names]
    try:
        reached = _initial_states(scenario, fmu, parameters, asked)
    except PlantError:
        return False
    for name, state, value in zip(names, reached, asked, strict=True):
        miss = abs(state - value)
        # Written so that no number is a miss, too.
        if not miss <= AGREES * _move(fmu, name, value):
            return False
    return True


def _move(
    fmu: UnpackedFmu,
    state: str,
    value: float,
) -> float:
    """By how much a probe moves a state's start."""
    stated = getattr(fmu.variable(state), "nominal", None)
    nominal = number(stated, 0.0)
    # A state that starts at zero has a scale, too.
    scale = max(abs(value), abs(nominal), 1e-3)
    return PROBED * scale


def _start_that_moves(
    fmu: UnpackedFmu,
    state: str,
    parameter: str,
    initial: float,
) -> float:
    """A start beside the initial one, within the range of the state and of the parameter."""
    move = _move(fmu, state, initial)
    state_low, state_high = fmu.range(state)
    parameter_low, parameter_high = fmu.range(parameter)
    low = max(state_low, parameter_low)
    high = min(state_high, parameter_high)
    for value in (initial + move, initial - move):
        if low <= value <= high:
            return value
    return initial + move
