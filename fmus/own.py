"""Build an FMU of one's own from a folder with its model description and C sources."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import fmpy

from fmus.build import archive, compile_library
from fmus.errors import BuildError


def build_folder(folder: str | Path, target: str | Path) -> Path:
    """Build `modelDescription.xml` and every `*.c` and `*.h` of a folder into the FMU `target`.

    FMI 2.0 or 3.0, co-simulation or model exchange; the library is for the platform at hand and
    the sources go along under `sources/`. With the same compiler the bytes repeat. Raises
    BuildError where a file is missing, the description names no model or the compiler complains.
    """
    folder, target = Path(folder), Path(target)
    description = folder / "modelDescription.xml"
    try:
        root = ElementTree.fromstring(description.read_bytes())
    except OSError as error:
        raise BuildError(f"{description}: {error.strerror}") from None
    except ElementTree.ParseError as error:
        raise BuildError(f"{description}: not XML: {error}") from None
    faces = [face for tag in ("CoSimulation", "ModelExchange") for face in root.findall(tag)]
    identifiers = {face.get("modelIdentifier") for face in faces} - {None}
    if len(identifiers) != 1:
        raise BuildError(
            f"{description}: CoSimulation and ModelExchange must name one modelIdentifier, not "
            f"{len(identifiers)}"
        )
    sources = {path.name: path.read_bytes() for path in sorted(folder.glob("*.[ch]"))}
    if not any(name.endswith(".c") for name in sources):
        raise BuildError(f"{folder}: there is no C source (*.c)")
    library = f"{identifiers.pop()}{fmpy.sharedLibraryExtension}"
    version = root.get("fmiVersion", "")
    platform = fmpy.platform if version.startswith("2") else fmpy.platform_tuple
    files = {
        "modelDescription.xml": description.read_bytes(),
        f"binaries/{platform}/{library}": compile_library(sources, library, ("-w",)),
        **{f"sources/{name}": data for name, data in sources.items()},
    }
    partial = target.with_name(f".{target.name}.partial")
    archive(files, partial)
    return partial.replace(target)
