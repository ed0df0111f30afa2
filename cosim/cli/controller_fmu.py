"""The controller's C and its variables, put into an FMU."""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from controllers import ExtendedKalmanFilter, OutputFeedback, Parameters, Problem, RtiNmpc
from controllers.estimator import largest_margins
from controllers.export import STATUSES, Observer, core, estimated_state, plain_c
from controllers.factories import build_controller
from controllers.filter_model import measured_outputs
from controllers.theta import ThetaBlocks
from cosim.core.errors import ControllerLookupError
from cosim.core.files import write_atomically
from cosim.core.scenario import EstimatorTable, Scenario
from cosim.core.signals import ahead_of
from cosim.core.simulation import spawn_seeds
from cosim.plant.fmi import unpack
from cosim.plant.wiring import start_values
from fmus.build import build_model, sampled_table
from fmus.model import FmiVersion, FmuModel, Kind, Type, Variable
from fmus.ssp import write_ssp

RECORD = "extra/org.rti-cosim/controller.json"


def rti_controller(
    name: str,
    scenario: Scenario,
    measured: tuple[str, ...] = (),
) -> RtiNmpc:
    """An RTI-NMPC, whose θ ends with the disturbances of its model that are measured.

    Args:
        name: what `build_controller` takes.
        scenario: what it controls.
        measured: names of disturbances of its model that are inputs of the exported controller.

    Raises:
        ControllerLookupError: it is no RTI-NMPC, or the scenario has sensors, too, and their
            estimator cannot be told what is measured.
        ModelError: the model lacks a name.
    """
    if scenario.sensors and measured:
        raise ControllerLookupError(
            f"scenario '{scenario.name}' has sensors, whose estimator cannot be told a measured "
            "disturbance yet: leave --measured out"
        )
    built: Any = build_controller(name, scenario)
    # The estimator before it is exported beside it: `observer_of`.
    controller = built.controller if isinstance(built, OutputFeedback) else built
    if type(controller) is not RtiNmpc or controller.iterations != 1:
        raise ControllerLookupError(
            f"controller '{name}' is no RTI-NMPC and cannot be exported; give "
            "naive, tuned or a parameters file (.toml) of a training"
        )
    if not measured:
        return controller
    model = controller.problem.model.measuring(measured)
    problem = replace(controller.problem, model=model)
    before = controller.parameters.blocks
    in_theta = before.block("p").labels if "p" in before else ()
    # A measured disturbance is a parameter of the model, and as such an entry of θ, which the
    # exported controller takes from an input at each sample.
    blocks = ThetaBlocks.from_problem(
        problem,
        slack_weights="w_sigma" in before,
        model_parameters=(*in_theta, *measured),
    )
    naive = Parameters.naive(problem, blocks)
    parameters = controller.parameters.placed_in(naive)
    return RtiNmpc(problem, parameters)


def observer_of(controller: RtiNmpc, scenario: Scenario) -> Observer | None:
    """Filter that turns the sensors' readings into a state; None without sensors.

    Args:
        controller: whose θ may have the filter's variances.
        scenario: says which estimator it is.

    Raises:
        ControllerLookupError: the estimator is another one than `ekf`.
    """
    if not scenario.sensors:
        return None
    table = scenario.estimator or EstimatorTable()
    if table.kind != "ekf":
        raise ControllerLookupError(
            f"scenario '{scenario.name}': an estimator of kind '{table.kind}' cannot be exported: "
            "take estimator.kind 'ekf', or a scenario without [[sensor]]"
        )
    estimator = OutputFeedback.from_scenario(scenario, controller).estimator
    assert isinstance(estimator, ExtendedKalmanFilter)
    # The filter has the logarithms of its variances.
    variances = np.exp(estimator.noise)
    blocks = controller.parameters.blocks
    most_margins = None
    if "margin" in blocks:
        most_margins = largest_margins(controller.problem)[: controller.problem.n_states]
    return estimated_state(
        estimator.model,
        variances,
        in_theta="noise" in blocks,
        most_margins=most_margins,
    )


def sampled_controller(
    controller: RtiNmpc,
    scenario: Scenario,
    measured: tuple[str, ...] = (),
) -> FmuModel:
    """The controller as a sampled system.

    Args:
        controller: what `rti_controller` has made.
        scenario: what it controls; its signals have the names and units of the plant's variables.
        measured: what `rti_controller` was given.

    Raises:
        ControllerError: it cannot be exported.
    """
    hessian = scenario.controller.hessian
    problem = controller.problem
    parameters = controller.parameters
    observer = observer_of(controller, scenario)
    exported = core(problem, parameters, hessian, observer, known_counts(scenario))
    # The order is that of the C's arrays: inputs, outputs, predictions, θ.
    if observer is None:
        signals = _state_signals(scenario, problem)
    else:
        signals = _reading_signals(scenario, problem)
    signals += _known_signals(scenario, problem)
    signals += _manual_signals(scenario, problem)
    signals += _disturbance_signals(scenario, parameters, measured)
    signals += _output_signals(scenario)
    signals += _prediction_signals(scenario, problem.horizon)
    if observer is not None:
        signals += _estimate_signals(scenario, problem, observer)
    signals += _theta_signals(parameters)
    terminal = (*scenario.plant.states, *scenario.plant.actions)
    # The terminal is that of a plant whose states are measured as they are.
    if observer is not None:
        terminal = ()
    # Another controller has another name in C, so that both may be linked into one program.
    origin = f"{scenario.hash} {hessian} {parameters.hash}"
    digest = hashlib.sha256(origin.encode()).hexdigest()
    return FmuModel(
        name=f"RTI-NMPC {scenario.name}",
        identifier=f"rti_nmpc_{digest[:12]}",
        description=(
            f"Real-time-iteration NMPC for {scenario.name}: horizon {problem.horizon}, "
            f"{hessian} Hessian, θ {parameters.hash}"
        ),
        variables=sampled_table(signals),
        step_size=scenario.sampling_time,
        sampled=True,
        sources=exported.sources,
        terminal=terminal,
    )


def _state_signals(scenario: Scenario, problem: Problem) -> list[Variable]:
    """The measured states, inputs of the controller."""
    plant = unpack(scenario.plant.fmu)
    signals = []
    # Before anything is connected the controller sees its reference.
    for name, value in zip(scenario.plant.states, problem.reference_state.tolist(), strict=True):
        state = Variable(
            name,
            Kind.INPUT,
            unit=plant.unit(name),
            start=value,
            description="measured state",
        )
        signals.append(state)
    return signals


def _reading_signals(scenario: Scenario, problem: Problem) -> list[Variable]:
    """The readings, and whether each of them is fresh.

    Scalars in FMI 3.0 too: an array has one unit for all of its elements.
    """
    plant = unpack(scenario.plant.fmu)
    sensors = scenario.sensors or ()
    # Before anything is connected the sensors show what they do at the reference.
    output = measured_outputs(problem, sensors)
    output.inputs["z"][:] = problem.reference_state
    output()
    values = output.part("y").tolist()
    readings = []
    fresh = []
    for sensor, value in zip(sensors, values, strict=True):
        name = f"y_{sensor.variable}"
        meaning = f"reading of {sensor.variable}"
        if sensor.delay:
            meaning += f", taken {sensor.delay} samples ago"
        reading = Variable(
            name,
            Kind.INPUT,
            unit=plant.unit(sensor.variable),
            start=value,
            description=meaning,
        )
        is_fresh = Variable(
            f"{name}_fresh",
            Kind.INPUT,
            Type.BOOLEAN,
            start=0.0,
            min=0.0,
            max=1.0,
            description=f"whether {name} is a new reading, to be taken up at the present sample",
        )
        readings.append(reading)
        fresh.append(is_fresh)
    return [*readings, *fresh]


def known_counts(scenario: Scenario) -> tuple[int, ...]:
    """Number of values of each known signal that a controller gets at a sample."""
    counts = []
    for signal in scenario.signals or ():
        if signal.known != "none":
            counts.append(1 + ahead_of(signal, scenario))
    return tuple(counts)


def _known_signals(scenario: Scenario, problem: Problem) -> list[Variable]:
    """Known values of each signal: the present one or, of a preview, an array."""
    plant = unpack(scenario.plant.fmu)
    tables = {table.name: table for table in scenario.signals or ()}
    signals = []
    for item, count in zip(problem.varying, known_counts(scenario), strict=True):
        table = tables[item.signal]
        # A price has no unit of the plant's.
        variable = table.bounded_state if table.bound is not None else table.reference
        unit = plant.unit(variable) if variable else ""
        for k in range(count):
            name = f"signal.{item.signal}"
            if count > 1:
                name += f"[{k}]"
            value = Variable(
                name,
                Kind.INPUT,
                unit=unit,
                start=item.nominal,
                description=f"known value of {item.signal}, {k} samples ahead",
            )
            signals.append(value)
    return signals


def _estimate_signals(scenario: Scenario, problem: Problem, observer: Observer) -> list[Variable]:
    """The estimates of the state, and of the parameters that the model calls uncertain."""
    plant = unpack(scenario.plant.fmu)
    states = scenario.plant.states
    signals = []
    for name in states:
        estimate = Variable(
            f"estimated.{name}",
            Kind.OUTPUT,
            unit=plant.unit(name),
            description=f"estimate of {name} at the present sample",
        )
        signals.append(estimate)
    n_parameters = observer.estimates - len(states)
    for name in problem.model.uncertain[:n_parameters]:
        estimate = Variable(
            f"estimated.{name}",
            Kind.OUTPUT,
            description=f"estimate of the model's parameter {name}",
        )
        signals.append(estimate)
    return signals


def _manual_signals(scenario: Scenario, problem: Problem) -> list[Variable]:
    """Inputs of manual control: a switch, and an action of each kind."""
    plant = unpack(scenario.plant.fmu)
    # Off where a tool connects nothing to it.
    manual = Variable(
        "manual",
        Kind.INPUT,
        Type.BOOLEAN,
        start=0.0,
        min=0.0,
        max=1.0,
        description="whether the actions are those of manual_…, as of the next sample",
    )
    signals = [manual]
    for name, value in zip(scenario.plant.actions, problem.reference_action.tolist(), strict=True):
        action = Variable(
            f"manual_{name}",
            Kind.INPUT,
            unit=plant.unit(name),
            start=value,
            description="action in manual; acts within the bounds of the action",
        )
        signals.append(action)
    return signals


def _disturbance_signals(
    scenario: Scenario,
    parameters: Parameters,
    measured: tuple[str, ...],
) -> list[Variable]:
    """The measured disturbances, inputs of the controller that start at their values in θ."""
    plant = unpack(scenario.plant.fmu)
    theta = _values_by_label(parameters)
    signals = []
    for name in measured:
        disturbance = Variable(
            name,
            Kind.INPUT,
            unit=plant.unit(name),
            start=theta[f"p[{name}]"],
            description="measured disturbance, held over the horizon; "
            "not a number: that of theta.p instead",
        )
        signals.append(disturbance)
    return signals


def _output_signals(scenario: Scenario) -> list[Variable]:
    """The actions, and what the controller reports of a sample."""
    plant = unpack(scenario.plant.fmu)
    signals = []
    for name in scenario.plant.actions:
        low, high = scenario.limits[name]
        action = Variable(
            name,
            Kind.OUTPUT,
            unit=plant.unit(name),
            min=low,
            max=high,
            description="action, within its bounds",
        )
        signals.append(action)
    codes = ", ".join(f"{code} {text}" for code, text in enumerate(STATUSES))
    reports = {
        "value": "value V(s) of the state, in manual Q(s, a)",
        "qp_status": f"of the present sample: {codes}",
        "kkt_residual": "largest KKT residual of the last QP that was solved",
        "qp_iterations": "steps of the QP solver in the last QP that was solved",
        "failures": "samples without a solution so far; they hold the last or manual action",
    }
    for name, text in reports.items():
        signals.append(Variable(name, Kind.OUTPUT, description=text))
    return signals


def _prediction_signals(scenario: Scenario, horizon: int) -> list[Variable]:
    """States and actions over the horizon, stage by stage."""
    plant = unpack(scenario.plant.fmu)
    signals = []
    # No action follows the last predicted state.
    predicted = (
        (scenario.plant.states, horizon + 1),
        (scenario.plant.actions, horizon),
    )
    for names, stages in predicted:
        for k in range(stages):
            for name in names:
                prediction = Variable(
                    f"predicted.{name}[{k}]",
                    Kind.OUTPUT,
                    unit=plant.unit(name),
                    description=f"predicted {name}, {k} samples ahead",
                )
                signals.append(prediction)
    return signals


def _theta_signals(parameters: Parameters) -> list[Variable]:
    """The entries of θ, which are tunable: another θ may be set where the FMU runs."""
    meanings = []
    for block in parameters.blocks:
        meanings += [block.meaning] * block.size
    values = _values_by_label(parameters)
    signals = []
    for (label, value), meaning in zip(values.items(), meanings, strict=True):
        entry = Variable(
            f"theta.{_structured(label)}",
            Kind.TUNABLE,
            start=value,
            description=meaning,
        )
        signals.append(entry)
    return signals


def _values_by_label(parameters: Parameters) -> dict[str, float]:
    """θ by the labels of its entries."""
    values = parameters.theta.tolist()
    return dict(zip(parameters.blocks.labels, values, strict=True))


def write_c(
    controller: RtiNmpc,
    scenario: Scenario,
    folder: Path,
    single: bool = False,
) -> dict[str, Any]:
    """Write a controller as C.

    Args:
        controller: what `rti_controller` has made.
        scenario: what it controls.
        folder: for the files; the functions begin with its name.
        single: whether the numbers are floats of 32 bits.

    Returns:
        The folder, the names of its files, and the name that the functions begin with.
    """
    observer = observer_of(controller, scenario)
    if single and observer is not None:
        raise ControllerLookupError(
            f"scenario '{scenario.name}' has sensors, and single precision does not carry the "
            "covariance of their estimator: leave --single out"
        )
    exported = core(
        controller.problem,
        controller.parameters,
        scenario.controller.hessian,
        observer,
        known_counts(scenario),
    )
    # A folder's name may hold what no C identifier does.
    folder_name = folder.absolute().name
    name = re.sub(r"\W", "_", folder_name)
    files = plain_c(exported, name, scenario, single=single)
    folder.mkdir(exist_ok=True)
    for file, text in files.items():
        write_atomically(folder / file, text)
    return {
        "folder": str(folder),
        "files": list(files),
        "name": name,
    }


def _structured(label: str) -> str:
    """A label of θ as FMI's structured names have it: `p[UA2]` becomes `p.UA2`."""
    block, bracket, rest = label.partition("[")
    inner = rest.removesuffix("]")
    # FMI's arrays have numbers in brackets, and nothing else.
    is_number = inner.replace(",", "").isdigit()
    if not bracket or is_number:
        return label
    return f"{block}.{inner}"


def write_fmu(
    controller: RtiNmpc,
    scenario: Scenario,
    target: Path,
    version: FmiVersion,
    *,
    measured: tuple[str, ...] = (),
    every_platform: bool = False,
) -> Path:
    """Write the FMU of `sampled_controller` with a record of its scenario and θ.

    Args:
        controller: what `rti_controller` has made.
        scenario: what it controls.
        target: path of the FMU.
        version: major version of FMI.
        measured: what `rti_controller` was given.
        every_platform: build for each of `fmus.PLATFORMS`, and not for the platform at hand alone.

    Returns:
        The path of the FMU.

    Raises:
        ControllerError: the controller cannot be exported.
        BuildError: there is no compiler, or it refuses the C.
    """
    system = sampled_controller(controller, scenario, measured)
    labels = controller.parameters.blocks.labels
    values = controller.theta.tolist()
    # Whoever finds the FMU can tell what it was made of, and make it again.
    record = {
        "scenario": scenario.to_dict(),
        "scenario_hash": scenario.hash,
        "theta": dict(zip(labels, values, strict=True)),
        "theta_hash": controller.parameters.hash,
    }
    text = json.dumps(record, indent=2, default=repr) + "\n"
    return build_model(
        system,
        target,
        version,
        every_platform=every_platform,
        files={RECORD: text.encode()},
    )


def write_loop(
    controller: Path,
    scenario: Scenario,
    seed: int,
    target: Path,
    measured: tuple[str, ...] = (),
) -> Path:
    """Write an SSP with the same trajectory as `cosim simulate --seed`, unless it has `measured`.

    The controller comes first: it acts on the state at the sample, then the plant takes the step.
    Where the plant can, its inputs saturate, as the loop of `simulate` does it, so that a master
    may begin before any action has come.

    Args:
        controller: path of its FMU.
        scenario: what it controls.
        seed: of the run, as `cosim simulate` takes it.
        target: path of the SSP.
        measured: disturbances that the plant gives to the controller.

    Returns:
        The path of the SSP.

    Raises:
        PlantError: the plant does not fit the scenario.
    """
    plant = scenario.plant
    plant_seed, _ = spawn_seeds(seed)
    starts = start_values(scenario, plant_seed)
    archive = unpack(plant.fmu)
    types = {}
    for name, variable in archive.variables.items():
        types[name] = variable.type
    # A switch of our own plants, off by default: an input beyond its range is then refused.
    if "saturate" in types:
        starts["saturate"] = ("Boolean", 1.0)
    for name, (kind, value) in list(starts.items()):
        # libcosim ignores enumerations of FMI 2.0; our plants have an integer beside theirs.
        if kind == "Enumeration" and types.get(f"{name}_number") == "Integer":
            del starts[name]
            starts[f"{name}_number"] = ("Integer", value)
    return write_ssp(
        target,
        controller,
        archive.path,
        (*plant.states, *measured),
        plant.actions,
        starts,
        # As in the FMU's own experiment.
        stop_time=100 * scenario.sampling_time,
    )
