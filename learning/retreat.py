"""Retreat: operation goes back to the cheapest θ that it has shown to be cheap.

Each shift the realised cost is set beside that of the best θ so far, the start's at first. Where
it is higher by more than chance, θ goes back, and stays for a shift in which its cost is measured
anew.
Costs are means of batches, long enough to be nearly independent: so the comparison allows for
costs that are correlated in time, and one rare penalty widens the interval that it moves.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import stdtr

from cosim.core.protocols import Array, Vector
from learning.checkpoint import State

BATCHES = 8
"""Batches of a shift; of eight hours, each is an hour."""


class ShownCost(NamedTuple):
    """The realised cost of a θ.

    Attributes:
        theta: θ, (n_θ,).
        batches: mean costs of its batches, (B,).
    """

    theta: Vector
    batches: Array

    @property
    def mean(self) -> float:
        """Mean cost per sample."""
        return float(self.batches.mean())

    @property
    def variance(self) -> float:
        """Variance of the mean, by the spread of the batches."""
        of_a_batch = self.batches.var(ddof=1)
        return float(of_a_batch / len(self.batches))


def exceeds(
    one: ShownCost,
    other: ShownCost,
    probability: float,
) -> bool:
    """Whether a cost is above another one by Welch's test.

    Args:
        one: a cost.
        other: the other one.
        probability: of an error where both are the same.
    """
    # A cost that is not finite is above any other, and leaves no test.
    if not np.isfinite(one.batches).all():
        return True
    # Equal variances that are both zero leave no test: then the means decide.
    if one.variance + other.variance == 0:
        return one.mean > other.mean
    from scipy.stats import ttest_ind  # noqa: PLC0415 - most of a second, of few trainings

    test = ttest_ind(one.batches, other.batches, equal_var=False, alternative="greater")
    return bool(test.pvalue < probability)


def exceeds_prediction(
    cost: ShownCost,
    predicted: float,
    probability: float,
) -> bool:
    """Whether a cost is above a predicted one by Student's test; not where none is predicted.

    Args:
        cost: the realised one.
        predicted: mean cost per sample; not finite where none is predicted.
        probability: of an error where the prediction is right.
    """
    if not np.isfinite(predicted):
        return False
    excess = cost.mean - predicted
    # Equal batches leave no test: then the means decide.
    if cost.variance == 0:
        return excess > 0
    degrees_of_freedom = len(cost.batches) - 1
    deviation = cost.variance**0.5
    tail = stdtr(degrees_of_freedom, -excess / deviation)
    return bool(tail < probability)


class Retreat:
    """Compares shifts and says to which θ to go back.

    A shift counts for the θ of its middle, since a rule may move θ in it. Another θ becomes the
    best one when it is shown to cost less, or where the best one's cost is hardly known. After a
    retreat the rule has to wait for a shift, then for two, four, and so on. If the best θ, measured
    anew, costs more than what was left, the plant has changed, and the retreat is taken back.

    Args:
        start: the first θ, (n_θ,).
        shift: samples of a shift.
        probability: that a shift goes back although both θ cost the same.

    Attributes:
        count: retreats so far.
        samples_to_wait: in which θ has to stay.
    """

    def __init__(
        self,
        start: Vector,
        shift: int,
        probability: float,
    ) -> None:
        self._start = start
        self._batch = max(shift // BATCHES, 1)
        self._probability = probability
        self._costs: list[float] = []  # of the present shift
        self._theta = start  # in the middle of it
        self._has_moved = False  # from the start
        self._best: ShownCost | None = None
        self._left: ShownCost | None = None  # by the last retreat, until its shift has ended
        self.count = 0
        self.samples_to_wait = 0

    @property
    def shift(self) -> int:
        """Samples of a shift."""
        return self._batch * BATCHES

    @property
    def best_theta(self) -> Vector:
        """θ that has been shown to cost least, (n_θ,); the start where none has been."""
        return self._start if self._best is None else self._best.theta

    def observe(
        self,
        cost: float,
        theta: Vector,
        predicted: float = float("nan"),
    ) -> Vector | None:
        """Count a sample.

        Args:
            cost: of the sample, stage cost and penalty.
            theta: θ after the sample and its update, (n_θ,).
            predicted: what the rule expects θ to cost on average.

        Returns:
            θ to go back to, (n_θ,); None: θ stays as it is.
        """
        self._costs.append(cost)
        self.samples_to_wait = max(self.samples_to_wait - 1, 0)
        if not self._has_moved and not np.array_equal(theta, self._start):
            # All samples so far were the start's; those of the next shift are the rule's.
            self._has_moved = True
            self._end_of_start()
            self._theta = theta
            return None
        n_samples = len(self._costs)
        if 2 * n_samples == self.shift:
            self._theta = theta
        if n_samples < self.shift:
            return None
        shown = self._shown()
        if not self._has_moved:
            self._best = self._with_best(shown)
            return None
        back = self._end_of_shift(shown, predicted)
        # The rule may have gone there itself.
        if back is None or np.array_equal(back, theta):
            return None
        return back

    def _shown(self) -> ShownCost:
        """The cost of what batches the samples fill, which are forgotten."""
        n_batches = len(self._costs) // self._batch
        n_samples = n_batches * self._batch
        costs = np.array(self._costs[:n_samples])
        self._costs = []
        batches = costs.reshape(n_batches, self._batch)
        return ShownCost(self._theta, batches.mean(axis=1))

    def _end_of_start(self) -> None:
        shown = self._shown()
        # One batch has no spread, and a few of them hardly one.
        if len(shown.batches) >= BATCHES // 2:
            self._best = self._with_best(shown)

    def _with_best(self, shown: ShownCost) -> ShownCost:
        """A cost of the best θ, together with what was known of it."""
        if self._best is None:
            return shown
        batches = np.concatenate([self._best.batches, shown.batches])
        return ShownCost(shown.theta, batches)

    def _end_of_shift(self, shown: ShownCost, predicted: float) -> Vector | None:
        """Compare the shift's cost with the best one; θ to go back to, if any."""
        if self._left is not None:
            return self._end_of_retreat(shown, self._left)
        if self.samples_to_wait:
            self._best = self._with_best(shown)
            return None
        best = self._best
        if best is None:
            # Of the start nothing is known: it is tried where the rule's prediction was wrong.
            if exceeds_prediction(shown, predicted, self._probability):
                return self._go_back(shown, self._start)
            self._best = shown
            return None
        if exceeds(shown, best, self._probability):
            return self._go_back(shown, best.theta)
        # Against a cost that is known three times worse a test would show nothing for long.
        is_cheaper = shown.mean < best.mean
        hardly_known = is_cheaper and best.variance > 9 * shown.variance
        if hardly_known or exceeds(best, shown, self._probability):
            self._best = shown
        return None

    def _end_of_retreat(self, shown: ShownCost, left: ShownCost) -> Vector | None:
        """Take a retreat back where the θ that was left, one shift ago, cost less."""
        # Costs from before the retreat may be of another plant.
        self._left = None
        self._best = shown
        if not exceeds(shown, left, self._probability):
            return None
        self._best = left
        self.samples_to_wait = 0
        return left.theta

    def _go_back(self, shown: ShownCost, theta: Vector) -> Vector:
        self._left = shown
        # Each retreat makes the rule wait twice as long as the one before.
        self.samples_to_wait = self.shift * 2**self.count
        self.count += 1
        self._theta = theta
        return theta

    def state_dict(self) -> State:
        """Costs of the shift, of the best θ and of the one that was left."""
        state: State = {
            "costs": np.array(self._costs),
            "theta": self._theta,
            "has_moved": self._has_moved,
            "count": self.count,
            "samples_to_wait": self.samples_to_wait,
        }
        shown_costs = {"best": self._best, "left": self._left}
        for name, shown in shown_costs.items():
            if shown is not None:
                state[f"{name}.theta"] = shown.theta
                state[f"{name}.batches"] = shown.batches
        return state

    def load_state_dict(self, state: State) -> None:
        """Restore what `state_dict` returned."""
        self._costs = state["costs"].tolist()
        self._theta = state["theta"]
        self._has_moved = state["has_moved"]
        self.count = state["count"]
        self.samples_to_wait = state["samples_to_wait"]
        self._best = _restored(state, "best")
        self._left = _restored(state, "left")


def _restored(state: State, name: str) -> ShownCost | None:
    if f"{name}.theta" not in state:
        return None
    theta = state[f"{name}.theta"]
    batches = state[f"{name}.batches"]
    return ShownCost(theta, batches)
