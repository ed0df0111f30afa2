"""The platforms that an FMU can hold a binary for, and what the standards call their folders.

FMI 3.0.2, 2.5.1.4 names platforms by architecture and system. FMI 2.0.5, 2.3 has names of its own
for x86 alone and refers to those of FMI 3.0 for any other.
"""

from __future__ import annotations

import platform as host
import sys
from dataclasses import dataclass

from fmus.errors import BuildError


@dataclass(frozen=True)
class Platform:
    """A platform by its FMI 3.0 tuple.

    Its folder under ``binaries/`` in FMI 2.0, the suffix of shared libraries there, and the target
    by which the cross-compiler knows it.
    """

    tuple: str
    fmi2_folder: str
    suffix: str
    target: str

    def folder(self, fmi_version: str) -> str:
        """The name of its folder under ``binaries/`` in FMI `fmi_version`."""
        return self.fmi2_folder if fmi_version.startswith("2") else self.tuple


PLATFORMS = (
    Platform("x86_64-linux", "linux64", ".so", "x86_64-linux-gnu.2.17"),
    Platform("aarch64-linux", "aarch64-linux", ".so", "aarch64-linux-gnu.2.17"),
    Platform("x86_64-windows", "win64", ".dll", "x86_64-windows-gnu"),
    Platform("x86_64-darwin", "darwin64", ".dylib", "x86_64-macos.11.0"),
    Platform("aarch64-darwin", "aarch64-darwin", ".dylib", "aarch64-macos.11.0"),
)

_ARCHITECTURES = {"amd64": "x86_64", "x86_64": "x86_64", "arm64": "aarch64", "aarch64": "aarch64"}
_SYSTEMS = {"linux": "linux", "win32": "windows", "darwin": "darwin"}


def present() -> Platform:
    """The platform at hand; raises BuildError for one that is not in `PLATFORMS`."""
    machine = host.machine().lower()
    name = f"{_ARCHITECTURES.get(machine, machine)}-{_SYSTEMS.get(sys.platform, sys.platform)}"
    for platform in PLATFORMS:
        if platform.tuple == name:
            return platform
    known = ", ".join(platform.tuple for platform in PLATFORMS)
    raise BuildError(f"no binaries are built for {name}; known are {known}")
