"""What θ would have cost on the disturbances of a log.

The model's errors are played back in their order, so that under the logged actions it repeats the
log, and two controllers meet the same. This is done for draws from the posterior of the model's
coefficients, so that the intervals hold what the log does not say of the plant, beside the chance
of its disturbances.
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


class Costs(NamedTuple):
    """Costs that D drawn models predict of the M samples that count.

    Attributes:
        samples: (D, M); infinite where a model's rollout is lost.
        other_errors: the mean of each model with as many errors, drawn anew from those that it
            made of the log, less that with all of them, (D,).
    """

    samples: Array
    other_errors: Array

    @classmethod
    def none(cls, n_models: int, n_samples: int) -> Costs:
        """Of rollouts that are all lost."""
        return cls(np.full((n_models, n_samples), np.inf), np.zeros(n_models))


class PredictedCosts(NamedTuple):
    """What is predicted of several θ and of the log.

    Attributes:
        thetas: of each θ.
        logged: of the logged operation.
        outside: share of the first θ's samples in which a state is where the plant has not been.
    """

    thetas: list[Costs]
    logged: Costs
    outside: float


class _Expectation:
    """What a model expects of samples, with its errors and with as many drawn anew from them.

    Rare errors make most of a penalty: how many of them a log happens to have is its chance, too.

    Args:
        problem: has the penalty.
        model: has the errors.
        settings: of the expected penalty.
        burn_in: samples before those that count.
        rng: draws errors.
    """

    def __init__(
        self,
        problem: Problem,
        model: EmpiricalModel,
        settings: ModelBasedConfiguration,
        burn_in: int,
        rng: np.random.Generator,
    ) -> None:
        n_errors = len(model.residuals)
        drawn_anew = rng.integers(n_errors, size=n_errors)
        other = replace(model, residuals=model.residuals[drawn_anew])
        self._expected = ExpectedCosts(problem, model, settings)
        self._expected_of_other = ExpectedCosts(problem, other, settings)
        self._burn_in = burn_in

    def keep(
        self,
        costs: Costs,
        number: int,
        predicted: Array,
        h: Array,
        limit: float = np.inf,
    ) -> None:
        """Store the costs of samples, unless one is above the limit.

        Args:
            costs: where they are stored.
            number: of the model.
            predicted: (s₊, ℓ) without residual, (T, K).
            h: sizes of the errors, (T, K).
            limit: of the magnitude of a sample's cost.
        """
        with np.errstate(over="ignore", invalid="ignore"):
            of_all, _ = self._expected(predicted, h)
            of_other, _ = self._expected_of_other(predicted, h)
        # A NaN is not below, either.
        if (np.abs(of_all) < limit).all():
            counted = of_all[self._burn_in :]
            counted_of_other = of_other[self._burn_in :]
            costs.samples[number] = counted
            costs.other_errors[number] = (counted_of_other - counted).mean()


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
        n_counted = n_samples - self._burn_in
        logged = Costs.none(count, n_counted)
        costs = []
        for _ in thetas:
            costs.append(Costs.none(count, n_counted))
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
            expectation = _Expectation(self._problem, model, self._settings, self._burn_in, rng)
            predicted, h, _ = model.predict(self._inputs)
            persists = h * (errors_before @ model.persistence.T)
            expectation.keep(logged, number, predicted + persists, h)
            # A rollout beyond a million times the log's largest cost has run away.
            limit = 1e6 * float(np.abs(logged.samples[number]).max())
            rollouts = self._rollout(thetas, start, model, picks)
            for cost, samples in zip(costs, rollouts, strict=True):
                # A loop that runs away ends early.
                if len(samples.inputs) == n_samples:
                    expectation.keep(cost, number, samples.predicted, samples.h, limit)
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
    costs: Costs,
    others: Costs,
    stretches: Sequence[int],
) -> tuple[Estimate, float]:
    """Mean difference of predicted costs, with an interval that holds model and chance.

    The variance is that over models, of the mean over samples; that of the mean over stretches of
    the log, of the mean over models; and that of the errors which the log happens to have.

    Args:
        costs: of D models and M samples.
        others: what is subtracted.
        stretches: numbers of stretches that the log is parted in; the one counts by which the mean
            spreads most.

    Returns:
        The estimate, without interval where a model's cost is not finite; and the models' share of
        its variance.
    """
    if not np.isfinite(costs.samples).all():
        return Estimate(np.inf), 1.0
    if not np.isfinite(others.samples).all():
        return Estimate(-np.inf), 1.0
    differences = costs.samples - others.samples
    mean_by_model = differences.mean(axis=1)
    value = float(mean_by_model.mean())
    freedom_of_models = len(differences) - 1
    variance_of_models = float(mean_by_model.var(ddof=1))
    by_other_errors = costs.other_errors - others.other_errors
    variance_of_errors = float(np.mean(by_other_errors**2))
    mean_by_sample = differences.mean(axis=0)
    variance_of_chance, freedom_of_chance = _chance(mean_by_sample, stretches)

    parts = [
        (variance_of_models, freedom_of_models),
        (variance_of_errors, len(differences)),
        (variance_of_chance, freedom_of_chance),
    ]
    variance = sum(part for part, _ in parts)
    if not variance:
        return Estimate(value, (value, value)), 0.0
    # Degrees of freedom of a sum of variances (Welch and Satterthwaite).
    freedom = 1.0 / sum((part / variance) ** 2 / of_part for part, of_part in parts)
    quantile = float(stdtrit(freedom, 0.5 + LEVEL / 2))
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
