"""Online Q-learning: a step of θ from each transition, or each few, as it comes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from controllers.errors import QpError
from cosim.scenario import Scenario
from learning.configuration import Configuration, Count, NonNegative, Positive
from learning.exploration import Strategy
from learning.fit import Fit, least_squares, line_search, td_fit, td_step
from learning.level import level
from learning.protocols import LearnableController, Sample, Update
from learning.step import ParameterStep

Vector = NDArray[np.float64]


class QLearningConfiguration(Configuration):
    """Hyperparameters of online Q-learning; the defaults are the recommended variant.

    The paper's rule as written: `rule="fit"`, `step_size=1e-3`, `scaled=false`, `update_every=1`,
    `exploration="scenario"`, `value_offset="stage-cost"`, `parametrisation="paper"`.
    """

    exploration_probability: float = Field(
        0.3, ge=0, le=1, description="share of samples that explore, at the start"
    )
    exploration_deviation: tuple[NonNegative, ...] = Field(
        (10.0,), description="standard deviation of e in the units of u, one or one per action"
    )
    rule: Literal["td", "fit", "gauss-newton"] = Field(
        "gauss-newton",
        description="αδ∇Q; the fit's αδ∇Q/(1+α‖∇Q‖²); or recursive Gauss–Newton with forgetting",
    )
    discount: float | None = Field(
        None, gt=0, le=1, description="of the TD error: the scenario's if not given; 1 is mean cost"
    )
    scaled: bool = Field(True, description="step in coordinates θ/scale, else in θ itself")
    update_every: Count = Field(20, description="samples per step of θ")
    step_size: Positive = Field(1e-3, description="α of the rules td and fit")
    gain: Positive = Field(0.3, le=1, description="share of the Gauss–Newton step taken, at first")
    gain_end: Positive | None = Field(
        0.03, le=1, description="the same at the end, approached geometrically"
    )
    memory: Positive = Field(
        4000.0, description="forgetting: samples after which weight has fallen to 1/e"
    )
    ridge: NonNegative = Field(
        1e-2, description="Levenberg–Marquardt term relative to each entry's information"
    )
    largest_step: Positive = Field(1.0, description="cap on each scaled entry of a step")
    warm_up: int = Field(200, ge=0, description="samples before the first Gauss–Newton step")
    line_search: bool = Field(
        False, description="rules td and fit: shorten a step until its TD error does not rise"
    )

    @model_validator(mode="after")
    def _line_search_needs_one_sample(self) -> Self:
        if self.line_search and self.rule == "gauss-newton":
            raise ValueError("line_search: is for the rules td and fit, which step on one sample")
        return self


class QLearning:
    """Q-learning on δ = ℓ + γV_θ(s₊) − Q_θ(s, a) (paper.tex, eq. Qlearning and q_solution).

    The rules `td` and `fit` take one step from the transitions since the last one, added up; the
    rule `gauss-newton` keeps the information A = Σ λᵏ ∇Q∇Qᵀ and steps by gain·(A+ρ)⁻¹ Σ δ∇Q.
    """

    Configuration: ClassVar[type[Configuration]] = QLearningConfiguration

    def __init__(
        self,
        controller: LearnableController,
        scenario: Scenario,
        configuration: QLearningConfiguration,
        samples: int,
        strategy: Strategy,
    ) -> None:
        self._controller, self._configuration = controller, configuration
        self._samples = samples
        self._step = ParameterStep(controller, configuration, scaled=configuration.scaled)
        self._level = level(configuration.discount, scenario, self._step)
        size = self._step.scale.size
        self._information = np.zeros((size, size))
        self._gradient = np.zeros(size)
        self._squares, self._count = 0.0, 0
        self.needs_action_value = True
        self.needs_points = configuration.line_search

    def observe(self, sample: Sample) -> Update | None:
        """Take one sample; one in `update_every` moves θ (each one under the rules td and fit)."""
        target = self._level.target(sample.cost, sample.next_policy.value)
        td_error = target - sample.action_value.value
        gradient = sample.action_value.value_gradient * self._step.scale
        if self._configuration.rule == "gauss-newton":
            return self._recursive(sample.number, td_error, gradient)
        rule = td_fit if self._configuration.rule == "fit" else td_step
        fit = rule(td_error, gradient, self._configuration.step_size)
        if self._configuration.line_search:
            fit = fit.shrunk(line_search(self._error_along(sample, target, fit)))
        return self._step.take(self._level.take(fit), abs(td_error))

    def _recursive(self, number: int, td_error: float, gradient: Vector) -> Update | None:
        settings = self._configuration
        self._information *= 1.0 - 1.0 / settings.memory
        self._information += np.outer(gradient, gradient)
        self._gradient += td_error * gradient
        self._squares += td_error * td_error
        self._count += 1
        if (number + 1) % settings.update_every or number < settings.warm_up:
            return None
        end = settings.gain if settings.gain_end is None else settings.gain_end
        gain = settings.gain * (end / settings.gain) ** min(number / self._samples, 1.0)
        fit = least_squares(self._information, self._gradient, settings.ridge)
        td_error = (self._squares / self._count) ** 0.5
        self._gradient[:] = 0.0
        self._squares, self._count = 0.0, 0
        fit = self._level.take(fit.shrunk(gain).clipped(settings.largest_step))
        return self._step.take(fit, td_error)

    def _error_along(self, sample: Sample, target: float, fit: Fit) -> Callable[[float], float]:
        """TD error of a sample with the step scaled by t, its target and its QP's guess held."""
        controller, theta = self._controller, self._controller.theta
        point = sample.point
        assert point is not None

        def error(t: float) -> float:
            new, _ = self._step.proposal(fit.shrunk(t))
            try:
                controller.theta = new
                controller.prepare_at(point)
                return target - controller.feedback(sample.s, sample.a).value
            except QpError:
                return float("nan")
            finally:
                controller.theta = theta

        return error

    def state(self) -> dict[str, NDArray[Any]]:
        """Information matrix and the sums since the last step."""
        return {
            "information": self._information,
            "gradient": self._gradient,
            "sums": np.array([self._squares, self._count, self._level.mean_cost]),
        }

    def restore(self, state: dict[str, NDArray[Any]]) -> None:
        """Take back what `state` gave."""
        self._information, self._gradient = state["information"], state["gradient"]
        squares, count, self._level.mean_cost = (float(value) for value in state["sums"])
        self._squares, self._count = squares, int(count)
