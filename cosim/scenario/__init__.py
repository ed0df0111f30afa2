"""The scenario: one validated document that says what plant is controlled, and to what end."""

from cosim.scenario.scenario import Scenario

__all__ = ["Scenario"]
