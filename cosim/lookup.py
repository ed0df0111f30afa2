"""Names at their former place until the imports have moved to `cosim.plugins`."""

from cosim.plugins import build_controller, import_from

__all__ = ["GROUP", "build_controller", "import_from", "import_from_here"]
GROUP = "cosim.controllers"


def import_from_here() -> None:
    """Nothing: `load_plugin` searches the working directory by itself."""
