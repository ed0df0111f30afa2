"""Hyperparameters: typed, documented, validated, by `name=value`; the exploration they describe."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator
from scipy.special import ndtr

from controllers.model import Model
from cosim.protocols import Matrix, Vector
from cosim.scenario import Scenario
from cosim.validation import validated
from learning.errors import ConfigurationError

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0, le=1)]
Count = Annotated[int, Field(ge=1)]
# The rules differ in how much exploration they need, so these two have other defaults in each.
ExplorationProbability = Annotated[Share, Field(description="share of samples that explore")]
ExplorationShare = Annotated[
    Positive, Field(description="standard deviation of e as a share of the input's range")
]


@dataclass(frozen=True)
class Strategy:
    """Draws the actions that explore: a = sat(c + e), e ~ N(0, diag σ²), on a share of the samples.

    The centre c is the policy's action (`additive`) or zero (`literal`, as the paper prints it).
    `probability` is the share and `deviation` σ (m,) or (1,) in the actions' units; `lower` and
    `upper` (m,) bound the action. The loop saturates.
    """

    kind: str
    lower: Vector
    upper: Vector
    probability: float
    deviation: Vector

    def __call__(self, action: Vector, rng: np.random.Generator) -> Vector | None:
        """Exploring action (m,) in place of the policy's `action`; None: greedy."""
        # Drawn in every sample, so that paired runs stay in step whatever the probability.
        draw, e = rng.random(), rng.standard_normal(self.lower.size)
        if draw >= self.probability:
            return None
        explored: Vector = self._centre(action) + self.deviation * e
        return explored

    def bias(self, actions: Matrix) -> Matrix:
        """E[a − π | explored] of samples with policies π, (K, m).

        From the moments of the censored normal distribution; zero but for saturation and a centre
        that is not π.
        """
        centres = self._centre(actions)
        sigma = np.maximum(self.deviation, np.finfo(float).tiny)
        low, high = (self.lower - centres) / sigma, (self.upper - centres) / sigma
        density = (np.exp(-(low**2) / 2) - np.exp(-(high**2) / 2)) / np.sqrt(2 * np.pi)
        mean: Matrix = sigma * (density + low * ndtr(low) + high * ndtr(-high))
        return mean + (centres - actions)

    def _centre(self, action: Vector) -> Vector:
        return action if self.kind == "additive" else np.zeros_like(action)


class Configuration(BaseModel):
    """Hyperparameters that every algorithm has; an algorithm adds its own in a subclass.

    What a scenario states of exploration and c_lambda's start takes the place of an algorithm's
    defaults, but not of what the user set (`for_scenario`). A field's description is its
    documentation (`documentation`). Scaled coordinates are θ / blocks.scale, so that one step size
    fits all entries.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    parametrisation: Literal["paper", "extended"] = Field(
        "extended",
        description="θ of the paper, or that and the slack weights of the predicted stages",
    )
    value_offset: Literal["stage-cost", "discounted"] = Field(
        "discounted",
        description="c_lambda at the start: ℓ_s (paper) or ℓ_s/(1−γ), unless the scenario says",
    )
    model_parameters: tuple[str, ...] = Field(
        (), description="parameters of the controller's model that θ has, in its block p"
    )
    smallest_eigenvalue: Positive = Field(
        1e-3, description="least eigenvalue that B_l and B_Vf may have, in the problem's own units"
    )
    exploration: Literal["additive", "literal", "none"] = Field(
        "additive",
        description="a = sat(π+e), a = sat(e), or always a = π; this and what follows: unless the "
        "scenario has a table [exploration]",
    )
    exploration_probability: ExplorationProbability = 1.0
    exploration_share: ExplorationShare = 1 / 60
    exploration_deviation: tuple[NonNegative, ...] | None = Field(
        None, description="the same in the units of u, one or one per action, in place of the share"
    )

    @classmethod
    def from_assignments(cls, assignments: Iterable[str]) -> Self:
        """Build from `name=value` texts, values as in TOML (a bare word is a string).

        Raises ConfigurationError that names the field and what it may be.
        """
        values: dict[str, Any] = {}
        for assignment in assignments:
            name, equals, text = assignment.partition("=")
            if not equals:
                raise ConfigurationError(f"'{assignment}' is no hyperparameter; write name=value")
            values[name.strip()] = _value(text.strip())
        return cls.from_dict(values)

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Self:
        """Build from a mapping; raises ConfigurationError."""
        return validated(cls, values, "hyperparameters", ConfigurationError)

    def for_scenario(self, scenario: Scenario) -> Self:
        """Copy with the scenario's values in place of defaults."""
        stated: dict[str, Any] = {}
        if (table := scenario.exploration) is not None:
            stated = {
                "exploration": table.kind,
                "exploration_probability": table.probability,
                "exploration_deviation": table.standard_deviation or (0.0,),
            }
        if scenario.controller.value_offset is not None:
            stated["value_offset"] = scenario.controller.value_offset
        chosen = self.model_fields_set
        return self.model_copy(update={k: v for k, v in stated.items() if k not in chosen})

    def deviation(self, scenario: Scenario) -> Vector:
        """Standard deviation of the exploration in the units of u, (m,) or (1,)."""
        if self.exploration_deviation is not None:
            return np.array(self.exploration_deviation)
        return self.exploration_share * (scenario.action_upper - scenario.action_lower)

    def strategy(self, scenario: Scenario) -> Strategy:
        """The exploration; ConfigurationError on a wrong number of deviations."""
        lower, upper = scenario.action_lower, scenario.action_upper
        deviation = np.asarray(self.deviation(scenario), dtype=np.float64)
        if deviation.size not in (1, lower.size):
            raise ConfigurationError(
                f"exploration_deviation has {deviation.size} entries; give one, or one for each of "
                f"the {lower.size} actions"
            )
        if self.exploration == "none":
            return Strategy("additive", lower, upper, 0.0, deviation)
        return Strategy(self.exploration, lower, upper, self.exploration_probability, deviation)

    def learned_parameters(self, model: Model) -> tuple[str, ...]:
        """Names of the model parameters that θ has."""
        return self.model_parameters

    def without_part(self) -> Mapping[str, str]:
        """Hyperparameters without effect here, each with the part that it belongs to."""
        return {}

    @model_validator(mode="after")
    def _refuse_what_has_no_part(self) -> Self:
        for name, where in self.without_part().items():
            if getattr(self, name) != type(self).model_fields[name].default:
                raise ValueError(f"{name}: has no part in {where}; leave it out")
        return self

    @classmethod
    def documentation(cls) -> list[tuple[str, str, str]]:
        """Name, default and meaning of each hyperparameter."""
        return [
            (name, repr(field.default), field.description or "")
            for name, field in cls.model_fields.items()
        ]


def _value(text: str) -> Any:
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except (ValueError, RecursionError):
        return text
