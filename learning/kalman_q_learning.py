"""Q-learning with a prior on θ: each TD error is a measurement in a Kalman filter over θ."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from cosim.scenario import Scenario
from learning.average_cost import AverageCost
from learning.configuration import Configuration, Count, NonNegative
from learning.constrained_step import ConstrainedStep
from learning.errors import DivergenceError
from learning.exploration import Strategy
from learning.kalman import KalmanRegression
from learning.prediction_errors import OneStepModel, PredictionErrors
from learning.prior import measured_prior
from learning.protocols import LearnableController, Transition, Update
from learning.q_configuration import QConfiguration

Vector = NDArray[np.float64]


class KalmanConfiguration(QConfiguration):
    """Hyperparameters of the Kalman form online, none of them in units of a plant."""

    prior_samples: Count = Field(
        500, description="kalman: first samples, at which θ rests: they give noise and widths"
    )
    step_every: Count = Field(50, description="kalman: samples per step of θ")
    parameter_drift: NonNegative = Field(
        0.0,
        description="kalman: variance that each sample adds to θ, in units of the prior's, so that "
        "learning goes on where the plant changes",
    )


class KalmanQLearning:
    """Extended Kalman filter for Q with the target held, and the next penalty by its expectation.

    θ ~ N(θ₀, diag(σ²)) with the widths of `learning.prior`. One TD error measures ∇Qᵀd with
    variance r (`KalmanRegression`):

        δ = ℓ + p(s) + γ[V_θ(s₊) − p(s₊) + mean_i p(f(s, a) + e_i)] − Q_θ(s, a)

    with f the controller's nominal model and e_i its latest prediction errors. Every `step_every`
    samples d goes into θ under the constraints on θ, in the metric P⁻¹. The first `prior_samples`
    leave θ as it is, but for c_f, which becomes the mean of e. Kalman temporal differences after
    Geist and Pietquin (2010), linearised and with the target held. `width` multiplies the prior's.
    """

    Configuration: ClassVar[type[Configuration]] = KalmanConfiguration
    needs_action_value = True
    needs_points = False

    def __init__(
        self,
        controller: LearnableController,
        scenario: Scenario,
        configuration: KalmanConfiguration,
        samples: int,
        strategy: Strategy,
        rng: np.random.Generator,
        *,
        width: float = 1.0,
    ) -> None:
        self._controller, self._scenario, self._configuration = controller, scenario, configuration
        self._width = width * configuration.prior_width
        self._model = OneStepModel(scenario)
        self._errors = PredictionErrors(scenario, configuration.prediction_errors)
        self._adopt(np.ones(controller.theta.size))
        self._regression: KalmanRegression | None = None
        rows, n = configuration.prior_samples, scenario.state_lower.size
        self._first = {
            "states": np.zeros((rows, n)),
            "prediction_errors": np.zeros((rows, n)),
            "td_errors": np.zeros(rows),
        }
        self._count = 0
        self._squares = 0.0

    def observe(self, transition: Transition) -> Update | None:
        """Take one sample; one in `step_every` moves θ."""
        prediction = self._model(transition.s, transition.a)
        error = transition.next_s - prediction
        self._errors.add(error)
        expected = self._errors.expected_penalty(prediction)
        value = transition.next_policy.value - transition.next_penalty + expected
        solution = transition.action_value
        td_error = self._average_cost.target(transition.cost, value) - solution.value
        count, self._count = self._count, self._count + 1
        if self._regression is None:
            first = self._first
            first["states"][count], first["prediction_errors"][count] = transition.s, error
            first["td_errors"][count] = td_error
            return self._begin() if self._count == len(first["states"]) else None
        gradient = solution.value_gradient * self._step.scale
        innovation = self._regression.update(td_error, gradient)
        self._squares += innovation * innovation
        every = self._configuration.step_every
        if self._count % every:
            return None
        error_size, self._squares = (self._squares / every) ** 0.5, 0.0
        update = self._step.take(self._average_cost.take(self._regression.fit()), error_size)
        self._regression.taken()
        return update

    def _begin(self) -> Update:
        """Take the noise, the widths and c_f from the first samples."""
        first, settings = self._first, self._configuration
        variance = float(np.mean(first["td_errors"] ** 2))
        if not np.isfinite(variance):
            raise DivergenceError("TD errors are not finite")
        start, scale = measured_prior(
            self._controller.parameters,
            first["states"],
            first["prediction_errors"],
            settings.deviation(self._scenario),
            variance**0.5,
            self._width,
            measure_offset=settings.measure_offset,
        )
        self._adopt(scale)
        self._regression = self._filter(max(variance, np.finfo(np.float64).tiny))
        return self._step.move(start.theta, variance**0.5)

    def _adopt(self, scale: Vector) -> None:
        """Work in coordinates of this scale, (n_θ,)."""
        settings = self._configuration
        self._step = ConstrainedStep(self._controller, settings, scale=scale)
        self._average_cost = AverageCost.of(settings.discount, self._scenario, self._step)

    def _filter(self, variance: float) -> KalmanRegression:
        settings = self._configuration
        return KalmanRegression(
            self._step.scale.size,
            variance,
            clip=settings.innovation_clip,
            memory=settings.variance_memory,
            drift=settings.parameter_drift,
        )

    def state(self) -> dict[str, NDArray[Any]]:
        """Filter, errors and first samples."""
        state = {
            **self._first,
            **self._errors.state(),
            "scale": self._step.scale,
            "sums": np.array([self._count, self._squares, self._average_cost.mean_cost]),
        }
        if self._regression is not None:
            state |= self._regression.state()
        return {name: np.array(values) for name, values in state.items()}

    def restore(self, state: dict[str, NDArray[Any]]) -> None:
        """Take back what `state` gave."""
        self._first = {name: state[name] for name in self._first}
        self._errors.restore(state)
        self._adopt(state["scale"])
        count, self._squares, self._average_cost.mean_cost = (float(v) for v in state["sums"])
        self._count = int(count)
        if "covariance" in state:
            self._regression = self._filter(float(state["variance"]))
            self._regression.restore(state)
