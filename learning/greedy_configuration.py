"""Hyperparameters of a rule that tries θ, not actions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, Self

from pydantic import Field

from cosim.scenario import Scenario
from learning.configuration import Configuration


class GreedyConfiguration(Configuration):
    """Hyperparameters of a rule whose samples are greedy and whose θ comes from no fit."""

    exploration: Literal["none"] = Field(
        "none", description="none: it is θ that is tried, not actions"
    )

    def for_scenario(self, scenario: Scenario) -> Self:
        """Copy with what the scenario states of c_lambda's start; its exploration has no part."""
        own = {name: getattr(self, name) for name in type(self).model_fields if "explor" in name}
        return super().for_scenario(scenario).model_copy(update=own)

    def without_part(self) -> Mapping[str, str]:
        """What is of exploration and of steps."""
        explored = [name for name in type(self).model_fields if name.startswith("exploration_")]
        stepped = ["definiteness", "smallest_eigenvalue", "slack_linear_minimum"]
        return dict.fromkeys([*explored, *stepped], "a rule that tries θ, not actions")
