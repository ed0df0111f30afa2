"""The economic optimum of a model and the NMPC cost tuned by it."""

from controllers.economic.tuning import EconomicTuning, tune

__all__ = ["EconomicTuning", "tune"]
