"""The plants as FMUs: the built files by name, and the platforms that an FMU has libraries for."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

from fmus.errors import BuildError, CheckError, FmuError

__all__ = ["NAMES", "PLANTS", "BuildError", "CheckError", "FmuError", "path"]

NAMES = ("evaporator", "evaporator_fmi3")
PLANTS = ("reactor", "tanks", "heater", "unstable_reactor")


def path(name: str = "evaporator") -> Path:
    """The path of a shipped FMU: ``evaporator_fmi3`` is FMI 3.0, the others FMI 2.0.

    Raises FmuError for another name.
    """
    shipped = (*NAMES, *PLANTS)
    if name not in shipped:
        raise FmuError(f"there is no FMU {name!r}; shipped are {', '.join(shipped)}")
    return Path(__file__).parent / f"{name}.fmu"


@dataclass(frozen=True)
class Platform:
    """A platform.

    Attributes:
        tuple: FMI 3.0's, which names its folder under ``binaries/``.
        fmi2_folder: its folder in FMI 2.0.
        suffix: of shared libraries there.
        target: by which the cross-compiler knows it.
    """

    tuple: str
    fmi2_folder: str
    suffix: str
    target: str

    def folder(self, fmi_version: str) -> str:
        """The name of its folder under ``binaries/`` in FMI `fmi_version`."""
        if fmi_version.startswith("2"):
            return self.fmi2_folder
        return self.tuple


# The oldest systems that a library shall run on: a glibc of 2012, macOS of 2020.
PLATFORMS = (
    Platform("x86_64-linux", "linux64", ".so", "x86_64-linux-gnu.2.17"),
    Platform("aarch64-linux", "aarch64-linux", ".so", "aarch64-linux-gnu.2.17"),
    Platform("x86_64-windows", "win64", ".dll", "x86_64-windows-gnu"),
    Platform("x86_64-darwin", "darwin64", ".dylib", "x86_64-macos.11.0"),
    Platform("aarch64-darwin", "aarch64-darwin", ".dylib", "aarch64-macos.11.0"),
)


def present() -> Platform:
    """The platform at hand; raises BuildError for one that is not in `PLATFORMS`."""
    from fmpy import platform_tuple  # noqa: PLC0415 - a tenth of a second

    known = {platform.tuple: platform for platform in PLATFORMS}
    if platform_tuple not in known:
        words = ", ".join(known)
        raise BuildError(f"no binaries are built for {platform_tuple}; known are {words}")
    return known[platform_tuple]


# Each format's number of an architecture.
_ELF = {
    0x3E: "x86_64",
    0xB7: "aarch64",
    0x03: "x86",
    0x28: "aarch32",
}
_PE = {
    0x8664: "x86_64",
    0xAA64: "aarch64",
    0x14C: "x86",
    0x1C4: "aarch32",
}
_MACH_O = {
    0x01000007: "x86_64",
    0x0100000C: "aarch64",
    7: "x86",
}
UNIVERSAL = 0xCAFEBABE
_MACH_O_64 = 0xFEEDFACF
_MACH_O_32 = 0xFEEDFACE
"""Magic numbers of Mach-O files, a universal binary's in the order of its bytes."""


def platforms_of(library: bytes) -> tuple[str, ...]:
    """FMI 3.0's tuples of the platforms that can load a shared library; empty if none can.

    Several for macOS' universal binaries. An architecture unknown here reads ``?``.
    """
    try:
        if library[:4] == b"\x7fELF":
            return (_elf_platform(library),)
        if library[:2] == b"MZ":
            return _pe_platform(library)
        return _mach_o_platforms(library)
    # The file ends within its header.
    except (struct.error, IndexError):
        return ()


def _elf_platform(library: bytes) -> str:
    """Platform of an ELF file: e_machine, in the byte order that the sixth byte says."""
    order = "<" if library[5] == 1 else ">"
    (machine,) = struct.unpack_from(order + "H", library, 18)
    return f"{_ELF.get(machine, '?')}-linux"


def _pe_platform(library: bytes) -> tuple[str, ...]:
    """Platform of a Windows file: Machine, after the signature to which the DOS header points."""
    (start,) = struct.unpack_from("<I", library, 0x3C)
    if library[start : start + 4] != b"PE\0\0":
        return ()
    (machine,) = struct.unpack_from("<H", library, start + 4)
    return (f"{_PE.get(machine, '?')}-windows",)


def _mach_o_platforms(library: bytes) -> tuple[str, ...]:
    """Platforms of a Mach-O file by cputype, or of each slice of a universal binary."""
    magic, cpu = struct.unpack_from("<II", library)
    if magic in (_MACH_O_64, _MACH_O_32):
        return (f"{_MACH_O.get(cpu, '?')}-darwin",)
    magic, count = struct.unpack_from(">II", library)
    # Java's class files have the same magic number, and a version of more than 40 as the count.
    if magic != UNIVERSAL or count >= 10:
        return ()
    platforms = []
    for position in range(count):
        # Behind the header of 8 bytes, an entry of 20 for each slice.
        start = 8 + 20 * position
        (cpu,) = struct.unpack_from(">I", library, start)
        platforms.append(f"{_MACH_O.get(cpu, '?')}-darwin")
    return tuple(platforms)
