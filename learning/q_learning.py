"""Q-learning online: a temporal-difference step a sample, or a Kalman filter over θ with a prior.

What it shares with Q-learning in batches is here too: hyperparameters, prior widths, mean cost.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import inf
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from controllers.theta import Parameters
from cosim.core.protocols import Matrix, Vector
from cosim.core.scenario import NonNegative, Positive, Scenario
from learning.algorithm import Algorithm, Transition, Update
from learning.checkpoint import State, part_of, prefixed
from learning.configuration import (
    Configuration,
    Count,
    ExplorationDecay,
    ExplorationProbability,
    ExplorationShare,
)
from learning.errors import DivergenceError
from learning.prediction_errors import (
    OneStepModel,
    PredictionErrors,
    effective_number,
    estimate_persistence,
    linear_part,
)
from learning.step import ConstrainedStep, Fit, td_fit, td_step

Values = TypeVar("Values", float, NDArray[np.float64])

LEAST_MEAN_SAMPLES = 10
"""Samples of the shortest mean of ∇Q: over M samples it takes 1/M of what each of them teaches."""


class ValueConfiguration(Configuration):
    """Hyperparameters that Q-learning has online and in batches."""

    exploration_probability: ExplorationProbability = 0.3
    exploration_share: ExplorationShare = 1 / 30
    exploration_decay_after: ExplorationDecay = 1440
    discount: float | None = Field(
        None,
        gt=0,
        le=1,
        description=(
            "discount of the TD error; if not given, 1 (mean cost), and the scenario's "
            "for the rules td and fit"
        ),
    )
    prior_width: Positive = Field(
        0.15,
        description="prior width of θ about its start, as a share of the start's cost",
    )
    level_width: Positive = Field(
        0.16,
        description="prior width of c_lambda, as a share of V's level",
    )
    offset_width: Positive = Field(
        0.02,
        description="prior width of c_f, in standard deviations of e",
    )
    back_off_width: Positive = Field(
        2.0,
        description=(
            "prior width of x_l and x_u, in standard deviations of e at prior_width = "
            "0.3, and in proportion to it"
        ),
    )
    slow_state_share: NonNegative = Field(
        0.3,
        description="a slow state moves by this share of its standard deviation where that is more "
        "than e's",
    )
    gradient_share: NonNegative = Field(
        0.3,
        description="width of a cost gradient as a share of the start's, where that is more than "
        "a shift's",
    )
    noise_width: Positive = Field(
        1.0,
        description="width of the logarithms of the estimator's variances, where θ has them",
    )
    measure_offset: bool = Field(
        True,
        description=(
            "c_f begins as the mean of the first prediction errors; false: as the start has it"
        ),
    )
    innovation_clip: Positive = Field(
        3.0,
        description="innovations are cut at this many standard deviations",
    )
    outlier: Positive = Field(
        25.0,
        description="squares of innovations beyond this many variances count as this many",
    )
    variance_memory: Positive = Field(
        2000.0,
        description="samples over which the innovations' variance is taken",
    )
    prediction_errors: Count = Field(
        1000,
        description="prediction errors over which the next penalty is expected",
    )
    persistence_doubt: NonNegative = Field(
        4.0,
        description="standard deviations by which errors must look correlated in time, or they "
        "count as independent",
    )
    largest_step: NonNegative = Field(
        1.0,
        description="prior deviations by which a step may move an entry of θ; 0: no limit",
    )

    def td_discount(self, scenario: Scenario) -> float:
        """Discount γ of the TD error; 1 is the mean cost."""
        return self.discount or 1.0

    def mean_cost_samples(self, time_constant: float) -> tuple[int, int]:
        """Samples over which the mean cost follows δ, and of the mean that ∇Q loses.

        Args:
            time_constant: the slowest of the nominal model, in samples.

        Returns:
            Both numbers; zero where the mean cost is fitted, and where ∇Q loses no mean.
        """
        return 0, 0


class QLearningConfiguration(ValueConfiguration):
    """Hyperparameters of online Q-learning."""

    rule: Literal["kalman", "td", "fit"] = Field(
        "kalman",
        description="Kalman filter with a prior on θ; αδ∇Q; or the fit's αδ∇Q/(1+α‖∇Q‖²)",
    )
    noise: bool = Field(
        False,
        description="put the estimator's variances into θ, under sensors",
    )
    margin: bool = Field(
        False,
        description="put back-offs that follow the estimate's deviation into θ, under sensors",
    )
    prior_samples: Count = Field(
        500,
        description="samples of the warm-up, without updates; they give noise and prior widths",
    )
    step_every: Count = Field(50, description="samples per step of θ")
    variance_memory: Positive = Field(
        200.0,
        description="samples over which the innovations' variance is taken",
    )
    mean_cost_memory: NonNegative = Field(
        1.625,
        description="time over which the mean cost follows δ, in slowest time constants of the "
        "nominal model; 0: the mean cost is fitted with θ",
    )
    gradient_mean_memory: NonNegative = Field(
        0.65,
        description=(
            "time of the running mean that ∇Q loses (the intercept), in slowest time "
            "constants of the nominal model, at least ten samples; 0: no intercept"
        ),
    )
    parameter_drift: NonNegative = Field(
        0.0,
        description=(
            "variance that each sample adds to θ, in units of the prior's, for plants that change"
        ),
    )
    step_size: Positive = Field(1e-3, description="rules td and fit: α")
    scaled: bool = Field(
        True,
        description="rules td and fit: step in coordinates θ/scale, else in θ itself",
    )

    def td_discount(self, scenario: Scenario) -> float:
        """Discount γ of the TD error; that of the rules td and fit is the scenario's."""
        by_default = 1.0 if self.rule == "kalman" else scenario.discount
        return self.discount or by_default

    def mean_cost_samples(self, time_constant: float) -> tuple[int, int]:
        """As above, by `mean_cost_memory` and `gradient_mean_memory`."""
        memory = round(self.mean_cost_memory * time_constant)
        gradient_memory = round(self.gradient_mean_memory * time_constant)
        if self.gradient_mean_memory:
            gradient_memory = max(gradient_memory, LEAST_MEAN_SAMPLES)
        if self.rule != "kalman" or not self.mean_cost_memory:
            return 0, 0
        # A mean cost that follows δ must be slower than the loop; the mean of ∇Q need not.
        return max(memory, 1), gradient_memory

    @property
    def full_exploration(self) -> float:
        """As above; the rules td and fit, as printed, explore as long as they run."""
        return super().full_exploration if self.rule == "kalman" else inf

    def without_part(self) -> Mapping[str, str]:
        """Hyperparameters of other rules than the chosen one."""
        names = ["step_size", "scaled"]
        if self.rule != "kalman":
            names = [name for name in ValueConfiguration.model_fields if name != "discount"]
            names += ["prior_samples", "step_every", "parameter_drift"]
            names += ["mean_cost_memory", "gradient_mean_memory"]
            for name in Configuration.model_fields:
                names.remove(name)
            names.append("exploration_decay_after")
        return dict.fromkeys(names, f"the rule {self.rule}")


def prior_deviation(
    start: Parameters,
    state_deviation: Vector,
    error_deviation: Vector,
    action_deviation: Vector,
    level: float,
    settings: ValueConfiguration,
) -> Vector:
    """Standard deviation of each entry of θ about its start, without units of any plant.

    With B a Hessian of the start, D = diag(B)^½ and κ = max_i B_ii σ_i² the cost of the most
    expensive typical move, entries of B get w·D_i D_j and gradients w·D_i √κ, with w the
    `prior_width` (docs/rules/q-learning.md).

    Args:
        start: θ at the start.
        state_deviation: σ of s, (n,).
        error_deviation: σ of the prediction errors e, (n,).
        action_deviation: σ of the exploration, (m,).
        level: size of c_lambda.
        settings: the widths.

    Returns:
        The deviations, (n_θ,).
    """
    # What a typical move of each state and action costs sets the size of θ's entries.
    width = settings.prior_width
    state_move = np.maximum(state_deviation, error_deviation)
    move = np.concatenate([state_move, action_deviation])
    stage = _root_diagonal(start["B_l"])
    terminal = _root_diagonal(start["B_Vf"])
    arrival = np.sqrt(np.abs(np.diag(start["B_lambda"])))
    initial = np.maximum(terminal, arrival)
    root_of_largest_cost = float((stage * move).max())
    slow = settings.slow_state_share * state_deviation
    # At a `prior_width` of 0.3 the bounds have the width that the setting says.
    relative_width = settings.back_off_width * width / 0.3
    bound = relative_width * np.maximum(error_deviation, slow)
    # A gradient may shift the minimum by as much as the most expensive typical move costs.
    terminal_shift = terminal * root_of_largest_cost
    stage_shift = stage * root_of_largest_cost
    share = settings.gradient_share
    initial_gradient = np.maximum(terminal_shift, np.abs(start["b_lambda"]))
    terminal_gradient = np.maximum(terminal_shift, share * np.abs(start["b_Vf"]))
    stage_gradient = np.maximum(stage_shift, share * np.abs(start["b_l"]))
    widths: dict[str, ArrayLike] = {
        "B_lambda": width * np.outer(initial, initial),
        "b_lambda": width * initial_gradient,
        "c_lambda": settings.level_width * abs(level),
        "B_Vf": width * np.outer(terminal, terminal),
        "b_Vf": width * terminal_gradient,
        "B_l": width * np.outer(stage, stage),
        "b_l": width * stage_gradient,
        "c_f": settings.offset_width * error_deviation,
        "x_l": bound,
        "x_u": bound,
    }
    # Weights and model parameters have a natural size: their own.
    for name in ("w_sigma", "W_sigma", "p"):
        if name in start.blocks:
            widths[name] = width * np.abs(start[name])
    if "noise" in start.blocks:
        widths["noise"] = np.full(start["noise"].size, settings.noise_width)
    if "margin" in start.blocks:
        # Counted in deviations already.
        widths["margin"] = np.full(start["margin"].size, relative_width)
    packed = [block.pack(widths[block.name]) for block in start.blocks]
    # An entry of no width would divide by zero where θ is scaled.
    floor = np.finfo(np.float64).tiny ** 0.25
    return np.maximum(np.concatenate(packed), floor)


def _root_diagonal(matrix: NDArray[np.float64]) -> Vector:
    """Square roots of the diagonal, 0 where it is negative."""
    diagonal = np.maximum(np.diag(matrix), 0.0)
    root: Vector = np.sqrt(diagonal)
    return root


class ValueRule(Algorithm):
    """Common part of online and batch Q-learning: prediction errors, a mean cost, coordinates."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._model = OneStepModel(self.scenario)
        self._errors = PredictionErrors(self.scenario, self.configuration.prediction_errors)
        # The mean cost must be slower than the plant, or it follows each transient.
        memory, gradient_memory = self.configuration.mean_cost_samples(self._model.slowest)
        blocks = self.controller.parameters.blocks
        self._average_cost = AverageCost(
            discount=self.configuration.td_discount(self.scenario),
            position=blocks.slices["c_lambda"].start,
            scale=1.0,
            start=self.scenario.controller.reference_cost,
            memory=memory,
            gradient_memory=gradient_memory,
        )
        # θ's own units, until the first samples have given the widths.
        self._set_coordinates(np.ones(self.controller.theta.size))

    def _set_coordinates(self, scale: Vector) -> None:
        """Take this scale of each entry of θ, (n_θ,), as the steps' coordinates from here on."""
        self._step = ConstrainedStep(self.controller, self.configuration, scale)
        self._average_cost.set_scale(scale)

    def _begin_with_prior(
        self,
        states: Matrix,
        errors: Matrix,
        noise: float,
    ) -> Parameters:
        """The prior's mean; its deviations become the coordinates.

        Args:
            states: s of the first samples, (K, n).
            errors: their prediction errors e, (K, n).
            noise: standard deviation of the TD errors, which c_lambda's level is not below.
        """
        start = self.controller.parameters
        # The mean error is measured, so it need not be learned from costs.
        if self.configuration.measure_offset:
            start = start.replace({"c_f": errors.mean(axis=0)})
        level = abs(float(start["c_lambda"]))
        deviation = prior_deviation(
            start,
            state_deviation=states.std(axis=0),
            error_deviation=errors.std(axis=0),
            action_deviation=self.strategy.deviation,
            level=max(level, noise),
            settings=self.configuration,
        )
        self._set_coordinates(deviation)
        return start

    def state_dict(self) -> State:
        """Coordinates, mean cost and prediction errors."""
        return {
            **prefixed("step", self._step.state_dict()),
            **prefixed("average_cost", self._average_cost.state_dict()),
            **prefixed("errors", self._errors.state_dict()),
        }

    def load_state_dict(self, state: State) -> None:
        """Restore what `state_dict` returned."""
        self._step.load_state_dict(part_of(state, "step"))
        self._average_cost.load_state_dict(part_of(state, "average_cost"))
        self._errors.load_state_dict(part_of(state, "errors"))


class QLearning(ValueRule):
    """Online Q-learning by the configuration's rule.

    `td` and `fit` step on each sample's δ = ℓ + γV_θ(s₊) − Q_θ(s, a) (paper.tex, eq. Qlearning).

    `kalman` is an extended Kalman filter for Q with a fixed target and the next penalty in
    expectation: θ ~ N(θ₀, diag(σ²)) with the widths of `prior_deviation`. One TD error measures
    ∇Qᵀd with variance r (`KalmanRegression`):

        δ = ℓ + p(s) + γ[V_θ(s₊) − p(s₊) + mean_i p(f(s, a) + e_i)] − Q_θ(s, a)

    with f the controller's nominal model and e_i its latest prediction errors. Every `step_every`
    samples θ moves by d under its constraints, in the metric P⁻¹. The warm-up of `prior_samples`
    moves only c_f, which becomes the mean of e (docs/rules/q-learning.md).
    """

    learns_from_estimates = True
    learns_under_signals = True

    Configuration = QLearningConfiguration
    needs_q_solution = True

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        settings = self.configuration
        if settings.rule != "kalman" and settings.scaled:
            self._set_coordinates(self.controller.parameters.blocks.scale)
        self._warm_up: list[list[float]] = []  # rows (s, e, δ)
        self._regression = self._new_regression(1.0)
        self._count = 0
        self._sum_of_squares = 0.0  # of the innovations since the last step

    def observe(self, transition: Transition) -> Update | None:
        """Learn from one sample; every `step_every`-th moves θ, with `td` and `fit` every one."""
        if self.configuration.rule != "kalman":
            return self._sample_step(transition)

        prediction = self._model(transition.s, transition.a)
        error = transition.next_s - prediction
        # First the error, so that the expectation has at least one.
        self._errors.add(error, transition.next_variances)
        # The realised penalty of s₊ is replaced by its expectation.
        expected = self._errors.expected_penalty(prediction, transition.moved_penalty)
        next_value = transition.next_solution.value - transition.next_penalty + expected
        solution = transition.q_solution
        # What the hour's prices cost whatever is done teaches nothing.
        cost = transition.cost - transition.signal_cost
        target = self._average_cost.target(cost, next_value)
        td_error = target - solution.value
        mean_cost = self._average_cost.mean_cost
        self._average_cost.follow(td_error)
        gradient = self._average_cost.without_level(solution.value_gradient)

        self._count += 1
        # In the warm-up no θ moves: its samples say how large noise and errors are.
        left = self.configuration.prior_samples - self._count
        if left >= 0:
            # The mean cost is not known yet: δ is kept with it.
            level = td_error + mean_cost
            row = [*transition.s.tolist(), *error.tolist(), level]
            self._warm_up.append(row)
            return self._begin_regression() if left == 0 else None

        # From here on each sample is a measurement of the step.
        innovation = self._regression.update(td_error, gradient * self._step.scale)
        self._sum_of_squares += innovation * innovation
        if self._count % self.configuration.step_every:
            return None
        mean_square = self._sum_of_squares / self.configuration.step_every
        error_size = mean_square**0.5
        self._sum_of_squares = 0.0
        fit = self._average_cost.absorb(self._regression.step())
        return self._step.apply(fit, error_size)

    def _begin_regression(self) -> Update:
        """Take the noise, the widths and c_f from the samples of the warm-up."""
        rows = np.array(self._warm_up)
        self._warm_up.clear()
        n = self._model.n_states
        states = rows[:, :n]
        errors = rows[:, n:-1]
        levels = rows[:, -1]
        # The start's TD errors are the noise that the filter expects.
        td_errors = self._average_cost.begin(levels)
        variance = float(np.mean(td_errors**2))
        if not np.isfinite(variance):
            raise DivergenceError("TD errors are not finite")
        deviation = variance**0.5
        start = self._begin_with_prior(states, errors, deviation)
        least_variance = np.finfo(np.float64).tiny
        doubt = self.configuration.persistence_doubt
        self._regression = self._new_regression(max(variance, least_variance))
        self._regression.redundancy = redundancy_of(states, errors, doubt)
        return self._step.move(start.theta, deviation)

    def _new_regression(self, variance: float) -> KalmanRegression:
        settings = self.configuration
        return KalmanRegression(
            size=self._step.scale.size,
            variance=variance,
            clip=settings.innovation_clip,
            memory=settings.variance_memory,
            drift=settings.parameter_drift,
            largest=settings.largest_step or np.inf,
            outlier=settings.outlier,
        )

    def _sample_step(self, transition: Transition) -> Update:
        """A step on one sample, as the paper prints it."""
        settings = self.configuration
        solution = transition.q_solution
        target = self._average_cost.target(transition.cost, transition.next_solution.value)
        td_error = target - solution.value
        gradient = solution.value_gradient * self._step.scale
        rule = td_fit if settings.rule == "fit" else td_step
        fit = rule(td_error, gradient, settings.step_size)
        # At a discount of 1 the fit's part of the level goes to the mean cost.
        fit = self._average_cost.absorb(fit)
        return self._step.apply(fit, abs(td_error))

    def begin_anew(self) -> None:
        """Forget noise and widths; the next samples are a warm-up at the present θ."""
        self._count = 0
        self._warm_up = []

    def retreat(self) -> None:
        """Begin anew at the θ to which the loop has gone back."""
        self.begin_anew()
        self._sum_of_squares = 0.0

    def state_dict(self) -> State:
        """State of `ValueRule`, the warm-up's rows, and the regression."""
        return {
            **super().state_dict(),
            **prefixed("regression", self._regression.state_dict()),
            "warm_up": np.array(self._warm_up),
            "count": self._count,
            "sum_of_squares": self._sum_of_squares,
        }

    def load_state_dict(self, state: State) -> None:
        """Restore what `state_dict` returned."""
        super().load_state_dict(state)
        self._regression.load_state_dict(part_of(state, "regression"))
        self._warm_up = state["warm_up"].tolist()
        self._count = state["count"]
        self._sum_of_squares = state["sum_of_squares"]


def redundancy_of(states: Matrix, errors: Matrix, doubt: float) -> float:
    """Consecutive samples that say as much as one independent sample, by the prediction errors.

    A disturbance with a memory makes errors, and with them TD errors, that are correlated in time.
    Errors that follow the state are those of a wrong model, which θ may correct: they do not count.

    Args:
        states: s of consecutive samples, (K, n).
        errors: their prediction errors e, (K, n).
        doubt: standard deviations by which they must look correlated in time.

    Returns:
        (1 + ρ)/(1 − ρ) of their autoregression; 1 where independent errors would look like it.
    """
    n_errors, n = errors.shape
    # Of few errors the fits would leave nothing.
    if n_errors < 25 * n:
        return 1.0
    left = errors - linear_part(states, errors)
    unknown = np.zeros((n, n))
    persistence = estimate_persistence(left[1:], left[:-1], unknown, n_earlier=0, doubt=doubt)
    return 1.0 / effective_number(persistence, 1)


@dataclass
class KalmanRegression:
    """d ~ N(0, I) in scaled coordinates; each δ measures ∇Qᵀd with variance r.

        K = P∇Q/(r + ∇QᵀP∇Q),  d ← d + K·clip(δ − ∇Qᵀd),  P ← P − K∇QᵀP

    Without clip and with r constant this is the ridge regression min Σ(δ−∇Qᵀd)²/r + ‖d‖².

    Args:
        size: entries of d.
        variance: r at first; it follows the innovations' mean square.
        clip: the innovation is clipped at ±clip·√r.
        memory: samples over which r follows.
        drift: added to P's diagonal at each sample.
        largest: a step has no entry beyond ±largest.
        outlier: squares of innovations beyond this many r count as this many.
        redundancy: consecutive samples that say as much as one independent sample; the noise of
            a sample counts as r times this.
    """

    size: int
    variance: float
    clip: float
    memory: float
    drift: float = 0.0
    largest: float = np.inf
    outlier: float = 25.0
    redundancy: float = 1.0

    def __post_init__(self) -> None:
        self.mean: Vector = np.zeros(self.size)
        self.covariance: Matrix = np.eye(self.size)
        self.covariance_at_step = self.covariance.copy()
        """P at the last step."""

    def update(self, td_error: float, gradient: Vector) -> float:
        """Learn from one sample.

        Args:
            td_error: δ.
            gradient: ∇Q, (n,), scaled.

        Returns:
            The innovation δ − ∇Qᵀd.
        """
        # The Kalman recursion for one scalar measurement.
        spread = self.covariance @ gradient
        # Noise that lasts tells the same again: the filter takes each sample for less.
        noise = self.redundancy * self.variance
        scale = noise + float(gradient @ spread)
        innovation = td_error - float(gradient @ self.mean)
        # A rare spike of the cost must not move θ as far as a hundred samples do.
        limit = self.clip * self.variance**0.5
        clipped = min(max(innovation, -limit), limit)
        gain = spread / scale
        self.mean += gain * clipped
        self.covariance -= gain[:, None] * spread
        # A plant that drifts makes what was learned less certain.
        if self.drift:
            diagonal = np.diag_indices_from(self.covariance)
            self.covariance[diagonal] += self.drift
        # The variance follows slowly, and an outlier counts as a bounded one.
        largest_square = self.outlier * self.variance
        square = min(innovation * innovation, largest_square)
        self.variance += (square - self.variance) / self.memory
        return innovation

    def step(self) -> Fit:
        """The step d in the metric P⁻¹; d then starts from zero again.

        Of a step that is too long only a share is taken, and that share of P's decrease.
        """
        longest = float(np.abs(self.mean).max())
        if longest > self.largest:
            share = self.largest / longest
            decrease = self.covariance - self.covariance_at_step
            self.mean *= share
            self.covariance = self.covariance_at_step + share * decrease
        self.covariance_at_step = self.covariance.copy()
        # Rounding makes P asymmetric over thousands of updates.
        symmetric = (self.covariance + self.covariance.T) / 2
        information: Matrix = np.linalg.inv(symmetric).astype(np.float64)
        # From the new θ on, d is counted from zero.
        step = self.mean
        self.mean = np.zeros_like(step)
        return Fit(information @ step, step, lambda: information)

    def state_dict(self) -> State:
        """Mean, covariances and variance."""
        return {
            "mean": self.mean,
            "covariance": self.covariance,
            "covariance_at_step": self.covariance_at_step,
            "variance": self.variance,
            "redundancy": self.redundancy,
        }

    def load_state_dict(self, state: State) -> None:
        """Restore what `state_dict` returned."""
        self.mean = state["mean"]
        self.covariance = state["covariance"]
        self.covariance_at_step = state["covariance_at_step"]
        self.variance = state["variance"]
        self.redundancy = state["redundancy"]


class AverageCost:
    """δ = ℓ + γV(s₊) − Q(s, a), and at γ = 1 δ = ℓ − g + V(s₊) − Q(s, a), with g learned.

    At γ = 1 the constant c_lambda cancels out of δ, and Q with any constant added is as good. So
    c_lambda stays, and g is found in one of three ways:

    - It is fitted with θ, in c_lambda's place.
    - It follows δ: each sample takes g ← g + δ/memory, differential Q-learning after Wan, Naik and
      Sutton (2021). The fit of θ is then one with an intercept that is forgotten: ∇Q loses its
      running mean, for without that the mean pays the level of δ into θ (docs/rules/q-learning.md).
    - It is the intercept of a batch (`centre`).

    Args:
        discount: γ.
        position: of c_lambda in θ.
        scale: of c_lambda in the fit's coordinates.
        start: first guess of g.
        memory: samples over which g follows δ; 0: g is fitted with θ.
        gradient_memory: samples of the running mean that ∇Q loses; 0: it loses none.
    """

    def __init__(
        self,
        discount: float,
        position: int,
        scale: float,
        start: float,
        memory: int = 0,
        gradient_memory: int = 0,
    ) -> None:
        self.discount = discount
        self.mean_cost = start if discount == 1.0 else 0.0
        self._position = position
        self._scale = scale
        self._memory = memory if discount == 1.0 else 0
        self._gradient_memory = gradient_memory
        self._gradient_mean: Vector = np.zeros(0)  # (n_θ,) from the first sample on
        self._count = 0  # samples in that mean

    def begin(self, levels: Vector) -> Vector:
        """Take the mean cost from the first samples, all at one θ.

        Args:
            levels: δ + g of each, (K,).

        Returns:
            Their δ, (K,). At γ = 1 its mean is zero, so a constant in the cost is without effect.
        """
        if self.discount == 1.0:
            self.mean_cost = float(levels.mean())
        return levels - self.mean_cost

    def follow(self, td_error: float) -> None:
        """Move g by a sample's δ, where it is no part of the fit."""
        if self._memory:
            self.mean_cost += td_error / self._memory

    def without_level(self, gradient: Vector) -> Vector:
        """∇Q (n_θ,), unscaled, less its running mean if g follows δ; a call a sample.

        c_lambda's entry is always one, so the mean takes it out.
        """
        if not self._memory:
            return gradient
        if not self._gradient_memory:
            fitted = gradient.copy()
            fitted[self._position] = 0.0
            return fitted
        # The plain mean of the first samples, then an exponential one.
        if not self._count:
            self._gradient_mean = np.zeros_like(gradient)
        self._count += 1
        window = min(self._count, self._gradient_memory)
        self._gradient_mean += (gradient - self._gradient_mean) / window
        centred: Vector = gradient - self._gradient_mean
        return centred

    def centre(self, td_errors: Vector, gradients: Matrix) -> tuple[Vector, Matrix]:
        """Make a batch's fit one with an intercept at γ = 1, which g takes.

        Args:
            td_errors: δ, (K,).
            gradients: ∇Q, (K, n_θ).

        Returns:
            Both less their means, in which c_lambda's entry vanishes; unchanged at γ < 1.
        """
        if self.discount != 1.0:
            return td_errors, gradients
        # The mean of ∇Q would pay the level into θ.
        level = float(td_errors.mean())
        mean_gradient = gradients.mean(axis=0)
        self.mean_cost += level
        return td_errors - level, gradients - mean_gradient

    def target(self, cost: Values, next_value: Values) -> Values:
        """Target of Q(s, a), of one sample or of several.

        Args:
            cost: ℓ plus the penalty of s, a number or (K,).
            next_value: V(s₊), a number or (K,).
        """
        return cost - self.mean_cost + self.discount * next_value

    def set_scale(self, scale: Vector) -> None:
        """Take over the scale of each entry of θ in the fit's coordinates, (n_θ,)."""
        self._scale = float(scale[self._position])

    def absorb(self, fit: Fit) -> Fit:
        """Move g by its part of a fit's step; returns the rest, which is for θ."""
        if self.discount != 1.0:
            return fit
        # c_lambda stays, since it cancels out of δ at γ = 1.
        minimiser = fit.minimiser.copy()
        level = float(minimiser[self._position])
        self.mean_cost += level * self._scale
        minimiser[self._position] = 0.0
        gradient = fit.metric() @ minimiser
        return replace(fit, gradient=gradient, minimiser=minimiser)

    def state_dict(self) -> State:
        """g, the scale of its entry, and the mean of ∇Q."""
        return {
            "mean_cost": self.mean_cost,
            "scale": self._scale,
            "gradient_mean": self._gradient_mean,
            "count": self._count,
        }

    def load_state_dict(self, state: State) -> None:
        """Restore what `state_dict` returned."""
        self.mean_cost = state["mean_cost"]
        self._scale = state["scale"]
        self._gradient_mean = state["gradient_mean"]
        self._count = state["count"]
