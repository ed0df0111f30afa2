"""Universal binaries of macOS: the libraries of several architectures in one file."""

from __future__ import annotations

import struct
from collections.abc import Sequence

_MAGIC = 0xCAFEBABE
_ALIGNMENT = 14  # binary digits: pages of 16 KiB on Apple silicon


def universal_binary(libraries: Sequence[bytes]) -> bytes:
    """Join 64-bit Mach-O files: a big-endian table of the slices, then each on a page of its own.

    The layout is that of ``fat_header`` and ``fat_arch`` in macOS' mach-o/fat.h.
    """
    page = 1 << _ALIGNMENT
    table = struct.pack(">II", _MAGIC, len(libraries))
    body = b""
    for library in libraries:
        architecture = struct.unpack_from("<II", library, 4)  # cputype, cpusubtype
        body += b"\0" * (-len(body) % page)
        offset = page + len(body)
        table += struct.pack(">IIIII", *architecture, offset, len(library), _ALIGNMENT)
        body += library
    return table.ljust(page, b"\0") + body
