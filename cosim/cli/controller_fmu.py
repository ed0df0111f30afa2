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
from controllers.export import STATUSES, Observer, core, estimated_state, plain_c
from controllers.filter_model import measured_outputs
from controllers.theta import ThetaBlocks
from cosim.core.errors import ControllerLookupError
from cosim.core.files import write_atomically
from cosim.core.plugins import build_controller
from cosim.core.scenario import EstimatorTable, Scenario
from cosim.core.signals import ahead_of
from cosim.core.simulation import spawn_seeds
from cosim.plant.fmi import UnpackedFmu, unpack
from cosim.plant.wiring import start_values
from fmus.build import build_model, sampled_table
from fmus.model import FmiVersion, FmuModel, Kind, Type, Variable
from fmus.ssp import write_ssp

RECORD = "extra/org.rti-cosim/controller.json"


def rti_controller(name: str, scenario: Scenario, measured: tuple[str, ...] = ()) -> RtiNmpc:
    """The controller `name`, whose θ ends with the `measured` disturbances of its model.

    Raises ControllerLookupError where it is no RTI-NMPC, ModelError on a name that the model lacks.
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
        problem, slack_weights="w_sigma" in before, model_parameters=(*in_theta, *measured)
    )
    naive = Parameters.naive(problem, blocks)
    return RtiNmpc(problem, controller.parameters.placed_in(naive))


def observer_of(controller: RtiNmpc, scenario: Scenario) -> Observer | None:
    """What makes the state of the readings of the scenario's sensors; None without sensors.

    Args:
        controller: Whose θ may have the filter's variances.
        scenario: Says which estimator it is.

    Raises:
        ControllerLookupError: The estimator is another one than `ekf`.
    """
    if not scenario.sensors:
        return None
    kind = (scenario.estimator or EstimatorTable()).kind
    if kind != "ekf":
        raise ControllerLookupError(
            f"scenario '{scenario.name}': an estimator of kind '{kind}' cannot be exported: take "
            "estimator.kind 'ekf', or a scenario without [[sensor]]"
        )
    estimator = OutputFeedback.from_scenario(scenario, controller).estimator
    assert isinstance(estimator, ExtendedKalmanFilter)
    in_theta = "noise" in controller.parameters.blocks
    return estimated_state(estimator.model, np.exp(estimator.noise), in_theta=in_theta)


def sampled_controller(
    controller: RtiNmpc, scenario: Scenario, measured: tuple[str, ...] = ()
) -> FmuModel:
    """The controller as a sampled system; raises ControllerError where it cannot be exported.

    Its signals have the names and units of the plant's variables; `measured` is what
    `rti_controller` was given.
    """
    plant = unpack(scenario.plant.fmu)
    hessian = scenario.controller.hessian
    origin = f"{scenario.hash} {hessian} {controller.parameters.hash}"
    problem = controller.problem
    parameters = controller.parameters
    blocks = parameters.blocks
    observer = observer_of(controller, scenario)
    exported = core(problem, parameters, hessian, observer, known_counts(scenario))
    states = scenario.plant.states
    actions = scenario.plant.actions
    # Before anything is connected the controller sees its reference.
    reference = (*problem.reference_state.tolist(), *problem.reference_action.tolist())
    start = dict(zip((*states, *actions), reference, strict=True))

    def signal(kind: Kind, name: str, about: str, variable: str, **more: Any) -> Variable:
        """A signal with the unit of a variable of the plant."""
        unit = plant.unit(variable)
        return Variable(name, kind, unit=unit, description=about, **more)

    # The order is that of the C's arrays: inputs, outputs, predictions, θ.
    if observer is None:
        signals = [signal(Kind.INPUT, x, "measured state", x, start=start[x]) for x in states]
    else:
        signals = _readings(scenario, problem, plant)
    signals += _known(scenario, problem, plant)
    about = "whether the actions are those of manual_…, as of the next sample"
    signals.append(
        Variable("manual", Kind.INPUT, Type.BOOLEAN, start=0.0, min=0.0, max=1.0, description=about)
    )
    about = "action in manual; acts within the bounds of the action"
    signals += [signal(Kind.INPUT, f"manual_{u}", about, u, start=start[u]) for u in actions]
    about = "measured disturbance, held over the horizon; not a number: that of theta.p instead"
    theta = dict(zip(blocks.labels, parameters.theta.tolist(), strict=True))
    signals += [signal(Kind.INPUT, d, about, d, start=theta[f"p[{d}]"]) for d in measured]
    for u in actions:
        low, high = scenario.limits[u]
        signals.append(signal(Kind.OUTPUT, u, "action, within its bounds", u, min=low, max=high))
    codes = ", ".join(f"{code} {text}" for code, text in enumerate(STATUSES))
    reports = {
        "value": "value V(s) of the state, in manual Q(s, a)",
        "qp_status": f"of the present sample: {codes}",
        "kkt_residual": "largest KKT residual of the last QP that was solved",
        "qp_iterations": "steps of the QP solver in the last QP that was solved",
        "failures": "samples without a solution so far; they hold the last or manual action",
    }
    signals += [Variable(name, Kind.OUTPUT, description=text) for name, text in reports.items()]
    # No action follows the last predicted state.
    for names, stages in ((states, problem.horizon + 1), (actions, problem.horizon)):
        for k in range(stages):
            for name in names:
                about = f"predicted {name}, {k} samples ahead"
                signals.append(signal(Kind.OUTPUT, f"predicted.{name}[{k}]", about, name))
    if observer is not None:
        signals += _estimates(scenario, problem, observer, plant)
    meanings = [block.meaning for block in blocks for _ in range(block.size)]
    signals += [
        Variable(f"theta.{_structured(label)}", Kind.TUNABLE, start=value, description=about)
        for (label, value), about in zip(theta.items(), meanings, strict=True)
    ]
    # Another controller has another name in C, so that both may be linked into one program.
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
        # The terminal is that of a plant whose states are measured as they are.
        terminal=(*states, *actions) if observer is None else (),
    )


def known_counts(scenario: Scenario) -> tuple[int, ...]:
    """How many values of each known signal a controller is given at a sample."""
    counts = []
    for signal in scenario.signals or ():
        if signal.known != "none":
            counts.append(1 + ahead_of(signal, scenario))
    return tuple(counts)


def _known(scenario: Scenario, problem: Problem, plant: UnpackedFmu) -> list[Variable]:
    """What is known of each signal: its present value or, of a preview, an array of them."""
    tables = {table.name: table for table in scenario.signals or ()}
    inputs = []
    for item, count in zip(problem.varying, known_counts(scenario), strict=True):
        table = tables[item.signal]
        variable = table.bounded_state if table.bound is not None else table.reference
        unit = plant.unit(variable) if variable else ""
        for k in range(count):
            name = f"signal.{item.signal}" + (f"[{k}]" if count > 1 else "")
            about = f"known value of {item.signal}, {k} samples ahead"
            inputs.append(
                Variable(name, Kind.INPUT, unit=unit, start=item.nominal, description=about)
            )
    return inputs


def _readings(scenario: Scenario, problem: Problem, plant: UnpackedFmu) -> list[Variable]:
    """The readings, and whether each of them is fresh.

    Scalars in FMI 3.0 too: an array has one unit for all of its elements.
    """
    sensors = scenario.sensors or ()
    output = measured_outputs(problem, sensors)
    output.inputs["z"][:] = problem.reference_state
    output()
    values = output.part("y").tolist()
    readings = []
    fresh = []
    for sensor, value in zip(sensors, values, strict=True):
        name = f"y_{sensor.variable}"
        about = f"reading of {sensor.variable}"
        if sensor.delay:
            about += f", taken {sensor.delay} samples ago"
        unit = plant.unit(sensor.variable)
        readings.append(Variable(name, Kind.INPUT, unit=unit, start=value, description=about))
        about = f"whether {name} is a new reading, to be taken up at the present sample"
        fresh.append(
            Variable(
                f"{name}_fresh",
                Kind.INPUT,
                Type.BOOLEAN,
                start=0.0,
                min=0.0,
                max=1.0,
                description=about,
            )
        )
    return [*readings, *fresh]


def _estimates(
    scenario: Scenario, problem: Problem, observer: Observer, plant: UnpackedFmu
) -> list[Variable]:
    """The estimates of the state, and of the parameters that the model calls uncertain."""
    states = scenario.plant.states
    outputs = []
    for name in states:
        about = f"estimate of {name} at the present sample"
        unit = plant.unit(name)
        outputs.append(Variable(f"estimated.{name}", Kind.OUTPUT, unit=unit, description=about))
    for name in problem.model.uncertain[: observer.estimates - len(states)]:
        about = f"estimate of the model's parameter {name}"
        outputs.append(Variable(f"estimated.{name}", Kind.OUTPUT, description=about))
    return outputs


def write_c(
    controller: RtiNmpc, scenario: Scenario, folder: Path, single: bool = False
) -> dict[str, Any]:
    """Write the controller as C into `folder`, whose name its functions begin with."""
    observer = observer_of(controller, scenario)
    if single and observer is not None:
        raise ControllerLookupError(
            f"scenario '{scenario.name}' has sensors, and single precision does not carry the "
            "covariance of their estimator: leave --single out"
        )
    hessian = scenario.controller.hessian
    exported = core(
        controller.problem, controller.parameters, hessian, observer, known_counts(scenario)
    )
    # A folder's name may hold what no C identifier does.
    name = re.sub(r"\W", "_", folder.absolute().name)
    files = plain_c(exported, name, scenario, single=single)
    folder.mkdir(exist_ok=True)
    for file, text in files.items():
        write_atomically(folder / file, text)
    return {"folder": str(folder), "files": list(files), "name": name}


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
    """Write the FMU of `sampled_controller` with a record of its scenario and θ."""
    system = sampled_controller(controller, scenario, measured)
    labels = controller.parameters.blocks.labels
    record = {
        "scenario": scenario.to_dict(),
        "scenario_hash": scenario.hash,
        "theta": dict(zip(labels, controller.theta.tolist(), strict=True)),
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
    controller: Path, scenario: Scenario, seed: int, target: Path, measured: tuple[str, ...] = ()
) -> Path:
    """Write an SSP with the same trajectory as `cosim simulate --seed`, unless it has `measured`.

    The controller comes first: it acts on the state at the sample, then the plant takes the step.
    Where the plant can, its inputs saturate, as the loop of `simulate` does it, so that a master
    may begin before any action has come.
    Raises PlantError where the plant does not fit the scenario.
    """
    plant = scenario.plant
    plant_seed, _ = spawn_seeds(seed)
    starts = start_values(scenario, plant_seed)
    archive = unpack(plant.fmu)
    types = {name: variable.type for name, variable in archive.variables.items()}
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
