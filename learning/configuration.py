"""Hyperparameters: typed, documented, validated, by `name=value`."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Mapping
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from controllers.model import Model
from cosim.scenario import Scenario
from cosim.validation import validated
from learning.errors import ConfigurationError

ALL = ("all",)
"""In place of names: every parameter of the controller's model."""
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0, le=1)]
Count = Annotated[int, Field(ge=1)]
# The rules differ in these three, so they have other defaults in each.
ModelParameters = Annotated[
    tuple[str, ...],
    Field(description='parameters of the controller\'s model that θ has; all of them by ["all"]'),
]
ExplorationProbability = Annotated[Share, Field(description="share of samples that explore")]
ExplorationShare = Annotated[
    Positive, Field(description="standard deviation of e as a share of the input's range")
]


class Configuration(BaseModel):
    """Hyperparameters that every algorithm has; an algorithm adds its own in a subclass.

    A scenario's exploration and first c_lambda replace an algorithm's defaults, but no value that
    the user set (`for_scenario`). A field's description is its documentation (`documentation`).
    Scaled coordinates are θ / blocks.scale, so that one step size fits all entries.
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
    model_parameters: ModelParameters = ()
    smallest_eigenvalue: Positive = Field(
        1e-3, description="least eigenvalue that B_l and B_Vf may have, in the problem's own units"
    )
    exploration: Literal["additive", "literal", "none"] = Field(
        "additive",
        description="a = sat(π+e), a = sat(e), or always a = π; a scenario's table [exploration] "
        "replaces the defaults of all four exploration settings",
    )
    exploration_probability: ExplorationProbability = 1.0
    exploration_share: ExplorationShare = 1 / 60
    exploration_deviation: tuple[NonNegative, ...] | None = Field(
        None, description="in place of the share: σ of e in the units of u, one or one per action"
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

    def learned_parameters(self, model: Model) -> tuple[str, ...]:
        """Names of the model parameters that θ has."""
        if self.model_parameters != ALL:
            return self.model_parameters
        return tuple(parameter.name for parameter in model.parameters)

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
