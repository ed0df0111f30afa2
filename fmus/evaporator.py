"""The evaporator: its table of variables, from which all else is generated, and its FMUs."""

from __future__ import annotations

import csv
import hashlib
import json
import re
import uuid
from html import escape
from pathlib import Path
from string import Template

from cosim.files import temporary_folder
from fmus import BuildError, plants
from fmus.build import (
    COMPILER_FLAGS,
    PACKAGE,
    RESOURCES,
    SOURCES,
    WARNINGS,
    Compiler,
    binaries,
    compilers,
    read_archive,
    write_archive,
)
from fmus.description import LICENSE, build_description, c_header, model_description
from fmus.model import FmiVersion, Kind, Model, Type, Unit, Variable

_EXPONENT = re.compile(r"([A-Za-z]+)(-?\d+)")


def _rows(file: str) -> list[dict[str, str]]:
    return list(csv.DictReader((RESOURCES / file).read_text(encoding="utf-8").splitlines()))


def _number(text: str) -> float | None:
    return float(text) if text else None


UNITS = tuple(
    Unit(
        row["name"],
        float(row["factor"]),
        float(row["offset"]),
        tuple((base, int(power)) for base, power in _EXPONENT.findall(row["exponents"])),
    )
    for row in _rows("units.csv")
)
DISTURBANCES = ("X1", "F1", "T1", "T200")
STATES = ("X2", "P2")

VARIABLES = tuple(
    Variable(
        row["name"],
        Kind[row["kind"]],
        Type[row["type"]],
        row["unit"],
        _number(row["start"]),
        _number(row["min"]),
        _number(row["max"]),
        _number(row["nominal"]),
        row["description"],
        tuple(row["uses"].split()),
    )
    for row in _rows("evaporator.csv")
)

EVAPORATOR = Model(
    name="Evaporator",
    identifier="evaporator",
    version="1.0.0",
    description="Stochastic evaporation process, the plant of the RTI co-simulation benchmark",
    variables=VARIABLES,
    units=UNITS,
    stop_time=6000.0,
    step_size=60.0,
    model_exchange=True,
    derivatives=True,
)

BY_NAME = EVAPORATOR.by_name


def documentation_page(version: FmiVersion, build_file: str) -> str:
    """The text of documentation/index.html; `build_file` names the record of the build."""
    template = Template((RESOURCES / "documentation.html").read_text(encoding="utf-8"))
    return template.substitute(
        description=escape(EVAPORATOR.description),
        fmi_version=f"{version}.0",
        model_version=EVAPORATOR.version,
        license=LICENSE,
        diagram=(RESOURCES / "diagram.svg").read_text(encoding="utf-8"),
        rows="\n".join(_row(variable) for variable in EVAPORATOR.exported(version)),
        source=f"fmi{version}.c",
        build_file=build_file,
    )


def _row(variable: Variable) -> str:
    numbers = "".join(
        f'<td class="n">{"" if value is None else f"{value:.10g}"}</td>'
        for value in (variable.start, variable.min, variable.max)
    )
    reference = EVAPORATOR.value_reference(variable.name)
    return (
        f'<tr><td>{variable.name}</td><td class="n">{reference}</td>'
        f"<td>{variable.kind}</td><td>{escape(variable.unit)}</td>{numbers}"
        f"<td>{escape(variable.description)}</td></tr>"
    )


FILE_NAMES: dict[FmiVersion, str] = {2: "evaporator.fmu", 3: "evaporator_fmi3.fmu"}
HEADER = "variables.h"
BUILD_FILE = "extra/org.rti-cosim/build.json"


def hand_written_sources() -> dict[str, bytes]:
    """File name → bytes of every C source but the generated header."""
    files = sorted(SOURCES.glob("*.[ch]"))
    return {path.name: path.read_bytes() for path in files if path.name != HEADER}


def header(token: str) -> str:
    """The text of `variables.h` with the model's `token`."""
    origin = "from fmus/evaporator.py by `cosim fmu build --in-place`"
    return c_header(token, EVAPORATOR.identifier, VARIABLES, origin)


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
        built = [*build(folder, every_platform=True), *plants.build(folder, every_platform=True)]
        return {path.name: differences(path, PACKAGE / path.name) for path in built}


def build_in_place() -> list[Path]:
    """Regenerate the C header and the shipped FMUs in the source tree (for developers)."""
    (SOURCES / HEADER).write_text(header(model_token()))
    return [*build(PACKAGE, every_platform=True), *plants.build(PACKAGE, every_platform=True)]
