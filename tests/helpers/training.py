"""Short trainings, whole, and killed and resumed; a rule in its loop."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from controllers.rti import RtiNmpc
from cosim import Scenario
from cosim.core.protocols import Array
from learning.algorithm import Algorithm, Transition, load_algorithm
from learning.exploration import Strategy
from learning.loop import TrainingLoop
from learning.training import Training, run_training
from learning.training_run import TrainingRun


class Killed(BaseException):
    """Stands for a kill: nothing after it runs."""


def make_run(
    algorithm: str = "q-learning",
    scenario: str | Scenario = "paper",
    settings: Mapping[str, Any] = {},
    **changes: Any,
) -> TrainingRun:
    """Forty samples, judged by one held-out run of ten, with a checkpoint in the middle."""
    values = {
        "samples": 40,
        "seed": 0,
        "configuration": load_algorithm(algorithm).Configuration.from_dict(settings),
        "log_every": 20,
        "evaluate_every": 40,
        "checkpoint_every": 20,
        "evaluation_seeds": 1,
        "evaluation_steps": 10,
    }
    loaded = scenario if isinstance(scenario, Scenario) else Scenario.load(scenario)
    return TrainingRun(algorithm=algorithm, scenario=loaded, **{**values, **changes})


def killed_and_resumed(
    run: TrainingRun, out: Path, at: int, rule: type[Algorithm] | None = None
) -> Training:
    """The result of a run that was killed when it had done `at` samples, and resumed."""

    def die(done: int, row: object) -> None:
        if done == at:
            raise Killed

    with pytest.raises(Killed):
        run_training(run, out, rule=rule, progress=die)
    return run_training(run, out, rule=rule, resume=True)


def looped(
    rule: type[Algorithm],
    plant: Any,
    controller: RtiNmpc,
    configuration: Any,
    samples: int = 1000,
    *,
    exploration: int = 0,
    seed: int,
) -> TrainingLoop:
    """A rule in its loop, at the start of the plant's noise `seed`."""
    strategy, own = Strategy(configuration, plant.scenario), np.random.default_rng(0)
    algorithm = rule(controller, plant.scenario, configuration, samples, strategy, own)
    rng = np.random.default_rng(exploration)
    loop = TrainingLoop(plant, controller, algorithm, strategy, rng)
    loop.start(plant.reset(seed))
    return loop


def bare_transition(number: int, s: Array, a: Array, cost: float, next_s: Array) -> Transition:
    """A greedy sample within the bounds, without the solutions, for rules that read none."""
    return Transition(
        number=number,
        s=s,
        a=a,
        explored=False,
        solution=None,
        q_solution=None,
        stage_cost=cost,
        cost=cost,
        known_cost=cost,
        next_s=next_s,
        next_penalty=0.0,
        next_solution=None,
        point=None,
        next_point=None,
    )


class Carrier:
    """A stand-in for a controller of which only θ matters."""

    def __init__(self, parameters):
        self.parameters = parameters

    @property
    def theta(self):
        return self.parameters.theta

    @theta.setter
    def theta(self, theta):
        self.parameters = self.parameters.with_theta(theta)
