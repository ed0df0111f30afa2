"""Baseline (b): the NMPC cost tuned by economics, after Zanon, Gros and Diehl (2016)."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from controllers.economic.convexification import Convexification, convexify
from controllers.economic.local_feedback import LocalFeedback, local_feedback
from controllers.economic.steady_state import SteadyState, optimal_steady_state
from controllers.errors import TuningError
from controllers.model import discretise
from controllers.parameters import Parameters
from controllers.problem import Problem
from controllers.theta import ThetaBlocks

Array = NDArray[np.float64]


@dataclass(frozen=True)
class EconomicTuning:
    """Tuned θ with its certificate.

    `economic` is the local optimum of the economic cost itself (γ = 1, active constraints kept),
    `tuned` that of the convexified one.
    """

    parameters: Parameters
    steady_state: SteadyState
    convexification: Convexification
    economic: LocalFeedback
    tuned: LocalFeedback

    @property
    def gain_error(self) -> float:
        """Largest difference between the tuned local feedback gain and the economic one."""
        return float(np.abs(self.tuned.gain - self.economic.gain).max())

    def __str__(self) -> str:
        """The certificate in six lines."""
        steady, convex = self.steady_state, self.convexification
        active = ", ".join(
            f"{name} (multiplier {multiplier:.4g})"
            for name, multiplier in zip(steady.active, steady.C @ steady.multipliers, strict=True)
        )
        return "\n".join(
            [
                f"optimal steady state  x = {_short(steady.x)}, u = {_short(steady.u)}, "
                f"cost {steady.cost:.6g}",
                f"strictly active       {active or 'none'}",
                f"economic Hessian      eigenvalues {_short(steady.eigenvalues)}",
                f"convexified Hessian   eigenvalues {_short(convex.eigenvalues)}, "
                f"α = {convex.alpha:.4g}, β = {convex.beta:.4g}, F = {_short(convex.F)}",
                f"economic gain         {_short(self.economic.gain)}",
                f"tuned gain            differs by {self.gain_error:.2g}",
            ]
        )


def tune(
    problem: Problem,
    blocks: ThetaBlocks | None = None,
    *,
    value_offset: float | None = None,
    weight: float = 1e-3,
    accuracy: float = 1e-8,
) -> EconomicTuning:
    """Tune the NMPC so that its local feedback is that of the economic optimum.

    The economic cost is rotated by the costate λ of the optimal steady state, which leaves its
    gradient q only along the active constraints, and convexified to H̃ (`convexify`, ρ = `weight`,
    published as 1e-3). For this the model is integrated in as many steps as bring the relative
    error of a sample's A and B below `accuracy`, published as 1e-8; the controller's own model
    keeps its `substeps`.
    Then ℓ_θ = ½ΔwᵀMΔw + qᵀΔw with M = H̃ + (1−γ)[A B]ᵀP[A B], V^f_θ = ½ΔxᵀPΔx + q_xᵀΔx with P
    the value of H̃ under γ = 1: the term in 1−γ, which the published procedure for γ = 1 does not
    need, makes P and its feedback those of the discounted problem as well, for any γ and horizon.
    Without it a discounted NMPC would act as if what it postpones were cheaper. λ_θ undoes both
    rotations, so that V_θ is to second order the economic value. `value_offset` is c_λ where it
    shall not be ℓ_s. Raises TuningError where steady state, local optimum or convexification do
    not exist.
    """
    steady = optimal_steady_state(
        dataclasses.replace(problem, substeps=accurate_substeps(problem, accuracy))
    )
    n, A, B = problem.n_states, steady.A, steady.B
    economic = local_feedback(A, B, steady.hessian, steady.C)
    convex = convexify(A, B, steady.hessian, steady.C, weight)
    tuned = local_feedback(A, B, convex.hessian, steady.C)
    P, dynamics = tuned.value, np.hstack([A, B])
    M = convex.hessian + (1.0 - problem.discount) * dynamics.T @ P @ dynamics
    q, C_x = steady.gradient, steady.C[:, :n]
    # θ's quadratics are about the reference, the tuning's about the optimal steady state.
    shift = np.concatenate(
        [problem.reference_state - steady.x, problem.reference_action - steady.u]
    )
    initial = convex.delta_P - C_x.T @ convex.F @ C_x
    parameters = Parameters.naive(problem, blocks, value_offset=value_offset).replace(
        {
            "B_l": _symmetric(0.5 * M),
            "b_l": q + M @ shift,
            "B_Vf": _symmetric(0.5 * P),
            "b_Vf": q[:n] + P @ shift[:n],
            "B_lambda": _symmetric(0.5 * initial),
            "b_lambda": steady.costate + initial @ shift[:n],
        }
    )
    return EconomicTuning(
        parameters=parameters,
        steady_state=steady,
        convexification=convex,
        economic=economic,
        tuned=tuned,
    )


def accurate_substeps(problem: Problem, accuracy: float) -> int:
    """Runge–Kutta steps a sample with a relative error below `accuracy`, at the reference.

    The error is that of A and B: a steady state itself is integrated exactly by any number of
    steps. The problem's own number is doubled until doubling it once more changes less. Raises
    TuningError where that does not come about in 1024 steps.
    """
    model, substeps = problem.model, problem.substeps
    point = (
        problem.reference_state,
        problem.reference_action,
        model.nominal_disturbance,
        model.nominal_parameters,
    )

    def end(steps: int) -> Array:
        x, u, d, p = model.symbols()
        following = discretise(model, problem.sampling_time, steps)(x, u, d, p)
        jacobian = ca.jacobian(following, ca.vertcat(x, u))
        found: Array = ca.Function("AB", [x, u, d, p], [jacobian])(*point).full()
        return found

    present = end(substeps)
    while substeps <= 1024:
        finer = end(2 * substeps)
        if (np.abs(finer - present) <= accuracy * (1.0 + np.abs(present))).all():
            return substeps
        substeps, present = 2 * substeps, finer
    raise TuningError(
        f"model '{model.name}' cannot be integrated to {accuracy:g} over a sample of "
        f"{problem.sampling_time:g} s"
    )


def _symmetric(matrix: Array) -> Array:
    """Rounding made symmetric, as θ's packing demands."""
    symmetric: Array = 0.5 * (matrix + matrix.T)
    return symmetric


def _short(array: Array) -> str:
    """Entries to five digits, on one line."""
    rows = [_short(row) if row.ndim else f"{float(row):.5g}" for row in array]
    return f"[{', '.join(rows)}]"
