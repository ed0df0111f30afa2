"""What the shipped archives hold for each platform: folders, symbols, load commands."""

import re
import shutil
import struct
import subprocess
import zipfile
from dataclasses import dataclass
from pathlib import Path

import pytest

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
    binaries, functions, version: int
) -> None:
    found = []
    for name, data in binaries.items():
        if not name.endswith(".dylib"):
            continue
        for part in slices(data):
            library = read(part)
            assert library.exports - NOT_OURS == functions
            assert library.needs == ("/usr/lib/libSystem.B.dylib",)
            assert library.name == f"{EVAPORATOR.identifier}.dylib"
            assert library.least_version == (11, 0)
            assert library.signed or library.architecture == "x86_64"
            found.append((name.split("/")[0], library.architecture))
    on_x86 = [("x86_64-darwin", "x86_64")]
    if version == 2:
        on_x86 = [("darwin64", "x86_64"), ("darwin64", "aarch64")]
    assert found == [("aarch64-darwin", "aarch64"), *on_x86]


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


ARCHITECTURES = {0x01000007: "x86_64", 0x0100000C: "aarch64"}
_SYMTAB, _LOAD_DYLIB, _ID_DYLIB, _SIGNATURE, _BUILD_VERSION = 0x2, 0xC, 0xD, 0x1D, 0x32
_DYLIB, _EXTERNAL, _DEFINED_IN_SECTION, _MACOS = 6, 0x01, 0x0E, 1


@dataclass(frozen=True)
class Library:
    """A 64-bit Mach-O dynamic library."""

    architecture: str
    name: str
    needs: tuple[str, ...]
    least_version: tuple[int, int]
    exports: frozenset[str]
    signed: bool


def slices(data: bytes) -> list[bytes]:
    """The libraries in a universal binary, or the one that `data` is."""
    magic, count = struct.unpack_from(">II", data)
    if magic != 0xCAFEBABE:
        return [data]
    found = []
    for i in range(count):
        cpu, _, offset, size, alignment = struct.unpack_from(">IIIII", data, 8 + 20 * i)
        assert cpu in ARCHITECTURES
        assert offset % (1 << alignment) == 0
        assert offset + size <= len(data)
        found.append(data[offset : offset + size])
    return found


def read(data: bytes) -> Library:
    magic, cpu, _, kind, count, _ = struct.unpack_from("<IIIIII", data)
    assert (magic, kind) == (0xFEEDFACF, _DYLIB)
    name, version, signed = "", (0, 0), False
    needs: list[str] = []
    exports: set[str] = set()
    position = 32
    for _ in range(count):
        command, size = struct.unpack_from("<II", data, position)
        body = data[position : position + size]
        if command & 0xFF == _SYMTAB:
            exports = _exports(data, *struct.unpack_from("<IIII", body, 8))
        elif command & 0xFF == _LOAD_DYLIB:
            needs.append(_text(body, struct.unpack_from("<I", body, 8)[0]))
        elif command == _ID_DYLIB:
            name = _text(body, struct.unpack_from("<I", body, 8)[0])
        elif command == _SIGNATURE:
            signed = True
        elif command == _BUILD_VERSION:
            platform, least = struct.unpack_from("<II", body, 8)
            assert platform == _MACOS
            version = (least >> 16, least >> 8 & 0xFF)
        position += size
    return Library(ARCHITECTURES[cpu], name, tuple(needs), version, frozenset(exports), signed)


def _text(data: bytes, offset: int) -> str:
    return data[offset : data.index(b"\0", offset)].decode()


def _exports(data: bytes, symbols: int, count: int, strings: int, _: int) -> set[str]:
    found = set()
    for i in range(count):
        name, kind, _, _, _ = struct.unpack_from("<IBBHQ", data, symbols + 16 * i)
        if kind & _EXTERNAL and kind & 0x0E == _DEFINED_IN_SECTION and not kind & 0x10:
            found.add(_text(data, strings + name).removeprefix("_"))
    return found
