"""What a check can end with other than a pass or a failure."""

from __future__ import annotations

import importlib
from types import ModuleType

from fmus import FmuError


class NotInstalledError(FmuError):
    """The importer, or a library that it needs, is not there."""


class NotOfferedError(FmuError):
    """The FMU or the importer lacks the interface that the check needs."""


class NotedError(FmuError):
    """A finding that is worth a line but no fault of the FMU."""


def require(module: str, package: str) -> ModuleType:
    """Import `module`, or raise NotInstalledError that says how to install `package`."""
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        raise NotInstalledError("pip install 'rti-cosim[fmi-check]'") from error
    except (ImportError, OSError) as error:
        raise NotInstalledError(f"{package} does not load: {error}") from error
