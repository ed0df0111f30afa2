"""Positive definite stage and terminal Hessians, kept so in three interchangeable ways.

A learning rule proposes a step (`learning.fit.Fit`); an enforcement turns it into one after which
∇²ℓ_θ = 2 B_l and ∇²V^f_θ = 2 B_Vf satisfy B ⪰ εI (paper.tex, eq. q_pd_constr and pg_pd_constr).
B counts in the units of its block, in which it has none: B_ij ρ_i ρ_j / κ.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from controllers import sdp
from controllers.theta import ThetaBlocks
from learning.errors import DefinitenessError
from learning.fit import Fit

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
HESSIANS = ("B_l", "B_Vf")


@dataclass(frozen=True)
class Certificate:
    """What vouches for a step: `eigenvalues`, the least of each Hessian block after it, by block.

    `corrected` says that the free step would have violated the constraint, `refused` that no
    admissible step was found and θ stays.
    """

    eigenvalues: dict[str, float]
    corrected: bool = False
    refused: bool = False

    @property
    def smallest(self) -> float:
        """Least eigenvalue of all blocks."""
        return min(self.eigenvalues.values())


Enforcement = Callable[[Vector, Fit], tuple[Vector, Certificate]]
"""Maps θ (n,) and a fit to the new θ and its certificate."""


def certificate(
    blocks: ThetaBlocks, theta: Vector, *, corrected: bool = False, refused: bool = False
) -> Certificate:
    """Least eigenvalue of B_l and B_Vf at θ."""
    return Certificate(
        {name: float(np.linalg.eigvalsh(matrix_of(blocks, theta, name))[0]) for name in HESSIANS},
        corrected,
        refused,
    )


def matrix_of(blocks: ThetaBlocks, theta: Vector, name: str) -> Matrix:
    """Symmetric block `name` of θ, in its own unit."""
    block = blocks.block(name)
    return block.unpack(theta[blocks.slices[name]] / block.packed_unit)


class LinearMatrixInequality:
    """The fit's own minimiser under B ⪰ εI, by Clarabel where the free minimiser violates it.

    min dᵀMd − 2bᵀd  s.t.  B_l(θ+Sd) ⪰ εI, B_Vf(θ+Sd) ⪰ εI with scaled steps d (S = diag scale):
    a quadratic programme over positive semidefinite cones (paper.tex, eq. q_solution, pg_solution).
    """

    def __init__(self, blocks: ThetaBlocks, smallest: float) -> None:
        self._blocks, self._smallest = blocks, smallest
        self._rows = {name: sdp.svec_order(blocks.block(name).dimension) for name in HESSIANS}

    def __call__(self, theta: Vector, fit: Fit) -> tuple[Vector, Certificate]:
        """Step of the constrained fit; a failure of the solver refuses the step."""
        blocks = self._blocks
        free = theta + blocks.scale * fit.minimiser
        found = certificate(blocks, free)
        if found.smallest >= self._smallest:
            return free, found
        step = self.solve(theta, fit)
        if step is None:
            return theta, certificate(blocks, theta, corrected=True, refused=True)
        # An interior-point solution may miss the cone by its tolerance; ε is meant to hold.
        theta = clip_eigenvalues(blocks, theta + blocks.scale * step, self._smallest)
        return theta, certificate(blocks, theta, corrected=True)

    def solve(self, theta: Vector, fit: Fit) -> Vector | None:
        """Scaled step of the constrained fit by the conic solver, (n,), or None where it fails."""
        blocks = self._blocks
        size = blocks.size
        matrices, offsets, cones = [], [], []
        for name in HESSIANS:
            block, where = blocks.block(name), blocks.slices[name]
            order, weight = self._rows[name]
            shifted = matrix_of(blocks, theta, name) - self._smallest * np.eye(block.dimension)
            scale = blocks.scale[where] / block.packed_unit
            rows = np.zeros((block.size, size))
            rows[np.arange(block.size), where.start + order] = -weight * scale[order]
            matrices.append(rows)
            offsets.append(weight * block.pack(shifted)[order])
            cones.append(sdp.semidefinite(block.dimension))
        # Dividing by the metric's size keeps the solver's absolute tolerances meaningful.
        metric = fit.metric()
        unit = max(float(np.abs(metric).max()), np.finfo(float).tiny)
        return sdp.solve(
            2 * metric / unit,
            -2 * fit.gradient / unit,
            np.vstack(matrices),
            np.concatenate(offsets),
            cones,
        ).x


class EigenvalueProjection:
    """The free step, then each Hessian's eigenvalues raised to ε: nearest in Frobenius norm."""

    def __init__(self, blocks: ThetaBlocks, smallest: float) -> None:
        self._blocks, self._smallest = blocks, smallest

    def __call__(self, theta: Vector, fit: Fit) -> tuple[Vector, Certificate]:
        """Clip the eigenvalues after the free step."""
        free = theta + self._blocks.scale * fit.minimiser
        found = certificate(self._blocks, free)
        if found.smallest >= self._smallest:
            return free, found
        theta = clip_eigenvalues(self._blocks, free, self._smallest)
        return theta, certificate(self._blocks, theta, corrected=True)


class CholeskyParametrisation:
    """The step taken in the factor L of B = LLᵀ + εI, so that B ≻ εI by construction.

    dL is the change that reproduces the free step D of B to first order, dL Lᵀ + L dLᵀ = D:
    dL = L Φ(X), X = L⁻¹ D L⁻ᵀ, where Φ takes the lower triangle and halves the diagonal. To first
    order means little where ‖X‖₂ > 1, where the free step would double B or lose it: the block's
    step is shortened to ‖X‖₂ = 1 then.
    """

    FLOOR = 1e-9

    def __init__(self, blocks: ThetaBlocks, smallest: float) -> None:
        self._blocks, self._smallest = blocks, smallest

    def __call__(self, theta: Vector, fit: Fit) -> tuple[Vector, Certificate]:
        """Move the factors; raises DefinitenessError where B(θ) ⪰ εI does not hold already."""
        blocks = self._blocks
        step = blocks.scale * fit.minimiser
        result = theta + step
        corrected = certificate(blocks, result).smallest < self._smallest
        for name in HESSIANS:
            block, where = blocks.block(name), blocks.slices[name]
            shift = (self._smallest - self.FLOOR) * np.eye(block.dimension)
            try:
                factor = np.linalg.cholesky(matrix_of(blocks, theta, name) - shift)
            except np.linalg.LinAlgError as error:
                raise DefinitenessError(
                    f"θ block {name} does not have all eigenvalues above {self._smallest}; "
                    "choose a smaller smallest_eigenvalue or start from another θ"
                ) from error
            unit = block.packed_unit
            inner = solve_triangular(factor, block.unpack(step[where] / unit), lower=True)
            inner = solve_triangular(factor, inner.T, lower=True)
            inner /= max(1.0, float(np.linalg.norm(inner, 2)))
            lower = np.tril(inner)
            np.fill_diagonal(lower, np.diag(inner) / 2)
            moved = factor + factor @ lower
            matrix = moved @ moved.T + self._smallest * np.eye(block.dimension)
            result[where] = unit * block.pack((matrix + matrix.T) / 2)
        return result, certificate(blocks, result, corrected=corrected)


def clip_eigenvalues(blocks: ThetaBlocks, theta: Vector, smallest: float) -> Vector:
    """Copy of θ whose Hessian blocks have no eigenvalue below `smallest`."""
    theta = theta.copy()
    for name in HESSIANS:
        matrix = matrix_of(blocks, theta, name)
        values, vectors = np.linalg.eigh(matrix)
        if values[0] < smallest:
            # Rounding of the product must not take the last digits back.
            values = np.maximum(values, smallest * (1 + 1e-9))
            matrix = (vectors * values) @ vectors.T
            block = blocks.block(name)
            theta[blocks.slices[name]] = block.packed_unit * block.pack((matrix + matrix.T) / 2)
    return theta


ENFORCEMENTS: dict[str, type] = {
    "lmi": LinearMatrixInequality,
    "projection": EigenvalueProjection,
    "cholesky": CholeskyParametrisation,
}


def enforcement(kind: str, blocks: ThetaBlocks, smallest: float) -> Enforcement:
    """Enforcement by name; raises DefinitenessError on a name that there is not."""
    if kind not in ENFORCEMENTS:
        raise DefinitenessError(
            f"there is no enforcement of definiteness '{kind}'; there are {', '.join(ENFORCEMENTS)}"
        )
    made: Enforcement = ENFORCEMENTS[kind](blocks, smallest)
    return made
