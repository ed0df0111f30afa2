"""Moved to `learning.algorithm`."""

from learning.algorithm import (
    Algorithm,
    LearnableController,
    LearnableSolution,
    Rule,
    Transition,
    Update,
)

__all__ = ["Algorithm", "LearnableController", "LearnableSolution", "Rule", "Transition", "Update"]
