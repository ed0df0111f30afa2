"""A policy's table in the compiled closed loop against the same in Python."""

import numpy as np
import pytest

from controllers import OptimalPolicy
from controllers.dynamic_programming import Accuracy, Grid, Optimum
from controllers.problem import PlantProblem
from cosim import FmuPlant, Scenario, simulate


def random_policy(scenario, seed, n_points):
    """Actions, some of them beyond the actuators' bounds, on a grid that the plant leaves."""
    generator = np.random.default_rng(seed)
    plant = PlantProblem.from_scenario(scenario)
    problem = plant.problem
    axes = []
    for reference in problem.reference_state:
        width = 0.01 * abs(reference)
        inner = generator.uniform(-width, width, n_points - 2)
        offsets = np.sort([-width, *inner, width])
        axes.append(reference + offsets)
    n_rows = n_points ** len(axes)
    spread = 0.2 * (problem.action_upper - problem.action_lower)
    optimum = Optimum(
        Grid(tuple(axes)),
        actions=generator.normal(problem.reference_action, spread, (n_rows, problem.n_actions)),
        W=generator.normal(size=n_rows),
        distribution=np.full(n_rows, 1.0 / n_rows),
        gain=0.0,
        accuracy=Accuracy(substeps=2, nodes=(3,), penalty_nodes=(3,)),
        lower=-1.0,
        upper=1.0,
    )
    return OptimalPolicy(plant, optimum)


@pytest.mark.parametrize(("name", "n_points"), [("paper", 2), ("paper", 9), ("reactor", 4)])
def test_its_loop_gives_the_bytes_of_pythons(name, n_points):
    scenario = Scenario.load(name)
    policy = random_policy(scenario, 7, n_points)
    runs = []
    with FmuPlant(scenario) as plant:
        for _ in range(2):
            run = simulate(plant, policy, 300, 5)
            runs.append((run.to_csv(), run.status, run.final_state.tobytes()))
            policy.compile()
            assert policy.functions == "compiled"
    assert runs[0] == runs[1]
    # Both kinds of look-up were met, and a clamped one is no failure.
    assert set(run.status) == {"solved", "clamped"}
    assert run["failed"].sum() == 0


def test_a_plant_with_more_states_than_the_model_is_run_by_python():
    scenario = Scenario.load("paper")
    policy = random_policy(scenario, 0, 3)
    policy.compile()
    assert policy.compiled_loop(scenario) is not None
    assert policy.compiled_loop(Scenario.load("tanks")) is None
