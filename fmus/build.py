"""The build of an FMU from C sources and a model or its description: compilers, equal archives."""

from __future__ import annotations

import hashlib
import importlib.util
import os
import shutil
import struct
import subprocess
import sys
import uuid
import zipfile
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from xml.etree import ElementTree

import fmpy

from fmus import PLATFORMS, UNIVERSAL, BuildError, Platform, present
from fmus.files import replacing
from fmus.model import (
    FmiVersion,
    FmuModel,
    Kind,
    Variable,
    build_description,
    c_header,
    model_description,
    render,
    terminals,
)

PACKAGE = Path(__file__).parent
SOURCES = PACKAGE / "sources"
RESOURCES = PACKAGE / "resources"


_ALIGNMENT = 14  # binary digits: pages of 16 KiB on Apple silicon


def universal_binary(libraries: Sequence[bytes]) -> bytes:
    """Join 64-bit Mach-O files: a big-endian table of the slices, then each on a page of its own.

    The layout is that of ``fat_header`` and ``fat_arch`` in macOS' mach-o/fat.h.
    """
    page = 1 << _ALIGNMENT
    table = struct.pack(">II", UNIVERSAL, len(libraries))
    body = b""
    for library in libraries:
        cpu_type, cpu_subtype = struct.unpack_from("<II", library, 4)
        padding = -len(body) % page
        body += b"\0" * padding
        # The table is the first page.
        offset = page + len(body)
        table += struct.pack(
            ">IIIII",
            cpu_type,
            cpu_subtype,
            offset,
            len(library),
            _ALIGNMENT,
        )
        body += library
    return table.ljust(page, b"\0") + body


_DATE = (1980, 1, 1, 0, 0, 0)


def write_archive(files: Mapping[str, bytes], target: Path) -> Path:
    """Write a ZIP archive, whole or not at all; the same files give the same bytes.

    Args:
        files: content by the path in the archive.
        target: path of the archive.

    Returns:
        The path.
    """
    with replacing(target) as partial, zipfile.ZipFile(partial, "x") as container:
        for name in sorted(files):
            # Of one date, and not compressed: another zlib would write other bytes.
            entry = zipfile.ZipInfo(name, _DATE)
            # As on Unix, a file that all may read, whatever the platform.
            entry.create_system = 3
            entry.external_attr = 0o100644 << 16
            container.writestr(entry, files[name])
    return target


# No path, date or identification may enter the binary; no fused multiply-add may change a result.
COMPILER_FLAGS = (
    "-std=c99",
    "-O2",
    "-ffp-contract=off",
    "-fno-math-errno",
    "-fPIC",
    "-fno-ident",
    "-fvisibility=hidden",
    # The functions of a library have FMI's own names, without the sources' prefix.
    "-DFMI2_OVERRIDE_FUNCTION_PREFIX",
    "-DFMI3_OVERRIDE_FUNCTION_PREFIX",
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
    """A C compiler for one platform: the command that calls it and the flags of its linker.

    `runtime` is a command that compiles the platform's C library and `empty.c`, where that is to be
    done first.
    """

    platform: Platform
    command: tuple[str, ...]
    linker_flags: tuple[str, ...]
    runtime: tuple[str, ...] = ()

    @property
    def version(self) -> str:
        """Its version, one line."""
        # Zig leaves a file where it is called.
        with TemporaryDirectory(prefix="cosim-") as folder:
            result = subprocess.run(
                [*self.command, "--version"],
                cwd=folder,
                capture_output=True,
                text=True,
                check=True,
            )
        return result.stdout.splitlines()[0]

    def library(
        self,
        sources: Mapping[str, bytes],
        name: str,
        warnings: tuple[str, ...] = WARNINGS,
    ) -> bytes:
        """Compile every ``*.c`` of the sources into one shared library.

        Args:
            sources: files by name; the FMI headers are fmpy's.
            name: the library's name, without suffix.
            warnings: compiler options that choose what it warns of.

        Returns:
            The library's bytes.

        Raises:
            BuildError: with the compiler's words, on anything that it says.
        """
        headers = Path(fmpy.__file__).parent / "c-code"
        file = name + self.platform.suffix
        units = sorted(path for path in sources if path.endswith(".c"))
        command = [
            *self.command,
            *COMPILER_FLAGS,
            *warnings,
            *("-isystem", str(headers)),
            *units,
            *("-o", file),
            *self.linker_flags,
        ]
        with TemporaryDirectory(prefix="cosim-", ignore_cleanup_errors=True) as name_of_folder:
            folder = Path(name_of_folder).absolute()
            (folder / "empty.c").touch()
            for path, data in sources.items():
                (folder / path).write_bytes(data)
            # What the runtime's compiler says is not about the sources.
            if self.runtime:
                subprocess.run(self.runtime, cwd=folder, capture_output=True, check=False)
            result = subprocess.run(
                command,
                cwd=folder,
                capture_output=True,
                text=True,
                check=False,
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
    zig = (sys.executable, "-m", "ziglang")
    target = ("-target", platform.target)
    command = (*zig, "cc", *target)
    linker_flags = _CROSS_FLAGS[platform.suffix]
    runtime: tuple[str, ...] = ()
    if platform.suffix == ".dll":
        # `zig cc` compiles the C library of Windows file by file; `build-lib` several at once.
        options = ("-dynamic", "-lc", "-OReleaseFast", "-fstrip")
        cores = os.cpu_count() or 1
        jobs = f"-j{2 * cores}"
        runtime = (*zig, "build-lib", *target, *options, "empty.c", jobs)
    return Compiler(platform, command, linker_flags, runtime)


def compilers(every_platform: bool) -> list[Compiler]:
    """The local compiler alone, or the cross-compiler for each of `PLATFORMS`.

    Raises BuildError where it is not installed.
    """
    if every_platform:
        return [cross_compiler(platform) for platform in PLATFORMS]
    return [local_compiler()]


def build_fmu(
    target: str | Path,
    sources: Mapping[str, bytes],
    description: str | bytes,
    *,
    every_platform: bool = False,
    files: Mapping[str, bytes] | None = None,
    warnings: tuple[str, ...] = ("-w",),
) -> Path:
    """Compile C sources and write them with their model description as an FMU.

    With the same compiler the bytes repeat.

    Args:
        target: path of the FMU.
        sources: files of the folder ``sources/`` by name; every ``*.c`` is compiled, as C99,
            against fmpy's FMI headers.
        description: text of modelDescription.xml, FMI 2.0 or 3.0; its interfaces must name one
            modelIdentifier.
        every_platform: build for each of `PLATFORMS`, by the extra ``cross``, and not for the
            platform at hand alone, by the local compiler.
        files: further members by their path in the archive.
        warnings: compiler options that choose what it warns of.

    Returns:
        The path of the FMU.

    Raises:
        BuildError: if there is no compiler, it complains, or the description names no model.
    """
    path = Path(target)
    text = description.encode() if isinstance(description, str) else description
    version, identifier = _model(text)
    if not any(name.endswith(".c") for name in sources):
        raise BuildError(f"{path}: there is no C source (*.c) to build it from")
    libraries = _libraries(compilers(every_platform), sources, identifier, warnings)
    members = {**(files or {}), "modelDescription.xml": text}
    for name, data in sources.items():
        members[f"sources/{name}"] = data
    macos = []
    for platform, library in libraries.items():
        folder = platform.folder(version)
        members[f"binaries/{folder}/{identifier}{platform.suffix}"] = library
        if platform.suffix == ".dylib":
            macos.append(library)
    # FMI 2.0 importers on Apple silicon look into the folder of macOS on x86: there, where both
    # are built, lies a universal binary.
    shared = f"binaries/darwin64/{identifier}.dylib"
    if shared in members and len(macos) > 1:
        members[shared] = universal_binary(macos)
    return write_archive(members, path)


def _libraries(
    compilers: Sequence[Compiler],
    sources: Mapping[str, bytes],
    identifier: str,
    warnings: tuple[str, ...],
) -> dict[Platform, bytes]:
    """The shared library of each platform, all compiled at once."""
    with ThreadPoolExecutor(len(compilers)) as pool:
        futures = {}
        for compiler in compilers:
            future = pool.submit(compiler.library, sources, identifier, warnings)
            futures[compiler.platform] = future
        # A compiler is a process: the threads only wait for them.
        libraries = {}
        for platform, future in futures.items():
            libraries[platform] = future.result()
        return libraries


def build_folder(
    folder: str | Path,
    target: str | Path,
    every_platform: bool = False,
) -> Path:
    """Build `modelDescription.xml` and every `*.c` and `*.h` of a folder into an FMU.

    Args:
        folder: where these files lie.
        target: path of the FMU.
        every_platform: build for each of `PLATFORMS`, and not for the platform at hand alone.

    Returns:
        The path of the FMU.

    Raises:
        OSError: if there is no model description.
        BuildError: as `build_fmu`.
    """
    folder = Path(folder)
    text = (folder / "modelDescription.xml").read_bytes()
    sources = _contents(folder.glob("*.[ch]"))
    return build_fmu(target, sources, text, every_platform=every_platform)


def _contents(paths: Iterable[Path]) -> dict[str, bytes]:
    """Content of files by name."""
    contents = {}
    for path in paths:
        contents[path.name] = path.read_bytes()
    return contents


def _model(description: bytes) -> tuple[str, str]:
    """FMI version and model identifier."""
    try:
        root = ElementTree.fromstring(description)
    except ElementTree.ParseError as error:
        raise BuildError(f"modelDescription.xml is not XML: {error}") from None
    version = root.get("fmiVersion", "")
    if version[:2] not in ("2.", "3."):
        raise BuildError(f"modelDescription.xml is for FMI {version or '?'}, not 2.0 or 3.0")
    identifiers = set()
    for tag in ("CoSimulation", "ModelExchange"):
        for interface in root.findall(tag):
            identifiers.add(interface.get("modelIdentifier", ""))
    if len(identifiers) != 1:
        raise BuildError(
            "modelDescription.xml: CoSimulation and ModelExchange must name one modelIdentifier, "
            f"not {len(identifiers)}"
        )
    identifier = identifiers.pop()
    if not (identifier.isascii() and identifier.isidentifier()):
        raise BuildError(
            f"modelDescription.xml: modelIdentifier {identifier!r} is not a C identifier"
        )
    return version, identifier


# The evaporator's sources that serve any model: FMI's functions and their parts.
_FACES = ("access.h", "exchange.h", "experiment.h", "grid.h", "instance.h", "snapshot.h")
HEADER = "variables.h"


def files_of(folder: str) -> dict[str, bytes]:
    """File name → bytes of the C headers in a folder of this package."""
    headers = (PACKAGE / folder).glob("*.h")
    return _contents(headers)


def sources_of(model: FmuModel, version: FmiVersion) -> dict[str, bytes]:
    """The files of the folder `sources/` of an FMU.

    Args:
        model: its own sources replace those that serve any model.
        version: major version of FMI.

    Returns:
        Content by file name.
    """
    files = {}
    for name in (*_FACES, f"fmi{version}.c"):
        files[name] = (SOURCES / name).read_bytes()
    # Without derivatives, unless the model has some of its own.
    no_derivatives = PACKAGE / "plant_sources" / "derivatives.h"
    files["derivatives.h"] = no_derivatives.read_bytes()
    if model.sampled:
        files |= _sampled_sources(model, version)
    files |= model.sources

    # The token is a digest of all of the above; what holds it does not count.
    token = token_of(model, version, files)
    files[HEADER] = c_header(token, model).encode()
    files["buildDescription.xml"] = build_description(version, model).encode()
    return files


def _sampled_sources(system: FmuModel, version: FmiVersion) -> dict[str, bytes]:
    """The C files of a sampled model: FMI's functions over a table of time, inputs, outputs, …."""
    kinds = [variable.kind for variable in system.variables]
    # The table begins with time.
    first_output = 1 + kinds.count(Kind.INPUT)
    first_parameter = first_output + kinds.count(Kind.OUTPUT)
    header = render(
        "system.h",
        first_output=first_output,
        first_parameter=first_parameter,
        sampling_time=float(system.step_size),
    )
    sources = files_of("sampled_sources")
    sources["system.h"] = header.encode()
    if version == 2:
        return sources
    # FMI 3.0 has its functions for scalars, and an adapter for the model's arrays.
    elements = dict.fromkeys(range(len(kinds)), (1, 0))
    for array in system.arrays.values():
        references = [system.value_reference(variable.name) for variable in array]
        following = [*references[1:], references[0]]
        # The first element stands for the array and has its size; each points to the next.
        sizes = [len(references)] + [0] * (len(references) - 1)
        for reference, size, next_reference in zip(references, sizes, following, strict=True):
            elements[reference] = (size, next_reference)
    adapter = render("arrays.h", model=system, elements=elements.values())
    sources["arrays.h"] = adapter.encode()
    last_include = b'#include "snapshot.h"\n'
    adapter_include = b'#include "arrays.h"\n'
    scalars = (SOURCES / "fmi3.c").read_bytes()
    sources["fmi3.c"] = scalars.replace(last_include, last_include + adapter_include)
    return sources


def build_model(
    model: FmuModel,
    target: str | Path,
    version: FmiVersion = 2,
    *,
    every_platform: bool = False,
    files: Mapping[str, bytes] | None = None,
    warnings: tuple[str, ...] = ("-w",),
) -> Path:
    """Build the FMU of a model, with a page of its variables; with the same compiler, equal bytes.

    Args:
        model: its table of variables and its sources.
        target: path of the FMU.
        version: major version of FMI.
        every_platform: build for each of `PLATFORMS`, and not for the platform at hand alone.
        files: further members by their path in the archive.
        warnings: compiler options that choose what it warns of.

    Returns:
        The path of the FMU.

    Raises:
        BuildError: as `build_fmu`.
    """
    sources = sources_of(model, version)
    page = render("model.html", model=model, version=version)
    members = {
        "documentation/index.html": page.encode(),
        "documentation/licenses/license.txt": (RESOURCES / "license.txt").read_bytes(),
    }
    if version == 3:
        members |= terminals(model)
    members |= files or {}
    token = token_of(model, version, sources)
    return build_fmu(
        target,
        sources,
        model_description(version, token, model),
        every_platform=every_platform,
        files=members,
        warnings=warnings,
    )


def token_of(
    model: FmuModel,
    version: FmiVersion,
    sources: Mapping[str, bytes],
) -> str:
    """GUID of FMI 2.0 or instantiation token of FMI 3.0: a digest of all that makes the model.

    Args:
        model: its description counts.
        version: major version of FMI.
        sources: content by file name; generated files, which hold the token, do not count.
    """
    # Without a token, which is what is to be found.
    description = model_description(version, "", model)
    digest = hashlib.sha256(description.encode())
    counted = sources.keys() - {HEADER, "buildDescription.xml"}
    for name in sorted(counted):
        # The null byte ends a name as nothing in it can.
        digest.update(name.encode() + b"\0" + sources[name])
    identifier = uuid.UUID(bytes=digest.digest()[:16], version=5)
    return f"{{{identifier}}}"


def sampled_table(signals: Sequence[Variable]) -> tuple[Variable, ...]:
    """The variables of a sampled model, a function of inputs and parameters.

    Args:
        signals: real variables, or Boolean inputs: the inputs, then the outputs, then the tunable
            parameters.

    Returns:
        The table: time, then the signals; every output depends on every input and parameter.

    Raises:
        BuildError: if two names are the same, in FMI or in C.
    """
    table = [Variable("time", Kind.INDEPENDENT, unit="s", description="simulation time")]
    settable = tuple(signal.name for signal in signals if signal.settable)
    for signal in signals:
        if signal.settable:
            table.append(signal)
        else:
            table.append(replace(signal, uses=settable))

    # In C a name has other signs, so that two names may meet there.
    names = [variable.name for variable in table]
    identifiers = [variable.identifier for variable in table]
    for taken_names in (names, identifiers):
        for name in taken_names:
            if taken_names.count(name) > 1:
                raise BuildError(f"two variables are called '{name}'")
    return tuple(table)
