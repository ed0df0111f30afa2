"""The RTI-NMPC as C code that needs no Python: what an FMU of the controller is made of."""

from controllers.export.core import STATUSES, Core, core, plain_c

__all__ = ["STATUSES", "Core", "core", "plain_c"]
