"""Random problems for tests: parameters, linearisation points, states and actions."""

from dataclasses import replace

import numpy as np

from controllers import LinearisationPoint, Parameters, Problem, ThetaBlocks
from cosim import Scenario


def evaporator_problem(**changes: object) -> Problem:
    """The evaporator's problem of scenario `paper`."""
    return replace(Problem.from_scenario(Scenario.load("paper")), **changes)


def random_parameters(
    problem: Problem, blocks: ThetaBlocks, rng: np.random.Generator
) -> Parameters:
    """θ with positive definite Hessians, about the size that learning reaches."""

    def definite(size: int) -> np.ndarray:
        root = rng.normal(size=(size, size))
        matrix = root @ root.T / size + 0.3 * np.eye(size)
        return (matrix + matrix.T) / 2

    n, m = problem.n_states, problem.n_actions
    values = {
        "B_lambda": definite(n) - np.eye(n),
        "b_lambda": rng.normal(size=n) * 10,
        "c_lambda": 6000 + rng.normal() * 100,
        "B_Vf": definite(n),
        "b_Vf": rng.normal(size=n) * 20,
        "B_l": definite(n + m),
        "b_l": rng.normal(size=n + m) * 20,
        "c_f": rng.normal(size=n) * 0.1,
        "x_l": problem.state_lower + rng.normal(size=n),
        "x_u": problem.state_upper + rng.normal(size=n),
    }
    if "w_sigma" in blocks:
        values["w_sigma"] = 80 + 50 * rng.random(n)
        values["W_sigma"] = 10 ** rng.uniform(-1, 3, size=n)
    parameters = Parameters.naive(problem, blocks).replace(values)
    if "p" in blocks:
        spread = 1 + 0.05 * rng.normal(size=blocks.block("p").size)
        parameters = parameters.replace({"p": parameters["p"] * spread})
    return parameters


def random_point(problem: Problem, rng: np.random.Generator) -> LinearisationPoint:
    """A linearisation point around the reference, far from any converged trajectory."""
    N, n, m = problem.horizon, problem.n_states, problem.n_actions
    return LinearisationPoint(
        x=problem.reference_state + rng.normal(size=(N, n)) * [2, 3],
        u=problem.reference_action + rng.normal(size=(N, m)) * 25,
        costates=rng.normal(size=(N, n)) * 100,
    )


def random_state(problem: Problem, rng: np.random.Generator) -> np.ndarray:
    """A state around the reference, violating the lower bound about half the time."""
    return problem.reference_state + rng.normal(size=problem.n_states) * [2, 4]


def random_action(problem: Problem, rng: np.random.Generator) -> np.ndarray:
    """An action about the reference; one in four components is saturated."""
    action = problem.reference_action + rng.normal(size=problem.n_actions) * 40
    saturated = np.where(
        rng.random(problem.n_actions) < 0.5, problem.action_lower, problem.action_upper
    )
    chosen = np.where(rng.random(problem.n_actions) < 0.25, saturated, action)
    return np.clip(chosen, problem.action_lower, problem.action_upper)
