"""What the shipped archives hold for each platform: folders, symbols, load commands."""

import re
import shutil
import subprocess
import zipfile
from pathlib import Path

import pytest
from macholib import mach_o
from macholib.MachO import MachO
from macholib.SymbolTable import SymbolTable

import fmus
from fmus import PLATFORMS
from fmus.evaporator import EVAPORATOR

NOT_OURS = {"__dso_handle", "_mh_dylib_header"}


@pytest.fixture
def binaries(version: int) -> dict[str, bytes]:
    with zipfile.ZipFile(fmus.path(fmus.NAMES[version - 2])) as container:
        return {
            name.removeprefix("binaries/"): container.read(name)
            for name in container.namelist()
            if name.startswith("binaries/")
        }


@pytest.fixture
def functions(version: int) -> set[str]:
    """Every function of the standard, as fmpy's header lists them."""
    import fmpy

    folder = Path(fmpy.__file__).parent / "c-code"
    text = (folder / f"fmi{version}Functions.h").read_text()
    return set(re.findall(rf"^\s*FMI{version}_Export \w+TYPE\s+(fmi{version}\w+);", text, re.M))


def test_there_is_a_library_for_each_platform(binaries, version: int) -> None:
    expected = {f"{p.folder(f'{version}.0')}/{EVAPORATOR.identifier}{p.suffix}" for p in PLATFORMS}
    assert set(binaries) == expected


def test_macos_libraries_export_the_functions_of_the_standard_and_need_the_system_alone(
    binaries, functions, version: int, tmp_path: Path
) -> None:
    found = []
    for name, data in binaries.items():
        if not name.endswith(".dylib"):
            continue
        (tmp_path / "library").write_bytes(data)
        file = MachO(str(tmp_path / "library"))
        for part in file.headers:
            commands = {load.cmd: (command, text) for load, command, text in part.commands}
            exports = {symbol.decode()[1:] for _, symbol in SymbolTable(file, part).extdefsyms}
            assert exports - NOT_OURS == functions
            assert [path for *_, path in part.walkRelocatables()] == ["/usr/lib/libSystem.B.dylib"]
            own = commands[mach_o.LC_ID_DYLIB][1].rstrip(b"\0").decode()
            assert (part.filetype, own) == ("dylib", f"{EVAPORATOR.identifier}.dylib")
            built = commands[mach_o.LC_BUILD_VERSION][0]
            assert (built.platform, built.minos) == (mach_o.PLATFORM_MACOS, 11 << 16)
            architecture = mach_o.CPU_TYPE_NAMES[part.header.cputype]
            assert mach_o.LC_CODE_SIGNATURE in commands or architecture == "x86_64"
            assert part.offset % 2**14 == 0  # a page
            found.append((name.split("/")[0], architecture))
    on_x86 = [("x86_64-darwin", "x86_64")]
    if version == 2:
        on_x86 = [("darwin64", "x86_64"), ("darwin64", "ARM64")]
    assert found == [("aarch64-darwin", "ARM64"), *on_x86]


def test_windows_library_exports_the_functions_and_needs_what_windows_10_has(
    binaries, functions, objdump
) -> None:
    data = next(data for name, data in binaries.items() if name.endswith(".dll"))
    listing = objdump("-p", data)
    exported = set(re.findall(r"\[ *\d+\] (?:\+base\[ *\d+\] +\w+ )?(fmi\d\w+)", listing))
    assert exported == functions
    needed = re.findall(r"DLL Name: (\S+)", listing)
    assert all(name == "KERNEL32.dll" or name.startswith("api-ms-win-crt-") for name in needed)


@pytest.mark.parametrize("folder", ["x86", "aarch64"])
def test_linux_libraries_need_no_newer_glibc_than_2_17_and_only_sqrt_of_libm(
    binaries, functions, objdump, folder: str
) -> None:
    names = {"x86": ("linux64", "x86_64-linux"), "aarch64": ("aarch64-linux",)}[folder]
    data = next(data for name, data in binaries.items() if name.split("/")[0] in names)
    listing = objdump("-T", data)
    versions = {tuple(map(int, v.split("."))) for v in re.findall(r"GLIBC_([\d.]+)", listing)}
    assert versions
    assert max(versions) <= (2, 17)
    assert set(re.findall(r" DF \.text.* (\w+)$", listing, re.M)) == functions
    undefined = set(re.findall(r"\*UND\*.* (\w+)$", listing, re.M))
    rounded = {"log", "exp", "sin", "cos", "sincos", "pow", "tan", "log1p", "expm1", "fma"}
    assert not undefined & rounded


@pytest.fixture
def objdump(tmp_path: Path):
    """What binutils prints of a library with an option."""

    def run(option: str, data: bytes) -> str:
        if shutil.which("objdump") is None:
            pytest.skip("there is no objdump")
        (tmp_path / "library").write_bytes(data)
        return subprocess.run(
            ["objdump", option, tmp_path / "library"], capture_output=True, text=True, check=True
        ).stdout

    return run
