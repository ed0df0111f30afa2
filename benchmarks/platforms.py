"""Write benchmarks/platforms.md: python -m benchmarks.platforms [FILE].

Runs every binary that can be run here and every importer that is installed; takes some minutes.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from benchmarks.importers import check
from cosim.core.result import markdown_table
from fmus import PLATFORMS
from fmus.model import FmiVersion
from tests.helpers.platforms import (
    LAWS,
    NATIVE,
    STEPS,
    VERSIONS,
    Hosted,
    NotHereError,
    hosted_controller,
    hosted_plant,
    verdict,
)

PAGE = Path(__file__).parent / "platforms.md"
NATURE = {"x86_64-linux": "natively", "aarch64-linux": "qemu-user", "x86_64-windows": "wine64"}


def main(target: Path) -> None:
    """Write the page."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        plants = {version: hosted_plant(version, folder) for version in VERSIONS}
        controllers = {version: hosted_controller(version, folder) for version in VERSIONS}
        text = "\n\n".join(
            [
                HEAD,
                "## The plant, by platform, law and FMI version",
                _plants(plants),
                "## The controller, by platform and FMI version",
                _exported(controllers),
                "## Importers of the plant's FMU",
                _importers(plants),
                "## Importers of the controller's FMU",
                _importers(controllers),
            ]
        )
    target.write_text(text + "\n", encoding="utf-8")


HEAD = f"""\
# Platforms and importers

Written by `python -m benchmarks.platforms`, which runs all that can be run on a Linux
machine on x86-64 with Debian's qemu-user, libc6-arm64-cross and wine64, and PyPI's ziglang. A small
C program steps the library of each platform {STEPS} times and hashes the bits of every state,
derivative and output after each step; the verdict compares the hashes with those of Linux on
x86-64. `make platforms`
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


def _runs(hosted: Hosted, *arguments: str) -> dict[str, list[str] | NotHereError]:
    runs: dict[str, list[str] | NotHereError] = {}
    for name in NATURE:
        try:
            runs[name] = hosted.run(name, *arguments)
        except NotHereError as error:
            runs[name] = error
    return runs


def _table(header: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    return markdown_table(header, rows).replace("---:", "---").rstrip()


def _plants(plants: dict[FmiVersion, Hosted]) -> str:
    found = {
        (version, law): _compared(_runs(plant, law), "not run: symbols and load commands checked")
        for version, plant in plants.items()
        for law in LAWS
    }
    rows = [
        (p.tuple, NATURE.get(p.tuple, "–"), law, found[2, law][p.tuple], found[3, law][p.tuple])
        for p in PLATFORMS
        for law in LAWS
    ]
    return _table(("platform", "run by", "law", "FMI 2.0", "FMI 3.0"), rows)


def _exported(controllers: dict[FmiVersion, Hosted]) -> str:
    found = {version: _compared(_runs(one), "not run") for version, one in controllers.items()}
    rows = [
        (p.tuple, NATURE.get(p.tuple, "–"), found[2][p.tuple], found[3][p.tuple]) for p in PLATFORMS
    ]
    return _table(("platform", "run by", "FMI 2.0", "FMI 3.0"), rows)


def _importers(hosted: dict[FmiVersion, Hosted]) -> str:
    findings = [check(one.fmu) for one in hosted.values()]
    rows = [
        (both[0].tool, both[0].subject, *(f"{f.status}: {f.detail}" for f in both))
        for both in zip(*findings, strict=True)
    ]
    return _table(("importer", "check", "FMI 2.0", "FMI 3.0"), rows)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else PAGE)
