"""FMUs run on the platforms that this machine can run: natively, under qemu, under wine."""

import importlib.util
import os
import shutil
import subprocess
import tempfile
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import fmpy
import pytest

import fmus
from cosim import Scenario
from cosim.cli.controller_fmu import rti_controller, sampled_controller, write_fmu
from fmus import PLATFORMS, Platform
from fmus.build import HEADER, cross_compiler, sources_of
from fmus.evaporator import EVAPORATOR
from fmus.model import FmiVersion

HOSTS = Path(__file__).parents[1] / "fmus" / "platforms"
BY_NAME = {platform.tuple: platform for platform in PLATFORMS}
NATIVE = "x86_64-linux"
OTHERS = ("aarch64-linux", "x86_64-windows")
ARM_LIBRARIES = Path("/usr/aarch64-linux-gnu")
WINE = Path("/usr/lib/wine/wine64")
STEPS = 10_000
VERSIONS: tuple[FmiVersion, ...] = (2, 3)
LAWS = ("none", "uniform", "normal", "uniform, fouling", "normal, fouling")
CROSS = pytest.mark.skipif(
    importlib.util.find_spec("ziglang") is None, reason="the extra 'cross' is not installed"
)
"""Of the tests that build or run other platforms' binaries."""
# A host draws the inputs that it gives: with fused multiply-adds, which clang makes for ARM64 by
# default and not for x86-64, they would be other inputs there.
FLAGS = ("-std=c99", "-Wall", "-ffp-contract=off")


class NotHereError(Exception):
    """The platform cannot be run on this machine; the message says what is missing."""


class Importer:
    """A C host of `tests/fmus/platforms`, compiled for each platform when it is first run there.

    `headers` are the C headers of the FMU that it includes. `run` raises NotHereError where the
    platform cannot be run, and CalledProcessError where the host ends with an error.
    """

    def __init__(self, source: str, headers: Mapping[str, bytes], folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._source, self._folder = source, folder
        for name in (source, "importer.h"):
            shutil.copy(HOSTS / name, folder)
        for name, data in headers.items():
            (folder / name).write_bytes(data)

    def run(self, name: str, library: Path, *arguments: str) -> list[str]:
        """The words that the host prints for a library on platform `name`."""
        before, environment = _launcher(name)
        result = subprocess.run(
            [*before, str(self._host(name)), str(library), *arguments],
            env=environment, capture_output=True, text=True, check=False,
        )  # fmt: skip
        assert result.returncode == 0, result.stderr
        return result.stdout.split()

    def _host(self, name: str) -> Path:
        target = self._folder / f"{name}.exe"
        if not target.exists():
            libraries = [] if name.endswith("windows") else ["-ldl"]
            c_code = Path(fmpy.__file__).parent / "c-code"
            command = [*cross_compiler(BY_NAME[name]).command, *FLAGS]
            subprocess.run(
                [*command, "-isystem", c_code, self._source, "-o", target.name, *libraries],
                cwd=self._folder, check=True,
            )  # fmt: skip
        return target


def library(folder: Path, platform: Platform, version: int, identifier: str) -> Path:
    """Where an unzipped FMU has its library for a platform."""
    return folder / "binaries" / platform.folder(f"{version}.0") / f"{identifier}{platform.suffix}"


def unzipped(fmu: Path, folder: Path) -> Path:
    """`folder`, with what the FMU holds."""
    with zipfile.ZipFile(fmu) as container:
        container.extractall(folder)
    return folder


@dataclass(frozen=True)
class Hosted:
    """An FMU for all platforms, unzipped in `root`, and the host that steps it."""

    fmu: Path
    root: Path
    importer: Importer
    version: FmiVersion
    identifier: str

    def run(self, name: str, *arguments: str) -> list[str]:
        """What the host prints of `STEPS` steps on platform `name`; see `Importer.run`."""
        file = library(self.root, BY_NAME[name], self.version, self.identifier)
        return self.importer.run(name, file, str(self.version), *arguments, str(STEPS))

    def run_or_skip(self, name: str, *arguments: str) -> list[str]:
        """The same in a test, skipped where the platform cannot be run."""
        try:
            return self.run(name, *arguments)
        except NotHereError as error:
            pytest.skip(str(error))


def hosted_plant(version: FmiVersion, folder: Path) -> Hosted:
    """The shipped plant."""
    fmu = fmus.path(fmus.NAMES[version - 2])
    header = sources_of(EVAPORATOR, version)[HEADER]
    importer = Importer("host.c", {HEADER: header}, folder / f"host{version}")
    return Hosted(fmu, unzipped(fmu, folder / fmu.stem), importer, version, EVAPORATOR.identifier)


def hosted_controller(version: FmiVersion, folder: Path) -> Hosted:
    """The tuned controller, exported for all platforms."""
    scenario = Scenario.load("paper")
    target = folder / f"controller{version}.fmu"
    controller = rti_controller("tuned", scenario)
    system = sampled_controller(controller, scenario)
    fmu = write_fmu(controller, scenario, target, version, every_platform=True)
    sources = sources_of(system, version)
    headers = {name: sources[name] for name in ("variables.h", "system.h")}
    importer = Importer("controller_host.c", headers, folder / f"host{version}")
    return Hosted(fmu, unzipped(fmu, folder / fmu.stem), importer, version, system.identifier)


def verdict(native: list[str], other: list[str]) -> str:
    """How two runs' words compare."""
    differing = sum(a != b for a, b in zip(native, other, strict=True))
    return f"{differing} of {len(native)} differ" if differing else "bit-identical"


def _launcher(name: str) -> tuple[list[str], dict[str, str] | None]:
    """The command before a program for platform `name`, and its environment."""
    if name == "aarch64-linux":
        qemu = shutil.which("qemu-aarch64")
        if qemu is None or not ARM_LIBRARIES.is_dir():
            raise NotHereError("Debian's qemu-user and libc6-arm64-cross are not installed")
        return [qemu, "-L", str(ARM_LIBRARIES)], None
    if name == "x86_64-windows":
        if not WINE.is_file():
            raise NotHereError("Debian's wine64 is not installed")
        return [str(WINE)], _wine()
    return [], None


@cache
def _wine() -> dict[str, str]:
    """The environment of a Windows of our own, made once a process."""
    prefix = tempfile.mkdtemp(prefix="wine")
    environment = os.environ | {"WINEPREFIX": prefix, "WINEDEBUG": "-all"}
    subprocess.run([WINE, "wineboot", "-i"], env=environment, check=True, capture_output=True)
    return environment
