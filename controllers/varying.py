"""What of a problem differs from stage to stage of the horizon, because a signal says so."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal, NamedTuple

import casadi as ca
import numpy as np

from controllers.errors import ModelError
from controllers.model import Model
from cosim.core.protocols import Vector
from cosim.core.scenario import Scenario, SignalTable
from cosim.core.validation import instead

VaryingKind = Literal["disturbance", "parameter", "price", "lower", "upper", "reference"]

MODEL_KINDS: tuple[VaryingKind, ...] = ("disturbance", "parameter", "price")
"""Kinds of what a signal gives of the model."""


class Varying(NamedTuple):
    """A quantity that differs from stage to stage.

    Attributes:
        signal: Name of the signal that gives its values.
        kind: What it is. A `price` is a parameter that the model's economic cost alone depends on.
        place: Its number among the model's disturbances, its parameters, the states, or (x, u).
        nominal: Its value where the signal is not known.
    """

    signal: str
    kind: VaryingKind
    place: int
    nominal: float


def varying_quantities(scenario: Scenario, model: Model) -> tuple[Varying, ...]:
    """What the signals of a scenario that a controller knows of are to its problem.

    Args:
        scenario: Has the signals, bounds and reference.
        model: The controller's model.

    Raises:
        ModelError: A signal names what the model does not have.
    """
    quantities = []
    for table in scenario.signals or ():
        # The plant follows such a signal, and the controller hears nothing of it.
        if table.known == "none":
            continue
        if table.model is not None:
            quantities.append(_of_model(table, table.model, model))
        elif table.bound is not None:
            quantities.append(_bound(table, scenario))
        elif table.reference is not None:
            quantities.append(_moving_reference(table, table.reference, scenario))
    return tuple(quantities)


def _of_model(
    table: SignalTable,
    name: str,
    model: Model,
) -> Varying:
    """The disturbance or parameter of a model that a signal is; raises ModelError."""
    # No two quantities of a model have one name.
    disturbances = [quantity.name for quantity in model.disturbances]
    parameters = [quantity.name for quantity in model.parameters]
    if name in disturbances:
        index = disturbances.index(name)
        nominal = model.disturbances[index].nominal
        return Varying(table.name, "disturbance", index, nominal)
    if name in parameters:
        index = parameters.index(name)
        kind: VaryingKind = "price" if is_price(model, index) else "parameter"
        nominal = model.parameters[index].nominal
        return Varying(table.name, kind, index, nominal)
    raise ModelError(
        f"signal '{table.name}': model '{model.name}' has no disturbance or parameter '{name}'"
        f"{instead(name, (*disturbances, *parameters))}"
    )


def _bound(table: SignalTable, scenario: Scenario) -> Varying:
    """The bound of a state that a signal is."""
    index = scenario.plant.states.index(table.bounded_state)
    kind: VaryingKind
    if table.is_lower_bound:
        kind = "lower"
        bounds = scenario.state_lower
    else:
        kind = "upper"
        bounds = scenario.state_upper
    nominal = float(bounds[index])
    return Varying(table.name, kind, index, nominal)


def _moving_reference(
    table: SignalTable,
    name: str,
    scenario: Scenario,
) -> Varying:
    """The reference of a state or an action that a signal is."""
    plant = scenario.plant
    names = [*plant.states, *plant.actions]
    index = names.index(name)
    references = np.concatenate([scenario.reference_state, scenario.reference_action])
    nominal = float(references[index])
    return Varying(table.name, "reference", index, nominal)


def is_price(model: Model, index: int) -> bool:
    """Whether a parameter is in the economic cost and not in the dynamics."""
    symbols = model.symbols()
    *_, p = symbols
    parameter = p[index]
    rates = ca.SX(model.ode(*symbols))
    cost = ca.SX(model.economic_cost(*symbols))
    in_dynamics = ca.depends_on(rates, parameter)
    in_cost = ca.depends_on(cost, parameter)
    return bool(in_cost and not in_dynamics)


def given_parameters(varying: Iterable[Varying], model: Model) -> tuple[str, ...]:
    """Names of a model's parameters whose values signals give, so that θ cannot have them.

    Args:
        varying: All quantities.
        model: The controller's model.
    """
    items = of_kind(varying, "parameter", "price")
    return tuple(model.parameters[item.place].name for _, item in items)


def of_kind(varying: Iterable[Varying], *kinds: VaryingKind) -> list[tuple[int, Varying]]:
    """The quantities of some kinds, each with its row among all.

    Args:
        varying: All quantities.
        kinds: The kinds that are wanted.
    """
    return [(row, item) for row, item in enumerate(varying) if item.kind in kinds]


def hold_last(column: Vector, values: Vector) -> None:
    """Fill the stages of the horizon with what is known of a signal; beyond that it keeps the last.

    Args:
        column: of the stages 0 … N, (N+1,), which is overwritten.
        values: the present one and those that follow, as many as are known.
    """
    n_known = min(len(values), len(column))
    column[:n_known] = values[:n_known]
    column[n_known:] = values[-1]
