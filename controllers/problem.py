"""What a controller is told of its task: model, horizon, bounds, penalty and reference."""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from controllers.errors import ModelError
from controllers.model import Model
from controllers.penalty import StatePenalty
from controllers.units import Units

Vector = NDArray[np.float64]


class ScenarioLike(Protocol):
    """The part of a scenario that a controller reads (`cosim.Scenario` has it)."""

    @property
    def sampling_time(self) -> float:
        """Sampling time [s]."""

    @property
    def discount(self) -> float:
        """Discount γ."""

    @property
    def state_lower(self) -> Vector:
        """Lower bounds of the states, (n,)."""

    @property
    def state_upper(self) -> Vector:
        """Upper bounds of the states, (n,)."""

    @property
    def action_lower(self) -> Vector:
        """Lower bounds of the actions, (m,)."""

    @property
    def action_upper(self) -> Vector:
        """Upper bounds of the actions, (m,)."""

    @property
    def penalty_linear(self) -> Vector:
        """Linear weight of a violation, (n,)."""

    @property
    def penalty_quadratic(self) -> Vector:
        """Quadratic weight of a violation, (n,)."""

    @property
    def controller(self) -> Any:
        """Settings of the controller."""

    @property
    def hash(self) -> str:
        """Hash of the scenario."""


def _frozen(name: str, values: ArrayLike, size: int) -> Vector:
    try:
        array = np.array(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ModelError(f"problem: {name} holds no numbers: {values!r}") from error
    if array.shape != (size,) or not np.isfinite(array).all():
        raise ModelError(f"problem: {name} must be {size} finite numbers, not {array}")
    array.flags.writeable = False
    return array


@dataclass(frozen=True)
class Problem:
    """A discounted optimal control problem around a reference steady state.

    `sampling_time` [s]; `horizon` N stages; `discount` γ ∈ (0, 1]; the bounds `state_lower` and
    `state_upper` (n,), `action_lower` and `action_upper` (m,), and the reference `reference_state`
    x_s (n,), `reference_action` u_s (m,), in the units of the model's quantities; `reference_cost`
    ℓ_s. The penalty of a violation v ≥ 0 is Σ_i linear_i v_i + quadratic_i v_i² with
    `penalty_linear` and `penalty_quadratic` (n,) (paper.tex, Simulations). `substeps` RK4 steps
    make a sample of the model. Raises ModelError on sizes or values that do not fit.
    """

    model: Model
    sampling_time: float
    horizon: int
    discount: float
    state_lower: Vector
    state_upper: Vector
    action_lower: Vector
    action_upper: Vector
    penalty_linear: Vector
    penalty_quadratic: Vector
    reference_state: Vector
    reference_action: Vector
    reference_cost: float
    substeps: int = 2

    def __post_init__(self) -> None:
        """Freeze the arrays and check every size and sign once."""
        n, m = self.n_states, self.n_actions
        for name, size in (
            ("state_lower", n),
            ("state_upper", n),
            ("action_lower", m),
            ("action_upper", m),
            ("penalty_linear", n),
            ("penalty_quadratic", n),
            ("reference_state", n),
            ("reference_action", m),
        ):
            object.__setattr__(self, name, _frozen(name, getattr(self, name), size))
        for kind in ("state", "action"):
            if not (getattr(self, f"{kind}_lower") < getattr(self, f"{kind}_upper")).all():
                raise ModelError(f"problem: {kind}_lower must be below {kind}_upper everywhere")
        if (self.penalty_linear <= 0).any() or (self.penalty_quadratic <= 0).any():
            raise ModelError("problem: penalty_linear and penalty_quadratic must be positive")
        if self.horizon < 1 or not 0 < self.discount <= 1:
            raise ModelError(
                f"problem: horizon {self.horizon} must be at least 1 and discount "
                f"{self.discount} in (0, 1]"
            )
        if not 0 < self.sampling_time < np.inf or self.substeps < 1:
            raise ModelError(
                f"problem: sampling_time {self.sampling_time} s must be positive and finite and "
                f"substeps {self.substeps} at least 1"
            )
        if not np.isfinite(self.reference_cost):
            raise ModelError(f"problem: reference_cost must be finite, not {self.reference_cost}")

    @property
    def n_states(self) -> int:
        """Number of states n."""
        return len(self.model.states)

    @property
    def n_actions(self) -> int:
        """Number of actions m."""
        return len(self.model.actions)

    @cached_property
    def penalty(self) -> StatePenalty:
        """Penalty of a state by the true bounds."""
        return StatePenalty(
            self.state_lower, self.state_upper, self.penalty_linear, self.penalty_quadratic
        )

    @cached_property
    def units(self) -> Units:
        """Orders of magnitude of states, actions and cost."""
        return Units.of(
            self.model,
            np.concatenate([self.state_lower, self.action_lower]),
            np.concatenate([self.state_upper, self.action_upper]),
            np.concatenate([self.reference_state, self.reference_action]),
            self.reference_cost,
        )

    def value_level(self, discount: float | None = None) -> float:
        """ℓ_s/(1−γ), the value of staying at the reference; ℓ_s where γ = 1.

        `discount` γ is the problem's own where None.
        """
        gamma = self.discount if discount is None else discount
        return self.reference_cost / (1 - gamma) if gamma < 1 else self.reference_cost

    @classmethod
    def from_scenario(cls, scenario: ScenarioLike) -> Problem:
        """Build the problem that a scenario describes; its model is named `module:factory`."""
        settings = scenario.controller
        return cls(
            model=load_model(settings.model),
            sampling_time=scenario.sampling_time,
            horizon=settings.horizon,
            discount=scenario.discount,
            state_lower=scenario.state_lower,
            state_upper=scenario.state_upper,
            action_lower=scenario.action_lower,
            action_upper=scenario.action_upper,
            penalty_linear=scenario.penalty_linear,
            penalty_quadratic=scenario.penalty_quadratic,
            reference_state=settings.reference_state,
            reference_action=settings.reference_action,
            reference_cost=settings.reference_cost,
            substeps=settings.substeps,
        )


def load_model(name: str | None) -> Model:
    """Import a model by `module:factory`; raises ModelError where there is none to be had."""
    if name is None:
        raise ModelError(
            'the scenario names no model for this controller; add model = "module:factory" to its '
            'table [controller], for the evaporator "controllers.evaporator:model"'
        )
    module_name, _, factory_name = name.partition(":")
    try:
        factory = getattr(importlib.import_module(module_name), factory_name)
        model = factory()
    # A user's module may raise anything, and one that is a script may even exit.
    except (Exception, SystemExit) as error:
        raise ModelError(
            f"model '{name}' cannot be loaded ({type(error).__name__}: {error}); name it as "
            "module:factory"
        ) from error
    if not isinstance(model, Model):
        raise ModelError(f"model '{name}' returned {type(model).__name__}, not a controllers.Model")
    return model
