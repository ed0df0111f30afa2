"""Conic programmes over positive semidefinite matrices, solved by Clarabel."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import clarabel
import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from cosim.protocols import Array

nonnegative = clarabel.NonnegativeConeT
second_order = clarabel.SecondOrderConeT
semidefinite = clarabel.PSDTriangleConeT


def solve(
    P: Array, q: Array, A: Array, b: Array, cones: Sequence[Any], *, iterations: int = 200
) -> tuple[Array | None, str]:
    """Solve min ½xᵀPx + qᵀx s.t. b − Ax in the product of the cones.

    P (d, d), of which the upper triangle is read, q (d,), A (c, d), b (c,). A cone of semidefinite
    matrices takes the rows that `svec` gives. Returns the minimiser, None where there is none, and
    the solver's word for how it ended.
    """
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.max_iter = iterations
    solution = clarabel.DefaultSolver(
        sparse.csc_matrix(np.triu(P)), q, sparse.csc_matrix(A), b, list(cones), settings
    ).solve()
    status = str(solution.status)
    return np.array(solution.x) if status in {"Solved", "AlmostSolved"} else None, status


def svec(matrix: Array) -> Array:
    """Vector of a symmetric matrix with its inner product: `svec_order` of its upper triangle."""
    order, weight = svec_order(len(matrix))
    packed: Array = matrix[np.triu_indices(len(matrix))]
    return weight * packed[order]


def svec_order(dimension: int) -> tuple[NDArray[np.intp], Array]:
    """Order and weights that make `svec` of an upper triangle packed row by row.

    Clarabel stacks the upper triangle column by column, off-diagonal entries times √2.
    """
    rows, columns = np.triu_indices(dimension)
    order = np.lexsort((rows, columns))
    return order, np.where(rows == columns, 1.0, np.sqrt(2.0))[order]
