"""`CaseRuns`: the runs of one case on one scenario, and the statistics made of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd

from cosim.core import statistics
from cosim.core.protocols import Array
from cosim.core.statistics import Estimate, over_runs, paired_difference, two_way
from cosim.studies.ranks import NO_SEED, costs_more, paired_runs

AGGREGATED_MEANS = ["economic_cost", "mean_violation", "violating_share"]
"""Indicators of which tables show the mean of a run, and the median of these over the runs."""


@dataclass(frozen=True, eq=False, repr=False)
class CaseRuns:
    """R runs of a case on a scenario, each evaluated on the same S seeds of the noise.

    Attributes:
        case: name of the case.
        scenario: name of the scenario.
        is_trained: whether a run is a training; else it is a controller, with one run.
        state: a row for each run: training_seed, status, samples, plant_samples.
        indicators: of each run and noise seed by name, (R, S) each.
        optimum: J* on the same noise, (S,); None where it is not known.
        naive: J of the naive NMPC on the same noise, (S,), or None.
    """

    case: str
    scenario: str
    is_trained: bool
    state: pd.DataFrame
    indicators: Mapping[str, Array]
    optimum: Array | None
    naive: Array | None

    def __len__(self) -> int:
        return len(self.state)

    @property
    def J(self) -> Array:
        """J of each run on each seed of the noise, (R, S)."""
        return self.indicators["J"]

    @property
    def is_trained_once(self) -> bool:
        """Whether there is one training only, so that the spread over trainings is unknown."""
        return self.is_trained and len(self) < 2

    # Run by run

    @cached_property
    def run_J(self) -> Array:
        """Mean J of each run, (R,); infinite where a run diverged."""
        mean_J = self.J.mean(axis=1)
        # The mean cost of a run that diverged may be NaN.
        return np.where(np.isfinite(mean_J), mean_J, np.inf)

    @cached_property
    def run_regrets(self) -> Array:
        """Regret of each run, (R,); infinite if J is not finite, NaN if J* is unknown."""
        if self.optimum is None:
            return np.full(len(self), np.nan)
        regrets = [self.regret([run]).value for run in range(len(self))]
        return np.where(np.isfinite(self.run_J), regrets, np.inf)

    def regret(self, runs: Sequence[int] = (0,)) -> Estimate:
        """Regret (J − J*)/|J*| of the mean of some runs, paired over the noise seeds.

        Args:
            runs: numbers of the runs, from 0, in the order of the training seeds.

        Returns:
            The regret and its 95 % interval over the noise; NaN without J*.
        """
        if self.optimum is None:
            return Estimate(np.nan)
        return statistics.regret(self._mean_J(runs), self.optimum)

    def gap_closed(self, runs: Sequence[int] = (0,)) -> Estimate:
        """Share (J_naive − J)/(J_naive − J*) of the mean of some runs, as `regret`."""
        if self.optimum is None or self.naive is None:
            return Estimate(np.nan)
        return statistics.gap_closed(self._mean_J(runs), self.naive, self.optimum)

    def _mean_J(self, runs: Sequence[int]) -> Array:
        """Mean J of some runs on each seed of the noise, (S,)."""
        mean: Array = self.J[list(runs)].mean(axis=0)
        return mean

    def rows(self) -> list[dict[str, Any]]:
        """A row for each run: its state, J, regret with its interval over the noise, indicators."""
        rows = []
        states = self.state.to_dict("records")
        for run, state in enumerate(states):
            row: dict[str, Any] = {
                **state,
                "J": float(self.run_J[run]),
                **columns_of("regret", self.regret([run])),
                "gap_closed": self.gap_closed([run]).value,
                "failures": int(self.indicators["failures"][run].sum()),
            }
            for name in AGGREGATED_MEANS:
                row[name] = float(self.indicators[name][run].mean())
            rows.append(row)
        return rows

    # All runs together

    def summary(self) -> dict[str, Any]:
        """The case's row of a summary, but for what compares it with other cases.

        The median regret is that of the middle run, or of the mean of both middle ones.
        """
        n_runs = len(self)
        by_cost = np.argsort(self.run_J, kind="stable")
        cost = self.run_J[by_cost]
        regrets = self.run_regrets[by_cost]
        # The middle run, or both middle ones.
        middle = list(by_cost[(n_runs - 1) // 2 : n_runs // 2 + 1])
        # One run has no distribution: its regret is the mean, without an interval.
        regret_iqm = Estimate(regrets[0])
        if n_runs > 1:
            regret_iqm = over_runs([regrets])
        diverged = self.state.status.str.startswith("diverged")
        row: dict[str, Any] = {
            "scenario": self.scenario,
            "case": self.case,
            "samples": self.state.samples.max(),
            "plant_samples": self.state.plant_samples.max(),
            "finished": int((~diverged).sum()),
            "runs": n_runs,
            **columns_of("regret_median", self.regret(middle)),
            "regret_worst": float(regrets[-1]),
            **columns_of("regret_iqm", regret_iqm),
            "J_median": float(np.median(cost)),
            "J_worst": float(cost[-1]),
            "J_iqm": over_runs([cost]).value,
            "gap_closed_median": self.gap_closed(middle).value,
            "failures": int(self.indicators["failures"].sum()),
            **columns_of("regret_wide", self._wide_estimate()),
        }
        for name in AGGREGATED_MEANS:
            mean_of_run = self.indicators[name].mean(axis=1)
            row[name] = float(np.median(mean_of_run))
        return row

    def _wide_estimate(self) -> Estimate:
        """Interval of the median regret over training seeds and noise; its value is not used."""
        # One training says nothing of another seed's: its interval would be too narrow.
        if self.optimum is None or self.is_trained_once:
            return Estimate(np.nan)
        return Estimate(np.nan, two_way(self.J, self.optimum))

    # Against another case

    def difference_from(self, other: CaseRuns) -> dict[str, float]:
        """Columns of the paired difference from another case on the scenario; NaN if unknown.

        The difference is relative to |J*|; where no J* is known, to the other case's |J|.
        """
        difference = Estimate(np.nan)
        p = np.nan
        J, other_J = self._pairs_with(other)
        unit = self._unit_against(other_J)
        # Without a training seed in common, or with no unit, nothing is known.
        if J.size and np.isfinite(unit).all():
            median, interval, p = paired_difference(J, other_J, unit)
            difference = Estimate(median, interval)
        return {**columns_of("difference", difference), "difference_p": p}

    def costs_more_than(self, other: CaseRuns) -> bool:
        """Whether the case is shown to cost more than another one on the scenario."""
        J, other_J = self._pairs_with(other)
        # Without a training seed in common nothing is known.
        if not J.size:
            return False
        unit = self._unit_against(other_J)
        # Half of the other's runs diverged: there is no unit.
        if not np.isfinite(unit).all():
            return False
        return costs_more(J, other_J, unit)

    def _unit_against(self, other_J: Array) -> Array:
        """J* (S,), or where none is known the median of the other case's runs, J' (R, S)."""
        if self.optimum is not None:
            return self.optimum
        # Of no pair there is no median.
        if not other_J.size:
            return np.empty(0)
        # Not the mean: one run that diverged would make the unit infinite.
        median: Array = np.median(other_J, axis=0)
        return median

    def _pairs_with(self, other: CaseRuns) -> tuple[Array, Array]:
        """J (R, S) of two cases over the training seeds that both have; a controller has any."""
        return paired_runs(self._J_by_training_seed(), other._J_by_training_seed())

    def _J_by_training_seed(self) -> pd.DataFrame:
        """J, a row for each training seed and a column for each seed of the noise."""
        seeds = self.state.training_seed.fillna(NO_SEED)
        return pd.DataFrame(self.J, index=seeds)


def columns_of(name: str, estimate: Estimate) -> dict[str, float]:
    """An estimate as columns of a table.

    Args:
        name: column of the value; those of the interval are `name_low` and `name_high`.
        estimate: a missing interval is NaN.
    """
    low, high = estimate.interval or (np.nan, np.nan)
    return {
        name: estimate.value,
        f"{name}_low": low,
        f"{name}_high": high,
    }
