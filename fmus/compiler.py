"""C sources to shared libraries: by the local compiler, or for every platform by Zig's."""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import fmpy

from cosim.temporary import temporary_folder
from fmus.errors import BuildError
from fmus.platforms import Platform, present

# No path, date or identification may enter the binary; no fused multiply-add may change a result.
COMPILER_FLAGS = (
    "-std=c99",
    "-O2",
    "-ffp-contract=off",
    "-fno-math-errno",
    "-fPIC",
    "-fno-ident",
    "-fvisibility=hidden",
)
WARNINGS = ("-Wall", "-Wextra")
_LINKER_FLAGS = {
    ".so": ("-shared", "-s", "-Wl,--build-id=none", "-lm"),
    ".dll": ("-shared", "-s"),
    ".dylib": ("-dynamiclib",),
}
_CROSS_FLAGS = {
    ".so": ("-shared", "-s", "-lm"),
    # Windows' own printf, which knows C99's formats, in place of a second one linked in.
    ".dll": ("-shared", "-s", "-D__USE_MINGW_ANSI_STDIO=0"),
    ".dylib": ("-shared", "-s"),
}


@dataclass(frozen=True)
class Compiler:
    """A C compiler for one platform: the command that calls it and the flags of its linker."""

    platform: Platform
    command: tuple[str, ...]
    linker_flags: tuple[str, ...]

    @property
    def version(self) -> str:
        """What it says of itself, one line."""
        result = subprocess.run(
            [*self.command, "--version"], capture_output=True, text=True, check=True
        )
        return result.stdout.splitlines()[0]

    def library(
        self, sources: Mapping[str, bytes], name: str, warnings: tuple[str, ...] = WARNINGS
    ) -> bytes:
        """Compile every ``*.c`` of `sources`, files by name, into one shared library.

        `name` is the library's, without suffix; the FMI headers are fmpy's. Returns its bytes.
        Raises BuildError with the compiler's words on anything that it says; `warnings` chooses
        what it warns of.
        """
        headers = Path(fmpy.__file__).parent / "c-code"
        file = name + self.platform.suffix
        with temporary_folder("cosim-") as folder:
            for path, data in sources.items():
                (folder / path).write_bytes(data)
            units = sorted(path for path in sources if path.endswith(".c"))
            command = [
                *self.command, *COMPILER_FLAGS, *warnings, "-isystem", str(headers),
                *units, "-o", file, *self.linker_flags,
            ]  # fmt: skip
            result = subprocess.run(
                command, cwd=folder, capture_output=True, text=True, check=False
            )
            if result.returncode != 0 or result.stderr:
                raise BuildError(f"{' '.join(command)} failed:\n{result.stderr.strip()}")
            return (folder / file).read_bytes()


def local_compiler() -> Compiler:
    """``$CC``, else ``cc``, for the platform at hand; raises BuildError when there is none."""
    name = os.environ.get("CC", "cc")
    if shutil.which(name) is None:
        raise BuildError(f"no C compiler: {name!r} is not on the path; install gcc or set CC")
    platform = present()
    return Compiler(platform, (name,), _LINKER_FLAGS[platform.suffix])


def cross_compiler(platform: Platform) -> Compiler:
    """Zig's C compiler for any platform, from PyPI; raises BuildError when it is not installed."""
    if importlib.util.find_spec("ziglang") is None:
        raise BuildError("no cross-compiler: pip install 'rti-cosim[cross]'")
    command = (sys.executable, "-m", "ziglang", "cc", "-target", platform.target)
    return Compiler(platform, command, _CROSS_FLAGS[platform.suffix])
