"""A step of θ: the fit that a rule proposes, and the constraints on θ.

Every rule proposes min_d dᵀMd − 2bᵀd in scaled coordinates d = (θ̄ − θ) / scale (`Fit`); M is built
only where a constraint needs it. `ConstrainedStep` moves the controller's θ by it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import clarabel
import numpy as np
from scipy.linalg import cho_factor, cho_solve

from controllers.economic import solve_conic, svec_order
from controllers.rti import RtiNmpc
from controllers.theta import ThetaBlocks
from cosim.core.protocols import Matrix, Vector
from learning.algorithm import Update
from learning.checkpoint import State
from learning.configuration import Configuration
from learning.errors import DivergenceError

HESSIAN_BLOCKS = ("B_l", "B_Vf")


@dataclass(frozen=True)
class Fit:
    """The problem min_d dᵀMd − 2bᵀd.

    Attributes:
        gradient: b, (n,).
        minimiser: M⁻¹b, (n,).
        metric: makes M, (n, n).
        reach: of a step d (n,), its length as a multiple of the fit's cap or trust region: at most
            1, after corrections too.
    """

    gradient: Vector
    minimiser: Vector
    metric: Callable[[], Matrix]
    reach: Callable[[Vector], float] | None = None

    def shrunk(self, factor: float) -> Fit:
        """The fit whose minimiser is `factor` times this one's, with the same metric."""
        gradient = factor * self.gradient
        minimiser = factor * self.minimiser
        return replace(self, gradient=gradient, minimiser=minimiser)

    def within(self, radius: float, size: Callable[[Vector], float]) -> Fit:
        """The fit with this one's minimiser, shortened into a trust region, and the same metric.

        Args:
            radius: largest size of a step.
            size: of a step d (n,); it must be a norm.
        """

        def reach(step: Vector) -> float:
            return size(step) / radius

        # A step within the region stays; a longer one is scaled, not cut entry by entry.
        excess = max(1.0, reach(self.minimiser))
        return replace(self.shrunk(1.0 / excess), reach=reach)


def td_fit(
    td_error: float,
    gradient: Vector,
    step_size: float,
) -> Fit:
    """Fit of one transition, min (δ − ∇Qᵀd)² + ‖d‖²/α, in closed form d = αδ∇Q/(1+α‖∇Q‖²).

    paper.tex, eq. q_learning_fitting with Q_lin = Q + ∇Qᵀ(θ̄−θ).

    Args:
        td_error: δ.
        gradient: ∇Q, (n,), in scaled coordinates.
        step_size: α.
    """
    weight = step_size * td_error / (1.0 + step_size * float(gradient @ gradient))

    def metric() -> Matrix:
        of_transition = np.outer(gradient, gradient)
        of_step = np.eye(gradient.size) / step_size
        return of_transition + of_step

    return Fit(
        gradient=td_error * gradient,
        minimiser=weight * gradient,
        metric=metric,
    )


def td_step(
    td_error: float,
    gradient: Vector,
    step_size: float,
) -> Fit:
    """The recursion θ ← θ + αδ∇Q as the fit min ‖d‖²/α − 2δ∇Qᵀd (paper.tex, eq. Qlearning).

    Args:
        td_error: δ.
        gradient: ∇Q, (n,), in scaled coordinates.
        step_size: α.
    """

    def metric() -> Matrix:
        return np.eye(gradient.size) / step_size

    return Fit(
        gradient=td_error * gradient,
        minimiser=step_size * td_error * gradient,
        metric=metric,
    )


def policy_gradient_fit(
    gradient: Vector,
    step_size: float,
    metric: Matrix,
) -> Fit:
    """Fit min ∇Jᵀd + dᵀFd/α (paper.tex, eq. pg_solution), d = −α F⁻¹∇J / 2.

    Args:
        gradient: ∇J, (n,), in scaled coordinates.
        step_size: α.
        metric: F, (n, n), positive definite, the Fisher matrix E[∇π ∇πᵀ].
    """
    half = -gradient / 2
    factor = cho_factor(metric)
    minimiser = step_size * cho_solve(factor, half)
    return Fit(half, minimiser, lambda: metric / step_size)


def smallest_eigenvalue(blocks: ThetaBlocks, theta: Vector) -> float:
    """Least eigenvalue of B_l and B_Vf.

    Args:
        blocks: layout of θ.
        theta: θ, (n_θ,).

    Returns:
        The eigenvalue, in the blocks' own units.
    """
    # One number for both blocks: the smaller of their least eigenvalues.
    least = np.inf
    for name in HESSIAN_BLOCKS:
        matrix = matrix_of(blocks, theta, name)
        eigenvalues = np.linalg.eigvalsh(matrix)
        least = min(least, float(eigenvalues[0]))
    return least


def matrix_of(
    blocks: ThetaBlocks,
    theta: Vector,
    name: str,
) -> Matrix:
    """Symmetric block of θ as a matrix.

    Args:
        blocks: layout of θ.
        theta: θ, (n_θ,).
        name: the block's.

    Returns:
        The matrix in its own unit.
    """
    where = blocks.slices[name]
    packed = theta[where] / blocks.scale[where]
    return blocks.block(name).unpack(packed)


def definite(
    blocks: ThetaBlocks,
    theta: Vector,
    fit: Fit,
    smallest: float,
    scale: Vector | None = None,
) -> Vector | None:
    """θ at the fit's own minimiser under B ⪰ εI, by Clarabel.

    min dᵀMd − 2bᵀd  s.t.  B_l(θ+Sd) ⪰ εI, B_Vf(θ+Sd) ⪰ εI with scaled steps d (S = diag scale):
    a quadratic programme over positive semidefinite cones (paper.tex, eq. q_solution, pg_solution).

    Args:
        blocks: layout of θ.
        theta: θ, (n_θ,).
        fit: in the coordinates of `scale`.
        smallest: ε, in the matrices' own units.
        scale: diagonal of S, (n_θ,); the layout's if not given.

    Returns:
        The new θ, (n_θ,); None where the solver fails.
    """
    scale = blocks.scale if scale is None else scale
    # Clarabel takes s = b − Ad in a product of cones, one for each Hessian.
    matrices = []
    offsets = []
    cones = []
    for name in HESSIAN_BLOCKS:
        block = blocks.block(name)
        where = blocks.slices[name]
        size = block.shape[0]
        order, weight = svec_order(size)
        shifted = matrix_of(blocks, theta, name) - smallest * np.eye(size)
        # The step is in the fit's coordinates, the matrix in its own unit.
        ratio = scale[where] / blocks.scale[where]
        numbers = np.arange(block.size)
        places = where.start + order
        rows = np.zeros((block.size, blocks.size))
        rows[numbers, places] = -weight * ratio[order]
        matrices.append(rows)
        packed = block.pack(shifted)
        offsets.append(weight * packed[order])
        cones.append(clarabel.PSDTriangleConeT(size))
    # Dividing by the metric's size keeps the solver's absolute tolerances meaningful.
    metric = fit.metric()
    largest = float(np.abs(metric).max())
    unit = max(largest, np.finfo(float).tiny)
    step, _ = solve_conic(
        2 * metric / unit,
        -2 * fit.gradient / unit,
        np.vstack(matrices),
        np.concatenate(offsets),
        cones,
    )
    if step is None:
        return None
    # An interior-point solution may miss the cone by its tolerance; ε is meant to hold.
    return clip_eigenvalues(blocks, theta + scale * step, smallest)


def clip_eigenvalues(
    blocks: ThetaBlocks,
    theta: Vector,
    smallest: float,
) -> Vector:
    """Copy of θ whose Hessian blocks have no eigenvalue below a given one.

    Args:
        blocks: layout of θ.
        theta: θ, (n_θ,).
        smallest: the least eigenvalue, in the blocks' own units.

    Returns:
        The new θ, (n_θ,).
    """
    theta = theta.copy()
    for name in HESSIAN_BLOCKS:
        matrix = matrix_of(blocks, theta, name)
        values, vectors = np.linalg.eigh(matrix)
        if values[0] < smallest:
            # Rounding of the product must not take the last digits back.
            values = np.maximum(values, smallest * (1 + 1e-9))
            matrix = (vectors * values) @ vectors.T
            symmetric = (matrix + matrix.T) / 2
            packed = blocks.block(name).pack(symmetric)
            where = blocks.slices[name]
            theta[where] = blocks.scale[where] * packed
    return theta


class ConstrainedStep:
    """Moves a controller's θ by a fit under every constraint on θ.

    The Hessians' least eigenvalue is the configuration's, or half of the start's where that is
    less.

    Args:
        controller: carries θ.
        configuration: has `smallest_eigenvalue`.
        scale: coordinates of the fits, (n_θ,), the layout's if not given.
    """

    def __init__(
        self,
        controller: RtiNmpc,
        configuration: Configuration,
        scale: Vector | None = None,
    ) -> None:
        self._controller = controller
        self.blocks = controller.parameters.blocks
        self.scale: Vector = self.blocks.scale if scale is None else scale
        # A start that is barely definite must stay admissible.
        at_start = smallest_eigenvalue(self.blocks, controller.parameters.theta)
        self._smallest: float = configuration.smallest_eigenvalue
        if at_start > 0:
            self._smallest = min(self._smallest, at_start / 2)
        # Only the slack weights have least values.
        self._minima = {}
        for block in self.blocks:
            if block.least:
                self._minima[block.name] = np.array(block.least)

    def apply(self, fit: Fit, td_error: float) -> Update:
        """Set the controller's θ to the fit's.

        A step that definiteness corrects beyond the fit's cap or trust region is scaled back: the θ
        with definite Hessians are a convex set. θ stays where Clarabel fails or bounds would cross.

        Args:
            fit: in the coordinates `scale`.
            td_error: for the log.

        Returns:
            What the log says of the step.

        Raises:
            DivergenceError: the step is not finite.
        """
        slices = self.blocks.slices
        theta = self._controller.theta
        if not np.isfinite(fit.minimiser).all():
            raise DivergenceError("the step of θ is not finite")
        # The unconstrained minimiser first: it is admissible in most steps.
        free = theta + self.scale * fit.minimiser
        least = smallest_eigenvalue(self.blocks, free)
        corrected = least < self._smallest
        admissible: Vector | None = free
        if corrected:
            admissible = definite(self.blocks, theta, fit, self._smallest, self.scale)
        new = theta.copy() if admissible is None else admissible.copy()
        # Least slack weights: exact (linear) and convex (quadratic).
        for name, minimum in self._minima.items():
            weights = new[slices[name]]
            np.maximum(weights, minimum, out=weights)
        # What was corrected may be longer than the fit's step.
        change = new - theta
        reach = 0.0
        if fit.reach is not None:
            reach = fit.reach(change / self.scale)
        if reach > 1.0:
            new = theta + change / reach
        # Crossed bounds leave no feasible state, and no solver can mend them.
        lower = new[slices["x_l"]]
        upper = new[slices["x_u"]]
        crossed = not (lower < upper).all()
        refused = admissible is None or crossed
        if refused:
            new = theta
            corrected = True
        # The eigenvalue was that of the free step.
        if not np.array_equal(new, free):
            least = smallest_eigenvalue(self.blocks, new)
        self._controller.theta = new
        scaled_step = (new - theta) / self.scale
        return Update(
            td_error=td_error,
            step=float(np.linalg.norm(scaled_step)),
            smallest_eigenvalue=least,
            corrected=corrected,
            refused=bool(refused),
        )

    def move(self, theta: Vector, td_error: float = float("nan")) -> Update:
        """Set the controller's θ to the admissible one nearest to another, in scaled coordinates.

        Args:
            theta: the other one, (n_θ,).
            td_error: for the log.

        Returns:
            What the log says of the step.

        Raises:
            ValueError: θ has another shape.
        """
        expected = self._controller.theta.shape
        if np.shape(theta) != expected:
            raise ValueError(f"θ has shape {np.shape(theta)}, needs {expected}")
        change = theta - self._controller.theta
        step = change / self.scale
        # In the metric I the minimiser is the step itself.
        fit = Fit(step, step, lambda: np.eye(step.size))
        return self.apply(fit, td_error)

    def state_dict(self) -> State:
        """The coordinates and the least eigenvalue."""
        return {"scale": self.scale, "smallest": self._smallest}

    def load_state_dict(self, state: State) -> None:
        """Restore what `state_dict` returned."""
        self.scale = state["scale"]
        self._smallest = state["smallest"]


def update_without_fit(
    blocks: ThetaBlocks,
    old: Vector,
    new: Vector,
    *,
    refused: bool = False,
) -> Update:
    """The `Update` of a rule that has set θ itself.

    Args:
        blocks: layout of θ.
        old: θ before, (n_θ,).
        new: θ now, (n_θ,).
        refused: for the log.
    """
    scaled_step = (new - old) / blocks.scale
    return Update(
        td_error=float("nan"),
        step=float(np.linalg.norm(scaled_step)),
        smallest_eigenvalue=smallest_eigenvalue(blocks, new),
        refused=refused,
    )
