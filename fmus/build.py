"""Build the FMUs from the table of variables and the C sources, byte for byte reproducibly."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
import uuid
import zipfile
from collections.abc import Mapping
from pathlib import Path

import fmpy

from fmus.description import MODEL_IDENTIFIER, build_description, model_description
from fmus.documentation import RESOURCES, documentation_page
from fmus.errors import BuildError
from fmus.header import c_header
from fmus.variables import FmiVersion

PACKAGE = Path(__file__).parent
SOURCES = PACKAGE / "sources"
FILE_NAMES: dict[FmiVersion, str] = {2: "evaporator.fmu", 3: "evaporator_fmi3.fmu"}
HEADER = "variables.h"
BUILD_FILE = "extra/org.rti-cosim/build.json"

# No path, date or identification may enter the binary; no fused multiply-add may change a result.
COMPILER_FLAGS = (
    "-std=c99",
    "-O2",
    "-ffp-contract=off",
    "-fPIC",
    "-fno-ident",
    "-fvisibility=hidden",
)
WARNINGS = ("-Wall", "-Wextra")
LINKER_FLAGS = {
    "linux": ("-shared", "-s", "-Wl,--build-id=none", "-lm"),
    "win32": ("-shared", "-s"),
    "darwin": ("-dynamiclib",),
}.get(sys.platform, ("-shared", "-lm"))

_ZIP_DATE = (1980, 1, 1, 0, 0, 0)
_PLATFORM: dict[FmiVersion, str] = {2: fmpy.platform, 3: fmpy.platform_tuple}
_LIBRARY = f"{MODEL_IDENTIFIER}{fmpy.sharedLibraryExtension}"


def hand_written_sources() -> dict[str, bytes]:
    """File name → bytes of every C source but the generated header."""
    files = sorted(SOURCES.glob("*.[ch]"))
    return {path.name: path.read_bytes() for path in files if path.name != HEADER}


def model_token() -> str:
    """GUID of FMI 2.0 and instantiation token of FMI 3.0: a digest of all that makes the model."""
    digest = hashlib.sha256()
    for text in (c_header(""), model_description(2, ""), model_description(3, "")):
        digest.update(text.encode())
    for name, content in hand_written_sources().items():
        digest.update(name.encode() + b"\0" + content)
    return "{" + str(uuid.UUID(bytes=digest.digest()[:16], version=5)) + "}"


def sources(version: FmiVersion) -> dict[str, bytes]:
    """File name → bytes of the folder `sources/` of the FMU, generated files included."""
    other = "fmi3.c" if version == 2 else "fmi2.c"
    files = {name: data for name, data in hand_written_sources().items() if name != other}
    files[HEADER] = c_header(model_token()).encode()
    files["buildDescription.xml"] = build_description(version).encode()
    return files


def compiler() -> str:
    """The C compiler: ``$CC``, else ``cc``; raises BuildError when there is none."""
    name = os.environ.get("CC", "cc")
    if shutil.which(name) is None:
        raise BuildError(f"no C compiler: {name!r} is not on the path; install gcc or set CC")
    return name


def compile_library(
    files: Mapping[str, bytes], library: str, warnings: tuple[str, ...] = WARNINGS
) -> bytes:
    """Compile C sources, by file name, into one shared library and return its bytes.

    The FMI headers are fmpy's. Raises BuildError with the compiler's words on anything that it
    says; `warnings` chooses what it warns of.
    """
    headers = Path(fmpy.__file__).parent / "c-code"
    with tempfile.TemporaryDirectory() as folder:
        for name, data in files.items():
            (Path(folder) / name).write_bytes(data)
        units = sorted(name for name in files if name.endswith(".c"))
        command = [
            compiler(), *COMPILER_FLAGS, *warnings, "-isystem", str(headers),
            *units, "-o", library, *LINKER_FLAGS,
        ]  # fmt: skip
        result = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        if result.returncode != 0 or result.stderr:
            raise BuildError(f"{' '.join(command)} failed:\n{result.stderr.strip()}")
        return (Path(folder) / library).read_bytes()


def build_record() -> bytes:
    """How the binary was made (JSON): compiler, its flags and the tool that drove it."""
    version = subprocess.run(
        [compiler(), "--version"], capture_output=True, text=True, check=True
    ).stdout.splitlines()[0]
    record = {
        "compiler": version,
        "compiler_flags": [*COMPILER_FLAGS, *WARNINGS],
        "linker_flags": list(LINKER_FLAGS),
        "model_token": model_token(),
    }
    return (json.dumps(record, indent=2) + "\n").encode()


def contents(version: FmiVersion) -> dict[str, bytes]:
    """Every file of the FMU by its path in the archive."""
    icon = (RESOURCES / "icon.png").read_bytes()
    files = {
        "modelDescription.xml": model_description(version, model_token()).encode(),
        "documentation/index.html": documentation_page(version, BUILD_FILE).encode(),
        "documentation/licenses/license.txt": (RESOURCES / "license.txt").read_bytes(),
        BUILD_FILE: build_record(),
        f"binaries/{_PLATFORM[version]}/{_LIBRARY}": compile_library(sources(version), _LIBRARY),
    }
    files |= {f"sources/{name}": data for name, data in sources(version).items()}
    if version == 2:
        return files | {"model.png": icon}
    name = "terminalsAndIcons.xml"
    return files | {
        "terminalsAndIcons/icon.png": icon,
        f"terminalsAndIcons/{name}": (RESOURCES / name).read_bytes(),
    }


def archive(files: dict[str, bytes], target: Path) -> None:
    """Write `files` as an uncompressed zip: sorted, with fixed dates and permissions."""
    with zipfile.ZipFile(target, "w", zipfile.ZIP_STORED) as container:
        for name in sorted(files):
            entry = zipfile.ZipInfo(name, _ZIP_DATE)
            entry.create_system = 3
            entry.external_attr = 0o100644 << 16
            container.writestr(entry, files[name])


def build(folder: Path) -> list[Path]:
    """Build both FMUs into `folder` (made when missing) and return their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    built = []
    for version, name in FILE_NAMES.items():
        partial = folder / f".{name}.partial"
        archive(contents(version), partial)
        partial.replace(folder / name)
        built.append(folder / name)
    return built


def differences(built: Path, shipped: Path) -> list[str]:
    """The archive members that differ between two FMU files, or ``["(order or metadata)"]``.

    Empty when the files are equal byte for byte. Raises BuildError when `shipped` is missing.
    """
    if not shipped.is_file():
        raise BuildError(f"{shipped} is missing; reinstall the package")
    if built.read_bytes() == shipped.read_bytes():
        return []
    members = [_members(path) for path in (built, shipped)]
    names = sorted(set(members[0]) | set(members[1]))
    differing = [name for name in names if members[0].get(name) != members[1].get(name)]
    return differing or ["(order or metadata)"]


def compare_with_shipped() -> dict[str, list[str]]:
    """Build anew; file name → `differences` from the shipped file."""
    with tempfile.TemporaryDirectory() as folder:
        return {path.name: differences(path, PACKAGE / path.name) for path in build(Path(folder))}


def _members(path: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(path) as container:
        return {name: container.read(name) for name in container.namelist()}


def build_in_place() -> list[Path]:
    """Regenerate the C header and the shipped FMUs in the source tree (for developers)."""
    (SOURCES / HEADER).write_text(c_header(model_token()))
    return build(PACKAGE)
