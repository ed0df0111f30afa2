"""FMUs of sampled systems, such as an exported controller: their C core, given, in an FMI face."""

from fmus.sampled.build import build_sampled
from fmus.sampled.instance import SampledInstance
from fmus.sampled.system import SampledSystem, Signal

__all__ = ["SampledInstance", "SampledSystem", "Signal", "build_sampled"]
