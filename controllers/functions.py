"""CasADi functions that read and write preallocated NumPy memory, and their C code."""

from __future__ import annotations

import hashlib
import os
import sys
from collections.abc import Mapping, Sequence
from math import isfinite
from pathlib import Path
from typing import TypeVar

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from controllers.errors import ControllerError
from controllers.shared_library import FLAGS, Build, find, find_compiler, lock_of
from cosim.files import cache_folder

Vector = NDArray[np.float64]


BLAS_STARTS_THREADS = 8192
"""Entries from which a product of vectors may be cut up."""
Expression = TypeVar("Expression", ca.SX, ca.MX)


class BufferedFunction:
    """A CasADi function whose arguments and results live in fixed NumPy arrays.

    `inputs[name]` and `outputs[name]` are flat float64 arrays in CasADi's column-major order:
    write the inputs, call, read the outputs. A call allocates nothing. The inputs follow each other
    in one array, `arguments`, but for the `shared` ones, which are read from somebody else's
    memory, such as another function's output. Every input and output of the function must be dense.
    Raises ValueError where a shared array has the wrong size.
    """

    def __init__(self, function: ca.Function, shared: Mapping[str, Vector] | None = None) -> None:
        self.function = function
        shared = shared or {}
        sizes = {function.name_in(i): function.numel_in(i) for i in range(function.n_in())}
        own = {name: size for name, size in sizes.items() if name not in shared}
        self.arguments: Vector = np.zeros(sum(own.values()))
        ends = np.cumsum(list(own.values()))
        self.positions = {
            name: slice(int(end) - size, int(end))
            for (name, size), end in zip(own.items(), ends, strict=True)
        }
        """Where an input of its own stands in `arguments`."""
        for name, array in shared.items():
            if array.shape != (sizes[name],) or not array.flags.c_contiguous:
                raise ValueError(f"{function.name()}: shared input {name} does not fit")
        self.inputs = {
            name: shared[name] if name in shared else self.arguments[self.positions[name]]
            for name in sizes
        }
        self.outputs = {
            function.name_out(i): np.zeros(function.numel_out(i)) for i in range(function.n_out())
        }
        self.bind(function)

    def bind(self, function: ca.Function) -> None:
        """Let another function of the same arguments and results do the work, a compiled one."""
        self._buffer, self._evaluate = function.buffer()
        for i, array in enumerate(self.inputs.values()):
            self._buffer.set_arg(i, memoryview(array))  # type: ignore[arg-type,call-arg]
        for i, array in enumerate(self.outputs.values()):
            self._buffer.set_res(i, memoryview(array))  # type: ignore[arg-type,call-arg]

    def __call__(self) -> None:
        """Evaluate with what stands in `inputs`, into `outputs`."""
        self._evaluate()


def stacked(
    name: str,
    arguments: Mapping[str, Expression],
    results: Mapping[str, Expression],
    shared: Mapping[str, Vector] | None = None,
) -> StackedFunction:
    """Buffered function whose results share one flat array, so that one copy keeps them all.

    Its expressions are scalar graphs (SX) or, where stages repeat, graphs of calls (MX).
    """
    sizes = [result.numel() for result in results.values()]
    ends = np.cumsum(sizes)
    function = ca.Function(
        name,
        [ca.densify(argument) for argument in arguments.values()],
        [ca.densify(ca.veccat(*results.values()))],
        list(arguments),
        ["stack"],
        {"cse": True},
    )
    slices = {
        key: slice(int(end) - size, int(end))
        for key, size, end in zip(results, sizes, ends, strict=True)
    }
    shapes = {key: value.shape for key, value in results.items()}
    return StackedFunction(function, slices, shapes, shared)


class StackedFunction(BufferedFunction):
    """A buffered function with one output array, cut into named parts."""

    def __init__(
        self,
        function: ca.Function,
        slices: dict[str, slice],
        shapes: dict[str, tuple[int, int]],
        shared: Mapping[str, Vector] | None = None,
    ) -> None:
        super().__init__(function, shared)
        self.slices = slices
        self.shapes = shapes
        self.stack: Vector = self.outputs["stack"]
        self._zeros = np.zeros(self.stack.size)

    def finite(self) -> bool:
        """Whether all results are: 0ᵀx takes a third of the time of NumPy's isfinite.

        By `vdot`, which does not warn of the 0·∞ that is looked for: `errstate` around `dot` costs
        more than the product. Not where BLAS would start threads for it, which wait for each other
        on a busy machine.
        """
        if self._zeros.size > BLAS_STARTS_THREADS:
            return bool(np.isfinite(self.stack).all())
        return isfinite(np.vdot(self.stack, self._zeros))

    def span(self, first: str, last: str) -> slice:
        """Where the results from the `first` to the `last` stand in the stack."""
        return slice(self.slices[first].start, self.slices[last].stop)

    def part(self, name: str, stack: Vector | None = None) -> Vector:
        """View of a result, transposed to row-major: shape (columns, rows), or flat for a column.

        It looks into the function's own output or into a copy of it.
        """
        flat = (self.stack if stack is None else stack)[self.slices[name]]
        rows, columns = self.shapes[name]
        return flat if columns == 1 else flat.reshape(columns, rows)


# Of two zeros of unlike sign CasADi's interpreter returns the first, the C library the second.
_TIES = (
    ("return fmax(x, y);", "return y > x || x != x ? y : x;"),
    ("return fmin(x, y);", "return y < x || x != x ? y : x;"),
)


def c_source(functions: Sequence[ca.Function]) -> str:
    """C99 source of the functions, which need nothing but the mathematical library.

    Each becomes `int NAME(const double** arg, double** res, long long* iw, double* w, int mem)`,
    with `NAME_work` for the sizes of its work vectors. Compiled without contraction of products
    and sums (-ffp-contract=off) and without fast-math it gives the interpreter's bytes. The same
    functions give the same source.
    """
    generator = ca.CodeGenerator("functions.c")
    for function in functions:
        generator.add(function)
    source = str(generator.dump())
    for library, interpreter in _TIES:
        source = source.replace(library, interpreter)
    return source


KIND = "compiled"
SWITCH = "COSIM_COMPILE"
CHOICES = ("auto", "never", "now")
INTERPRETED, COMPILED = "interpreted", "compiled"
LOOK, WORTH, POLL = 50, 2000, 200
"""Calls after which a stored library is looked for, one is compiled, and each look at its end."""


def switch() -> str:
    """`auto`, `never` or `now`, as the environment's COSIM_COMPILE says.

    Raises ControllerError on another word.
    """
    chosen = os.environ.get(SWITCH) or CHOICES[0]
    if chosen not in CHOICES:
        raise ControllerError(f"{SWITCH} is '{chosen}'; it must be {', '.join(CHOICES)} or not set")
    return chosen


def description() -> str:
    """Which of compiler and interpreter a long run uses here, in a few words."""
    if switch() == "never":
        return f"{INTERPRETED} ({SWITCH}=never)"
    compiler = find_compiler(os.environ.get("CC"))
    if compiler is None:
        return f"{INTERPRETED} (no C compiler found)"
    return f"{COMPILED} by {compiler.path} {' '.join(FLAGS)}, kept in {cache_folder(KIND)}"


class Compilation:
    """Functions that are interpreted at first and compiled once enough calls show that it pays.

    `count()` is called once a sample. Early on, a library that some earlier run has left is taken
    up; after `WORTH` samples the compiler is started, and its library taken up when it is there,
    while the samples go on. The bytes of all results are the same throughout. Without compiler, and
    where it fails, the interpreter stays. The environment's COSIM_COMPILE may say `never`, or
    `now` to have it done, and waited for, at once.
    """

    def __init__(self, functions: Sequence[BufferedFunction]) -> None:
        self._functions = functions
        self.mode = INTERPRETED
        """Whether the functions are `interpreted` or `compiled` now."""
        self._calls, self._next = 0, LOOK
        self._build: Build | None = None
        self._source = ""
        chosen = switch()
        if chosen == "never":
            self._next = sys.maxsize
        elif chosen == "now":
            self.finish()

    def count(self) -> None:
        """Count a sample."""
        self._calls += 1
        if self._calls >= self._next:
            self._advance()

    def postpone(self) -> None:
        """Change nothing before `finish`, however many samples are counted."""
        self._next = sys.maxsize

    def finish(self) -> str:
        """Do at once, and wait for, what `count` would do in time; returns `mode`.

        With COSIM_COMPILE=never that is nothing.
        """
        wanted = self.mode == INTERPRETED and switch() != "never"
        if wanted and self._prepare() and not self._take(self._stored()):
            if self._build is None:
                self._start(wait=True)
            if self._build is not None:
                self._build.done(wait=True)
                self._finish_build()
        self._next = sys.maxsize
        return self.mode

    def _advance(self) -> None:
        if self._build is not None:
            self._next = self._calls + POLL
            if self._build.done():
                self._finish_build()
        elif not self._prepare() or self._take(self._stored()):
            self._next = sys.maxsize
        elif self._calls < WORTH:
            self._next = WORTH
        else:
            self._next = self._calls + POLL
            try:
                self._start()
            except OSError:
                self._next = sys.maxsize

    def _prepare(self) -> bool:
        """Write the source and name the library; False where there is no compiler."""
        compiler = find_compiler(os.environ.get("CC"))
        if compiler is None:
            return False
        if not self._source:
            self._source = c_source([function.function for function in self._functions])
            content = "\0".join((self._source, compiler.identity, *FLAGS))
            self._name = hashlib.sha256(content.encode()).hexdigest()[:32]
            self._compiler, self._folder = compiler, cache_folder(KIND)
        return True

    def _start(self, *, wait: bool = False) -> None:
        """Start the compiler unless another process is at it, or, after a wait, has been."""
        lock = lock_of(self._name, self._folder, wait=wait)
        if lock is None:
            return
        if self._take(self._stored()):
            lock.release()
            self._next = sys.maxsize
            return
        self._build = Build(self._compiler, self._source, self._name, self._folder, lock)

    def _finish_build(self) -> None:
        assert self._build is not None
        path, self._build = self._build.publish(), None
        self._take(path)
        self._next = sys.maxsize

    def _stored(self) -> Path | None:
        return find(self._name, self._folder)

    def _take(self, path: Path | None) -> bool:
        """Put the library's functions in place of the interpreted ones."""
        if path is None:
            return False
        try:
            loaded = [ca.external(f.function.name(), str(path)) for f in self._functions]
        except RuntimeError:  # not a library that this system loads
            return False
        for function, compiled in zip(self._functions, loaded, strict=True):
            function.bind(compiled)
        self.mode = COMPILED
        return True
