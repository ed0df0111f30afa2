"""Predicted cost of θ on the disturbances of a log.

The model's errors are played back in their order, so that under the logged actions it repeats the
log, and two controllers meet the same. This is done for draws from the posterior of the model's
coefficients. The intervals so hold the doubt about the plant, beside the chance of its
disturbances.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from controllers.problem import Problem
from cosim.core.protocols import Array, Vector
from cosim.core.statistics import LEVEL, Estimate
from learning.empirical_model import EmpiricalModel
from learning.model_based import ExpectedCosts, ModelBasedConfiguration
from learning.rollout import Rollout


class PredictedCosts(NamedTuple):
    """Costs that D drawn models predict of the M samples that count.

    Attributes:
        thetas: of each θ, (D, M) each; infinite where a model's rollout is lost.
        logged: of the logged operation, (D, M).
        outside: share of the first θ's samples in which a state is where the plant has not been.
    """

    thetas: list[Array]
    logged: Array
    outside: float


class Expectation:
    """Expected costs of the samples of a rollout, as shares in the mean cost.

    An error of the log has two parts in the mean: it moved the states that followed, and it is one
    of the errors over which each sample's penalty is expected. A rare error makes most of a
    penalty, so that both belong in the share of its sample: their chance is one.

    Args:
        problem: has the penalty.
        model: its errors are those of the log, in their order.
        settings: of the expected penalty.
        number: of the model, so that each weighs its errors at other samples.
        burn_in: samples before those that count.
    """

    def __init__(
        self,
        problem: Problem,
        model: EmpiricalModel,
        settings: ModelBasedConfiguration,
        number: int,
        burn_in: int,
    ) -> None:
        self._expected = ExpectedCosts(problem, model, settings)
        self._penalty = problem.penalty
        self._errors = model.residuals[:, : problem.n_states]
        self._number = number
        self._burn_in = burn_in

    def __call__(self, predicted: Array, h: Array) -> Array:
        """Shares in the mean cost of the samples that count, of the mean of their expected costs.

        Args:
            predicted: (s₊, ℓ) without residual, (T, K).
            h: sizes of the errors, (T, K).
        """
        with np.errstate(over="ignore", invalid="ignore"):
            costs, _ = self._expected(predicted, h)
            counted = costs[self._burn_in :]
            penalties = self._by_error(predicted, h)[self._burn_in :]
            shares: Array = counted + penalties - penalties.mean()
            return shares

    def _by_error(self, predicted: Array, h: Array) -> Array:
        """Mean penalty of the samples if each had this one error, (T,)."""
        count, n = self._errors.shape
        # All models together weigh an error at a thousand samples.
        every = max(count // 64, 1)
        rows = np.arange(self._number % every, count, every)
        errors = h[rows, None, :n] * self._errors
        states = predicted[rows, None, :n] + errors
        penalties = self._penalty.along(states.reshape(-1, n))
        mean: Array = penalties.reshape(len(rows), count).mean(axis=0)
        return mean


class Prediction:
    """Predicts what θ would have cost on the disturbances of a log.

    Args:
        problem: has the penalty.
        rollout: of the problem's controller.
        model: the estimate from the log.
        inputs: (s, a), (M, n+m).
        outputs: (s₊, ℓ), (M, K).
        settings: of the fit, of the expected penalty and of the samples before a rollout counts.
        follows: whether each transition begins where the one before ends, (M,).
    """

    def __init__(
        self,
        problem: Problem,
        rollout: Rollout,
        model: EmpiricalModel,
        inputs: Array,
        outputs: Array,
        settings: ModelBasedConfiguration,
        follows: NDArray[np.bool_],
    ) -> None:
        self._problem = problem
        self._rollout = rollout
        self._model = model
        self._follows = follows
        self._inputs = inputs
        self._outputs = outputs
        # A search widens the tails to be safe, a prediction must not be biased.
        self._settings = settings.model_copy(update={"tail_widening": 0.0})
        # A short log must not be burnt in whole.
        self._burn_in = min(settings.burn_in, len(inputs) // 4)

    def costs(
        self,
        thetas: Sequence[Vector],
        count: int,
        rng: np.random.Generator,
    ) -> PredictedCosts:
        """Costs of θ and of the log, by models drawn from the posterior.

        Args:
            thetas: θ (n_θ,) each.
            count: number of models.
            rng: draws them.
        """
        # All begin at the log's first state.
        n_samples = len(self._inputs)
        start = self._inputs[0, : self._problem.n_states]
        picks = np.arange(n_samples, dtype=np.int32)
        shape = (count, n_samples - self._burn_in)
        logged = np.empty(shape)
        costs = []
        for _ in thetas:
            costs.append(np.full(shape, np.inf))
        outside = []
        models = self._model.draws(
            self._inputs,
            self._outputs,
            self._settings,
            count,
            rng,
            self._follows,
        )
        for number, drawn in enumerate(models):
            model, errors_before = self._repeating(drawn)
            expectation = Expectation(self._problem, model, self._settings, number, self._burn_in)
            predicted, h, _ = model.predict(self._inputs)
            persists = h * (errors_before @ model.persistence.T)
            logged[number] = expectation(predicted + persists, h)
            # A rollout beyond a million times the log's largest cost has run away.
            limit = 1e6 * float(np.abs(logged[number]).max())
            rollouts = self._rollout(thetas, start, model, picks)
            for cost, samples in zip(costs, rollouts, strict=True):
                # A loop that runs away ends early.
                if len(samples.inputs) < n_samples:
                    continue
                shares = expectation(samples.predicted, samples.h)
                # A NaN is not below, either.
                if (np.abs(shares) < limit).all():
                    cost[number] = shares
            states = rollouts[0].inputs[self._burn_in :, : self._problem.n_states]
            if len(states):
                outside.append(self._share_outside(states))
        share_outside = float(np.mean(outside)) if outside else 1.0
        return PredictedCosts(costs, logged, share_outside)

    def _share_outside(self, states: Array) -> float:
        """Share of states (·, n) where the plant has not been."""
        n = self._problem.n_states
        low = self._inputs.min(axis=0)[:n]
        high = self._inputs.max(axis=0)[:n]
        is_outside = (states < low) | (states > high)
        return float(is_outside.any(axis=1).mean())

    def _repeating(self, drawn: EmpiricalModel) -> tuple[EmpiricalModel, Array]:
        """A model with the errors that it makes of the log, in their order.

        Under the logged actions it repeats the log, whatever its coefficients.

        Args:
            drawn: the model.

        Returns:
            The model, and r of the sample before each, (M, K).
        """
        predicted, h, _ = drawn.predict(self._inputs)
        errors = (self._outputs - predicted) / h
        # A rollout begins without one, and after a gap goes on from the last one before it.
        before = np.concatenate([np.zeros_like(errors[:1]), errors[:-1]])
        residuals = errors - before @ drawn.persistence.T
        return replace(drawn, residuals=residuals), before


def difference(
    costs: Array,
    others: Array,
    stretches: Sequence[int],
) -> tuple[Estimate, float]:
    """Mean difference of predicted costs, with an interval that holds model and chance.

    The variance is that over models, of the mean over samples, and that of the mean over stretches
    of the log, of the mean over models.

    Args:
        costs: of D models and M samples, (D, M).
        others: what is subtracted, (D, M).
        stretches: numbers of stretches that the log is parted in; the one counts by which the mean
            spreads most.

    Returns:
        The estimate, without interval where a model's cost is not finite; and the models' share of
        its variance.
    """
    if not np.isfinite(costs).all():
        return Estimate(np.inf), 1.0
    if not np.isfinite(others).all():
        return Estimate(-np.inf), 1.0
    differences = costs - others
    chance = _chance(differences.mean(axis=0), stretches)
    return _estimate(differences.mean(axis=1), [chance])


def difference_of_separate(
    costs: Array,
    others: Array,
    stretches: Sequence[int],
) -> tuple[Estimate, float]:
    """The same where the two met disturbances that have nothing to do with each other.

    Args:
        costs: of D models and T samples, (D, T).
        others: what is subtracted, of the same models and M samples, (D, M).
        stretches: numbers of stretches that the samples are parted in.
    """
    if not np.isfinite(costs).all():
        return Estimate(np.inf), 1.0
    mean_by_model = costs.mean(axis=1) - others.mean(axis=1)
    chances = []
    for values in (costs, others):
        chances.append(_chance(values.mean(axis=0), stretches))
    return _estimate(mean_by_model, chances)


def _estimate(mean_by_model: Array, chances: list[tuple[float, int]]) -> tuple[Estimate, float]:
    """Mean of the models' differences (D,) with its interval, and the models' share of the doubt.

    Args:
        mean_by_model: of each model.
        chances: variances of the mean by the disturbances, with their degrees of freedom.
    """
    value = float(mean_by_model.mean())
    variance_of_models = float(mean_by_model.var(ddof=1))
    sources = [(variance_of_models, len(mean_by_model) - 1), *chances]
    variance = 0.0
    for of_source, _ in sources:
        variance += of_source
    if not variance:
        return Estimate(value, (value, value)), 0.0
    # Degrees of freedom of a sum of variances (Welch and Satterthwaite).
    parts = 0.0
    for of_source, freedom in sources:
        parts += (of_source / variance) ** 2 / freedom
    quantile = float(stdtrit(1.0 / parts, 0.5 + LEVEL / 2))
    half_width = quantile * variance**0.5
    interval = (value - half_width, value + half_width)
    return Estimate(value, interval), variance_of_models / variance


def _chance(values: Array, stretches: Sequence[int]) -> tuple[float, int]:
    """Variance of the mean of values in time, (M,), and its degrees of freedom.

    Values that are correlated for hours leave stretches that are not independent: the longer ones
    count where their means spread more.
    """
    variance = 0.0
    freedom = stretches[0] - 1
    for count in stretches:
        means = []
        for stretch in np.array_split(values, count):
            means.append(stretch.mean())
        of_the_mean = float(np.var(means, ddof=1)) / count
        if of_the_mean >= variance:
            variance = of_the_mean
            freedom = count - 1
    return variance, freedom
