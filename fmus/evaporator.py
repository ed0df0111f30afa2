"""The evaporator: its table of variables, from which all else is generated, and its FMUs."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from tempfile import TemporaryDirectory

from fmus import NAMES, BuildError, plant
from fmus.build import (
    COMPILER_FLAGS,
    HEADER,
    PACKAGE,
    RESOURCES,
    SOURCES,
    WARNINGS,
    build_model,
    compilers,
    files_of,
    sources_of,
    token_of,
)
from fmus.model import FmiVersion, FmuModel, read_variables, render, terminals

UNITS = (
    "1", "s", "d", "1/d", "%", "%/s", "kg", "kPa", "kPa/s", "kg/min", "kg/kPa", "degC", "K",
    "K/kPa", "K/%", "kW", "kW/K", "kW.min/kg", "kW.min/(kg.K)",
)  # fmt: skip

VARIABLES = tuple(read_variables(RESOURCES / "evaporator.csv"))

# The header stands in the source tree for whoever reads it; a build generates its own.
_EVAPORATOR_SOURCES = files_of("sources")
_EVAPORATOR_SOURCES.pop(HEADER, None)

EVAPORATOR = FmuModel(
    name="Evaporator",
    identifier="evaporator",
    description="Stochastic evaporation process, the plant of the RTI co-simulation benchmark",
    variables=VARIABLES,
    step_size=60.0,
    model_exchange=True,
    derivatives=True,
    terminal=("X2", "P2", "P100", "F200"),
    units=UNITS,
    sources=_EVAPORATOR_SOURCES,
    origin="fmus/evaporator.py by `cosim fmu build --in-place`",
)


BUILD_FILE = "extra/org.rti-cosim/build.json"


def _build_record(version: FmiVersion, every_platform: bool) -> bytes:
    """Build record of the binaries (JSON): for each platform the compiler and its flags."""
    platforms = {}
    for compiler in compilers(every_platform):
        platforms[compiler.platform.tuple] = {
            "compiler": compiler.version,
            "target": compiler.platform.target,
            "linker_flags": list(compiler.linker_flags),
        }
    sources = sources_of(EVAPORATOR, version)
    record = {
        "compiler_flags": [*COMPILER_FLAGS, *WARNINGS],
        "platforms": platforms,
        "model_token": token_of(EVAPORATOR, version, sources),
    }
    text = json.dumps(record, indent=2)
    return f"{text}\n".encode()


def build_evaporator(folder: Path, every_platform: bool = False) -> list[Path]:
    """Build both FMUs of the evaporator.

    Args:
        folder: where they are written; made when missing.
        every_platform: build for each of `PLATFORMS`, by the extra ``cross``, and not for the
            platform at hand alone, by the local compiler.

    Returns:
        Their paths.
    """
    folder.mkdir(parents=True, exist_ok=True)
    diagram = (RESOURCES / "diagram.svg").read_text(encoding="utf-8")
    # Each version of FMI has a place of its own for a picture.
    icons: dict[FmiVersion, str] = {2: "model.png", 3: "terminalsAndIcons/icon.png"}
    built = []
    for name, (version, icon) in zip(NAMES, icons.items(), strict=True):
        page = render(
            "evaporator.html",
            model=EVAPORATOR,
            version=version,
            diagram=diagram,
            build_file=BUILD_FILE,
        )
        files = {
            icon: (RESOURCES / "icon.png").read_bytes(),
            "documentation/index.html": page.encode(),
            BUILD_FILE: _build_record(version, every_platform),
        }
        if version == 3:
            files |= terminals(EVAPORATOR, icon=True)
        path = build_model(
            EVAPORATOR,
            folder / f"{name}.fmu",
            version,
            every_platform=every_platform,
            files=files,
            warnings=WARNINGS,
        )
        built.append(path)
    return built


def differences(built: Path, shipped: Path) -> list[str]:
    """The archive members that differ between two FMU files.

    Args:
        built: one file.
        shipped: the other.

    Returns:
        Names of the members, ``["(order or metadata)"]`` where these alone differ; empty when the
        files are equal byte for byte.

    Raises:
        BuildError: if `shipped` is missing.
    """
    if not shipped.is_file():
        raise BuildError(f"{shipped} is missing; reinstall the package")
    if built.read_bytes() == shipped.read_bytes():
        return []
    # What is in one of them alone, and what has another content there.
    unequal = _checksums(built).items() ^ _checksums(shipped).items()
    names = {name for name, _ in unequal}
    return sorted(names) or ["(order or metadata)"]


def _checksums(path: Path) -> dict[str, int]:
    """CRC of each member of an archive by its name."""
    with zipfile.ZipFile(path) as archive:
        return {member.filename: member.CRC for member in archive.infolist()}


def compare_with_shipped() -> dict[str, list[str]]:
    """Build anew for every platform; file name → `differences` from the shipped file."""
    with TemporaryDirectory(prefix="cosim-", ignore_cleanup_errors=True) as name:
        folder = Path(name).absolute()
        built = [
            *build_evaporator(folder, every_platform=True),
            *plant.build_shipped_plants(folder, every_platform=True),
        ]
        unequal = {}
        for path in built:
            shipped = PACKAGE / path.name
            unequal[path.name] = differences(path, shipped)
        return unequal


def build_in_place() -> list[Path]:
    """Regenerate the C header and the shipped FMUs in the source tree (for developers)."""
    header = sources_of(EVAPORATOR, 2)[HEADER]
    (SOURCES / HEADER).write_bytes(header)
    return [
        *build_evaporator(PACKAGE, every_platform=True),
        *plant.build_shipped_plants(PACKAGE, every_platform=True),
    ]
