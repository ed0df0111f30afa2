"""Names at their former place until the imports have moved."""

from controllers.theta import Parameters

__all__ = ["Parameters"]
