"""The TD target: a discount, or the average cost per sample in its place."""

from __future__ import annotations

from dataclasses import replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from cosim.scenario import Scenario
from learning.constrained_step import ConstrainedStep
from learning.fit import Fit

Matrix = NDArray[np.float64]
Values = TypeVar("Values", float, NDArray[np.float64])


class AverageCost:
    """δ = ℓ + γV(s₊) − Q(s, a), and at γ = 1 δ = ℓ − g + V(s₊) − Q(s, a), with g learned.

    At γ = 1 the constant c_lambda cancels out of δ, and what the fit would have it do is to take
    up the mean of δ. That is what g, the mean cost per sample, has to do: so the step of
    c_lambda goes to g, and c_lambda stays. This is differential Q-learning; it serves the
    yardstick J itself, which a discounted optimum need not.

    `position` and `scale` are those of c_lambda in θ; `start` the first guess of g.
    """

    def __init__(self, discount: float, position: int, scale: float, start: float) -> None:
        self.discount = discount
        self.mean_cost = start if discount == 1.0 else 0.0
        self._position, self._scale = position, scale

    @classmethod
    def of(cls, discount: float | None, scenario: Scenario, step: ConstrainedStep) -> AverageCost:
        """Target of a scenario's TD error; `discount` None is the scenario's own."""
        position = step.blocks.slices["c_lambda"].start
        return cls(
            scenario.discount if discount is None else discount,
            position,
            float(step.scale[position]),
            scenario.controller.reference_cost,
        )

    def target(self, cost: Values, next_value: Values) -> Values:
        """What Q(s, a) is fitted to, of one sample or of several, (K,)."""
        return cost - self.mean_cost + self.discount * next_value

    def descent(self, change: Matrix) -> Matrix:
        """How a fit's scaled step lowers the TD errors, (K, n_θ), with g in c_lambda's column.

        `change` (K, n_θ) is that of θ alone: ∇Q, or ∇Q − γ∇V(s₊) where the target moves along; in
        the latter c_lambda cancels at γ = 1, and g, which moves all δ alike, would not be fitted.
        """
        if self.discount != 1.0:
            return change
        jacobian = change.copy()
        jacobian[:, self._position] = self._scale
        return jacobian

    def take(self, fit: Fit) -> Fit:
        """Move g by its part of a fit's step; returns the rest, which is for θ."""
        if self.discount != 1.0:
            return fit
        minimiser = fit.minimiser.copy()
        self.mean_cost += float(minimiser[self._position]) * self._scale
        minimiser[self._position] = 0.0
        return replace(fit, gradient=fit.metric() @ minimiser, minimiser=minimiser)
