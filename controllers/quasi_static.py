"""Names at their former place until the imports have moved."""

from controllers.optimum import DAY, Fouling, QuasiStaticPolicy

__all__ = ["DAY", "Fouling", "QuasiStaticPolicy"]
