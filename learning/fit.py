"""Learning steps as quadratic fits, in scaled coordinates d = (θ̄ − θ) / scale.

Every rule of the package proposes min_d dᵀMd − 2bᵀd. Its free minimiser is all that most steps
need; M is built only where a constrained fit asks for it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from learning.errors import DivergenceError

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]


@dataclass(frozen=True)
class Fit:
    """The problem min_d dᵀMd − 2bᵀd.

    `gradient` is b (n,), `minimiser` M⁻¹b (n,), `metric()` M (n, n). `reach(d)` says how far a
    step goes, as a multiple of the cap or trust region that the fit keeps: a step that a constraint
    on θ corrects must still have at most 1.
    """

    gradient: Vector
    minimiser: Vector
    metric: Callable[[], Matrix]
    reach: Callable[[Vector], float] | None = None

    def shrunk(self, factor: float) -> Fit:
        """The fit whose minimiser is `factor` times this one's, with the same metric."""
        if factor == 1.0:
            return self
        return replace(self, gradient=factor * self.gradient, minimiser=factor * self.minimiser)

    def clipped(self, largest: float) -> Fit:
        """The fit whose minimiser is this one's with each entry cut to ±`largest`, same metric.

        Entries are cut one by one: the level c_lambda has far to go, and must not hold up the rest.
        """

        def reach(step: Vector) -> float:
            return float(np.abs(step).max()) / largest

        if reach(self.minimiser) <= 1.0:
            return replace(self, reach=reach)
        minimiser = np.clip(self.minimiser, -largest, largest)
        return Fit(self.metric() @ minimiser, minimiser, self.metric, reach)

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


def damped(information: Matrix, ridge: float) -> Matrix:
    """A + ρ diag(A) + a floor, (n, n), positive definite.

    The Levenberg–Marquardt term `ridge` ρ is relative to each entry's own information, so that a
    step does not depend on units; the floor serves entries that the data say nothing of.
    """
    diagonal = np.diag(information)
    floor = max(float(diagonal.max()), np.finfo(float).tiny) * 1e-8
    return information + np.diag(ridge * diagonal + floor)


def least_squares(information: Matrix, gradient: Vector, ridge: float) -> Fit:
    """Gauss–Newton or Newton-like fit with M = A, `damped`, and b = Σ δ∇Q, (n,).

    `information` A (n, n), symmetric positive semidefinite. Raises DivergenceError where the data
    are not finite.
    """
    if not (np.isfinite(information).all() and np.isfinite(gradient).all()):
        raise DivergenceError("TD errors or gradients are not finite")
    metric = damped(information, ridge)
    return Fit(
        gradient=gradient,
        minimiser=cho_solve(cho_factor(metric), gradient),
        metric=lambda: metric,
    )


def policy_gradient_fit(gradient: Vector, step_size: float, metric: Matrix | None = None) -> Fit:
    """Fit min ∇Jᵀd + dᵀFd/α (paper.tex, eq. pg_solution), d = −α F⁻¹∇J / 2.

    `gradient` ∇J (n,) in scaled coordinates; `metric` F (n, n), positive definite, is the identity
    for the plain gradient and the Fisher matrix E[∇π ∇πᵀ] for the natural one.
    """
    half = -gradient / 2
    if metric is None:
        return Fit(half, step_size * half, lambda: np.eye(gradient.size) / step_size)
    fisher = metric
    return Fit(half, step_size * cho_solve(cho_factor(fisher), half), lambda: fisher / step_size)


def line_search(error: Callable[[float], float], *, shrink: float = 0.5, trials: int = 8) -> float:
    """Largest of the steps 1, β, β², … that does not raise |TD error|, else 0.

    `error(t)` is the TD error with the fit's step scaled by t, its target held (paper.tex, after
    eq. q_solution); it may be NaN where the QP fails, which counts as a rise.
    """
    start = abs(error(0.0))
    step = 1.0
    for _ in range(trials):
        if abs(error(step)) <= start:
            return step
        step *= shrink
    return 0.0
