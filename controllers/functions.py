"""CasADi functions that read and write preallocated NumPy memory, and their C code."""

from __future__ import annotations

import hashlib
import os
import platform
import re
import shutil
import subprocess
import sys
import tarfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import casadi as ca
import numpy as np

from controllers.errors import ControllerError, ModelWarning
from cosim.core.errors import warn
from cosim.core.files import cache_folder, lock, temporary_folder
from cosim.core.processes import child_process, processor_seconds
from cosim.core.protocols import Matrix, Vector

Expression = TypeVar("Expression", ca.SX, ca.MX)


def consecutive(sizes: Mapping[str, int], first: int = 0) -> dict[str, slice]:
    """Slices of parts that follow each other.

    Args:
        sizes: Sizes of the parts by name.
        first: Index of the first part's first entry.
    """
    slices = {}
    start = first
    for name, size in sizes.items():
        slices[name] = slice(start, start + size)
        start += size
    return slices


@dataclass(frozen=True)
class Definition:
    """A CasADi function whose results are one dense column, and the sizes of its parts.

    Attributes:
        function: the function; it has no memory of its own and may serve many.
        inputs: number of entries of each input by name, in order.
        shapes: rows and columns of each result by name, in order of the column.
    """

    function: ca.Function
    inputs: Mapping[str, int]
    shapes: Mapping[str, tuple[int, int]]


def define(
    name: str,
    arguments: Mapping[str, Expression],
    results: Mapping[str, Expression],
) -> Definition:
    """Make a function of expressions for `StackedFunction`.

    The expressions are scalar graphs (SX) or, where stages repeat, graphs of calls (MX).

    Args:
        name: Name of the function, in C too.
        arguments: Symbols by the names of the inputs.
        results: Expressions by name.
    """
    # Dense, so that every result has a fixed place; common subexpressions are computed once.
    stacked = ca.veccat(*results.values())
    function = ca.Function(
        name,
        [ca.densify(argument) for argument in arguments.values()],
        [ca.densify(stacked)],
        list(arguments),
        ["stack"],
        {"cse": True},
    )
    inputs = {key: argument.numel() for key, argument in arguments.items()}
    shapes = {key: result.shape for key, result in results.items()}
    return Definition(function, inputs, shapes)


Shapes = Mapping[str, tuple[int, int]]
"""Rows and columns of matrices by name."""


def scalar_symbols(shapes: Shapes) -> dict[str, ca.SX]:
    """Symbols of these shapes for an expression in scalars (SX)."""
    return {name: ca.SX.sym(name, *shape) for name, shape in shapes.items()}


def matrix_symbols(shapes: Shapes) -> dict[str, ca.MX]:
    """Symbols of these shapes for a graph of calls of other functions (MX)."""
    return {name: ca.MX.sym(name, *shape) for name, shape in shapes.items()}


def stage_function(
    name: str,
    arguments: Mapping[str, ca.SX],
    results: Mapping[str, ca.SX],
) -> ca.Function:
    """Function of one stage, to be mapped over the horizon: dense, common expressions shared.

    A graph of such calls keeps the generated C short: written out for all stages, that of eight
    states and ten stages took gcc 24 s, and that of 32 states an hour or more.

    Args:
        name: Name of the function, in C too.
        arguments: Its symbols by the names of its inputs.
        results: Its expressions by the names of its outputs.
    """
    return ca.Function(
        name,
        [ca.densify(argument) for argument in arguments.values()],
        [ca.densify(result) for result in results.values()],
        list(arguments),
        list(results),
        {"cse": True},
    )


def sweep_function(
    name: str,
    arguments: Mapping[str, ca.SX],
    results: Mapping[str, ca.SX],
) -> ca.Function:
    """`stage_function` of a sweep over the stages, without the arguments that it does not need.

    The results of one stage are arguments of the next, so that stages are called one by one, with
    `call`: an argument that is passed for nothing costs more than the arithmetic of two states.

    Args:
        name: Name of the function, in C too.
        arguments: Symbols by name, among which are those of the results.
        results: Its expressions by the names of its outputs.
    """
    stacked = ca.veccat(*results.values())
    free = {symbol.element_hash() for symbol in ca.symvar(stacked)}
    needed = {}
    for argument, symbols in arguments.items():
        if any(symbol.element_hash() in free for symbol in ca.symvar(symbols)):
            needed[argument] = symbols
    return stage_function(name, needed, results)


def call(function: ca.Function, **values: ca.MX | float) -> dict[str, ca.MX]:
    """Results of a function by name, given those of the values that it has inputs for."""
    return function.call({name: values[name] for name in function.name_in()})


class StackedFunction:
    """A CasADi function whose arguments and results live in fixed NumPy arrays.

    `inputs[name]` are flat float64 arrays in CasADi's column-major order: write the inputs, call,
    read the results by `part`, or `matrix`. A call allocates nothing. All results share one flat
    array, `stack`, so that one copy keeps them all. Inputs that are not shared, and results, are
    one array, `memory`; `places` are slices of it by name, `slices` the results' in `stack`.

    Args:
        definition: The function with the sizes of its parts.
        shared: Arrays of inputs that are read from other memory, such as another function's output.
        room: Sizes, by name, of more parts that `memory` has behind the function's own.
        memory: The memory to use in place of a new one.
    """

    def __init__(
        self,
        definition: Definition,
        shared: Mapping[str, Vector] | None = None,
        *,
        room: Mapping[str, int] | None = None,
        memory: Vector | None = None,
    ) -> None:
        self.function = definition.function
        self.shapes = definition.shapes

        # The memory: inputs of its own, the results one after the other, room for the caller.
        shared = shared or {}
        sizes = {}
        for input_name, size in definition.inputs.items():
            if input_name in shared:
                _check_array(input_name, shared[input_name], size)
            else:
                sizes[input_name] = size
        sizes["stack"] = self.function.numel_out(0)
        sizes |= dict(room or {})
        total = sum(sizes.values())
        if memory is None:
            memory = np.zeros(total)
        _check_array("memory", memory, total)
        self.memory: Vector = memory

        # Names of its parts; a result has a place in the memory and one in the stack.
        self.places = consecutive(sizes)
        result_sizes = {key: rows * columns for key, (rows, columns) in self.shapes.items()}
        self.slices = consecutive(result_sizes)
        self.inputs: dict[str, Vector] = {}
        for input_name in definition.inputs:
            if input_name in shared:
                self.inputs[input_name] = shared[input_name]
            else:
                self.inputs[input_name] = memory[self.places[input_name]]
        stack = self.places["stack"]
        self.stack: Vector = memory[stack]
        self.places |= consecutive(result_sizes, stack.start)

        # CasADi keeps pointers: the arrays must stay where they are.
        self._buffer, self._evaluate = self.function.buffer()
        for i, array in enumerate(self.inputs.values()):
            self._buffer.set_arg(i, memoryview(array))  # type: ignore[arg-type,call-arg]
        self._buffer.set_res(0, memoryview(self.stack))  # type: ignore[arg-type,call-arg]

    def __call__(self) -> None:
        """Evaluate at `inputs`, into `stack`; NaN where a solver inside the function fails."""
        try:
            self._evaluate()
        except RuntimeError:  # CasADi's, of a root finder or an integrator say
            self.stack[:] = np.nan

    def finite(self) -> bool:
        """Whether all results are finite."""
        return bool(np.isfinite(self.stack).all())

    def part(self, name: str, memory: Vector | None = None) -> Vector:
        """View of a part of the memory, flat: a result by its columns.

        Args:
            name: An input that is not shared, a result, or a part of the `room`.
            memory: A copy of the memory to take it from.
        """
        source = self.memory if memory is None else memory
        return source[self.places[name]]

    def matrix(self, name: str, memory: Vector | None = None) -> Matrix:
        """View of a result as the transpose of its expression: shape (columns, rows).

        What is a matrix is the caller's to say: one column may be either.

        Args:
            name: A result.
            memory: A copy of the memory to take it from.
        """
        rows, columns = self.shapes[name]
        return self.part(name, memory).reshape(columns, rows)


def _check_array(name: str, array: Vector, size: int) -> None:
    """CasADi reads and writes raw memory: a wrong array would be a wrong number or a crash."""
    doubles = array.dtype == np.float64 and array.flags.c_contiguous
    if array.shape != (size,) or not doubles:
        raise ValueError(f"{name} must be {size} doubles in a row, not {array.dtype} {array.shape}")


IN_C = frozenset(
    {
        "SXFunction",
        "MXFunction",
        "Map",
        "Switch",
        "LinearInterpolant",
        "LinearInterpolantJac",
        "BSplineInterpolant",
    }
)
"""CasADi's classes of functions whose C needs nothing but itself and the mathematical library."""


def not_in_c(functions: Sequence[ca.Function]) -> str | None:
    """Say which function inside of these cannot be C by itself; None where all can.

    Such are externals, callbacks, integrators, iterative root finders and optimisers. CasADi's
    interpreter evaluates them.
    """
    for function in functions:
        parts = [function, *function.find_functions()]
        for part in parts:
            kind = part.class_name()
            if kind not in IN_C:
                return f"the model calls '{part.name()}', a {kind} of CasADi"
    return None


def work_sizes(prefix: str, function: ca.Function) -> dict[str, int]:
    """Sizes that a call of a function's C needs, by the names of constants that begin so.

    They are the lengths of `arg`, `res`, `iw` and `w`. The first two exceed the numbers of inputs
    and outputs where the function calls others: CasADi keeps their pointers behind its own.

    Args:
        prefix: What the constants' names begin with.
        function: The function.
    """
    return {
        f"{prefix}_ARG": function.sz_arg(),
        f"{prefix}_RES": function.sz_res(),
        f"{prefix}_IW": function.sz_iw(),
        f"{prefix}_W": function.sz_w(),
    }


# CasADi's C asks at each entry whether its argument is there at all. Here all are, and gcc takes
# twice as long over that many branches.
_ASKED = re.compile(r"arg\[(\d+)\]\? arg\[\1\]\[(\d+)\] : 0")
_GIVEN = r"arg[\1][\2]"

# Of two zeros of unlike sign CasADi's interpreter returns the first, the C library the second.
_TIES = (
    ("return fmax(x, y);", "return y > x || x != x ? y : x;"),
    ("return fmin(x, y);", "return y < x || x != x ? y : x;"),
)

# gcc 12 has lost what a function of CasADi's stores: inlined in its caller, with the results in
# arrays of the caller's, at -O2 and -O3. Without this vectorisation, from here to the end of the
# file, it has not (tests/controllers/export/test_compilers.py).
_STORES_KEPT = """\
#if defined(__GNUC__) && !defined(__clang__)
#pragma GCC optimize ("no-tree-slp-vectorize")
#endif
"""


def c_source(functions: Sequence[ca.Function], name: str = "functions") -> str:
    """C99 source of the functions; it needs the mathematical library alone.

    Each becomes `int NAME(const double** arg, double** res, long long* iw, double* w, int mem)`,
    whose arrays must have the sizes of `work_sizes`, all of whose arguments must be given, and
    which returns 0 unless it fails. None of them needs a memory checked out, so `mem` is 0.
    Compiled without contraction of products and sums (-ffp-contract=off) and without fast-math it
    gives the interpreter's bytes. The same functions give the same source.

    Args:
        functions: The functions.
        name: What the names of the source's helpers begin with.

    Raises:
        ControllerError: A function cannot be C by itself (`not_in_c`).
    """
    reason = not_in_c(functions)
    if reason is not None:
        raise ControllerError(f"{reason}, which cannot be written as C of its own")
    generator = ca.CodeGenerator(f"{name}.c")
    for function in functions:
        generator.add(function)
    source = str(generator.dump())
    for library, interpreter in _TIES:
        source = source.replace(library, interpreter)
    return _STORES_KEPT + _ASKED.sub(_GIVEN, source)


SWITCH = "COSIM_COMPILE"
CHOICES = ("auto", "never", "now")
INTERPRETED, COMPILED = "interpreted", "compiled"
FLAGS = ("-O3", "-ffp-contract=off", "-fPIC", "-shared", "-fno-gcse-after-reload")
"""For gcc and clang. What the last one forbids takes gcc a third of the time at 32 states."""
LONG = 1000
"""Least samples of a run for which a controller is compiled; libraries are kept."""
PATIENCE = 120.0
"""Seconds of the processor that a compiler may take: what else the machine does must not matter."""
HANGING = 1800.0
"""Seconds after which a compiler hangs, whatever it does."""
LOOK_SECONDS = 0.5
"""Seconds between two looks at what a compiler has taken."""
BUILDS = Path(__file__).with_name("builds.tar.xz")
"""Libraries of the presets' controllers and rollouts for five platforms, by `build_name`."""


def library(sources: Mapping[str, str | bytes]) -> Path | None:
    """Shared library of C files by name, in the user's cache, made where it is missing.

    A library of `BUILDS` is taken from there: a compiler needs a minute for the same bytes of
    results. Of others every `*.c` is given to the compiler, and the other files are included. It is
    the same file for the same content, compiler and flags, it appears whole, and of several
    processes one makes it. None where there is no compiler, where it fails, and where COSIM_COMPILE
    says `never`; ControllerError on a word that it does not know. A compiler that fails or takes
    longer than PATIENCE is a ModelWarning, and is not tried again on the same files: a note in the
    cache, which the warning names, says why.
    """
    if switch() == "never":
        return None
    # A library is named by a digest of its files, which is taken of bytes.
    files = {}
    for name, source in sources.items():
        files[name] = source.encode() if isinstance(source, str) else source
    compiler = find_compiler()
    system = [sys.platform, platform.machine().lower()]
    stored = build_name(files, system)
    if compiler is not None:
        # Another compiler, or a new version in its place, makes another library.
        status = Path(compiler).resolve().stat()
        system += [compiler, str(status.st_size), str(status.st_mtime_ns), *FLAGS]
    try:
        # Any number of processes may ask for the same library at once: `_make` locks.
        path = cache_folder("compiled") / f"{build_name(files, system)}.lib"
        note = path.with_suffix(".failed")
        if not path.is_file() and not note.is_file():
            _make(path, files, compiler, stored)
        if not path.is_file():
            if note.is_file():
                _warn_of_failure(note)
            return None
        # A cache that is cleaned by age keeps what is in use.
        os.utime(path)
    except OSError:
        return None
    return path


def _warn_of_failure(note: Path) -> None:
    """Warn that a controller is interpreted, for the reason that the note has."""
    reason = note.read_text(encoding="utf-8")
    warn(
        f"not compiled but interpreted, which is slower: {reason}; remove {note} to try again",
        ModelWarning,
    )


def build_name(files: Mapping[str, bytes], system: Sequence[str]) -> str:
    """Name of a library: a digest of its C files and of what it is built for and with.

    Args:
        files: C files by name.
        system: Platform, architecture and, for what is compiled here, compiler and flags.
    """
    digest = hashlib.sha256("\0".join(system).encode())
    for name in sorted(files):
        # With its length, so that no file can be taken for the end of another.
        content = files[name]
        digest.update(f"\0{name}\0{len(content)}\0".encode())
        digest.update(content)
    return digest.hexdigest()[:32]


def _make(
    path: Path,
    files: Mapping[str, bytes],
    compiler: str | None,
    stored: str,
) -> None:
    """Take a library from `BUILDS`, else compile it; a note where the compiler fails."""
    note = path.with_suffix(".failed")
    with lock(path.with_suffix(".lock"), HANGING):
        # Another process may have tried in the meantime.
        if path.is_file() or note.is_file():
            return
        with temporary_folder(".partial-", path.parent) as folder:
            made = folder / "library"
            content = _stored_build(stored)
            if content is not None:
                made.write_bytes(content)
            elif compiler is None:
                return
            else:
                reason = _compile(compiler, files, folder)
                if reason is not None:
                    note.write_text(reason, encoding="utf-8")
                    return
            # The library appears whole, in one step, or not at all.
            made.replace(path)


def _stored_build(name: str) -> bytes | None:
    """Content of a library of `BUILDS`; None where it is not there."""
    try:
        # An installation may lack the builds: then what is needed is compiled.
        with tarfile.open(BUILDS) as builds:
            build = builds.extractfile(name)
            assert build is not None, "only files are in it"
            return build.read()
    except (OSError, KeyError, tarfile.TarError, EOFError):
        return None


def _compile(compiler: str, files: Mapping[str, bytes], folder: Path) -> str | None:
    """Compile the files to `library` in a folder; the reason where the compiler does not.

    Raises:
        OSError: The files cannot be written or the compiler cannot be started, which is no fault of
            the files'.
    """
    for name, content in files.items():
        (folder / name).write_bytes(content)
    # The other files are headers, which the units include.
    units = sorted(name for name in files if name.endswith(".c"))
    command = [compiler, *FLAGS, "-o", "library", *units, "-lm"]
    # A compiler that hangs must not hang the run: without a library the interpreter does.
    with child_process(command, folder=folder, log=subprocess.DEVNULL) as child:
        begin = time.monotonic()
        status = None
        while status is None:
            try:
                status = child.wait(LOOK_SECONDS)
            except subprocess.TimeoutExpired:
                if processor_seconds(child.pid) > PATIENCE:
                    return f"{compiler} took longer than {PATIENCE:g} s of the processor"
                if time.monotonic() - begin > HANGING:
                    return f"{compiler} did not end in {HANGING:g} s"
    if status < 0:
        # It was ended from outside, for want of memory say: another time it may succeed.
        raise OSError(f"{compiler} was ended by signal {-status}")
    if status != 0:
        return f"{compiler} failed with status {status}"
    if not (folder / "library").is_file():
        return f"{compiler} wrote no library"
    return None


def worth_compiling(samples: int) -> bool:
    """Whether a run of so many samples is compiled: a long one, unless COSIM_COMPILE says else."""
    chosen = switch()
    if chosen == "never":
        return False
    return samples >= LONG or chosen == "now"


def switch() -> str:
    """`auto`, `never` or `now`, as the environment's COSIM_COMPILE says; ControllerError else."""
    chosen = os.environ.get(SWITCH) or CHOICES[0]
    if chosen not in CHOICES:
        raise ControllerError(f"{SWITCH} is '{chosen}'; it must be {', '.join(CHOICES)} or not set")
    return chosen


def find_compiler() -> str | None:
    """Path of the C compiler: CC, else the first of cc, gcc and clang, else None."""
    names = ["cc", "gcc", "clang"]
    chosen = os.environ.get("CC")
    if chosen:
        names = [chosen]
    paths = [path for path in map(shutil.which, names) if path is not None]
    if not paths:
        return None
    if sys.platform == "darwin":  # its `cc` may only ask the user to install a compiler
        tools = subprocess.run(["xcode-select", "-p"], capture_output=True, check=False)
        if tools.returncode != 0:
            return None
    return paths[0]


def description() -> str:
    """Which of compiler and interpreter a long run uses here, in a few words."""
    if switch() == "never":
        return f"{INTERPRETED} ({SWITCH}=never)"
    compiler = find_compiler()
    if compiler is None:
        return f"{COMPILED} for the presets, {INTERPRETED} else (no C compiler found)"
    return f"{COMPILED} by {compiler} {' '.join(FLAGS)}, kept in {cache_folder('compiled')}"
