"""A policy as a table over a grid of states, looked up in Python and, in closed loop, in C."""

from __future__ import annotations

import ctypes
import itertools
from bisect import bisect_right
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from controllers.export.core import ENGINE_SOURCES
from controllers.functions import library
from cosim.core.protocols import ActionLimits, Array
from cosim.core.scenario import Penalty


class PolicyTable:
    """An action and a value for each state of a grid, interpolated multilinearly.

    Args:
        axes: coordinates of each state, ascending, (≥ 2,) each.
        actions: of the grid's states, the last one running fastest, (K, m).
        values: of the grid's states, (K,).
    """

    def __init__(
        self,
        axes: Sequence[Array],
        actions: Array,
        values: Array,
    ) -> None:
        self.axes = axes
        self.rows = np.column_stack([actions, values])
        # Python's numbers: for a few states they are faster than arrays.
        self._axes = [axis.tolist() for axis in axes]
        self._rows = self.rows.tolist()
        # A cell's corners, and how far each one's row is behind that of the first.
        self._corners = []
        shape = [len(axis) for axis in axes]
        n_states = len(shape)
        for corner in itertools.product((0, 1), repeat=n_states):
            offset = np.ravel_multi_index(corner, shape)
            self._corners.append((corner, int(offset)))

    def look_up(self, state: list[float]) -> tuple[list[float], bool]:
        """Interpolate at a state; in plain Python that takes a tenth of NumPy's time.

        Args:
            state: finite numbers, (n,); one outside the grid is moved to the nearest inside.

        Returns:
            Action and value (m+1,), and whether the state was outside.
        """
        base = 0  # row of the cell's first corner
        clamped = False
        fractions = []
        for x, axis in zip(state, self._axes, strict=True):
            # The last cell includes its upper end.
            last_cell = len(axis) - 2
            cell = bisect_right(axis, x) - 1
            cell = min(max(cell, 0), last_cell)
            begin = axis[cell]
            end = axis[cell + 1]
            fraction = (x - begin) / (end - begin)
            if not 0.0 <= fraction <= 1.0:
                fraction = min(max(fraction, 0.0), 1.0)
                clamped = True
            base = base * len(axis) + cell
            fractions.append(fraction)
        n_entries = len(self._rows[0])
        row = [0.0] * n_entries
        for corner, offset in self._corners:
            weight = 1.0
            for fraction, high in zip(fractions, corner, strict=True):
                # Multilinear: the weight of a corner is the product over the axes.
                weight *= fraction if high else 1.0 - fraction
            if not weight:
                continue
            corner_row = self._rows[base + offset]
            for i, entry in enumerate(corner_row):
                row[i] += weight * entry
        return row, clamped


class _Native(ctypes.Structure):
    """A table for compiled code; the C struct is `PolicyTable` of `optimal.c`."""

    _fields_: ClassVar[list[tuple[str, Any]]] = [
        ("n_states", ctypes.c_size_t),
        ("n_actions", ctypes.c_size_t),
        ("sizes", ctypes.c_void_p),
        ("axes", ctypes.c_void_p),
        ("rows", ctypes.c_void_p),
        ("action_lower", ctypes.c_void_p),
        ("action_upper", ctypes.c_void_p),
        ("state_lower", ctypes.c_void_p),
        ("state_upper", ctypes.c_void_p),
        ("linear", ctypes.c_void_p),
        ("quadratic", ctypes.c_void_p),
        ("action", ctypes.c_void_p),
        ("fractions", ctypes.c_void_p),
        ("row", ctypes.c_void_p),
    ]


def table_sources() -> dict[str, bytes]:
    """C files of the loop of a table and an FMU by name."""
    sources = {}
    for name in ("loop.h", "fmu.h", "optimal.c"):
        sources[name] = (ENGINE_SOURCES / name).read_bytes()
    return sources


class CompiledTable:
    """The closed loop of a table and an FMU in compiled code, with the digits of Python's.

    Args:
        library_path: of the compiled `table_sources`.
        table: the policy.
        penalty: of the states' bounds, which the solution's value has beside the table's.
        limits: bounds of the actuators.
    """

    def __init__(
        self,
        library_path: str,
        table: PolicyTable,
        penalty: Penalty,
        limits: ActionLimits,
    ) -> None:
        self._run = ctypes.CDLL(library_path).optimal_run
        # ctypes takes every result for an int, which is too short for a sample's number.
        self._run.restype = ctypes.c_longlong
        n_states = len(table.axes)
        n_actions = table.rows.shape[1] - 1
        points_of_axes = [len(axis) for axis in table.axes]
        sizes = np.array(points_of_axes, dtype=np.uintp)
        arrays: list[NDArray[Any]] = [sizes]
        # In the order of the struct's pointers.
        numbers = [
            np.concatenate(table.axes),
            table.rows,
            limits.action_lower,
            limits.action_upper,
            penalty.lower,
            penalty.upper,
            penalty.linear,
            penalty.quadratic,
            np.zeros(n_actions),
            np.zeros(n_states),
            np.zeros(n_actions + 1),
        ]
        for array in numbers:
            arrays.append(np.ascontiguousarray(array, dtype=np.float64))
        # Kept: compiled code has only their addresses.
        self._arrays = arrays
        addresses = [array.ctypes.data for array in arrays]
        self._native = _Native(n_states, n_actions, *addresses)

    @classmethod
    def compile(
        cls,
        table: PolicyTable,
        penalty: Penalty,
        limits: ActionLimits,
    ) -> CompiledTable | None:
        """The compiled loop, or None without a compiler.

        Args:
            table: the policy.
            penalty: of the states' bounds.
            limits: bounds of the actuators.
        """
        path = library(table_sources())
        if path is None:
            return None
        return cls(str(path), table, penalty, limits)

    def __call__(
        self,
        plant: Any,
        first: int,
        rows: Array,
    ) -> tuple[int, int, int]:
        """Run samples of the loop (`cosim.core.protocols.CompiledLoop`)."""
        fault = (ctypes.c_int * 2)()
        reached = self._run(
            ctypes.byref(self._native),
            ctypes.byref(plant),
            ctypes.c_longlong(first),
            ctypes.c_longlong(first + len(rows)),
            ctypes.c_void_p(rows.ctypes.data),
            fault,
        )
        return reached, fault[0], fault[1]
