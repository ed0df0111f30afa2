"""Which platform a shared library is made for, by its own first bytes."""

from __future__ import annotations

import struct

_ELF = {0x3E: "x86_64", 0xB7: "aarch64", 0x03: "x86", 0x28: "aarch32"}
_PE = {0x8664: "x86_64", 0xAA64: "aarch64", 0x14C: "x86", 0x1C4: "aarch32"}
_MACH_O = {0x01000007: "x86_64", 0x0100000C: "aarch64", 7: "x86"}
_UNIVERSAL, _MACH_O_64, _MACH_O_32 = 0xCAFEBABE, 0xFEEDFACF, 0xFEEDFACE


def platforms_of(library: bytes) -> tuple[str, ...]:
    """FMI 3.0's tuples of the platforms that can load `library`: none where it is no library.

    Several for macOS' universal binaries. An architecture unknown here reads ``?``.
    """
    try:
        if library[:4] == b"\x7fELF":
            order = "<" if library[5] == 1 else ">"
            return (f"{_ELF.get(struct.unpack_from(order + 'H', library, 18)[0], '?')}-linux",)
        if library[:2] == b"MZ":
            start = struct.unpack_from("<I", library, 0x3C)[0]
            if library[start : start + 4] == b"PE\0\0":
                machine = struct.unpack_from("<H", library, start + 4)[0]
                return (f"{_PE.get(machine, '?')}-windows",)
        if struct.unpack_from("<I", library)[0] in (_MACH_O_64, _MACH_O_32):
            return (f"{_MACH_O.get(struct.unpack_from('<I', library, 4)[0], '?')}-darwin",)
        magic, count = struct.unpack_from(">II", library)
        if magic == _UNIVERSAL and count < 10:
            codes = (struct.unpack_from(">I", library, 8 + 20 * i)[0] for i in range(count))
            return tuple(f"{_MACH_O.get(code, '?')}-darwin" for code in codes)
    except (struct.error, IndexError):
        pass
    return ()
