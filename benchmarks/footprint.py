"""Bytes that the exported controller takes on micro-controllers: python -m benchmarks.footprint.

By clang -Os of the extra ``cross``; the table is in docs/how-to/deploy.md.
"""

from __future__ import annotations

import re
import struct
import subprocess
import sys
import tempfile
from math import prod
from pathlib import Path

from cosim import Scenario
from cosim.cli.controller_fmu import rti_controller, write_c
from cosim.core.result import markdown_table

PROCESSORS = {
    "Cortex-M7, double-precision FPU": ("thumb-linux-musleabihf", "-mcpu=cortex_m7+fp_armv8d16"),
    "Cortex-M4, arithmetic in software": ("thumb-linux-musleabihf", "-mcpu=cortex_m4"),
    "RISC-V, RV32GC": ("riscv32-linux-musl",),
}
SINGLE = {
    "Cortex-M4F, `--single`": ("thumb-linux-musleabihf", "-mcpu=cortex_m4+vfp4d16sp"),
}
ALLOCATED, NO_BITS, WRITABLE = 2, 8, 1


def footprint(folder: Path, target: tuple[str, ...]) -> dict[str, int]:
    """`flash` without libm and what is called for arithmetic, `static` memory, `stack` [bytes].

    The stack is the sum of all frames, a bound without recursion.
    """
    command = [
        sys.executable, "-m", "ziglang", "cc", "-target", *target, "-std=c99", "-Os",
        "-ffp-contract=off", "-Wframe-larger-than=0", "-c", "nmpc.c", "-o", "object.o",
    ]  # fmt: skip
    result = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True)
    elf = (folder / "object.o").read_bytes()
    sizes = {"flash": 0, "static": 0}
    (start,) = struct.unpack_from("<I", elf, 0x20)
    size, count = struct.unpack_from("<HH", elf, 0x2E)
    for k in range(count):
        kind, flags, _, _, length = struct.unpack_from("<5I", elf, start + k * size + 4)
        if flags & ALLOCATED:
            sizes["static" if kind == NO_BITS or flags & WRITABLE else "flash"] += length
    frames = re.findall(r"stack frame size \((\d+)\)", result.stderr)
    header = (folder / "nmpc.h").read_text()
    lengths = re.findall(r"_(?:MEMORY|THETA) = ([\d *]+)", header)
    memory = sum(prod(map(int, length.split("*"))) for length in lengths)
    bytes_each = 4 if "float theta" in header else 8
    return sizes | {"stack": sum(map(int, frames)), "a controller": bytes_each * memory}


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as name:
        paper, rows = Scenario.load("paper"), []
        for processors in (PROCESSORS, SINGLE):
            code = Path(name, str(len(rows)), "nmpc")
            code.parent.mkdir()
            write_c(rti_controller("tuned", paper), paper, code, processors is SINGLE)
            rows += [
                (name, *(f"{size / 1000:.2g} kB" for size in footprint(code, target).values()))
                for name, target in processors.items()
            ]
    print(markdown_table(("processor", "flash", "static memory", "stack", "a controller"), rows))
