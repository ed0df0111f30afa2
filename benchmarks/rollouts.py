"""A sample of the controller in closed loop with an empirical model: in C beside Python's loop."""

import numpy as np

from benchmarks.measuring import clock, figure
from controllers import Problem
from controllers.factories import tuned
from cosim import FmuPlant, simulate
from learning.empirical_model import EmpiricalModel, EmpiricalModelConfiguration, Features
from learning.rollout import Rollout

TAUGHT, SHORTER, REPETITIONS, TARGET = 480, 200, 5, 15.0


def measure(scenario, steps):
    """CPU time of a sample of one θ; the model is that of `TAUGHT` samples of the plant."""
    problem, controller = Problem.from_scenario(scenario), tuned(scenario)
    features = Features(problem)
    with FmuPlant(scenario) as plant:
        run = simulate(plant, controller, TAUGHT + 1, seed=0)
    inputs = np.column_stack(
        [run[name] for name in (*scenario.plant.states, *scenario.plant.actions)]
    )
    outputs = np.column_stack([inputs[1:, : problem.n_states], run["stage_cost"][:-1]])
    model = EmpiricalModel.fit(
        features, inputs[:-1], outputs, EmpiricalModelConfiguration.from_dict({})
    )
    start = problem.reference_state
    rollout = Rollout(problem, controller.parameters, features)
    if rollout.compiled is None:
        raise SystemExit("there is no C compiler, so there is nothing to compare")
    picks = np.random.default_rng(0).integers(TAUGHT, size=steps).astype(np.int32)
    compiled, seconds = rollout.compiled, {"C": [], "Python": []}
    for turn in range(REPETITIONS + 1):
        for name, function, count in (("C", compiled, steps), ("Python", None, SHORTER)):
            rollout.compiled = function
            begin = clock()
            ((rows, _, _),) = rollout([controller.theta], start, model, picks[:count])
            spent = (clock() - begin) / count
            assert len(rows) == count
            if turn:  # the first one warms up
                seconds[name].append(spent)
    return [figure("rollout in C", seconds["C"], "Python", seconds["Python"], at_most=TARGET)]
