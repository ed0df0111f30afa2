"""Names at their former place until the imports have moved."""

from controllers.functions import COMPILED, SWITCH, description

__all__ = ["COMPILED", "SWITCH", "description"]
