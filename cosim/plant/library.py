"""The shared library of an FMU for the platform at hand: an entry of the archive, never a path."""

from __future__ import annotations

import re
from pathlib import Path

import fmpy

from cosim.errors import PlantError
from cosim.plant.archive import UnpackedFmu
from fmus import BuildError
from fmus.build import platforms_of, present

_IDENTIFIER = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
# FMI 2.0's names are for x86, but exporters on ARM use them as well.
_FALLBACKS = {"aarch64-linux": "linux64", "aarch64-darwin": "darwin64"}


def library_path(fmu: UnpackedFmu) -> Path:
    """The library to load; raises PlantError that says why there is none.

    `modelIdentifier` must be a C identifier, the library an entry of the archive, and made for
    this platform by its own first bytes.
    """
    identifier = str(fmu.description.coSimulation.modelIdentifier)
    if not _IDENTIFIER.fullmatch(identifier):
        raise PlantError(
            f"FMU '{fmu.path}' is refused: modelIdentifier {identifier!r} is not a C identifier"
        )
    wanted, folders = _wanted(str(fmu.description.fmiVersion))
    others = []
    for folder in folders:
        entry = f"binaries/{folder}/{identifier}{fmpy.sharedLibraryExtension}"
        if entry not in fmu.entries:
            continue
        path = fmu.folder / entry
        if not path.resolve().is_relative_to(fmu.folder.resolve()):
            raise PlantError(f"FMU '{fmu.path}' is refused: '{entry}' leads outside its folder")
        made_for = platforms_of(path.read_bytes())
        if wanted in made_for:
            return path
        what = f"made for {' and '.join(made_for)}" if made_for else "not a shared library"
        others.append(f"its '{entry}' is {what}")
    raise PlantError(
        f"FMU '{fmu.path}' has no binary for {wanted} ({'; '.join(others) or _found(fmu)}); build "
        "one from its sources, the shipped FMU's by `cosim fmu build --out DIR` with a C "
        "compiler, and name that file"
    )


def _wanted(version: str) -> tuple[str, list[str]]:
    """This platform's tuple, and the folders that its library may lie in, the best first."""
    try:
        platform = present()
    except BuildError:
        return str(fmpy.platform_tuple), [str(fmpy.platform_tuple), str(fmpy.platform)]
    folders = [platform.folder(version)]
    if version.startswith("2") and platform.tuple in _FALLBACKS:
        folders.append(_FALLBACKS[platform.tuple])
    return platform.tuple, folders


def _found(fmu: UnpackedFmu) -> str:
    folders = {name.split("/")[1] for name in fmu.entries if name.startswith("binaries/")}
    return f"it has: {', '.join(sorted(folders)) or 'none'}"
