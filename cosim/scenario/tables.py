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

    What is left out is not written: without `seed`, for instance, the FMU draws its own noise.
    """

    initial_state: Names = ()
    """One start parameter per state."""
    seed: Names = ()
    """Variables of the seed, low 32 bits first; a 64-bit one takes all of it and ends the list."""
    sampling_time: Name | None = None
    """Parameter of the disturbances' grid, in s."""
    stochastic: Name | None = None
    """Boolean parameter: false gives the nominal plant."""
    law: Name | None = None
    """Parameter of the law, which takes the number that `law_codes` gives."""
    law_codes: dict[str, int] = {}
    """The FMU's number of each law by its name."""
    nominal: Names = ()
    """One parameter per disturbance for its nominal value."""
    ranges: Names = ()
    """One parameter per disturbance for its half width or standard deviation."""


class PlantTable(Table):
    """The FMU and the map from its variables to states, actions, disturbances and stage cost.

    Values are in the FMU's units.
    """

    fmu: Name
    """A shipped FMU (`evaporator`, `evaporator_fmi3`) or a path relative to the scenario's file."""
    states: Annotated[Names, Field(min_length=1)]
    """Names of the n variables that are the state."""
    actions: Annotated[Names, Field(min_length=1)]
    """Names of the m inputs that the controller sets."""
    disturbances: Names = ()
    """Names of the p outputs that say which disturbance was realised."""
    stage_cost: Name
    """Name of the output ℓ(x, u, d), without penalty."""
    initial_state: Numbers
    """State at k = 0, (n,)."""
    parameters: dict[str, float | bool] = {}
    """Further start values, by variable, that each reset writes."""
    model: Annotated[str, Field(pattern=r"^[\w.]+:\w+$")] | None = None
    """Model of the plant for its optimum, `module:factory`, where the controller's is another."""
    mapping: MappingTable = MappingTable()
    """Table `[plant.mapping]`."""


class DisturbanceTable(Table):
    """Law of the disturbances, drawn anew each sample and held."""

    law: Literal["uniform", "normal", "none"] = "none"
    """Uniform about the nominal value, normal about it, or that value itself."""
    nominal: Numbers = ()
    """Nominal values, (p,)."""
    ranges: NonNegatives = ()
    """Half widths of the uniform law, standard deviations of the normal one, (p,)."""


class BoundsTable(Table):
    """Bounds of the states (soft: the penalty) and of the actions (hard: the actuators)."""

    state_lower: Limits
    """x_l, (n,); −∞ where there is none."""
    state_upper: Limits
    """x_u, (n,); ∞ where there is none."""
    action_lower: Numbers
    """u_l, (m,)."""
    action_upper: Numbers
    """u_u, (m,)."""


class PenaltyTable(Table):
    """Weights b and B of the violation v: Σᵢ bᵢ vᵢ + Bᵢ vᵢ² per sample."""

    linear: NonNegatives
    """b, (n,)."""
    quadratic: NonNegatives
    """B, (n,)."""


class ExplorationTable(Table):
    """ε-greedy exploration: `additive` a = sat(π(s)+e), `literal` a = sat(e), e ~ N(0, diag σ²)."""

    kind: Literal["additive", "literal", "none"] = "none"
    """How e enters the action."""
    probability: Annotated[float, Field(ge=0, le=1)] = 0.0
    """Share ε of the samples that explore."""
    standard_deviation: NonNegatives = ()
    """σ in the units of the actions, (m,)."""


class ControllerTable(Table):
    """What the controller is told."""

    model: Annotated[str, Field(pattern=r"^[\w.]+:\w+$")] | None = None
    """Its model of the plant, `module:factory`; not needed by controllers that have none."""
    horizon: Annotated[int, Field(ge=1, le=1000)] = 10
    """Stages N."""
    substeps: Annotated[int, Field(ge=1, le=1000)] = 2
    """Runge–Kutta steps of the model per sample."""
    hessian: Literal["gauss-newton", "exact"] = "gauss-newton"
    """Hessian of the QP: the cost's, or the Lagrangian's, convexified."""
    backend: Annotated[str, Field(pattern=r"^(daqp|proxqp|qpsolvers:\w+)$")] = "daqp"
    """QP solver: `daqp`, `proxqp`, or any of qpsolvers as `qpsolvers:NAME`."""
    iterations: Annotated[int, Field(ge=1, le=100)] = 1
    """QPs a sample: 1 is the real-time iteration, more of them come near to convergence."""
    value_offset: Literal["stage-cost", "discounted"] | None = None
    """c_λ at the start: ℓ_s (paper) or ℓ_s/(1−γ); without it left to the algorithm, ℓ_s else."""
    reference_state: Numbers
    """x_s of the operating point, (n,)."""
    reference_action: Numbers
    """u_s, (m,)."""
    reference_cost: Number
    """ℓ_s."""
