"""The second-order term of the QP: Gauss–Newton, or exact with a stated convexification."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from controllers.buffered import BufferedFunction, stacked
from controllers.dynamics import stage_curvature
from controllers.errors import ControllerError
from controllers.parameters import Parameters
from controllers.problem import Problem
from controllers.theta import ThetaBlocks

Vector = NDArray[np.float64]
RULES = ("gauss-newton", "exact", "exact-unlifted")


@dataclass(frozen=True)
class Spectrum:
    """Eigenvalues (N, s) and eigenvectors (N, s, s) of the blocks before they were lifted."""

    values: Vector
    vectors: Vector
    floor: Vector

    def undecided(self, tolerance: float = 1e-6) -> bool:
        """Whether an eigenvalue is so close to the floor that the lift has a kink there."""
        distance = np.abs(self.values - self.floor)
        return bool((distance < tolerance * np.maximum(1.0, np.abs(self.values))).any())

    @property
    def kept(self) -> NDArray[np.bool_]:
        """Which eigenvalues were not lifted, (N, s)."""
        return self.values > self.floor

    def contract(self, seed: Vector) -> Vector:
        """Adjoint of the derivative of L = P(·): M with ⟨seed, dL⟩ = ⟨M, dX⟩, shapes (N, s, s).

        The derivative of a spectral function is a Schur product with its divided differences in
        the eigenbasis (Daleckii and Krein).
        """
        lifted = np.maximum(self.values, self.floor)
        gap = self.values[:, :, None] - self.values[:, None, :]
        rise = lifted[:, :, None] - lifted[:, None, :]
        kept = self.kept.astype(float)
        same = np.abs(gap) < 1e-12 * np.maximum(1.0, np.abs(self.values).max())
        divided = np.where(same, kept[:, :, None] * kept[:, None, :], rise / np.where(same, 1, gap))
        transposed = self.vectors.transpose(0, 2, 1)
        return self.vectors @ (divided * (transposed @ seed @ self.vectors)) @ transposed


class Unlifted:
    """In place of `Spectrum` where the blocks are left as they are: P is the identity."""

    kept: NDArray[np.bool_] = np.ones(0, dtype=np.bool_)

    def undecided(self) -> bool:
        """No: nothing is lifted."""
        return False

    def contract(self, seed: Vector) -> Vector:
        """The identity's adjoint."""
        return seed


Lift = Spectrum | Unlifted
"""What P did to the blocks of an exact Hessian."""


class HessianRule(Protocol):
    """Fills the QP's stage costs ½wᵀL_k w + q_kᵀw in the memory of the preparation."""

    spectrum: Lift | None
    functions: Sequence[BufferedFunction]
    """The CasADi functions that it calls."""

    def set_parameters(self, parameters: Parameters) -> None:
        """Take over a new θ."""

    def fill(self, x: Vector, u: Vector, costates: Vector) -> float:
        """Write L and q for the linearisation points (N, n), (N, m); return the constant."""


class GaussNewton:
    """L_k = 2γᵏB_l, the Hessian of the cost: the QP then holds the paper's cost as it is."""

    spectrum: Lift | None = None
    functions: Sequence[BufferedFunction] = ()

    def __init__(self, problem: Problem, prepared: BufferedFunction) -> None:
        n, m, horizon = problem.n_states, problem.n_actions, problem.horizon
        self.discounts = problem.discount ** np.arange(horizon)
        self._end = problem.discount**horizon
        self.L = prepared.inputs["L"].reshape(horizon, n + m, n + m)
        self.q = prepared.inputs["q"].reshape(horizon, n + m)
        self._L_N, self._q_N = prepared.inputs["L_N"], prepared.inputs["q_N"]

    def set_parameters(self, parameters: Parameters) -> None:
        """Write the costs of θ, which no linearisation point changes."""
        self.L[:] = 2 * self.discounts[:, None, None] * parameters["B_l"]
        self.q[:] = self.discounts[:, None] * parameters["b_l"]
        self._L_N[:] = 2 * self._end * parameters["B_Vf"].reshape(-1)
        self._q_N[:] = self._end * parameters["b_Vf"]

    def fill(self, x: Vector, u: Vector, costates: Vector) -> float:
        """Leave all as it is."""
        return 0.0


class Exact:
    """L_k = P(2γᵏB_l + D_k), D_k the curvature of χ̄_{k+1}ᵀf at the linearisation point.

    P lifts the eigenvalues of each stage's block to at least γᵏ·`FLOOR`, so that the QP keeps its
    stage structure and is strictly convex. The floor does not depend on θ, so that P can be
    differentiated. The terminal cost has no curvature of the model and stays as it is. Where
    `lifts` is false P is the identity, and the QP may be indefinite.
    """

    FLOOR = 1e-3
    spectrum: Lift | None = None

    def __init__(
        self,
        problem: Problem,
        blocks: ThetaBlocks,
        prepared: BufferedFunction,
        *,
        lifts: bool = True,
    ) -> None:
        self.lifts = lifts
        self._cost = GaussNewton(problem, prepared)
        n, m, horizon = problem.n_states, problem.n_actions, problem.horizon
        self._reference = np.concatenate([problem.reference_state, problem.reference_action])
        given = {
            "x": ca.MX.sym("x", n, horizon),
            "u": ca.MX.sym("u", m, horizon),
            "guess": ca.MX.sym("guess", n, horizon),
            "theta": ca.MX.sym("theta", blocks.size),
        }
        *point, theta = given.values()
        D = stage_curvature(problem, blocks).map(horizon)(*point, ca.repmat(theta, 1, horizon))
        self._curvature = stacked("curvature", given, {"D": D})
        self.functions: Sequence[BufferedFunction] = (self._curvature,)

    def set_parameters(self, parameters: Parameters) -> None:
        """Take over the costs of θ."""
        self._cost.set_parameters(parameters)
        self._B, self._b = parameters["B_l"], parameters["b_l"]
        self._curvature.inputs["theta"][:] = parameters.theta

    def fill(self, x: Vector, u: Vector, costates: Vector) -> float:
        """Write the convexified blocks and the gradients that go with them."""
        call = self._curvature
        for name, value in (("x", x), ("u", u), ("guess", costates)):
            call.inputs[name][:] = value.reshape(-1)
        call()
        L, q, discounts = self._cost.L, self._cost.q, self._cost.discounts
        raw = 2 * discounts[:, None, None] * self._B + call.part("D").reshape(L.shape)
        if not np.isfinite(raw).all():
            # The controller refuses the QP; an eigenvalue solver would raise its own error.
            L[:] = np.nan
            return np.nan
        if self.lifts:
            values, vectors = np.linalg.eigh(raw)
            floor = np.asarray(self.FLOOR * discounts[:, None], dtype=np.float64)
            self.spectrum = Spectrum(values, vectors, floor)
            lifted = np.maximum(values, floor)
            L[:] = (vectors * lifted[:, None, :]) @ vectors.transpose(0, 2, 1)
        else:
            self.spectrum = Unlifted()
            L[:] = raw
        at = np.concatenate([x, u], axis=1) - self._reference
        curved = np.einsum("kij,kj->ki", L, at)
        flat = 2 * discounts[:, None] * (at @ self._B)
        q[:] = flat + discounts[:, None] * self._b - curved
        return float((at * (curved - flat)).sum() / 2)


def make_hessian(
    name: str, problem: Problem, blocks: ThetaBlocks, prepared: BufferedFunction
) -> HessianRule:
    """Rule by name; raises ControllerError on an unknown one.

    `exact-unlifted` leaves an indefinite Hessian as it is: right for the sensitivities of a
    converged programme, not for a QP that is still to be solved.
    """
    if name == "gauss-newton":
        return GaussNewton(problem, prepared)
    if name == "exact":
        return Exact(problem, blocks, prepared)
    if name == "exact-unlifted":
        return Exact(problem, blocks, prepared, lifts=False)
    raise ControllerError(f"there is no Hessian '{name}'; choose {' or '.join(RULES)}")
