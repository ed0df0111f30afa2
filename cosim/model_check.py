"""Comparison of an FMU with a controller's model at random points."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from math import inf
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from controllers.errors import ModelError
from controllers.model import Model, discretise, economic_cost
from controllers.problem import load_model
from cosim.core.errors import PlantError
from cosim.core.protocols import Array
from cosim.core.scenario import Scenario
from cosim.plant.draft import first_document, guess_roles, start_value
from cosim.plant.fmi import SHIPPED_FMUS, UnpackedFmu, unpack
from cosim.plant.fmu_plant import FmuPlant
from cosim.plant.probe import OutputKind, probe
from cosim.plant.starts import start_parameters
from fmus.states import continuous_states

AGREEMENT = 1e-3
"""Largest difference, as a share of what the quantity varies, at which FMU and model agree."""
SHARE_OF_START = 0.2
"""Half width of the points about a start value, as a share of it, where no bounds are given."""
ACCURATE = 1e-9
"""Relative error to which the model is integrated over a sample."""
MOST_SUBSTEPS = 8192


@dataclass(frozen=True)
class ModelDifference:
    """The largest difference between FMU and model in one quantity.

    Attributes:
        name: What was compared: the state a sample later, the cost or an output.
        unit: Of its values.
        difference: Largest absolute difference.
        share: The same as a share of what the FMU's values vary over the points; of a state, of
            the most that it moves in a sample.
        fmu: The FMU's value there.
        model: The model's value there.
        where: The point: states, actions and disturbances by name.
    """

    name: str
    unit: str
    difference: float
    share: float
    fmu: float
    model: float
    where: Mapping[str, float]

    def __str__(self) -> str:
        point = ", ".join(f"{name} = {value:.5g}" for name, value in self.where.items())
        # "1" is FMI's unit of a number without dimension.
        unit = "" if self.unit in ("", "1") else f" {self.unit}"
        return (
            f"{self.name}: differs by at most {self.difference:.3g}{unit} "
            f"({100 * self.share:.3g} % of what it varies): FMU {self.fmu:.6g}, model "
            f"{self.model:.6g} at {point}"
        )


@dataclass(frozen=True)
class ModelCheck:
    """Result of `check_model`.

    Attributes:
        agrees: Whether every difference is at most `tolerance` of what the quantity varies.
        tolerance: That share.
        points: Number of points that were compared.
        differences: One for each state, the cost and each of the model's outputs.
        remarks: What else differs, or was left out.
    """

    agrees: bool
    tolerance: float
    points: int
    differences: tuple[ModelDifference, ...]
    remarks: tuple[str, ...]

    @property
    def verdict(self) -> str:
        """The answer in a line."""
        if self.agrees:
            return f"FMU and model agree at {self.points} points"
        wrong = []
        for item in self.differences:
            # Written so that no number differs, too.
            if not item.share <= self.tolerance:
                wrong.append(item.name)
        return f"FMU and model differ in {', '.join(wrong)}"

    def to_dict(self) -> dict[str, Any]:
        """The same as numbers, words and lists, for JSON."""
        return asdict(self) | {"verdict": self.verdict}


def check_model(
    fmu: str | Path,
    model: Model | str,
    *,
    scenario: Scenario | str | Path | None = None,
    states: Sequence[str] = (),
    actions: Sequence[str] = (),
    stage_cost: str | None = None,
    sampling_time: float | None = None,
    points: int = 100,
    seed: int = 0,
    tolerance: float = AGREEMENT,
) -> ModelCheck:
    """Compare an FMU with a model over one sample from random points. This runs its native code.

    States and actions of both stand in the same order; disturbances and outputs are those of the
    same name. The model has its nominal parameters. Where nothing sets the FMU's initial state, the
    points are those of a run with random actions.

    Args:
        fmu: A shipped FMU's name, or a path.
        model: The model, or its name, `module:factory`.
        scenario: Names the variables, and its bounds are those of the points; else the other
            arguments do, as for `cosim scenario init`, and the points lie within a fifth of the
            FMU's start values.
        states: The FMU's states, in the order of the model's; default: the model's names.
        actions: The FMU's actions, in the order of the model's; default: the model's names.
        stage_cost: The FMU's output that is the stage cost.
        sampling_time: Sampling time in s; default: the FMU's own step size.
        points: Number of points.
        seed: Seed of the points.
        tolerance: Share of what a quantity varies at which both agree.

    Raises:
        CosimError: The FMU, the model or the scenario cannot be used, or a name is unknown.
    """
    if points < 1 or not 0 < tolerance < inf:
        raise PlantError("a comparison takes at least 1 point and a positive finite tolerance")
    loaded = load_model(model) if isinstance(model, str) else model
    archive = unpack(fmu)
    if scenario is None:
        task = _drafted(fmu, archive, loaded, states, actions, stage_cost, sampling_time)
    else:
        if states or actions or stage_cost or sampling_time:
            raise PlantError("give a scenario, or names and a sampling time, not both")
        given = scenario if isinstance(scenario, Scenario) else Scenario.load(scenario)
        task = given.replace({"plant": {"fmu": _name(fmu, archive)}})
    _require_sizes(task, loaded)
    task, remarks = _reading(task, archive, loaded)
    # The probe says to which instant an output belongs.
    kinds = probe(task).kinds
    generator = np.random.default_rng(seed)
    bounded = scenario is not None
    samples = _sample(task, points, generator, bounded, remarks)
    remarks += _hidden_state_remarks(task, archive)
    remarks += _parameter_remarks(task, archive, loaded)
    remarks += _unit_remarks(task, archive, loaded)
    differences = _differences(task, archive, loaded, samples, kinds)
    return ModelCheck(
        agrees=all(item.share <= tolerance for item in differences),
        tolerance=tolerance,
        points=len(samples.x),
        differences=tuple(differences),
        remarks=tuple(remarks),
    )


def _name(fmu: str | Path, archive: UnpackedFmu) -> str:
    """The FMU as a scenario names it."""
    name = str(fmu)
    if name in SHIPPED_FMUS:
        return name
    return archive.path.as_posix()


def _drafted(
    fmu: str | Path,
    archive: UnpackedFmu,
    model: Model,
    states: Sequence[str],
    actions: Sequence[str],
    stage_cost: str | None,
    sampling_time: float | None,
) -> Scenario:
    """A scenario of the FMU with the model's names, where no others are given."""
    names = {"states": list(states), "actions": list(actions)}
    for kind, given in names.items():
        if given:
            continue
        own = [quantity.name for quantity in getattr(model, kind)]
        missing = [name for name in own if archive.variable(name) is None]
        if missing:
            raise PlantError(
                f"FMU '{archive.path.name}' has no variable '{missing[0]}', as model "
                f"'{model.name}' calls one of its {kind}; give the FMU's names by --{kind} A,B,… "
                f"in the order {', '.join(own)}"
            )
        names[kind] = own
    roles = guess_roles(archive, names["states"], names["actions"], stage_cost)
    document = first_document(fmu, archive, roles, sampling_time)
    plant = document["plant"]
    whole_mapping = plant["mapping"]
    document["disturbance"] = {"law": "none"}
    plant["mapping"] = {}
    parameters = start_parameters(Scenario.from_dict(document), archive)
    mapping = _without_law(whole_mapping)
    # Those of some states alone are of no use: a point is all of them.
    state_names = names["states"]
    if all(name in parameters for name in state_names):
        starts = [parameters[name] for name in state_names]
        mapping["initial_state"] = starts
        plant["initial_state"] = [start_value(archive, name) for name in starts]
    plant["mapping"] = mapping
    return Scenario.from_dict(document)


def _without_law(mapping: Mapping[str, Any]) -> dict[str, Any]:
    """What a scenario maps, but for what sets the disturbances: they are as the FMU draws them."""
    kept = {}
    for key in ("initial_state", "seed", "sampling_time"):
        if mapping.get(key):
            kept[key] = mapping[key]
    return kept


def _require_sizes(task: Scenario, model: Model) -> None:
    """Raise PlantError where FMU and model have not as many states and actions."""
    for kind in ("states", "actions"):
        theirs = getattr(task.plant, kind)
        ours = [quantity.name for quantity in getattr(model, kind)]
        if len(theirs) != len(ours):
            raise PlantError(
                f"model '{model.name}' has {len(ours)} {kind} ({', '.join(ours)}), and "
                f"{len(theirs)} are named of the FMU ({', '.join(theirs)})"
            )


def _reading(task: Scenario, archive: UnpackedFmu, model: Model) -> tuple[Scenario, list[str]]:
    """The scenario, with the model's disturbances and outputs read too; and what is left out.

    The disturbances are as the FMU draws them: the model is given what it drew.
    """
    remarks = []
    read = []
    for quantity in model.disturbances:
        variable = archive.variable(quantity.name)
        if variable is not None and variable.causality == "output":
            read.append(quantity.name)
        else:
            remarks.append(
                f"disturbance {quantity.name} is no output of the FMU: the model has its nominal "
                f"value {quantity.nominal:g}"
            )
    for name in task.plant.disturbances:
        if name not in read:
            remarks.append(f"disturbance {name} of the FMU is unknown to the model")
    for name in model.outputs:
        if archive.variable(name) is None:
            remarks.append(f"output {name} of the model is no variable of the FMU: not compared")
        else:
            read.append(name)
    document = task.to_dict()
    plant = document["plant"]
    plant["mapping"] = _without_law(plant["mapping"])
    plant["disturbances"] = read
    # The optimum's conditions are not asked for here.
    plant.pop("model", None)
    document["disturbance"] = {"law": "none"}
    # Exact states under constant parameters are compared.
    for key in ("sensor", "estimator", "signal"):
        document.pop(key, None)
    return Scenario.from_dict(document), remarks


@dataclass(frozen=True)
class _Samples:
    """Samples of the FMU, a row each: x, u, what was read, the cost and the next state."""

    x: Array
    u: Array
    read: Array
    cost: Array
    next_x: Array


def _sample(
    task: Scenario,
    points: int,
    generator: np.random.Generator,
    bounded: bool,
    remarks: list[str],
) -> _Samples:
    """Steps of the FMU from random points; those at which it fails are left out with a remark.

    The points fill the scenario's bounds where these are somebody's (`bounded`): the ranges that an
    FMU states are often far beyond where its equations mean anything.
    """
    rows = []
    failures = []
    with FmuPlant(task) as plant:
        settable = bool(task.plant.mapping.initial_state)
        low, high = plant.state_range
        x_lower = np.maximum(task.state_lower, low)
        x_upper = np.minimum(task.state_upper, high)
        x_lower, x_upper = _box(task.plant.initial_state, x_lower, x_upper, bounded)
        u_lower, u_upper = _box(
            task.reference_action,
            task.action_lower,
            task.action_upper,
            bounded,
        )
        if not settable:
            remarks.append(
                "nothing sets the FMU's initial state: the points are those of a run with random "
                "actions"
            )
        running = False
        for k in range(points):
            # Drawn in any case: the points do not hang on where the FMU fails.
            start = generator.uniform(x_lower, x_upper)
            u = generator.uniform(u_lower, u_upper)
            try:
                if settable:
                    x = plant.reset(k, start)
                elif not running:
                    x = plant.reset(k)
                step = plant.step(u)
            except PlantError as error:
                # A run that failed begins anew.
                running = False
                failures.append(str(error))
                # A plant that fails everywhere is no matter of the points.
                if len(failures) > points // 2:
                    raise
                continue
            rows.append((x, u, step.disturbance, step.stage_cost, step.s))
            x = step.s
            running = True
    if failures:
        remarks.append(f"the FMU failed at {len(failures)} points, left out: {failures[0]}")
    columns = []
    for column in zip(*rows, strict=True):
        columns.append(np.array(column, dtype=np.float64))
    x, u, read, cost, next_x = columns
    return _Samples(x, u, read, cost, next_x)


def _box(
    start: Sequence[float] | Array,
    lower: Array,
    upper: Array,
    bounded: bool,
) -> tuple[Array, Array]:
    """Between the bounds if wanted and where both are finite, else about the start value."""
    values = np.asarray(start, dtype=np.float64)
    centre = np.clip(values, lower, upper)
    # What starts at 0 says nothing of its size.
    size = np.where(centre != 0, np.abs(centre), 1.0)
    reach = SHARE_OF_START * size
    fills = np.isfinite(lower) & np.isfinite(upper) & bounded
    low = np.where(fills, lower, np.maximum(centre - reach, lower))
    high = np.where(fills, upper, np.minimum(centre + reach, upper))
    return low, high


def _hidden_state_remarks(task: Scenario, archive: UnpackedFmu) -> list[str]:
    """Continuous states of the FMU that no state of the model stands for."""
    named = set()
    for name in task.plant.states:
        # The description has an array as one state.
        variable, _, _ = name.partition("[")
        named.add(variable)
    hidden = [name for name in continuous_states(archive.path) if name not in named]
    if not hidden:
        return []
    words = ", ".join(hidden)
    return [f"the FMU has the states {words}, too: from the same point it may go elsewhere"]


def _parameter_remarks(task: Scenario, archive: UnpackedFmu, model: Model) -> list[str]:
    """Parameters of one name and two values."""
    remarks = []
    for quantity in model.parameters:
        variable = archive.variable(quantity.name)
        if variable is None or variable.causality != "parameter":
            continue
        start = start_value(archive, quantity.name)
        value = float(task.plant.parameters.get(quantity.name, start))
        # Both may have been written with other digits of one number.
        allowed = 1e-9 * max(abs(quantity.nominal), 1e-300)
        if abs(value - quantity.nominal) > allowed:
            remarks.append(
                f"parameter {quantity.name} is {value:g} in the FMU and "
                f"{quantity.nominal:g} in the model"
            )
    return remarks


def _unit_remarks(task: Scenario, archive: UnpackedFmu, model: Model) -> list[str]:
    """States and actions that are stated in two units."""
    names = (*task.plant.states, *task.plant.actions)
    quantities = (*model.states, *model.actions)
    remarks = []
    for name, quantity in zip(names, quantities, strict=True):
        theirs = archive.unit(name)
        ours = quantity.unit
        # A unit that is not stated contradicts none.
        if theirs and ours and theirs != ours:
            remarks.append(f"{name} is in {theirs} in the FMU and in {ours} in the model")
    return remarks


def _differences(
    task: Scenario,
    archive: UnpackedFmu,
    model: Model,
    samples: _Samples,
    kinds: Mapping[str, OutputKind],
) -> list[ModelDifference]:
    """The largest difference in each state, in the cost and in each output."""
    plant = task.plant
    count = len(samples.x)
    x = samples.x.T
    u = samples.u.T
    # What the FMU shows of disturbances and outputs, by name.
    read = dict(zip(plant.disturbances, samples.read.T, strict=True))
    d = np.empty((len(model.disturbances), count))
    # The variables' values at the points, for the report.
    point: dict[str, Array] = dict(zip(plant.states, x, strict=True))
    point |= dict(zip(plant.actions, u, strict=True))
    for i, quantity in enumerate(model.disturbances):
        # A disturbance that the FMU does not show has its nominal value.
        d[i] = read.get(quantity.name, quantity.nominal)
        point[quantity.name] = d[i]
    p = np.tile(model.nominal_parameters[:, None], (1, count))
    next_x = _next_states(model, task.sampling_time, (x, u, d, p))
    result = []
    for i, name in enumerate(plant.states):
        of_fmu = samples.next_x[:, i]
        # A slow state is the same in both for lack of time: its movement is what counts.
        movement = np.abs(of_fmu - x[i])
        difference = _compare_at(
            model,
            f"{name} a sample later",
            archive.unit(name),
            of_fmu,
            next_x[i],
            float(movement.max()),
            point,
        )
        result.append(difference)

    def compare_output(name: str, function: ca.Function, of_fmu: Array) -> ModelDifference:
        """Compare at the time to which the FMU's output belongs."""
        at_end = kinds.get(name) is OutputKind.END
        states = next_x if at_end else x
        of_model = _evaluate(function, (states, u, d, p))[0]
        spread = float(np.ptp(of_fmu))
        unit = archive.unit(name)
        return _compare_at(model, name, unit, of_fmu, of_model, spread, point)

    cost = compare_output(plant.stage_cost, economic_cost(model), samples.cost)
    result.append(cost)
    symbols = model.symbols()
    for name, output in model.outputs.items():
        # The others have their remark.
        if name in read:
            function = ca.Function("y", list(symbols), [output(*symbols)])
            difference = compare_output(name, function, read[name])
            result.append(difference)
    return result


def _compare_at(
    model: Model,
    name: str,
    unit: str,
    of_fmu: Array,
    of_model: Array,
    scale: float,
    point: Mapping[str, Array],
) -> ModelDifference:
    """The largest difference in a quantity, and where it is.

    Args:
        model: For messages.
        name: What is compared.
        unit: Its unit.
        of_fmu: Its values in the FMU, (points,).
        of_model: Its values in the model, (points,).
        scale: How much it varies, to which the difference is related.
        point: Values of all variables at the points, by name, (points,) each.

    Raises:
        ModelError: The model has no finite number at a point.
    """
    finite = np.isfinite(of_model)
    if not finite.all():
        first = int(np.argmin(finite))
        coordinates = [f"{key} = {values[first]:.5g}" for key, values in point.items()]
        place = ", ".join(coordinates)
        raise ModelError(f"model '{model.name}' gives no finite number for {name} at {place}")
    gaps = np.abs(of_fmu - of_model)
    worst = int(np.argmax(gaps))
    gap = float(gaps[worst])
    # What does not vary is compared with its own size.
    reference = scale or float(np.abs(of_fmu).max())
    # Of what is 0 throughout any difference is too large.
    share = inf if gap else 0.0
    if reference:
        share = gap / reference
    return ModelDifference(
        name=name,
        unit=unit,
        difference=gap,
        share=share,
        fmu=float(of_fmu[worst]),
        model=float(of_model[worst]),
        where={key: float(values[worst]) for key, values in point.items()},
    )


def _evaluate(function: ca.Function, arguments: tuple[Array, ...]) -> Array:
    """A function's values (rows, points) at the columns of its arguments."""
    count = arguments[0].shape[1]
    columns = []
    for values in arguments:
        # CasADi takes an array without rows for one without columns, too.
        matrix = ca.DM(values) if values.size else ca.DM.zeros(0, count)
        columns.append(matrix)
    at_all_points = function.map(count)
    result: Array = at_all_points(*columns).full()
    return result


def _next_states(model: Model, sampling_time: float, arguments: tuple[Array, ...]) -> Array:
    """The model's states a sample later, (n, points); ModelError where they cannot be integrated.

    The number of Runge–Kutta steps is doubled until that changes nothing that matters.
    """
    x, *held = arguments
    before = None
    substeps = 8
    while substeps <= MOST_SUBSTEPS:
        step = discretise(model, sampling_time / substeps, 1)
        state = x
        for _ in range(substeps):
            state = _evaluate(step, (state, *held))
        if before is not None:
            change = np.abs(state - before).max(axis=1)
            movement = np.abs(state - x).max(axis=1)
            size = np.abs(state).max(axis=1) + movement
            # A state that is 0 throughout has no size.
            allowed = ACCURATE * size + 1e-300
            if (change <= allowed).all():
                return state
        before = state
        substeps *= 2
    raise ModelError(
        f"model '{model.name}' cannot be integrated over a sample of {sampling_time:g} s from "
        "every point: give a scenario with narrower bounds, or a shorter sampling time"
    )
