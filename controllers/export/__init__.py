"""The RTI-NMPC as C code without Python: the sources of a controller's FMU."""

from controllers.export.core import STATUSES, Core, Observer, core, plain_c
from controllers.export.filter import estimated_state

__all__ = ["STATUSES", "Core", "Observer", "core", "estimated_state", "plain_c"]
