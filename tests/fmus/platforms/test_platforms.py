"""Each platform's binary gives the bits of the native one, where it can be run here."""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import zipfile
from functools import cache
from pathlib import Path

import fmpy
import pytest

import fmus
from fmus.build import HEADER, SOURCES
from fmus.compiler import cross_compiler
from fmus.platforms import PLATFORMS, Platform

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        importlib.util.find_spec("ziglang") is None, reason="the extra 'cross' is not installed"
    ),
]
HERE = Path(__file__).parent
STEPS = "10000"
LAWS = ["none", "uniform", "normal", "drifting"]
BY_NAME = {platform.tuple: platform for platform in PLATFORMS}
ARM_LIBRARIES = Path("/usr/aarch64-linux-gnu")
WINE = Path("/usr/lib/wine/wine64")


@pytest.fixture(scope="session")
def unzipped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("unzipped")
    for name in fmus.NAMES:
        with zipfile.ZipFile(fmus.path(name)) as container:
            container.extractall(root / name)
    return root


@pytest.fixture(scope="session")
def wine(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The environment of a fresh Windows."""
    environment = os.environ | {
        "WINEPREFIX": str(tmp_path_factory.mktemp("wine")),
        "WINEDEBUG": "-all",
    }
    subprocess.run([WINE, "wineboot", "-i"], env=environment, check=True, capture_output=True)
    return environment


@pytest.fixture(scope="session")
def hosts(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The small importer of host.c, for each platform that can be run here."""
    folder = tmp_path_factory.mktemp("hosts")
    shutil.copy(SOURCES / HEADER, folder)
    shutil.copy(HERE / "host.c", folder)
    found = {}
    headers = Path(fmpy.__file__).parent / "c-code"
    for name in ("x86_64-linux", "aarch64-linux", "x86_64-windows"):
        found[name] = folder / f"{name}.exe"
        libraries = [] if name.endswith("windows") else ["-ldl"]
        command = [*cross_compiler(BY_NAME[name]).command, "-std=c99", "-Wall", "-isystem", headers]
        subprocess.run(
            [*command, "host.c", "-o", found[name].name, *libraries], cwd=folder, check=True
        )
    return found


def library(unzipped: Path, platform: Platform, version: int) -> Path:
    folder = unzipped / fmus.NAMES[version - 2] / "binaries" / platform.folder(f"{version}.0")
    return folder / f"evaporator{platform.suffix}"


@pytest.fixture(scope="session")
def run(hosts, unzipped, request: pytest.FixtureRequest):
    """Lines that the host prints on a platform; skipped where it cannot be run."""

    @cache
    def runner(name: str, version: int, law: str) -> list[str]:
        environment = None
        before: list[str] = []
        if name == "aarch64-linux":
            qemu = shutil.which("qemu-aarch64")
            if qemu is None or not ARM_LIBRARIES.is_dir():
                pytest.skip("Debian's qemu-user and libc6-arm64-cross are not installed")
            before = [qemu, "-L", str(ARM_LIBRARIES)]
        if name == "x86_64-windows":
            if not WINE.is_file():
                pytest.skip("Debian's wine64 is not installed")
            before, environment = [str(WINE)], request.getfixturevalue("wine")
        file = library(unzipped, BY_NAME[name], version)
        command = [*before, str(hosts[name]), str(file), str(version), law, STEPS]
        result = subprocess.run(
            command, env=environment, capture_output=True, text=True, check=False
        )
        assert result.returncode == 0, result.stderr
        return result.stdout.split()

    return runner


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("name", ["aarch64-linux", "x86_64-windows"])
def test_ten_thousand_steps_are_bit_identical_to_the_native_ones(run, name, version, law) -> None:
    native, other = run("x86_64-linux", version, law), run(name, version, law)
    assert len(native) == int(STEPS) + 1
    differing = [k for k, (a, b) in enumerate(zip(native, other, strict=True)) if a != b]
    assert differing == []


@pytest.mark.parametrize("law", LAWS)
def test_both_fmi_versions_give_the_same_bits(run, law: str) -> None:
    assert run("x86_64-linux", 2, law) == run("x86_64-linux", 3, law)


def test_laws_differ(run) -> None:
    """The hashes see what they are to compare."""
    runs = {law: run("x86_64-linux", 2, law)[0] for law in LAWS[:3]}
    assert len(set(runs.values())) == 3
    assert run("x86_64-linux", 2, "normal")[1] != run("x86_64-linux", 2, "drifting")[1]
