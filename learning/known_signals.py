"""Known signals of a scenario for a rule that simulates, at its samples and at coming ones."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from controllers.problem import MODEL_KINDS, Problem, hold_last, of_kind
from cosim.core.protocols import Array
from cosim.core.scenario import Scenario
from cosim.core.signals import Known, Signals, period_of
from learning.algorithm import Transition
from learning.checkpoint import State
from learning.signal_costs import SignalCosts


class SignalsOfSamples(NamedTuple):
    """Values of the signals in T samples in a row.

    Attributes:
        stages: what is known at each sample of the problem's varying quantities at the stages
            0 … N, (T, N+1, n_σ).
        inputs: what signals give of the model at each sample, v, (T, n_v).
        lower, upper: bounds of the state after each sample, (T, n).
        costs: what prices alone change of each sample's stage cost, at the reference, (T,).
    """

    stages: Array
    inputs: Array
    lower: Array
    upper: Array
    costs: Array


class KnownSignals:
    """The signals of a scenario as a rule on a model knows them.

    Where all of them are periodic, the coming samples are known from the scenario. Else, of a
    signal that ends or a disturbance that is measured, nobody knows what comes: the latest samples
    are taken over and over, each with what was known at it then.

    Args:
        scenario: may have signals.
        problem: of its controller.
        capacity: number of latest samples that are kept.

    Attributes:
        period: samples after which all signals begin again, 1 without any; None where there is
            no such number.
    """

    def __init__(self, scenario: Scenario, problem: Problem, capacity: int) -> None:
        self._problem = problem
        # Without forecasts: what is measured is known from the samples alone.
        self._signals = Signals(scenario)
        self._costs = SignalCosts(problem)
        self._model_rows: list[int] = []
        self._model_signals: list[str] = []
        self._price_columns: list[int] = []
        for column, (row, item) in enumerate(of_kind(problem.varying, *MODEL_KINDS)):
            self._model_rows.append(row)
            self._model_signals.append(item.signal)
            if item.kind == "price":
                self._price_columns.append(column)
        # What is measured does not come again.
        self.period = None if self._signals.measured else period_of(scenario)
        kept = 0 if self.period is not None else capacity
        n_stages = problem.horizon + 1
        self._stages = np.zeros((kept, n_stages, len(problem.varying)))
        self._numbers = np.zeros(kept, dtype=np.int64)
        self._n_kept = 0
        self._next = 0  # number of the next sample

    @property
    def move_targets(self) -> bool:
        """Whether one of them is a bound or a reference."""
        references = of_kind(self._problem.varying, "reference")
        return self._signals.move_bounds or bool(references)

    def add(self, transition: Transition) -> None:
        """Keep what was known at a sample."""
        self._next = transition.number + 1
        size = len(self._numbers)
        if not size:
            return
        oldest = self._n_kept % size
        self._numbers[oldest] = transition.number
        self._stages[oldest] = self._known_stages(transition.known or {})
        self._n_kept += 1

    def inputs_of(self, known: Known | None) -> Array:
        """Inputs of the model that signals give at a sample, v, (n_v,).

        Args:
            known: what is known of the signals at the sample; None without signals.
        """
        if known is None:
            return np.empty(0)
        values = [known[signal][0] for signal in self._model_signals]
        return np.array(values, dtype=np.float64)

    def bounds(self, numbers: Sequence[int]) -> tuple[Array, Array]:
        """Lower and upper bounds of the states at K samples, (K, n) each.

        Args:
            numbers: of the samples, (K,).
        """
        if not self._signals.move_bounds:
            count = len(numbers)
            lower = np.tile(self._problem.state_lower, (count, 1))
            upper = np.tile(self._problem.state_upper, (count, 1))
            return lower, upper
        penalties = [self._signals.penalty(number) for number in numbers]
        lower = np.array([penalty.lower for penalty in penalties])
        upper = np.array([penalty.upper for penalty in penalties])
        return lower, upper

    def price_costs(self, inputs: Array) -> Array:
        """Change of the stage cost at the reference by prices alone, (K,).

        Args:
            inputs: v of K samples, (K, n_v).
        """
        return self._costs.along(inputs[:, self._price_columns])

    def coming(self, n_samples: int) -> SignalsOfSamples:
        """The signals that a rollout from the next sample on meets.

        Args:
            n_samples: T.
        """
        if self.period is None:
            size = min(self._n_kept, len(self._numbers))
            # The ring as time has it, over and over.
            first = self._n_kept - size
            places = (first + np.arange(n_samples) % size) % len(self._numbers)
            numbers = self._numbers[places]
            stages = self._stages[places]
        else:
            numbers = self._next + np.arange(n_samples)
            n_stages = self._problem.horizon + 1
            stages = np.empty((n_samples, n_stages, len(self._problem.varying)))
            if stages.size:
                for row, number in zip(stages, numbers.tolist(), strict=True):
                    row[:] = self._known_stages(self._signals.known(number))
        inputs = stages[:, 0, self._model_rows]
        # A sample's penalty in a rollout is that of the state to which it leads.
        lower, upper = self.bounds((numbers + 1).tolist())
        return SignalsOfSamples(stages, inputs, lower, upper, self.price_costs(inputs))

    def whole_periods(
        self,
        n_samples: int,
        burn_in: int,
        longest: int,
    ) -> int:
        """A length near that of a rollout which counts whole periods, so that no hour weighs more.

        Args:
            n_samples: of the rollout.
            burn_in: the first of them, which do not count.
            longest: period in samples above which parts of one have to do.
        """
        period = self.period
        if period is None or period == 1 or period > longest:
            return n_samples
        rounds = max(1, round((n_samples - burn_in) / period))
        return burn_in + rounds * period

    def _known_stages(self, known: Known) -> Array:
        """The varying quantities at the stages 0 … N as they are known, (N+1, n_σ)."""
        n_stages = self._problem.horizon + 1
        stages = np.empty((n_stages, len(self._problem.varying)))
        for row, item in enumerate(self._problem.varying):
            hold_last(stages[:, row], known[item.signal])
        return stages

    def state_dict(self) -> State:
        """Known values at the stored samples."""
        return {
            "stages": self._stages,
            "numbers": self._numbers,
            "n_kept": self._n_kept,
            "next": self._next,
        }

    def load_state_dict(self, state: State) -> None:
        """Restore what `state_dict` returned."""
        self._stages = state["stages"]
        self._numbers = state["numbers"]
        self._n_kept = state["n_kept"]
        self._next = state["next"]
