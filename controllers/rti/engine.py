"""The compiled controller: the phases of a sample and whole closed loops, in a library of its own.

The library is that of `controllers.export` with the sensitivities; it works in the memory of the
CasADi functions that it replaces, and its solver is the exported controller's.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from typing import Any

import numpy as np

from controllers.export.core import SOURCES, STATUSES, controller_sources, stack_needed
from controllers.functions import library
from controllers.rti.solution import Functions
from controllers.theta import ThetaBlocks
from cosim.protocols import Vector

MOST = 700_000
"""Bytes of a sample's largest arrays beyond which CasADi's interpreter and DAQP do the work."""
NOT_FINITE = STATUSES.index("not finite")


class Engine:
    """Prepares and solves in the memory of a controller's `functions`; `load` makes one.

    `prepare` and `feedback` return 0, or a status of the QP solver's. `action` (m,) is where the
    action to enforce is written.
    """

    def __init__(self, path: str, functions: Functions) -> None:
        self._library = library_ = ctypes.CDLL(path)
        before, after = functions.preparation.memory, functions.readout.memory
        library_.engine_sizes.restype = library_.engine_loop_size.restype = ctypes.c_size_t
        library_.engine_run.restype = ctypes.c_longlong
        sizes = [library_.engine_sizes(kind) for kind in range(3)]
        assert sizes[:2] == [before.nbytes, after.nbytes], "Python and C lay memory out unlike"
        self._work, self._other_work = np.zeros((2, sizes[2] // 8 + 1))
        self._loop = np.zeros(library_.engine_loop_size() // 8 + 1)
        self.action: Vector = np.zeros(functions.problem.n_actions)
        kept = (before, self._work, self._other_work, after, self.action, self._loop)
        self._before, self._workspace, self._other, self._after, action, self._begun = (
            ctypes.c_void_p(array.ctypes.data) for array in kept
        )
        self._value = (self._before, self._workspace, self._after, None)
        self._action_value = (self._before, self._workspace, self._after, action)
        self._prepare: Callable[..., int] = library_.engine_prepare
        self._feedback: Callable[..., int] = library_.engine_feedback
        self._policy: Callable[..., int] = library_.engine_policy
        n, m, size = functions.problem.n_states, self.action.size, functions.gradient.stack.size
        self._jacobians: Vector = np.zeros((size + n) * m)
        self._jacobians_at = ctypes.c_void_p(self._jacobians.ctypes.data)
        self._split, self._m = size * m, m

    @classmethod
    def load(cls, functions: Functions, blocks: ThetaBlocks) -> Engine | None:
        """The engine of a Gauss–Newton controller; None where it cannot be had.

        That is without a compiler, where COSIM_COMPILE says `never`, and for long horizons.
        """
        named = {
            "PREPARED": functions.preparation,
            "EMBEDDED": functions.embedding,
            "READ": functions.readout,
            "GRADIENT": functions.gradient,
            "POLICY": functions.policy(),
        }
        if stack_needed(functions.problem, named) > MOST:
            return None
        sources = controller_sources(functions.problem, blocks, "gauss-newton", named)
        for name in ("sensitivities.h", "engine.c"):
            sources[name] = (SOURCES / name).read_bytes()
        path = library(sources, ["engine.c"])
        return None if path is None else cls(str(path), functions)

    def prepare(self) -> int:
        """Preparation phase at the point and θ that the memory holds."""
        return self._prepare(self._before, self._workspace)

    def feedback(self, enforced: bool) -> int:
        """Feedback phase for the memory's state, with `action` enforced or not."""
        return self._feedback(*(self._action_value if enforced else self._value))

    def batch(self, states: Vector) -> tuple[Vector, Vector]:
        """π (K, m) and V (K,) of the memory's QP for states (K, n), NaN where there is none."""
        actions, values = np.empty((len(states), self.action.size)), np.empty(len(states))
        self._library.engine_batch(
            *self._value[:3],
            ctypes.c_longlong(len(states)),
            *(ctypes.c_void_p(array.ctypes.data) for array in (states, actions, values)),
        )
        return actions, values

    def policy(self, before: Vector, after: Vector) -> tuple[Vector, Vector] | None:
        """dπ/dθ (m, n_θ) and dπ/ds (m, n) of copies of the memory; None where LICQ fails."""
        # In another workspace: the next feedback needs what the preparation factorised.
        given = (ctypes.c_void_p(array.ctypes.data) for array in (before, after))
        status = self._policy(*given, self._other, self._jacobians_at)
        if status:
            return None
        parts = self._jacobians[: self._split], self._jacobians[self._split :]
        by_theta, by_state = (part.reshape(self._m, -1).copy() for part in parts)
        return by_theta, by_state

    def begin(self) -> None:
        """Make ready for a closed loop: no earlier sample is known."""
        self._library.engine_begin(self._begun, self._before, self._after, self._workspace)

    def run(self, plant: Any, first: int, table: Vector) -> tuple[int, int, int]:
        """Run the plant, an instance's `native`, from sample `first` on; a row of `table` each.

        Returns the number of the sample that it came to, what failed there (0 where nothing did)
        and FMI's status. Other threads run meanwhile.
        """
        fault = (ctypes.c_int * 2)()
        reached = self._library.engine_run(
            self._begun,
            ctypes.byref(plant),
            ctypes.c_longlong(first),
            ctypes.c_longlong(first + len(table)),
            ctypes.c_void_p(table.ctypes.data),
            fault,
        )
        return reached, fault[0], fault[1]
