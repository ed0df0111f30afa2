"""`dyna`: Q-learning from the plant's samples and from those of its empirical model, mixed."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from pydantic import Field

from controllers.problem import Problem
from cosim.protocols import Array, Step
from cosim.scenario import Scenario
from learning.algorithm import PlantInOperation, TrainingLoop, Transition, Update
from learning.configuration import Count
from learning.empirical_model import GROWTH, WINDOWS, EmpiricalModel, Features, PlantData
from learning.q_learning import QLearning, QLearningConfiguration
from learning.step import moved


class DynaConfiguration(QLearningConfiguration):
    """Hyperparameters of `dyna`."""

    model_samples: int = Field(4, ge=0, description="samples of the model for each of the plant")
    interval: Count = Field(120, description="least samples of the plant between the model's fits")
    memory: Count = Field(20_000, description="samples that the model remembers")
    exploration_samples: Count = Field(
        480,
        description="samples of the plant that explore after the start and after a change of it; "
        "those of the model always may",
    )


class Dyna(QLearning):
    """Q-learning that learns from the plant and, from time to time, from its empirical model too.

    The model is fitted to the present plant's data, whenever they have grown by an eighth and by
    `interval` samples. From the plant's state the controller runs `model_samples` times as long on
    it, explores, and the same rule learns from that. Where the errors since the last fit have a
    mean that the model makes improbable, the plant has changed: its data begin anew, and so do the
    rule's noise, widths and prior, at the present θ.
    Dyna after Sutton (1991).
    """

    Configuration: ClassVar[type[QLearningConfiguration]] = DynaConfiguration
    KEPT = (*QLearning.KEPT, "_data", "model_samples")
    configuration: DynaConfiguration

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        features = Features(Problem.from_scenario(self.scenario))
        self._data = PlantData(features, self.configuration.memory)
        self._imagines = False
        self.model_samples = 0
        """Samples of the model so far."""

    @property
    def explores(self) -> bool:
        """Whether the samples explore now."""
        age = self._data.count - self._data.era
        return self._imagines or age < self.configuration.exploration_samples

    def observe(self, transition: Transition) -> Update | None:
        """Learn from one sample of the plant and, when due, from the model's."""
        update, data = super().observe(transition), self._data
        data.add(transition)
        since = data.count - data.fitted
        judged = data.model is not None and since % WINDOWS[0] == 0
        changed = judged and data.changed(*data.errors()[2:])
        age = data.count - data.era
        if changed:
            self._count, self._first = 0, []
            self._average_cost.mean_cost = self.scenario.controller.reference_cost
        if since < max(self.configuration.interval, age // GROWTH) and not changed:
            return update
        return self._imagine(data.fit(), transition.next_s, min(since, age))

    def _imagine(self, model: EmpiricalModel, s: Array, since: int) -> Update:
        """Learn from a trajectory of the model from the state s, after so many of the plant."""
        controller, before = self.controller, self.controller.theta
        plant = ModelPlant(self.scenario, model, s, self.rng)
        loop = TrainingLoop(plant, controller, self, self.strategy, self.rng)
        loop.start(s)
        self._imagines = True
        for _ in range(self.configuration.model_samples * since):
            transition, _ = loop.next()
            if transition is not None and super().observe(transition):
                loop.renew()
        self._imagines = False
        self.model_samples += loop.counts.number
        return moved(controller.parameters.blocks, before, controller.theta)


class ModelPlant(PlantInOperation):
    """A plant simulated by an empirical model from s (n,), with resampled residuals."""

    __slots__ = ()

    def __init__(
        self, scenario: Scenario, model: EmpiricalModel, s: Array, rng: np.random.Generator
    ) -> None:
        self.scenario = scenario
        (c, W), present = model.coefficients, s

        def step(a: Array) -> Step:
            nonlocal present
            inputs, penalty = np.concatenate([present, a]), scenario.state_penalty(present.tolist())
            y, _, h = model.features(inputs[None], c)
            residual = model.residuals[rng.integers(len(model.residuals))]
            outcome = y[0] + W @ np.append(1.0, inputs) + h[0] * residual
            present = outcome[:-1]
            return Step(present, float(outcome[-1]), penalty, np.zeros(0))

        self.step = step
