"""The tables of a scenario document, each with its fields, types and ranges."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

Number = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Name = Annotated[str, Field(min_length=1)]
Names = Annotated[tuple[Name, ...], Field(strict=False)]
Numbers = Annotated[tuple[Number, ...], Field(strict=False)]
Limits = Annotated[tuple[float, ...], Field(strict=False)]
NonNegatives = Annotated[tuple[NonNegative, ...], Field(strict=False)]


class Table(BaseModel):
    """A table whose fields are all known, checked strictly and never changed."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, populate_by_name=True)


class MappingTable(Table):
    """FMU variables through which a reset writes what the scenario says; each may be left out.

    `initial_state` one start parameter per state; `seed` the variables that take the seed, low 32
    bits first (a 64-bit variable takes all of it and ends the list); `law` takes the number that
    `law_codes` gives; `nominal` and `ranges` one variable per disturbance.
    """

    initial_state: Names = ()
    seed: Names = ()
    sampling_time: Name | None = None
    stochastic: Name | None = None
    law: Name | None = None
    law_codes: dict[str, int] = {}
    nominal: Names = ()
    ranges: Names = ()


class PlantTable(Table):
    """The FMU and the map from its variables to states, actions, disturbances and stage cost.

    `fmu` is the name of a shipped one (`evaporator`, `evaporator_fmi3`) or a path, relative to
    the scenario's file. `parameters` are further start values that each reset writes.
    """

    fmu: Name
    states: Annotated[Names, Field(min_length=1)]
    actions: Annotated[Names, Field(min_length=1)]
    disturbances: Names = ()
    stage_cost: Name
    initial_state: Numbers
    parameters: dict[str, float | bool] = {}
    mapping: MappingTable = MappingTable()


class DisturbanceTable(Table):
    """Law of the disturbances, drawn anew each sample and held.

    `ranges` are half widths for the uniform law and standard deviations for the normal one.
    """

    law: Literal["uniform", "normal", "none"] = "none"
    nominal: Numbers = ()
    ranges: NonNegatives = ()


class BoundsTable(Table):
    """Bounds of the states (soft: the penalty) and of the actions (hard: the actuators)."""

    state_lower: Limits
    state_upper: Limits
    action_lower: Numbers
    action_upper: Numbers


class PenaltyTable(Table):
    """Weights b and B of the violation v: Σᵢ bᵢ vᵢ + Bᵢ vᵢ² per sample."""

    linear: NonNegatives
    quadratic: NonNegatives


class ExplorationTable(Table):
    """ε-greedy exploration: `additive` a = sat(π(s)+e), `literal` a = sat(e), e ~ N(0, diag σ²)."""

    kind: Literal["additive", "literal", "none"] = "none"
    probability: Annotated[float, Field(ge=0, le=1)] = 0.0
    standard_deviation: NonNegatives = ()


class ControllerTable(Table):
    """What the controller is told; `reference_*` is the operating point x_s, u_s, ℓ_s.

    `value_offset` is c_λ at the start: `stage-cost` ℓ_s (paper) or `discounted` ℓ_s/(1−γ).
    """

    model: Annotated[str, Field(pattern=r"^[\w.]+:\w+$")] | None = None
    horizon: Annotated[int, Field(ge=1, le=1000)] = 10
    substeps: Annotated[int, Field(ge=1, le=1000)] = 2
    hessian: Literal["gauss-newton", "exact"] = "gauss-newton"
    backend: Annotated[str, Field(pattern=r"^(daqp|proxqp|qpsolvers:\w+)$")] = "daqp"
    value_offset: Literal["stage-cost", "discounted"] = "stage-cost"
    reference_state: Numbers
    reference_action: Numbers
    reference_cost: Number
