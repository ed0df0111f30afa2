"""From a fit to a new θ: definite Hessians, slack weights and bounds that stay admissible."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from controllers.parameters import Parameters
from controllers.theta import ThetaBlocks
from learning.configuration import Configuration
from learning.definiteness import Certificate, certificate, enforcement
from learning.errors import DivergenceError
from learning.fit import Fit
from learning.protocols import LearnableController, Update

Vector = NDArray[np.float64]


class ConstrainedStep:
    """Moves a controller's θ by a fit under every constraint on θ.

    `scale` (n_θ,) are the coordinates of the fits: the layout's, or ones where the configuration
    says `scaled = false`, or `scale` where it is given. The least eigenvalue that the Hessians may
    have is the configuration's, or half of the start's where that is less: an economically tuned
    cost is flat. Raises DivergenceError on a step that is not finite.
    """

    def __init__(
        self,
        controller: LearnableController,
        configuration: Configuration,
        *,
        scaled: bool = True,
        scale: Vector | None = None,
    ) -> None:
        self._controller = controller
        blocks = controller.parameters.blocks
        if scale is not None:
            self.blocks = rescaled(blocks, scale)
        else:
            self.blocks = blocks if scaled else rescaled(blocks, np.ones(blocks.size))
        self.scale: Vector = self.blocks.scale
        self._enforce = enforcement(
            configuration.definiteness,
            self.blocks,
            least_eigenvalue(configuration, controller.parameters),
        )
        self._least = {block.name: np.array(block.least) for block in blocks if block.least}
        if (chosen := configuration.slack_linear_minimum) is not None and "w_sigma" in blocks:
            self._least["w_sigma"] = np.full(blocks.block("w_sigma").size, chosen)

    def proposal(self, fit: Fit) -> tuple[Vector, Certificate]:
        """The new θ that a fit leads to, and its certificate; the controller stays as it is.

        A step that definiteness corrects beyond the fit's cap or trust region is scaled back: the
        θ with definite Hessians are a convex set, in which the whole way lies.
        """
        theta = self._controller.theta
        if not np.isfinite(fit.minimiser).all():
            raise DivergenceError("the step of θ is not finite")
        new, vouched = self._enforce(theta, fit)
        new = self._admissible(new)
        reach = 0.0 if fit.reach is None else fit.reach((new - theta) / self.scale)
        if reach > 1.0:
            new = theta + (new - theta) / reach
            vouched = dataclasses.replace(
                certificate(self.blocks, new), corrected=vouched.corrected
            )
        lower, upper = self.blocks.slices["x_l"], self.blocks.slices["x_u"]
        if not (new[lower] < new[upper]).all():
            return theta, dataclasses.replace(
                certificate(self.blocks, theta), corrected=True, refused=True
            )
        return new, vouched

    def take(self, fit: Fit, td_error: float) -> Update:
        """Set the controller's θ to the fit's proposal and say what happened."""
        old = self._controller.theta
        new, vouched = self.proposal(fit)
        self._controller.theta = new
        return Update(
            td_error=td_error,
            step=float(np.linalg.norm((new - old) / self.scale)),
            smallest_eigenvalue=vouched.smallest,
            corrected=vouched.corrected,
            refused=vouched.refused,
        )

    def move(self, theta: Vector, td_error: float = float("nan")) -> Update:
        """Set the controller's θ to the admissible one nearest to `theta` (n_θ,), and say so.

        Nearest in the scaled coordinates where definiteness is kept by the LMI.
        """
        step = (theta - self._controller.theta) / self.scale
        return self.take(Fit(step, step, lambda: np.eye(step.size)), td_error)

    def _admissible(self, theta: Vector) -> Vector:
        """Keep learned slack weights above what exactness (linear) and convexity ask for."""
        if not self._least:
            return theta
        theta = theta.copy()
        for name, minimum in self._least.items():
            where = self.blocks.slices[name]
            theta[where] = np.maximum(theta[where], minimum)
        return theta


def least_eigenvalue(configuration: Configuration, start: Parameters) -> float:
    """ε of B ⪰ εI for a run that begins at `start`."""
    own = certificate(start.blocks, start.theta).smallest
    chosen = configuration.smallest_eigenvalue
    return min(chosen, own / 2) if own > 0 else chosen


def rescaled(blocks: ThetaBlocks, scale: Vector) -> ThetaBlocks:
    """The blocks with another learning scale, (n_θ,)."""
    return ThetaBlocks(
        tuple(
            dataclasses.replace(block, scale=tuple(scale[blocks.slices[block.name]].tolist()))
            for block in blocks
        )
    )
