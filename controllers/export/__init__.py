"""The RTI-NMPC as C code without Python: the sources of a controller's FMU."""

from controllers.export.core import STATUSES, Core, core, plain_c

__all__ = ["STATUSES", "Core", "core", "plain_c"]
