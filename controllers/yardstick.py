"""Names at their former place until the imports have moved."""

from controllers.optimum import Yardstick, yardstick

__all__ = ["Yardstick", "yardstick"]
