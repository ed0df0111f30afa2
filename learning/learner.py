"""What learns in a run: the controller, the rule that moves its θ, and their loop."""

from __future__ import annotations

from typing import Any, cast

from controllers.problem import Problem
from cosim.simulation import spawn_seeds
from learning.interaction import ContinuablePlant, Interaction
from learning.protocols import Algorithm, Update
from learning.starting_point import build_controller, build_strategy, starting_parameters
from learning.training_run import TrainingRun


class Learner:
    """Controller, algorithm and plant of a run, at their start.

    `start` is θ at the start; `rng` draws the exploration. Both seeds, the plant's and that of
    `rng`, come from the run's.
    """

    def __init__(
        self, run: TrainingRun, algorithm: type[Algorithm], plant: ContinuablePlant
    ) -> None:
        problem = Problem.from_scenario(cast("Any", run.scenario))
        self.start = starting_parameters(problem, run.configuration)
        self.controller = build_controller(run.controller, run.scenario, problem, self.start)
        strategy = build_strategy(run.configuration, run.scenario, run.samples)
        self.algorithm = algorithm(
            self.controller, run.scenario, run.configuration, run.samples, strategy
        )
        self._plant_seed, self.rng = spawn_seeds(run.seed)
        self.interaction = Interaction(plant, self.controller, self.algorithm, strategy, self.rng)

    def begin(self) -> None:
        """Reset the plant and solve for its first state."""
        self.interaction.start(self._plant_seed)

    def advance(self) -> tuple[float, Update | None]:
        """One sample of plant and rule: its cost, and the update if θ moved.

        Raises DivergenceError where the rule finds that θ means nothing any more.
        """
        transition, cost = self.interaction.next()
        update = None if transition is None else self.algorithm.observe(transition)
        if update is not None:
            self.interaction.failures += update.failures
            self.interaction.renew()
        return cost, update
