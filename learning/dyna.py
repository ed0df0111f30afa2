"""`dyna`: Q-learning from the plant's samples and from those of its empirical model, mixed."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from pydantic import Field

from controllers.problem import Problem
from cosim.core.protocols import Array, Step
from cosim.core.scenario import Scenario
from learning.algorithm import Transition, Update
from learning.checkpoint import State, part_of, prefixed
from learning.configuration import Count, ExplorationDecay
from learning.empirical_model import EmpiricalModel, EmpiricalModelConfiguration, Features
from learning.loop import PlantInOperation, TrainingLoop
from learning.plant_data import PlantData
from learning.q_learning import QLearning, QLearningConfiguration
from learning.step import update_without_fit


class DynaConfiguration(QLearningConfiguration, EmpiricalModelConfiguration):
    """Hyperparameters of `dyna`: those of Q-learning and of the empirical model, and its own."""

    model_samples: int = Field(4, ge=0, description="samples of the model for each of the plant")
    interval: Count = Field(120, description="least samples of the plant between the model's fits")
    exploration_decay_after: ExplorationDecay = None
    exploration_samples: Count = Field(
        480,
        description=(
            "samples of the plant that explore after the start and after a change; those "
            "of the model always may"
        ),
    )


class Dyna(QLearning):
    """Q-learning that learns from the plant and, from time to time, from its empirical model too.

    The model is fitted to the present regime's data, whenever they have grown by an eighth and by
    `interval` samples. From the plant's state the controller runs `model_samples` times as long on
    it, explores, and the same rule learns from that. Where the errors since the last fit have a
    mean that the model makes improbable, the plant has changed: its data begin anew, and so do the
    rule's noise, widths and prior, at the present θ.
    Dyna after Sutton (1991).
    """

    learns_from_estimates = False
    learns_under_signals = False

    Configuration: ClassVar[type[QLearningConfiguration]] = DynaConfiguration
    configuration: DynaConfiguration

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        problem = Problem.from_scenario(self.scenario)
        features = Features(problem, self.configuration.smallest_error_size)
        self._data = PlantData(features, self.configuration)
        self._imagines = False  # whether the samples are the model's now
        self.model_samples = 0
        """Samples of the model so far."""

    @property
    def explores(self) -> bool:
        """Whether the samples explore now."""
        return self._imagines or self._data.age < self.configuration.exploration_samples

    def observe(self, transition: Transition) -> Update | None:
        """Learn from one sample of the plant and, when due, from the model's."""
        # The plant's own sample teaches first.
        update = super().observe(transition)
        settings = self.configuration
        data = self._data
        data.add(transition)
        since_fit = data.since_fit
        changed = False
        # In between there is no window that was not looked at.
        shortest_window = settings.change_windows[0]
        if data.model is not None and since_fit % shortest_window == 0:
            predictions = data.predictions()
            changed = data.changed(predictions)
        if changed:
            # Noise and widths were those of another plant.
            self.begin_anew()
        age = data.age
        growth = age // settings.refit_growth
        due = since_fit >= max(settings.interval, growth)
        if not due and not changed:
            return update
        model = data.fit()
        # Samples from before a change are of another plant than the model.
        n_plant_samples = min(since_fit, age)
        return self._imagine(model, transition.next_s, n_plant_samples)

    def _imagine(
        self,
        model: EmpiricalModel,
        s: Array,
        n_plant_samples: int,
    ) -> Update:
        """Learn from a trajectory of the model.

        Args:
            model: of the present regime.
            s: where it begins, (n,).
            n_plant_samples: since the last one.
        """
        controller = self.controller
        before = controller.theta
        plant = ModelPlant(self.scenario, model, s, self.rng)
        loop = TrainingLoop(plant, controller, self, self.strategy, self.rng)
        # From where the plant is: the model knows nothing of other places.
        loop.start(s)
        self._imagines = True
        n_samples = self.configuration.model_samples * n_plant_samples
        for _ in range(n_samples):
            transition, _ = loop.next()
            if transition is not None and super().observe(transition):
                loop.renew()
        self._imagines = False
        self.model_samples += loop.counts.number
        blocks = controller.parameters.blocks
        return update_without_fit(blocks, before, controller.theta)

    def state_dict(self) -> State:
        """State of Q-learning, the data and the model."""
        return {
            **super().state_dict(),
            **prefixed("data", self._data.state_dict()),
            "model_samples": self.model_samples,
        }

    def load_state_dict(self, state: State) -> None:
        """Restore what `state_dict` returned."""
        super().load_state_dict(state)
        self._data.load_state_dict(part_of(state, "data"))
        self.model_samples = state["model_samples"]


class ModelPlant(PlantInOperation):
    """A plant simulated by an empirical model, with residuals drawn anew.

    Args:
        scenario: bounds and penalty.
        model: plays the plant.
        s: state at the start, (n,).
        rng: draws the residuals.
    """

    __slots__ = ()

    def __init__(
        self,
        scenario: Scenario,
        model: EmpiricalModel,
        s: Array,
        rng: np.random.Generator,
    ) -> None:
        self.scenario = scenario
        c, W = model.coefficients
        present = s
        error = np.zeros(model.features.n_outputs)

        def step(a: Array) -> Step:
            nonlocal present, error
            penalty = scenario.state_penalty(present.tolist())
            # Residuals as they came, so that no law of the noise is assumed.
            inputs = np.concatenate([present, a])
            y, _, h = model.features(inputs[None], c)
            pick = rng.integers(len(model.residuals))
            linear = W @ np.append(1.0, inputs)
            persists = model.persistence @ error
            error = persists + model.residuals[pick]
            outcome = y[0] + linear + h[0] * error
            present = outcome[:-1]
            stage_cost = float(outcome[-1])
            return Step(present, stage_cost, penalty, np.zeros(0))

        self.step = step
