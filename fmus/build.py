"""Build the FMUs from the table of variables and the C sources, byte for byte reproducibly."""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import tempfile
import uuid
import zipfile
from pathlib import Path

import fmpy

from fmus.description import MODEL_IDENTIFIER, FmiVersion, build_description, model_description
from fmus.errors import BuildError
from fmus.header import c_header

PACKAGE = Path(__file__).parent
SOURCES = PACKAGE / "sources"
FILE_NAMES: dict[FmiVersion, str] = {2: "evaporator.fmu", 3: "evaporator_fmi3.fmu"}
HEADER = "variables.h"

# No path, date or identification may enter the binary; no fused multiply-add may change a result.
COMPILER_FLAGS = (
    "-std=c99",
    "-O2",
    "-ffp-contract=off",
    "-fPIC",
    "-fno-ident",
    "-fvisibility=hidden",
    "-Wall",
    "-Wextra",
)
LINKER_FLAGS = ("-shared", "-s", "-Wl,--build-id=none", "-lm")

_ZIP_DATE = (1980, 1, 1, 0, 0, 0)
_PLATFORM: dict[FmiVersion, str] = {2: "linux64", 3: "x86_64-linux"}


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


def compile_library(version: FmiVersion) -> bytes:
    """Compile the shared library of FMI `version`; raises BuildError with the compiler's words."""
    headers = Path(fmpy.__file__).parent / "c-code"
    with tempfile.TemporaryDirectory() as folder:
        for name, data in sources(version).items():
            (Path(folder) / name).write_bytes(data)
        output = f"{MODEL_IDENTIFIER}.so"
        command = [
            compiler(), *COMPILER_FLAGS, "-isystem", str(headers),
            f"fmi{version}.c", "-o", output, *LINKER_FLAGS,
        ]  # fmt: skip
        result = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        if result.returncode != 0 or result.stderr:
            raise BuildError(f"{' '.join(command)} failed:\n{result.stderr.strip()}")
        return (Path(folder) / output).read_bytes()


def contents(version: FmiVersion) -> dict[str, bytes]:
    """Every file of the FMU by its path in the archive."""
    files = {"modelDescription.xml": model_description(version, model_token()).encode()}
    files |= {f"sources/{name}": data for name, data in sources(version).items()}
    library = f"binaries/{_PLATFORM[version]}/{MODEL_IDENTIFIER}.so"
    files[library] = compile_library(version)
    return files


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


def build_in_place() -> list[Path]:
    """Regenerate the C header and the shipped FMUs in the source tree (for developers)."""
    (SOURCES / HEADER).write_text(c_header(model_token()))
    return build(PACKAGE)
