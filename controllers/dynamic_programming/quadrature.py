"""The disturbance's law and Gauss rules for expectations under it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from controllers.errors import OptimumError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class DisturbanceLaw:
    """Independent disturbances, drawn anew each sample and held over it.

    `uniform`: `nominal` ± `ranges`; `normal`: mean `nominal`, standard deviations `ranges`; `none`:
    always nominal. Both arrays have shape (n_d,). Raises OptimumError where they do not fit.
    """

    kind: Literal["uniform", "normal", "none"]
    nominal: Array
    ranges: Array

    def __post_init__(self) -> None:
        """Freeze the arrays and check them."""
        for name in ("nominal", "ranges"):
            array = np.array(getattr(self, name), dtype=np.float64).reshape(-1)
            array.flags.writeable = False
            object.__setattr__(self, name, array)
        if self.kind not in {"uniform", "normal", "none"}:
            raise OptimumError(
                f"disturbance law '{self.kind}' is not known; use uniform, normal or none"
            )
        finite = np.isfinite(self.nominal).all() and np.isfinite(self.ranges).all()
        if self.nominal.shape != self.ranges.shape or not finite or (self.ranges < 0).any():
            raise OptimumError(
                f"disturbance law: nominal {self.nominal} and ranges {self.ranges} must be finite, "
                "of one length, and no range negative"
            )

    @property
    def deterministic(self) -> bool:
        """Whether the disturbances never leave their nominal values."""
        return self.kind == "none" or not self.ranges.any()

    def draw(self, generator: np.random.Generator, count: int) -> Array:
        """Draw `count` independent disturbances, shape (count, n_d)."""
        size = (count, len(self.nominal))
        if self.kind == "uniform":
            return self.nominal + self.ranges * generator.uniform(-1.0, 1.0, size)
        if self.kind == "normal":
            return self.nominal + self.ranges * generator.standard_normal(size)
        return np.tile(self.nominal, (count, 1))

    def rule(self, counts: tuple[int, ...]) -> ProductRule:
        """Gauss rule with the given number of nodes per disturbance.

        Gauss–Legendre for the uniform law, Gauss–Hermite for the normal one; a disturbance that
        does not vary takes one node. Exact for polynomials of degree 2·count−1 in each.
        """
        if len(counts) != len(self.nominal) or any(count < 1 for count in counts):
            raise OptimumError(
                f"quadrature: {len(self.nominal)} disturbances need as many positive numbers of "
                f"nodes, not {counts}"
            )
        points, weights = [], []
        for count, nominal, spread in zip(counts, self.nominal, self.ranges, strict=True):
            if self.kind == "none" or spread == 0:
                x, w = np.zeros(1), np.ones(1)
            elif self.kind == "uniform":
                x, w = np.polynomial.legendre.leggauss(count)
            else:
                x, w = np.polynomial.hermite_e.hermegauss(count)
            points.append(nominal + spread * x)
            weights.append(w / w.sum())
        return ProductRule(tuple(points), tuple(weights))


@dataclass(frozen=True)
class ProductRule:
    """A product quadrature rule: E[g(d)] ≈ Σ_i weights_i g(nodes_i).

    `axis_nodes` and `axis_weights` hold one array per disturbance.
    """

    axis_nodes: tuple[Array, ...]
    axis_weights: tuple[Array, ...]

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of nodes per disturbance."""
        return tuple(len(nodes) for nodes in self.axis_nodes)

    @cached_property
    def nodes(self) -> Array:
        """All nodes, shape (q, n_d), the last disturbance running fastest."""
        if not self.axis_nodes:
            return np.zeros((1, 0))
        mesh = np.meshgrid(*self.axis_nodes, indexing="ij")
        return np.stack([axis.reshape(-1) for axis in mesh], axis=1)

    @cached_property
    def weights(self) -> Array:
        """Weights of `nodes`, shape (q,), with sum 1."""
        weights = np.ones(1)
        for axis in self.axis_weights:
            weights = np.multiply.outer(weights, axis).reshape(-1)
        return weights


class Refinement:
    """Values at one product rule's nodes carried to another's by polynomial interpolation.

    A smooth function known at few Gauss nodes is known everywhere to spectral accuracy; what is
    not smooth is then applied on the finer rule without evaluating the function anew.
    """

    def __init__(self, coarse: ProductRule, fine: ProductRule) -> None:
        self.weights = fine.weights
        self._matrices: list[Array] = []
        for nodes, targets in zip(coarse.axis_nodes, fine.axis_nodes, strict=True):
            self._matrices.append(lagrange_matrix(nodes, targets))
        # Products of tiny matrices cost more in calls than in arithmetic: join the last axes.
        while len(self._matrices) > 1 and self._matrices[-1].shape[1] < 4:
            last = self._matrices.pop()
            self._matrices[-1] = np.kron(self._matrices[-1], last).astype(np.float64)

    def __call__(self, values: Array) -> Array:
        """Carry values (B, q_coarse) to (B, q_fine)."""
        count, right = len(values), 1
        for matrix in reversed(self._matrices):
            fine, coarse = matrix.shape
            if right == 1:
                values = values.reshape(count, -1, coarse) @ matrix.T
            else:
                values = matrix @ values.reshape(-1, coarse, right)
            right *= fine
        return values.reshape(count, -1)


def lagrange_matrix(nodes: ArrayLike, targets: ArrayLike) -> Array:
    """Matrix (len(targets), len(nodes)) of the Lagrange polynomials of `nodes` at `targets`."""
    x, t = np.asarray(nodes, dtype=np.float64), np.asarray(targets, dtype=np.float64)
    matrix = np.ones((len(t), len(x)))
    for j in range(len(x)):
        for k in range(len(x)):
            if k != j:
                matrix[:, j] *= (t - x[k]) / (x[j] - x[k])
    return matrix
