"""A step of θ: the fit that a rule proposes, the constraints on θ, and the prior's coordinates.

Every rule proposes min_d dᵀMd − 2bᵀd in scaled coordinates d = (θ̄ − θ) / scale (`Fit`); M is built
only where a constraint needs it. `ConstrainedStep` moves the controller's θ by it.
`prior_deviation` says how far each entry of θ may be from its start, without units of any plant.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import clarabel
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import cho_factor, cho_solve

from controllers.economic import solve_conic, svec_order
from controllers.rti import RtiNmpc
from controllers.theta import Parameters, ThetaBlocks
from cosim.protocols import Matrix, Vector
from learning.algorithm import Update
from learning.configuration import Configuration
from learning.errors import DivergenceError

HESSIANS = ("B_l", "B_Vf")
LEVEL = 0.16
"""Width of c_lambda as a share of V's level, which is all that it carries."""
OFFSET = 0.02
"""Width of c_f in standard deviations of e: its mean is measured, the TD error need not say it."""
BACK_OFF = 2.0
"""Width of x_l and x_u in standard deviations of e."""
SLOW = 0.3
"""A slow state moves by this share of its standard deviation where that is more than e's."""
GRADIENT = 0.3
"""Width of a cost gradient as a share of the start's, where that is more than a shift's."""


@dataclass(frozen=True)
class Fit:
    """The problem min_d dᵀMd − 2bᵀd.

    `gradient` is b (n,), `minimiser` M⁻¹b (n,), `metric()` M (n, n). `reach(d)` is the length of a
    step as a multiple of the fit's cap or trust region: at most 1, after corrections too.
    """

    gradient: Vector
    minimiser: Vector
    metric: Callable[[], Matrix]
    reach: Callable[[Vector], float] | None = None

    def shrunk(self, factor: float) -> Fit:
        """The fit whose minimiser is `factor` times this one's, with the same metric."""
        return replace(self, gradient=factor * self.gradient, minimiser=factor * self.minimiser)

    def within(self, radius: float, size: Callable[[Vector], float]) -> Fit:
        """The fit whose minimiser is this one's, shortened to `size(d)` ≤ `radius`, same metric.

        `size` must be a norm of the step.
        """

        def reach(step: Vector) -> float:
            return size(step) / radius

        return replace(self.shrunk(1.0 / max(1.0, reach(self.minimiser))), reach=reach)


def td_fit(td_error: float, gradient: Vector, step_size: float) -> Fit:
    """Fit of one transition, min (δ − ∇Qᵀd)² + ‖d‖²/α, in closed form d = αδ∇Q/(1+α‖∇Q‖²).

    `td_error` δ, `gradient` ∇Q (n,) in scaled coordinates, `step_size` α (paper.tex, eq.
    q_learning_fitting with Q_lin = Q + ∇Qᵀ(θ̄−θ)).
    """
    weight = step_size * td_error / (1.0 + step_size * float(gradient @ gradient))
    return Fit(
        gradient=td_error * gradient,
        minimiser=weight * gradient,
        metric=lambda: np.outer(gradient, gradient) + np.eye(gradient.size) / step_size,
    )


def td_step(td_error: float, gradient: Vector, step_size: float) -> Fit:
    """The recursion θ ← θ + αδ∇Q as the fit min ‖d‖²/α − 2δ∇Qᵀd (paper.tex, eq. Qlearning)."""
    return Fit(
        gradient=td_error * gradient,
        minimiser=step_size * td_error * gradient,
        metric=lambda: np.eye(gradient.size) / step_size,
    )


def policy_gradient_fit(gradient: Vector, step_size: float, metric: Matrix) -> Fit:
    """Fit min ∇Jᵀd + dᵀFd/α (paper.tex, eq. pg_solution), d = −α F⁻¹∇J / 2.

    `gradient` ∇J (n,) in scaled coordinates; `metric` F (n, n), positive definite, the Fisher
    matrix E[∇π ∇πᵀ].
    """
    half = -gradient / 2
    minimiser = step_size * cho_solve(cho_factor(metric), half)
    return Fit(half, minimiser, lambda: metric / step_size)


def smallest_eigenvalue(blocks: ThetaBlocks, theta: Vector) -> float:
    """Least eigenvalue of B_l and B_Vf at θ, in their own units."""
    least = [np.linalg.eigvalsh(matrix_of(blocks, theta, name))[0] for name in HESSIANS]
    return float(min(least))


def matrix_of(blocks: ThetaBlocks, theta: Vector, name: str) -> Matrix:
    """Symmetric block `name` of θ, in its own unit."""
    where = blocks.slices[name]
    return blocks.block(name).unpack(theta[where] / blocks.scale[where])


def definite(
    blocks: ThetaBlocks, theta: Vector, fit: Fit, smallest: float, scale: Vector | None = None
) -> Vector | None:
    """θ at the fit's own minimiser under B ⪰ εI, by Clarabel; None where the solver fails.

    min dᵀMd − 2bᵀd  s.t.  B_l(θ+Sd) ⪰ εI, B_Vf(θ+Sd) ⪰ εI with scaled steps d (S = diag scale):
    a quadratic programme over positive semidefinite cones (paper.tex, eq. q_solution, pg_solution).
    S is `scale` (n_θ,), the layout's if not given; the matrices have their own units in any case.
    """
    scale = blocks.scale if scale is None else scale
    matrices, offsets, cones = [], [], []
    for name in HESSIANS:
        block, where = blocks.block(name), blocks.slices[name]
        order, weight = svec_order(block.shape[0])
        shifted = matrix_of(blocks, theta, name) - smallest * np.eye(block.shape[0])
        rows = np.zeros((block.size, blocks.size))
        ratio = (scale[where] / blocks.scale[where])[order]
        rows[np.arange(block.size), where.start + order] = -weight * ratio
        matrices.append(rows)
        offsets.append(weight * block.pack(shifted)[order])
        cones.append(clarabel.PSDTriangleConeT(block.shape[0]))
    # Dividing by the metric's size keeps the solver's absolute tolerances meaningful.
    metric = fit.metric()
    unit = max(float(np.abs(metric).max()), np.finfo(float).tiny)
    step, _ = solve_conic(
        2 * metric / unit,
        -2 * fit.gradient / unit,
        np.vstack(matrices),
        np.concatenate(offsets),
        cones,
    )
    # An interior-point solution may miss the cone by its tolerance; ε is meant to hold.
    return None if step is None else clip_eigenvalues(blocks, theta + scale * step, smallest)


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
            where, packed = blocks.slices[name], blocks.block(name).pack((matrix + matrix.T) / 2)
            theta[where] = blocks.scale[where] * packed
    return theta


class ConstrainedStep:
    """Moves a controller's θ by a fit under every constraint on θ.

    `scale` (n_θ,) are the coordinates of the fits, the layout's if not given. The Hessians' least
    eigenvalue is the configuration's, or half of the start's where that is less.
    """

    KEPT = ("scale", "_smallest")

    def __init__(
        self, controller: RtiNmpc, configuration: Configuration, scale: Vector | None = None
    ) -> None:
        self._controller = controller
        self.blocks = controller.parameters.blocks
        self.scale: Vector = self.blocks.scale if scale is None else scale
        own = smallest_eigenvalue(self.blocks, controller.parameters.theta)
        least = configuration.smallest_eigenvalue
        self._smallest = min(least, own / 2) if own > 0 else least
        self._least = {block.name: np.array(block.least) for block in self.blocks if block.least}

    def take(self, fit: Fit, td_error: float) -> Update:
        """Set the controller's θ to the fit's; the update.

        A step that definiteness corrects beyond the fit's cap or trust region is scaled back: the θ
        with definite Hessians are a convex set. θ stays where Clarabel fails or bounds would cross.
        Raises DivergenceError on a step that is not finite.
        """
        blocks, slices, theta = self.blocks, self.blocks.slices, self._controller.theta
        if not np.isfinite(fit.minimiser).all():
            raise DivergenceError("the step of θ is not finite")
        free = theta + self.scale * fit.minimiser
        least = smallest_eigenvalue(blocks, free)
        corrected = least < self._smallest
        found = definite(blocks, theta, fit, self._smallest, self.scale) if corrected else free
        new = (theta if found is None else found).copy()
        for name, minimum in self._least.items():
            # Least slack weights: exact (linear) and convex (quadratic).
            new[slices[name]] = np.maximum(new[slices[name]], minimum)
        reach = 0.0 if fit.reach is None else fit.reach((new - theta) / self.scale)
        if reach > 1.0:
            new = theta + (new - theta) / reach
        refused = found is None or not (new[slices["x_l"]] < new[slices["x_u"]]).all()
        if refused:
            new, corrected = theta, True
        if not np.array_equal(new, free):
            least = smallest_eigenvalue(blocks, new)
        self._controller.theta = new
        size = float(np.linalg.norm((new - theta) / self.scale))
        return Update(td_error, size, least, corrected, bool(refused))

    def move(self, theta: Vector, td_error: float = float("nan")) -> Update:
        """Set the controller's θ to the admissible one nearest to `theta` (n_θ,), scaled."""
        step = (theta - self._controller.theta) / self.scale
        return self.take(Fit(step, step, lambda: np.eye(step.size)), td_error)


def moved(blocks: ThetaBlocks, old: Vector, new: Vector, **said: Any) -> Update:
    """Update of θ without a fit; `said` are further log fields."""
    return Update(
        td_error=float("nan"),
        step=float(np.linalg.norm((new - old) / blocks.scale)),
        smallest_eigenvalue=smallest_eigenvalue(blocks, new),
        **said,
    )


def prior_deviation(
    start: Parameters,
    state_deviation: Vector,
    error_deviation: Vector,
    action_deviation: Vector,
    level: float,
    width: float,
) -> Vector:
    """Standard deviation of each entry of θ about its start, (n_θ,).

    With B a Hessian of the start, D = diag(B)^½ and κ = max_i B_ii σ_i² the cost of the dearest
    typical move, entries of B get `width`·D_i D_j and gradients `width`·D_i √κ (docs/method.md).
    `state_deviation`, `error_deviation` (n,) and `action_deviation` (m,) are σ of s, e and the
    exploration, `level` is the size of c_lambda.
    """
    move = np.concatenate([np.maximum(state_deviation, error_deviation), action_deviation])
    stage, terminal = _root_diagonal(start["B_l"]), _root_diagonal(start["B_Vf"])
    initial = np.maximum(terminal, np.sqrt(np.abs(np.diag(start["B_lambda"]))))
    dearest = float((stage * move).max())
    bound = BACK_OFF * width / 0.3 * np.maximum(error_deviation, SLOW * state_deviation)
    widths: dict[str, ArrayLike] = {
        "B_lambda": width * np.outer(initial, initial),
        "b_lambda": width * np.maximum(terminal * dearest, np.abs(start["b_lambda"])),
        "c_lambda": LEVEL * abs(level),
        "B_Vf": width * np.outer(terminal, terminal),
        "b_Vf": width * np.maximum(terminal * dearest, GRADIENT * np.abs(start["b_Vf"])),
        "B_l": width * np.outer(stage, stage),
        "b_l": width * np.maximum(stage * dearest, GRADIENT * np.abs(start["b_l"])),
        "c_f": OFFSET * error_deviation,
        "x_l": bound,
        "x_u": bound,
    }
    for name in ("w_sigma", "W_sigma", "p"):
        if name in start.blocks:
            widths[name] = width * np.abs(start[name])
    floor = np.finfo(np.float64).tiny ** 0.25
    packed = [block.pack(widths[block.name]) for block in start.blocks]
    return np.maximum(np.concatenate(packed), floor)


def _root_diagonal(matrix: NDArray[np.float64]) -> Vector:
    root: Vector = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    return root
