"""Functions of an extended Kalman filter: the model's step, its outputs, its start.

The filter's state z is the model's, and behind it the parameters that the model calls uncertain. A
disturbance or parameter that a known signal is has the signal's present value.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from controllers.errors import ModelError
from controllers.functions import Definition, StackedFunction, define
from controllers.model import discretise
from controllers.problem import Problem, Varying, of_kind
from cosim.core.protocols import Vector
from cosim.core.scenario import SensorTable

INITIAL_DEVIATION = 0.1
"""Deviation of the first state from the reference, as a share of the width of its bounds."""
UNCERTAIN = 0.1
"""Deviation of an uncertain parameter from its nominal value at the start, as a share of this."""


@dataclass(frozen=True, eq=False)
class FilterModel:
    """A model and its sensors, as a filter has them.

    Attributes:
        transition: z₊ (`z_next`), A = ∂z₊/∂z and G = ∂z₊/∂d at the nominal disturbances, by
            (z, u, σ).
        output: What the sensors read, `y` (n_y,), and C = ∂y/∂z, by z.
        variables: What each sensor reads, by name.
        delays: Samples from a reading of each sensor to its arrival.
        n_drifts: Number of uncertain parameters, the last entries of z.
        start: z before the first reading, (n,).
        start_deviation: Expected deviations of z from there, (n,).
        signals: σ: the disturbances and parameters that known signals are, each with its row among
            all that varies.
    """

    transition: Definition
    output: Definition
    variables: tuple[str, ...]
    delays: tuple[int, ...]
    n_drifts: int
    start: Vector
    start_deviation: Vector
    signals: tuple[tuple[int, Varying], ...] = ()

    @property
    def n_disturbances(self) -> int:
        """Number of disturbances."""
        return self.transition.shapes["G"][1]

    @property
    def n_kept(self) -> int:
        """Samples of z that the filter keeps: the present one, and those of late readings."""
        return max(self.delays) + 1

    @property
    def n_noises(self) -> int:
        """Number of variances: of disturbances, drifts and sensors."""
        return self.n_disturbances + self.n_drifts + len(self.delays)


def filter_model(
    problem: Problem, sensors: Sequence[SensorTable], uncertain: Sequence[int]
) -> FilterModel:
    """Functions of a filter on a problem's model.

    Args:
        problem: Has the model with its nominal disturbances and parameters, and the reference.
        sensors: Name the states and outputs of the model.
        uncertain: Places of the parameters that are states of the filter.

    Raises:
        ModelError: A sensor reads what is neither a state nor an output, or what a signal changes;
            or a parameter is both uncertain and known.
    """
    signals = tuple(of_kind(problem.varying, "disturbance", "parameter"))
    _require_clear(problem, sensors, uncertain, signals)
    nominal = problem.model.nominal_parameters[list(uncertain)]
    deviations = (INITIAL_DEVIATION * bound_widths(problem), UNCERTAIN * np.abs(nominal))
    return FilterModel(
        transition=_augmented_transition(problem, uncertain, signals),
        output=_output(problem, sensors, uncertain),
        variables=tuple(sensor.variable for sensor in sensors),
        delays=tuple(sensor.delay for sensor in sensors),
        n_drifts=len(uncertain),
        start=np.concatenate([problem.reference_state, nominal]),
        start_deviation=np.concatenate(deviations),
        signals=signals,
    )


def _require_clear(
    problem: Problem,
    sensors: Sequence[SensorTable],
    uncertain: Sequence[int],
    signals: Sequence[tuple[int, Varying]],
) -> None:
    """Raise ModelError where a signal's parameter is uncertain, or a sensor's reading has it."""
    symbols = problem.model.symbols()
    for _, item in signals:
        if item.kind != "parameter":
            continue
        name = problem.model.parameters[item.place].name
        if item.place in uncertain:
            raise ModelError(
                f"signal '{item.signal}' says what the model's parameter {name} is, which the "
                "model calls uncertain: one of both"
            )
        for sensor in sensors:
            output = problem.model.outputs.get(sensor.variable)
            if output and ca.depends_on(ca.SX(output(*symbols)), symbols[3][item.place]):
                raise ModelError(
                    f"the estimator cannot read '{sensor.variable}', which depends on parameter "
                    f"{name} of the model, which signal '{item.signal}' moves"
                )


def bound_widths(problem: Problem) -> Vector:
    """Widths of the states' bounds, (n,); where there is no bound the reference's size.

    Args:
        problem: The problem.
    """
    widths = problem.state_upper - problem.state_lower
    return np.where(np.isfinite(widths), widths, np.abs(problem.reference_state))


def _with_uncertain(problem: Problem, uncertain: Sequence[int]) -> tuple[ca.SX, ca.SX]:
    """Symbols z of states and uncertain parameters, and p with these in their places."""
    model = problem.model
    z = ca.SX.sym("z", problem.n_states + len(uncertain))
    p = ca.SX(ca.DM(model.nominal_parameters))
    for place, index in enumerate(uncertain):
        p[index] = z[problem.n_states + place]
    return z, p


def _augmented_transition(
    problem: Problem,
    uncertain: Sequence[int],
    signals: Sequence[tuple[int, Varying]],
) -> Definition:
    """z₊, A = ∂z₊/∂z and G = ∂z₊/∂d at the nominal disturbances, by (z, u, σ)."""
    model = problem.model
    f = discretise(model, problem.sampling_time, problem.substeps)
    z, p = _with_uncertain(problem, uncertain)
    sigma = ca.SX.sym("sigma", len(signals))
    nominal = ca.SX(ca.DM(model.nominal_disturbance))
    for number, (_, item) in enumerate(signals):
        known = nominal if item.kind == "disturbance" else p
        known[item.place] = sigma[number]
    _, u, d, _ = model.symbols()
    x_next: Any = f(z[: problem.n_states], u, d, p)
    z_next = ca.vertcat(x_next, z[problem.n_states :])
    derivatives: Any = ca.Function(
        "derivatives",
        [z, u, sigma, d],
        [z_next, ca.jacobian(z_next, z), ca.jacobian(z_next, d)],
    )
    value, A, G = derivatives(z, u, sigma, nominal)
    results = {"z_next": value, "A": A, "G": G}
    return define("estimator_transition", {"z": z, "u": u, "sigma": sigma}, results)


def _output(
    problem: Problem, sensors: Sequence[SensorTable], uncertain: Sequence[int]
) -> Definition:
    """`y` (n_y,) and C = ∂y/∂z, by z."""
    model = problem.model
    z, p = _with_uncertain(problem, uncertain)
    x = z[: problem.n_states]
    _, u, d, _ = model.symbols()
    names = [quantity.name for quantity in model.states]
    rows = []
    for variable in (sensor.variable for sensor in sensors):
        if variable in model.outputs:
            rows.append(model.outputs[variable](x, u, d, p))
        elif variable in names:
            rows.append(x[names.index(variable)])
        else:
            raise ModelError(
                f"a [[sensor]] reads '{variable}', which is neither a state nor an output of model "
                f"'{model.name}': give it to the model, Model(outputs={{'{variable}': …}})"
            )
    y = ca.vertcat(*rows)
    results = {"y": y, "C": ca.jacobian(y, z)}
    return define("estimator_output", {"z": z}, results)


def measured_outputs(
    problem: Problem, sensors: Sequence[SensorTable], uncertain: Sequence[int] = ()
) -> StackedFunction:
    """Readings of the sensors from the model: `y` (n_y,) and C = ∂y/∂z, by z.

    Args:
        problem: Has the model.
        sensors: Name the states and outputs of the model.
        uncertain: Places of the parameters that z has behind the states; the others are nominal.

    Raises:
        ModelError: A sensor reads what is neither a state nor an output.
    """
    return StackedFunction(_output(problem, sensors, uncertain))


def by_direction(definition: Definition) -> Definition:
    """Derivative `moved` of a function's stacked results along a direction Z (n,) of z.

    Args:
        definition: `transition` or `output` of a `FilterModel`.
    """
    symbols = {name: ca.SX.sym(name, size) for name, size in definition.inputs.items()}
    stacked: ca.SX = definition.function(*symbols.values())
    Z = ca.SX.sym("Z", symbols["z"].numel())
    moved = ca.jtimes(stacked, symbols["z"], Z)
    name = f"{definition.function.name()}_by_z"
    return define(name, {**symbols, "Z": Z}, {"moved": moved})
