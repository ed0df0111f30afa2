"""Names at their former place until the imports have moved."""

from controllers.functions import BufferedFunction

__all__ = ["BufferedFunction"]
