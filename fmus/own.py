"""Build an FMU of one's own from C sources and a model description."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from xml.etree import ElementTree

from fmus.archive import write_archive
from fmus.compiler import Compiler, cross_compiler, local_compiler
from fmus.errors import BuildError
from fmus.model import C_IDENTIFIER
from fmus.platforms import PLATFORMS
from fmus.universal import universal_binary

_QUIET = ("-w",)


def compilers(every_platform: bool) -> list[Compiler]:
    """The local compiler alone, or the cross-compiler for each of `PLATFORMS`.

    Raises BuildError where it is not installed.
    """
    return [cross_compiler(p) for p in PLATFORMS] if every_platform else [local_compiler()]


def build_fmu(
    target: str | Path,
    sources: Mapping[str, bytes],
    description: str | bytes,
    *,
    every_platform: bool = False,
    files: Mapping[str, bytes] | None = None,
) -> Path:
    """Compile C sources and write them with their model description as the FMU `target`.

    `sources` are the files of the folder ``sources/`` by name; every ``*.c`` is compiled, as C99,
    against fmpy's FMI headers. `description` is the text of modelDescription.xml, FMI 2.0 or 3.0;
    its interfaces must name one modelIdentifier. The binary is for the platform at hand, made by
    the local compiler, or, with `every_platform`, one for each of `fmus.platforms.PLATFORMS`, made
    by the extra ``cross``. `files` are further members by their path in the archive. With the same
    compiler the bytes repeat. Raises BuildError where there is no compiler, it complains, or the
    description names no model.
    """
    path = Path(target)
    text = description.encode() if isinstance(description, str) else description
    version, identifier = _model(text)
    if not any(name.endswith(".c") for name in sources):
        raise BuildError(f"{path}: there is no C source (*.c) to build it from")
    members = {
        "modelDescription.xml": text,
        **binaries(sources, identifier, version, compilers(every_platform), _QUIET),
        **{f"sources/{name}": data for name, data in sources.items()},
    }
    return write_archive({**(files or {}), **members}, path)


def build_folder(folder: str | Path, target: str | Path, every_platform: bool = False) -> Path:
    """Build `modelDescription.xml` and every `*.c` and `*.h` of a folder into the FMU `target`.

    As `build_fmu`; raises BuildError also where a file is missing.
    """
    folder = Path(folder)
    description = folder / "modelDescription.xml"
    try:
        text = description.read_bytes()
    except OSError as error:
        raise BuildError(f"{description}: {error.strerror}") from None
    sources = {path.name: path.read_bytes() for path in sorted(folder.glob("*.[ch]"))}
    if not any(name.endswith(".c") for name in sources):
        raise BuildError(f"{folder}: there is no C source (*.c)")
    return build_fmu(target, sources, text, every_platform=every_platform)


def binaries(
    sources: Mapping[str, bytes],
    identifier: str,
    version: str,
    compilers: Sequence[Compiler],
    warnings: tuple[str, ...],
) -> dict[str, bytes]:
    """The members under ``binaries/`` of an FMU for FMI `version`: one library a compiler.

    FMI 2.0 importers on Apple silicon look into the folder of macOS on x86: there, where both are
    built, lies a universal binary.
    """
    libraries = {c.platform: c.library(sources, identifier, warnings) for c in compilers}
    macos = [library for p, library in libraries.items() if p.suffix == ".dylib"]
    found = {}
    for platform, library in libraries.items():
        folder = platform.folder(version)
        universal = folder == "darwin64" and len(macos) > 1
        name = f"binaries/{folder}/{identifier}{platform.suffix}"
        found[name] = universal_binary(macos) if universal else library
    return found


def _model(description: bytes) -> tuple[str, str]:
    """FMI version and model identifier."""
    try:
        root = ElementTree.fromstring(description)
    except ElementTree.ParseError as error:
        raise BuildError(f"modelDescription.xml is not XML: {error}") from None
    version = root.get("fmiVersion", "")
    if version[:2] not in ("2.", "3."):
        raise BuildError(f"modelDescription.xml is for FMI {version or '?'}, not 2.0 or 3.0")
    faces = [face for tag in ("CoSimulation", "ModelExchange") for face in root.findall(tag)]
    identifiers = {face.get("modelIdentifier", "") for face in faces}
    if len(identifiers) != 1:
        raise BuildError(
            "modelDescription.xml: CoSimulation and ModelExchange must name one modelIdentifier, "
            f"not {len(identifiers)}"
        )
    identifier = identifiers.pop()
    if not C_IDENTIFIER.fullmatch(identifier):
        raise BuildError(
            f"modelDescription.xml: modelIdentifier {identifier!r} is not a C identifier"
        )
    return version, identifier
