"""What learns in a run: the controller, the rule that moves its θ, and their loop."""

from __future__ import annotations

import numpy as np

from controllers.parameters import Parameters
from controllers.problem import Problem
from cosim.simulation import spawn_seeds
from learning.interaction import Interaction
from learning.protocols import Algorithm, ContinuablePlant, Update
from learning.starting_point import build_controller, build_strategy, starting_parameters
from learning.training_run import ALGORITHM, TrainingRun


class Learner:
    """Controller, algorithm and plant of a run, at their start.

    `start` is θ at the start; `rng` draws the exploration, `algorithm_rng` is the rule's own. All
    seeds come from the run's.
    """

    def __init__(
        self, run: TrainingRun, algorithm: type[Algorithm], plant: ContinuablePlant
    ) -> None:
        problem = Problem.from_scenario(run.scenario)
        self.start = starting_parameters(problem, run.configuration, run.start)
        self.controller = build_controller(run.controller, run.scenario, self.start)
        strategy = build_strategy(run.configuration, run.scenario, run.samples)
        self._plant_seed, self.rng = spawn_seeds(run.seed)
        self.algorithm_rng = np.random.default_rng(run.spawned(ALGORITHM))
        self.algorithm = algorithm(
            self.controller,
            run.scenario,
            run.configuration,
            run.samples,
            strategy,
            self.algorithm_rng,
        )
        self.interaction = Interaction(
            plant, self.controller, self.algorithm, strategy, self.rng, run.rest_after
        )

    def begin(self) -> None:
        """Reset the plant and solve for its first state."""
        seed: int | None = getattr(self.algorithm, "first_episode", None)
        self.interaction.start(self._plant_seed if seed is None else seed)

    @property
    def parameters(self) -> Parameters:
        """The θ that the rule would hand over: what it reports, else what it behaves with."""
        theta = getattr(self.algorithm, "theta", None)
        present = self.controller.parameters
        return present if theta is None else present.with_theta(theta)

    def advance(self) -> tuple[float, Update | None]:
        """One sample of plant and rule: its cost, and the update if θ moved.

        Raises DivergenceError where the rule finds that θ means nothing any more.
        """
        rests = self.interaction.rests
        transition, cost = self.interaction.next()
        if rests:
            return cost, None
        update: Update | None = None
        if transition is not None:
            update = self.algorithm.observe(transition)
        elif failed := getattr(self.algorithm, "failed", None):
            update = failed(cost)
        if update is not None:
            self.interaction.failures += update.failures
            if update.mark:
                self.interaction.mark()
            if update.rewind:
                self.interaction.rewind()
            elif update.episode is not None:
                self.interaction.start(update.episode)
            else:
                self.interaction.renew()
        return cost, update
