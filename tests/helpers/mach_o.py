"""A reader of what the tests ask of macOS' libraries: slices, load commands, exported symbols."""

from __future__ import annotations

import struct
from dataclasses import dataclass

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
