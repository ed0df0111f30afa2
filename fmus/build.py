"""Build the FMUs from the table of variables and the C sources, byte for byte reproducibly."""

from __future__ import annotations

import hashlib
import json
import uuid
from pathlib import Path

from cosim.temporary import temporary_folder
from fmus.archive import read_archive, write_archive
from fmus.compiler import COMPILER_FLAGS, WARNINGS, Compiler
from fmus.description import build_description, model_description
from fmus.documentation import RESOURCES, documentation_page
from fmus.errors import BuildError
from fmus.header import c_header
from fmus.model import FmiVersion
from fmus.own import binaries, compilers
from fmus.variables import EVAPORATOR, VARIABLES

PACKAGE = Path(__file__).parent
SOURCES = PACKAGE / "sources"
FILE_NAMES: dict[FmiVersion, str] = {2: "evaporator.fmu", 3: "evaporator_fmi3.fmu"}
HEADER = "variables.h"
BUILD_FILE = "extra/org.rti-cosim/build.json"


def hand_written_sources() -> dict[str, bytes]:
    """File name → bytes of every C source but the generated header."""
    files = sorted(SOURCES.glob("*.[ch]"))
    return {path.name: path.read_bytes() for path in files if path.name != HEADER}


def header(token: str) -> str:
    """The text of `variables.h` with the model's `token`."""
    return c_header(token, VARIABLES, "from fmus/variables.py by `cosim fmu build --in-place`")


def model_token() -> str:
    """GUID of FMI 2.0 and instantiation token of FMI 3.0: a digest of all that makes the model."""
    digest = hashlib.sha256()
    descriptions = (model_description(version, "", EVAPORATOR) for version in FILE_NAMES)
    for text in (header(""), *descriptions):
        digest.update(text.encode())
    for name, content in hand_written_sources().items():
        digest.update(name.encode() + b"\0" + content)
    return "{" + str(uuid.UUID(bytes=digest.digest()[:16], version=5)) + "}"


def sources(version: FmiVersion) -> dict[str, bytes]:
    """File name → bytes of the folder `sources/` of the FMU, generated files included."""
    other = "fmi3.c" if version == 2 else "fmi2.c"
    files = {name: data for name, data in hand_written_sources().items() if name != other}
    files[HEADER] = header(model_token()).encode()
    files["buildDescription.xml"] = build_description(version, EVAPORATOR).encode()
    return files


def build_record(with_compilers: list[Compiler]) -> bytes:
    """How the binaries were made (JSON): for each platform the compiler and its flags."""
    record = {
        "compiler_flags": [*COMPILER_FLAGS, *WARNINGS],
        "platforms": {
            compiler.platform.tuple: {
                "compiler": compiler.version,
                "target": compiler.platform.target,
                "linker_flags": list(compiler.linker_flags),
            }
            for compiler in with_compilers
        },
        "model_token": model_token(),
    }
    return (json.dumps(record, indent=2) + "\n").encode()


def contents(version: FmiVersion, every_platform: bool) -> dict[str, bytes]:
    """Every file of the FMU by its path in the archive."""
    icon = (RESOURCES / "icon.png").read_bytes()
    code = sources(version)
    used = compilers(every_platform)
    files = {
        "modelDescription.xml": model_description(version, model_token(), EVAPORATOR).encode(),
        "documentation/index.html": documentation_page(version, BUILD_FILE).encode(),
        "documentation/licenses/license.txt": (RESOURCES / "license.txt").read_bytes(),
        BUILD_FILE: build_record(used),
        **binaries(code, EVAPORATOR.identifier, f"{version}.0", used, WARNINGS),
        **{f"sources/{name}": data for name, data in code.items()},
    }
    if version == 2:
        return files | {"model.png": icon}
    name = "terminalsAndIcons.xml"
    return files | {
        "terminalsAndIcons/icon.png": icon,
        f"terminalsAndIcons/{name}": (RESOURCES / name).read_bytes(),
    }


def build(folder: Path, every_platform: bool = False) -> list[Path]:
    """Build both FMUs into `folder` (made when missing) and return their paths.

    For the platform at hand by the local compiler, or for every one by the extra ``cross``.
    """
    files = {name: contents(v, every_platform) for v, name in FILE_NAMES.items()}
    folder.mkdir(parents=True, exist_ok=True)
    return [write_archive(members, folder / name) for name, members in files.items()]


def differences(built: Path, shipped: Path) -> list[str]:
    """The archive members that differ between two FMU files, or ``["(order or metadata)"]``.

    Empty when the files are equal byte for byte. Raises BuildError when `shipped` is missing.
    """
    if not shipped.is_file():
        raise BuildError(f"{shipped} is missing; reinstall the package")
    if built.read_bytes() == shipped.read_bytes():
        return []
    members = [read_archive(path) for path in (built, shipped)]
    names = sorted(set(members[0]) | set(members[1]))
    differing = [name for name in names if members[0].get(name) != members[1].get(name)]
    return differing or ["(order or metadata)"]


def compare_with_shipped() -> dict[str, list[str]]:
    """Build anew for every platform; file name → `differences` from the shipped file."""
    with temporary_folder("cosim-") as folder:
        built = build(folder, every_platform=True)
        return {path.name: differences(path, PACKAGE / path.name) for path in built}


def build_in_place() -> list[Path]:
    """Regenerate the C header and the shipped FMUs in the source tree (for developers)."""
    (SOURCES / HEADER).write_text(header(model_token()))
    return build(PACKAGE, every_platform=True)
