"""FMUs of sampled systems, such as an exported controller: their C core, given, in an FMI face."""

from fmus.sampled.build import build_sampled
from fmus.sampled.system import SampledSystem, Signal

__all__ = ["SampledSystem", "Signal", "build_sampled"]
