"""Batch Q-learning: an iterated Kalman filter over θ, each batch replayed at the present θ."""

from __future__ import annotations

from typing import Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.linalg import cho_factor, cho_solve

from cosim.scenario import Scenario
from learning.algorithm import LearnableController, Transition, Update
from learning.checkpoint import group, prefixed
from learning.configuration import Configuration, Count, ExplorationProbability, ExplorationShare
from learning.errors import DivergenceError
from learning.exploration import Strategy
from learning.prediction_errors import OneStepModel, PredictionErrors
from learning.q_learning import (
    OUTLIER,
    AverageCost,
    Discount,
    ErrorsKept,
    InnovationClip,
    MeasureOffset,
    PriorWidth,
    VarianceMemory,
)
from learning.replay import ReplayBuffer, Replayed
from learning.step import ConstrainedStep, Fit, measured_prior

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]


class BatchQLearningConfiguration(Configuration):
    """Hyperparameters of batch Q-learning."""

    exploration_probability: ExplorationProbability = 0.3
    exploration_share: ExplorationShare = 1 / 30
    discount: Discount = None
    prior_width: PriorWidth = 0.3
    batch_size: Count = Field(500, description="samples between two updates")
    first_batch: Count | None = Field(
        None,
        description="samples of the first batch, which gives noise and widths; as the others if "
        "not given",
    )
    measure_offset: MeasureOffset = True
    relinearisations: Count = Field(2, description="replays and steps of θ per batch")
    innovation_clip: InnovationClip = 3.0
    variance_memory: VarianceMemory = 2000.0
    prediction_errors: ErrorsKept = 1000

    def narrowed(self, width: float) -> Self:
        """Copy whose prior is `width` times as wide."""
        return self.model_copy(update={"prior_width": width * self.prior_width})


class BatchQLearning:
    """The measurements and the prior of online Q-learning, replayed at the present θ.

    Each batch of `batch_size` transitions is a measurement of d = (θ−θ₀)/σ with the information
    GᵀG/r, G the rows ∇Qᵀσ. The prior of a batch is the posterior of the one before:

        min_d Σ (δ − ∇Qᵀ(d − d_now))²/r + (d − m)ᵀΛ(d − m),  then Λ ← Λ + GᵀG/r, m ← d

    `relinearisations` times a batch, linearised anew where the last step led to: the iterated
    filter (Gauss–Newton on the posterior). TD errors hold the next penalty's expectation and are
    cut at ±`innovation_clip`·√r. The first batch gives noise, widths and c_f as well.
    """

    Configuration: ClassVar[type[Configuration]] = BatchQLearningConfiguration
    asks_for: ClassVar[Literal["operation", "simulator"]] = "operation"
    needs_action_value = False
    needs_points = True

    def __init__(
        self,
        controller: LearnableController,
        scenario: Scenario,
        configuration: BatchQLearningConfiguration,
        samples: int,
        strategy: Strategy,
        rng: np.random.Generator,
    ) -> None:
        self._controller, self._scenario, self._configuration = controller, scenario, configuration
        self._model = OneStepModel(scenario)
        self._errors = PredictionErrors(scenario, configuration.prediction_errors)
        self._variance = 0.0
        rows, n = max(self._length, configuration.batch_size), scenario.state_lower.size
        self._buffer = ReplayBuffer(self._controller, self._length)
        self._batch = {
            "states": np.zeros((rows, n)),
            "prediction_errors": np.zeros((rows, n)),
            "corrections": np.zeros(rows),
        }
        self._filled, self._last = 0, -1
        self._anchor = controller.theta.copy()
        self._adopt(np.ones(controller.theta.size))
        self._information: Matrix = np.eye(controller.theta.size)
        self._mean: Vector = np.zeros(controller.theta.size)

    def observe(self, transition: Transition) -> Update | None:
        """Take one sample; the last of a batch moves θ."""
        prediction = self._model(transition.s, transition.a)
        error, row = transition.next_s - prediction, self._filled
        self._errors.add(error)
        batch = self._batch
        batch["states"][row], batch["prediction_errors"][row] = transition.s, error
        expected = self._errors.expected_penalty(prediction)
        batch["corrections"][row] = expected - transition.next_penalty
        self._buffer.add(transition)
        self._filled, self._last = row + 1, transition.number
        if self._filled < self._length:
            return None
        self._filled = 0
        first = self._variance == 0.0
        update = self._update()
        if first:
            self._buffer = ReplayBuffer(self._controller, self._length)
        return update

    @property
    def _length(self) -> int:
        """Samples of the open batch."""
        settings = self._configuration
        first = settings.first_batch if self._variance == 0.0 else None
        return settings.batch_size if first is None else first

    def _update(self) -> Update:
        settings, update, failures = self._configuration, None, 0
        count = self._length
        information = self._information
        for _ in range(settings.relinearisations):
            replayed = self._buffer.replay(self._average_cost)
            failures += replayed.failures
            if not len(replayed.number):
                break
            td_error = self._td_error(replayed, count)
            if self._variance == 0.0:
                self._begin(td_error, count)
                information = self._information
            gradient = replayed.gradient * self._step.scale
            limit = settings.innovation_clip * self._variance**0.5
            innovation = np.clip(td_error, -limit, limit)
            information = self._information + gradient.T @ gradient / self._variance
            slope = gradient.T @ innovation / self._variance
            slope -= self._information @ (self._present - self._mean)
            fit = _newton(information, slope)
            size = float(np.sqrt(np.mean(td_error**2)))
            update = self._step.take(self._average_cost.take(fit), size)
        if update is None:
            raise DivergenceError("no transition of a batch can be replayed")
        self._information, self._mean = information, self._present
        squares = np.minimum(td_error**2, OUTLIER * self._variance)
        share = min(len(td_error) / settings.variance_memory, 1.0)
        self._variance += share * (float(squares.mean()) - self._variance)
        return update._replace(failures=failures)

    def _td_error(self, replayed: Replayed, count: int) -> Vector:
        """δ with the next penalty's expectation in its place, (K,), in a batch of `count`."""
        rows = count - 1 - (self._last - replayed.number)
        discount = self._average_cost.discount
        td_error: Vector = replayed.td_error + discount * self._batch["corrections"][rows]
        if not np.isfinite(td_error).all():
            raise DivergenceError("TD errors are not finite")
        return td_error

    @property
    def _present(self) -> Vector:
        """d of the controller's θ."""
        present: Vector = (self._controller.theta - self._anchor) / self._step.scale
        return present

    def _begin(self, td_error: Vector, count: int) -> None:
        """Take the noise, the widths and c_f from the `count` samples of the first batch."""
        batch = {name: values[:count] for name, values in self._batch.items()}
        self._variance = max(float(np.mean(td_error**2)), np.finfo(np.float64).tiny)
        start, scale = measured_prior(
            self._controller.parameters,
            batch["states"],
            batch["prediction_errors"],
            self._configuration.deviation(self._scenario),
            self._variance**0.5,
            self._configuration.prior_width,
            measure_offset=self._configuration.measure_offset,
        )
        self._controller.theta = start.theta
        self._anchor = start.theta.copy()
        self._adopt(scale)

    def _adopt(self, scale: Vector) -> None:
        """Work in coordinates of this scale, (n_θ,)."""
        settings = self._configuration
        self._step = ConstrainedStep(self._controller, settings, scale=scale)
        self._average_cost = AverageCost.of(settings.discount, self._scenario, self._step)

    def state(self) -> dict[str, NDArray[Any]]:
        """Filter, errors and the open batch."""
        sums = [self._filled, self._last, self._variance, self._average_cost.mean_cost]
        return {
            **{name: values.copy() for name, values in self._batch.items()},
            **self._errors.state(),
            "scale": self._step.scale.copy(),
            "anchor": self._anchor.copy(),
            "information": self._information.copy(),
            "mean": self._mean.copy(),
            "sums": np.array(sums),
            **prefixed("buffer_", self._buffer.state()),
        }

    def restore(self, state: dict[str, NDArray[Any]]) -> None:
        """Take back what `state` gave."""
        self._batch = {name: state[name].copy() for name in self._batch}
        self._errors.restore(state)
        self._adopt(state["scale"].copy())
        self._anchor, self._mean = state["anchor"].copy(), state["mean"].copy()
        self._information = state["information"].copy()
        filled, last, self._variance, self._average_cost.mean_cost = (
            float(value) for value in state["sums"]
        )
        self._filled, self._last = int(filled), int(last)
        self._buffer = ReplayBuffer(self._controller, self._length)
        self._buffer.restore(group(state, "buffer_"))


def _newton(information: Matrix, slope: Vector) -> Fit:
    """Step Λ⁻¹b in the metric Λ."""
    return Fit(slope, cho_solve(cho_factor(information), slope), lambda: information)
