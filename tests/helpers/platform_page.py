"""Write docs/reference/platforms.md: python -m tests.helpers.platform_page [FILE].

Runs every binary that can be run here and every importer that is installed; takes some minutes.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import fmus
from controllers.factories import tuned
from cosim import FmuPlant, Scenario
from cosim.cli.controller_fmu import IDENTIFIER, rti_controller, sampled_controller, write_fmu
from cosim.text_tables import markdown_table
from fmus.build import HEADER, SOURCES
from fmus.checks import check
from fmus.description import MODEL_IDENTIFIER
from fmus.platforms import PLATFORMS
from fmus.sampled.build import sampled_sources
from fmus.variables import FmiVersion
from tests.helpers.platforms import (
    BY_NAME,
    NATIVE,
    STEPS,
    Importer,
    NotHereError,
    library,
    unzipped,
    verdict,
)

PAGE = Path(__file__).parents[2] / "docs" / "reference" / "platforms.md"
LAWS = ("none", "uniform", "normal", "drifting")
VERSIONS: tuple[FmiVersion, ...] = (2, 3)
NATURE = {"x86_64-linux": "natively", "aarch64-linux": "qemu-user", "x86_64-windows": "wine64"}


def main(target: Path) -> None:
    """Write the page."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        controllers = _controllers(folder)
        text = "\n\n".join(
            [
                HEAD,
                "## The plant, by platform, law and FMI version",
                _plants(folder),
                "## The controller, by platform and FMI version",
                _exported(folder, controllers),
                "## Importers of the plant's FMU",
                _importers([fmus.path(name) for name in fmus.NAMES]),
                "## Importers of the controller's FMU",
                _importers([path for path, _ in controllers.values()]),
            ]
        )
    target.write_text(text + "\n", encoding="utf-8")


HEAD = f"""\
# Platforms and importers

Written by `python -m tests.helpers.platform_page`, which runs all that can be run on a Linux
machine on x86-64 with Debian's qemu-user, libc6-arm64-cross and wine64, and PyPI's ziglang. A small
C program steps the library of each platform {STEPS} times and hashes the bits of every state,
derivative and output after each step; the verdict compares the hashes with those of Linux on
x86-64. `python -m pytest -m slow tests/fmus/platforms tests/integration/test_exported_platforms.py`
holds the files to this."""


def _compared(runs: dict[str, list[str] | NotHereError], otherwise: str) -> dict[str, str]:
    """A verdict for each platform; `otherwise` for those that were not tried."""
    native = runs[NATIVE]
    found = {}
    for platform in PLATFORMS:
        run = runs.get(platform.tuple)
        if run is None:
            found[platform.tuple] = otherwise
        elif isinstance(run, NotHereError) or isinstance(native, NotHereError):
            found[platform.tuple] = f"not run: {run}"
        elif platform.tuple == NATIVE:
            found[platform.tuple] = "the reference"
        else:
            found[platform.tuple] = verdict(native, run)
    return found


def _runs(importer: Importer, root: Path, version: int, identifier: str, *arguments: str):
    runs: dict[str, list[str] | NotHereError] = {}
    for name in NATURE:
        try:
            file = library(root, BY_NAME[name], version, identifier)
            runs[name] = importer.run(name, file, str(version), *arguments, str(STEPS))
        except NotHereError as error:
            runs[name] = error
    return runs


def _table(header: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    return markdown_table(header, rows).replace("---:", "---").rstrip()


def _plants(folder: Path) -> str:
    importer = Importer("host.c", {HEADER: (SOURCES / HEADER).read_bytes()}, folder / "host")
    found = {}
    for version in VERSIONS:
        name = fmus.NAMES[version - 2]
        root = unzipped(fmus.path(name), folder / name)
        for law in LAWS:
            runs = _runs(importer, root, version, MODEL_IDENTIFIER, law)
            found[version, law] = _compared(runs, "not run: symbols and load commands checked")
    rows = [
        (p.tuple, NATURE.get(p.tuple, "–"), law, found[2, law][p.tuple], found[3, law][p.tuple])
        for p in PLATFORMS
        for law in LAWS
    ]
    return _table(("platform", "run by", "law", "FMI 2.0", "FMI 3.0"), rows)


def _controllers(folder: Path) -> dict[FmiVersion, tuple[Path, dict[str, bytes]]]:
    """The tuned controller's FMUs for all platforms, and their sources."""
    scenario = Scenario.load("paper")
    with FmuPlant(scenario) as plant:
        system = sampled_controller(tuned(scenario), scenario, plant.units)
    controller = rti_controller("tuned", scenario)
    return {
        v: (
            write_fmu(system, controller, scenario, folder / f"controller{v}.fmu", v, True),
            sampled_sources(system, v),
        )
        for v in VERSIONS
    }


def _exported(folder: Path, controllers: dict[FmiVersion, tuple[Path, dict[str, bytes]]]) -> str:
    found = {}
    for version, (path, sources) in controllers.items():
        headers = {name: sources[name] for name in ("variables.h", "system.h")}
        importer = Importer("controller_host.c", headers, folder / f"host{version}")
        root = unzipped(path, folder / path.stem)
        runs = _runs(importer, root, version, IDENTIFIER)
        found[version] = _compared(runs, "not run")
    rows = [
        (p.tuple, NATURE.get(p.tuple, "–"), found[2][p.tuple], found[3][p.tuple]) for p in PLATFORMS
    ]
    return _table(("platform", "run by", "FMI 2.0", "FMI 3.0"), rows)


def _importers(files: list[Path]) -> str:
    findings = [check(path) for path in files]
    rows = [
        (both[0].tool, both[0].subject, *(f"{f.status}: {f.detail}" for f in both))
        for both in zip(*findings, strict=True)
    ]
    return _table(("importer", "check", "FMI 2.0", "FMI 3.0"), rows)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else PAGE)
