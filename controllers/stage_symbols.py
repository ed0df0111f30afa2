"""Symbols of θ and of what differs from stage to stage, in one vector.

The values σ of the problem's varying quantities at the stages 0 … N stand behind θ: (θ, σ_0, …,
σ_N), in the place that θ alone has where nothing varies. So what computes from θ computes from the
signals too, and a problem without any has the same functions as ever. A function of one stage has
(θ, σ_k, γᵏ) there.
"""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca
import numpy as np

from controllers.errors import ModelError
from controllers.functions import Expression
from controllers.problem import Problem, VaryingKind, of_kind
from controllers.theta import Symbols, ThetaBlocks, symbolic_theta
from cosim.core.protocols import Vector


def given_size(problem: Problem, blocks: ThetaBlocks) -> int:
    """Entries of (θ, σ).

    Args:
        problem: The problem.
        blocks: The blocks of θ.
    """
    n_stages = problem.horizon + 1
    return blocks.size + len(problem.varying) * n_stages


def nominal_given(problem: Problem, theta: Vector) -> Vector:
    """(θ, σ) with every varying quantity at its nominal value.

    Args:
        problem: The problem.
        theta: θ, (n_θ,).
    """
    nominal = [item.nominal for item in problem.varying]
    n_stages = problem.horizon + 1
    sigma = np.tile(nominal, n_stages)
    return np.concatenate([theta, sigma])


def symbolic_given(problem: Problem, blocks: ThetaBlocks) -> Symbols:
    """`symbolic_theta` whose `theta` is (θ, σ), and `sigma` (n_σ, N+1)."""
    count = len(problem.varying)
    n_stages = problem.horizon + 1
    symbols = symbolic_theta(problem, blocks, count * n_stages)
    behind = symbols["theta"][blocks.size :]
    # A stage in each column, as CasADi stacks them.
    symbols["sigma"] = ca.reshape(behind, count, n_stages)
    return symbols


def given_parts(problem: Problem, blocks: ThetaBlocks, given: ca.MX) -> dict[str, ca.MX]:
    """Parts of (θ, σ) for a graph of calls: θ's blocks, packed as θ has them, and `sigma`.

    A slack weight that is no block is the problem's constant, `sigma` is (n_σ, N+1).

    Args:
        problem: The problem.
        blocks: The blocks of θ.
        given: (θ, σ).
    """
    parts = {name: given[place] for name, place in blocks.slices.items()}
    parts.setdefault("w_sigma", ca.MX(ca.DM(problem.penalty_linear)))
    parts.setdefault("W_sigma", ca.MX(ca.DM(problem.penalty_quadratic)))
    behind = given[blocks.size :]
    parts["sigma"] = ca.reshape(behind, len(problem.varying), problem.horizon + 1)
    return parts


def symbolic_stage(problem: Problem, blocks: ThetaBlocks) -> Symbols:
    """`symbolic_theta` whose `theta` is (θ, σ_k, γᵏ), and what the model is given at the stage.

    That are `disturbance` (n_d,), `model_parameters` (n_p,), and `nominal_prices`, the same with
    each price at its nominal value; and `discount`, γᵏ.

    Raises:
        ModelError: A varying parameter is one of θ's.
    """
    varying = problem.varying
    model = problem.model
    # Behind θ the signals and γᵏ, which differs from stage to stage where they do.
    n_behind = len(varying) + 1 if varying else 0
    symbols = symbolic_theta(problem, blocks, n_behind)
    theta = symbols["theta"]
    disturbance = ca.SX(ca.DM(model.nominal_disturbance))
    parameters = symbols["model_parameters"]
    # θ's cost stands for the nominal prices: what a price adds is the difference from these.
    nominal_prices = ca.SX(parameters)
    in_theta: tuple[str, ...] = ()
    if "p" in blocks:
        in_theta = blocks.block("p").labels
    for row, item in of_kind(varying, "disturbance", "parameter", "price"):
        value = theta[blocks.size + row]
        if item.kind == "disturbance":
            disturbance[item.place] = value
            continue
        name = model.parameters[item.place].name
        if name in in_theta:
            raise ModelError(
                f"signal '{item.signal}' gives the model's parameter {name}, which is in θ too: "
                "one of both can say what it is"
            )
        parameters[item.place] = value
        if item.kind != "price":
            nominal_prices[item.place] = value
    symbols["disturbance"] = disturbance
    symbols["nominal_prices"] = nominal_prices
    symbols["discount"] = theta[-1] if varying else ca.SX(1.0)
    return symbols


def stage_columns(
    problem: Problem,
    blocks: ThetaBlocks,
    given: ca.MX,
) -> ca.MX:
    """What the functions of the stages 0 … N−1 are given in the place of θ, side by side.

    Args:
        problem: The problem.
        blocks: The blocks of θ.
        given: (θ, σ).
    """
    horizon = problem.horizon
    count = len(problem.varying)
    if not count:
        return ca.repmat(given, 1, horizon)
    begins = [0, blocks.size, given.numel()]
    theta, behind = ca.vertsplit(given, begins)
    theta_of_stages = ca.repmat(theta, 1, horizon)
    # The last column and the last power are those of x_N, where the horizon ends.
    sigma = ca.reshape(behind, count, horizon + 1)
    sigma_of_stages = sigma[:, :-1]
    discounts = ca.DM(problem.discounts[:-1])
    row_of_discounts = ca.MX(discounts.T)
    return ca.vertcat(theta_of_stages, sigma_of_stages, row_of_discounts)


def state_bounds(
    problem: Problem,
    symbols: Mapping[str, Expression],
) -> tuple[list[Expression], list[Expression]]:
    """θ's lower and upper bounds of the states at the stages 0 … N, (n,) each.

    A bound that moves is θ's, moved by as much as the signal is off the scenario's bound: what θ
    keeps from it is kept.

    Args:
        problem: The problem.
        symbols: Of `symbolic_given` or `given_parts`.
    """
    sigma = symbols["sigma"]
    lower = _moved(problem, sigma, "lower", symbols["x_l"])
    upper = _moved(problem, sigma, "upper", symbols["x_u"])
    return lower, upper


def true_bounds(problem: Problem, symbols: Symbols) -> tuple[ca.SX, ca.SX] | None:
    """The scenario's bounds of the present state as they are known, (n,) each; None if none moves.

    Args:
        problem: The problem.
        symbols: Of `symbolic_given`.
    """
    if not of_kind(problem.varying, "lower", "upper"):
        return None
    sigma = symbols["sigma"]
    lower = _moved(problem, sigma, "lower", ca.SX(ca.DM(problem.state_lower)))
    upper = _moved(problem, sigma, "upper", ca.SX(ca.DM(problem.state_upper)))
    return lower[0], upper[0]


def moved_references(problem: Problem, sigma: Expression) -> list[Expression]:
    """How far the cost's reference is from the problem's at the stages 0 … N, (n+m,) each.

    Args:
        problem: The problem.
        sigma: Values of the varying quantities, (n_σ, N+1).
    """
    still = type(sigma).zeros(problem.n_states + problem.n_actions)
    return _moved(problem, sigma, "reference", still)


def _moved(
    problem: Problem,
    sigma: Expression,
    kind: VaryingKind,
    start: Expression,
) -> list[Expression]:
    """A vector at the stages 0 … N, moved by the varying quantities of a kind."""
    moving = of_kind(problem.varying, kind)
    n_stages = problem.horizon + 1
    if not moving:
        # One expression for all of them: what is made of it is computed once.
        return [start] * n_stages
    stages = []
    for k in range(n_stages):
        vector = type(start)(start)
        for row, item in moving:
            vector[item.place] += sigma[row, k] - item.nominal
        stages.append(vector)
    return stages
