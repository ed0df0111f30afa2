"""A convex cost with the local optimum of an indefinite one, by a conic programme (Clarabel)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from controllers import sdp
from controllers.errors import TuningError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Convexification:
    """H̃ = H + 𝓗(δP) + CᵀFC with I/α ⪯ H̃ ⪯ (β/α) I.

    `hessian` H̃ (n+m, n+m), `delta_P` (n, n) and `F` (n_c, n_c) are those of H̃ itself, the
    programme's divided by α.
    """

    hessian: Array
    delta_P: Array
    F: Array
    alpha: float
    beta: float

    @property
    def eigenvalues(self) -> Array:
        """Eigenvalues of H̃, ascending."""
        return np.linalg.eigvalsh(self.hessian).astype(np.float64)


def rotation(A: Array, B: Array, delta_P: Array) -> Array:
    """𝓗(δP) = [A B]ᵀ δP [A B] − [I 0]ᵀ δP [I 0]: what the storage ½xᵀδPx adds to a stage."""
    dynamics = np.hstack([A, B])
    rotated: Array = dynamics.T @ delta_P @ dynamics
    rotated[: len(A), : len(A)] -= delta_P
    return rotated


def convexify(A: Array, B: Array, H: Array, C: Array, weight: float = 1e-2) -> Convexification:
    """Least conditioned convex stage cost that leaves the local optimum where it is.

    min β + ρ‖F‖ s.t. βI ⪰ αH + 𝓗(δP) + CᵀFC ⪰ I over α ≥ 0, β, δP and F, with ρ = `weight`
    (Zanon, Gros, Diehl 2016). 𝓗(δP) telescopes along a trajectory; CᵀFC vanishes where the active
    constraints C w = 0 hold: neither changes the optimal feedback. Raises TuningError where there
    is no solution: then the steady state is not locally optimal under these constraints.
    """
    size, n, n_c = len(H), len(A), len(C)
    basis = [("α", H)]
    basis += [("δP", rotation(A, B, e)) for e in _symmetric_basis(n)]
    basis += [("F", C.T @ e @ C) for e in _symmetric_basis(n_c)]
    columns = np.stack([sdp.svec(matrix) for _, matrix in basis], axis=1)
    count, triangle = columns.shape[1], columns.shape[0]
    identity = sdp.svec(np.eye(size))[:, None]
    # Variables: α, δP, F, β, t with t ≥ ‖F‖.
    n_F = n_c * (n_c + 1) // 2
    zeros = np.zeros((triangle, 1))
    norm = np.zeros((1 + n_F, count + 2))
    norm[0, -1] = -1.0
    for k, e in enumerate(_symmetric_basis(n_c)):
        norm[1 + k, count - n_F + k] = -np.linalg.norm(e)
    nonnegative = np.zeros((1, count + 2))
    nonnegative[0, 0] = -1.0
    constraints = np.vstack(
        [
            nonnegative,
            norm,
            np.hstack([-columns, zeros, zeros]),
            np.hstack([columns, -identity, zeros]),
        ]
    )
    offset = np.concatenate([np.zeros(2 + n_F), -identity[:, 0], np.zeros(triangle)])
    cones = [sdp.nonnegative(1), sdp.second_order(1 + n_F)]
    cones += [sdp.semidefinite(size), sdp.semidefinite(size)]
    objective = np.zeros(count + 2)
    objective[-2:] = 1.0, weight
    z, status = sdp.solve(
        np.zeros((count + 2, count + 2)), objective, constraints, offset, cones, iterations=500
    )
    if z is None or not z[0] > 0:
        raise TuningError(
            f"no convex cost has the local optimum of the economic one (Clarabel: {status}) with "
            f"{n_c} active constraint{'' if n_c == 1 else 's'}: the steady state is not optimally "
            "operated under them"
        )
    alpha = float(z[0])
    delta_P = sum_of(z[1 : count - n_F], n) / alpha
    F = sum_of(z[count - n_F : count], n_c) / alpha
    hessian = H + rotation(A, B, delta_P) + C.T @ F @ C
    found = Convexification(0.5 * (hessian + hessian.T), delta_P, F, alpha, float(z[-2]))
    if not found.eigenvalues[0] > 0:
        raise TuningError(
            f"the convexified cost is not positive definite (smallest eigenvalue "
            f"{found.eigenvalues[0]:.3g}, Clarabel: {status})"
        )
    return found


def _symmetric_basis(size: int) -> list[Array]:
    """Basis of the symmetric matrices: e_ij + e_ji, upper triangle row by row."""
    basis = []
    for i, j in zip(*np.triu_indices(size), strict=True):
        matrix = np.zeros((size, size))
        matrix[i, j] = matrix[j, i] = 1.0
        basis.append(matrix)
    return basis


def sum_of(weights: Array, size: int) -> Array:
    """Symmetric matrix (size, size) with the given upper triangle, row by row."""
    matrix = np.zeros((size, size))
    for weight, element in zip(weights, _symmetric_basis(size), strict=True):
        matrix += weight * element
    return matrix
