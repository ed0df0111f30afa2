"""CasADi functions that read and write preallocated NumPy memory."""

from __future__ import annotations

from collections.abc import Mapping
from math import isfinite
from typing import TypeVar

import casadi as ca
import numpy as np
from numpy.typing import NDArray

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
