"""What `cosim.build_controller` and `cosim.Parameters` are: handed on from `controllers`."""

from controllers.factories import build_controller
from controllers.theta import Parameters

__all__ = ["Parameters", "build_controller"]
