"""Hyperparameters: typed, documented, validated, by `NAME=VALUE`."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Mapping
from math import inf
from typing import Annotated, Any, Literal, NamedTuple, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from controllers.model import Model
from cosim.core.scenario import NonNegative, Positive, Scenario
from cosim.core.validation import assignments, validated
from learning.errors import ConfigurationError

ALL = ("all",)
"""In place of names: every parameter of the controller's model."""
Share = Annotated[float, Field(ge=0, le=1)]
Count = Annotated[int, Field(ge=1)]
# The rules differ in these four, so they have other defaults in each.
ModelParameters = Annotated[
    tuple[str, ...],
    Field(description='parameters of the controller\'s model in θ; ["all"]: all of them'),
]
ExplorationProbability = Annotated[Share, Field(description="share of samples that explore")]
ExplorationShare = Annotated[
    Positive, Field(description="standard deviation of e as a share of the input's range")
]
ExplorationDecay = Annotated[
    Count | None,
    Field(
        description=(
            "samples T after which the share that explores falls as T/k; constant if not given"
        ),
    ),
]


class Hyperparameter(NamedTuple):
    """Description of a hyperparameter for `--explain`."""

    name: str
    default: str
    allowed: str
    meaning: str


class Configuration(BaseModel):
    """Hyperparameters that every algorithm has; an algorithm adds its own in a subclass.

    A scenario's exploration and first c_lambda replace an algorithm's defaults, but no value that
    the user set (`for_scenario`). A field's description is its documentation (`documentation`).
    Scaled coordinates are θ / blocks.scale, so that one step size fits all entries.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    parametrisation: Literal["paper", "extended"] = Field(
        "extended",
        description="θ of the paper, or extended by the slack weights of the predicted stages",
    )
    value_offset: Literal["stage-cost", "discounted"] = Field(
        "discounted",
        description="c_lambda at the start, if the scenario has none: ℓ_s (paper) or ℓ_s/(1−γ)",
    )
    model_parameters: ModelParameters = ()
    smallest_eigenvalue: Positive = Field(
        1e-3,
        description="least eigenvalue that B_l and B_Vf may have, in the problem's own units",
    )
    retreat_probability: Share = Field(
        3e-4,
        description=(
            "level of the test that a shift costs more than the cheapest one; θ then goes "
            "back; 0: never"
        ),
    )
    shift_hours: Positive = Field(8.0, description="hours of a shift")
    exploration: Literal["additive", "literal", "none"] = Field(
        "additive",
        description="a = sat(π+e), a = sat(e), or always a = π; a scenario's table [exploration] "
        "replaces the defaults of all exploration settings",
    )
    exploration_probability: ExplorationProbability = 1.0
    exploration_share: ExplorationShare = 1 / 60
    exploration_decay_after: ExplorationDecay = None
    exploration_deviation: tuple[NonNegative, ...] | None = Field(
        None,
        description=(
            "σ of e in the units of u, one or one per action; takes the place of the share"
        ),
    )

    @classmethod
    def from_assignments(cls, texts: Iterable[str]) -> Self:
        """Build from `NAME=VALUE` texts, values as in TOML (a bare word is a string).

        Raises ConfigurationError that names the field and what it may be.
        """
        # A bare word is a text, so that no shell needs two kinds of quotes.
        values: dict[str, Any] = {}
        for name, text in assignments(texts, "--set", "NAME=VALUE", ConfigurationError):
            if name in values:
                raise ConfigurationError(f"--set {name} is given twice")
            values[name] = _value(text)
        return cls.from_dict(values)

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Self:
        """Build from a mapping; raises ConfigurationError."""
        return validated(cls, values, "hyperparameters", ConfigurationError)

    def for_scenario(self, scenario: Scenario) -> Self:
        """Copy with the scenario's values in place of defaults."""
        # What a user has set stands, whatever the scenario says.
        stated: dict[str, Any] = {}
        table = scenario.exploration
        if table is not None:
            stated["exploration"] = table.kind
            stated["exploration_probability"] = table.probability
            stated["exploration_deviation"] = table.standard_deviation or (0.0,)
            stated["exploration_decay_after"] = None
        if scenario.controller.value_offset is not None:
            stated["value_offset"] = scenario.controller.value_offset
        for name in self.model_fields_set:
            stated.pop(name, None)
        return self.model_copy(update=stated)

    @property
    def full_exploration(self) -> float:
        """Samples after which the share that explores falls."""
        return self.exploration_decay_after or inf

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
        # A setting that acts nowhere is a mistake of its user, who expects it to act.
        for name, where in self.without_part().items():
            default = type(self).model_fields[name].default
            if getattr(self, name) != default:
                raise ValueError(f"{name}: has no part in {where}; leave it out")
        return self

    @classmethod
    def documentation(cls) -> list[Hyperparameter]:
        """Name, default, allowed values and meaning of each hyperparameter."""
        # The schema knows ranges and choices, in words that pydantic has checked.
        properties = cls.model_json_schema()["properties"]
        documented = []
        for name, field in cls.model_fields.items():
            allowed = _allowed(properties[name])
            meaning = field.description or ""
            default = _as_typed(field.default)
            documented.append(Hyperparameter(name, default, allowed, meaning))
        return documented


class GreedyConfiguration(Configuration):
    """Hyperparameters of a rule with greedy samples and without a fit of θ."""

    exploration: Literal["none"] = Field(
        "none",
        description="none: the rule tries θ, not actions",
    )

    def for_scenario(self, scenario: Scenario) -> Self:
        """Copy with what the scenario states of c_lambda's start; its exploration has no part."""
        # A table [exploration] of the scenario is for the rules that explore.
        unchanged = {}
        for name in type(self).model_fields:
            if name.startswith("exploration"):
                unchanged[name] = getattr(self, name)
        return super().for_scenario(scenario).model_copy(update=unchanged)

    def without_part(self) -> Mapping[str, str]:
        """Hyperparameters of exploration and steps."""
        names = ["smallest_eigenvalue"]
        for name in type(self).model_fields:
            if name.startswith("exploration_"):
                names.append(name)
        return dict.fromkeys(names, "a rule that tries θ, not actions")


def _as_typed(value: object) -> str:
    """A default as one types it behind `--set NAME=`; `unset` where it is None."""
    if value is None:
        return "unset"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, tuple | list):
        return f"[{', '.join(_as_typed(entry) for entry in value)}]"
    return str(value)


def _value(text: str) -> Any:
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except (ValueError, RecursionError):
        return text


def _allowed(schema: Mapping[str, Any]) -> str:
    """Allowed values of a JSON schema, in words: a range, a choice, or a type."""
    if "anyOf" in schema:
        return " or ".join(_allowed(part) for part in schema["anyOf"])
    if "enum" in schema:
        return ", ".join(schema["enum"])
    if "const" in schema:
        return str(schema["const"])
    if "prefixItems" in schema:
        # Of a tuple of fixed length all entries are of one kind.
        entries = schema["prefixItems"]
        return f"{len(entries)} × {_allowed(entries[0])}"
    if "items" in schema:
        entry = _allowed(schema["items"])
        return "names" if entry == "text" else f"list of {entry}"
    signs = {
        "exclusiveMinimum": ">",
        "minimum": "≥",
        "exclusiveMaximum": "<",
        "maximum": "≤",
    }
    limits = []
    for key, sign in signs.items():
        if key in schema:
            limits.append(f"{sign} {schema[key]:g}")
    kind = str(schema.get("type", ""))
    words = {
        "boolean": "true, false",
        "null": "unset",
        "string": "text",
    }
    word = words.get(kind, kind)
    range_in_words = ", ".join(limits)
    # One of both may be missing.
    return f"{word} {range_in_words}".strip()
