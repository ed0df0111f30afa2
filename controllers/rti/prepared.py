"""Names at their former place until the imports have moved."""

from controllers.rti.solution import LinearisationPoint

__all__ = ["LinearisationPoint"]
