"""Signals: what moves with time in a scenario, at each sample, and what is known of it then."""

from __future__ import annotations

from bisect import bisect_right
from collections import defaultdict
from collections.abc import Mapping
from math import floor, isclose, lcm

import numpy as np
from numpy.typing import NDArray

from cosim.core.errors import PlantError, ScenarioError
from cosim.core.protocols import Array, Plant
from cosim.core.scenario import Penalty, Scenario, SignalTable

Known = Mapping[str, Array]
"""Values of each signal that is known, by its name: the present one, and those of a preview."""
FORECAST_STREAM = 0x464F5245
"""Word of the key that keeps the forecasts' errors apart from every other use of a seed."""
ROUNDING = 1e-6
"""Share of a sample by which a value may begin late: k·h and its time are rounded."""


class Signals:
    """The values of a scenario's signals at its samples.

    Args:
        scenario: with signals.

    Attributes:
        tables: the signals that have values.
        measured: those that are disturbances of the plant.
    """

    def __init__(self, scenario: Scenario) -> None:
        self._scenario = scenario
        self._h = scenario.sampling_time
        self.tables = scenario.valued_signals
        self._times: list[list[float]] = []
        # Values at the first samples, so far as they have been asked for.
        self._at_samples: list[Array] = []
        # The numbers of those signals that are a bound.
        self._bounds: list[int] = []
        for i, table in enumerate(self.tables):
            self._times.append(_times(table))
            self._at_samples.append(np.empty(0))
            if table.bound is not None:
                self._bounds.append(i)
        # A bound that steps takes few values: a penalty is made once for each of them.
        self._penalties: dict[tuple[float, ...], Penalty] = {}
        self.measured = tuple(
            signal for signal in scenario.signals or () if signal.measures is not None
        )
        # Of each measured disturbance what is known at each sample of a run (`foresee`).
        self._forecasts: dict[str, Array] = {}

    @property
    def move_bounds(self) -> bool:
        """Whether one of them is a bound."""
        return bool(self._bounds)

    def require(self, samples: int) -> None:
        """Check that the signals last for a run, and their previews.

        Args:
            samples: of the run.

        Raises:
            ScenarioError: one of them ends too early.
        """
        for i, table in enumerate(self.tables):
            ahead = self.ahead(i)
            if table.once is None or self._lasts_to(i, samples - 1 + ahead):
                continue
            needed = (samples + ahead) * self._h
            purpose = f"a run of {samples} samples"
            if ahead:
                purpose += f" with a preview of {ahead}"
            raise ScenarioError(
                f"scenario '{self._scenario.name}': signal '{table.name}' ends after "
                f"{table.once:g} s, and {purpose} needs {needed:g} s of it"
            )

    def foresee(self, plant: Plant, seed: int, samples: int) -> None:
        """Find out what the plant will realise in a run, and forecast it.

        The plant takes the run's samples beforehand, from the same seed, under the reference
        action; after that it has to be reset.

        Args:
            plant: of the scenario.
            seed: of its noise.
            samples: of the run.
        """
        if not self.measured:
            return
        scenario = self._scenario
        # The last samples' previews reach beyond the end of the run.
        longest = max(ahead_of(table, scenario) for table in self.measured)
        action = scenario.reference_action
        realised = _realised(plant, seed, action, samples + longest)
        for number, table in enumerate(self.measured):
            values = realised[:, self._disturbance_index(table)]
            ahead = ahead_of(table, scenario)
            # Row k has the values of the samples k … k+ahead; the view's rows share memory.
            windows = np.lib.stride_tricks.sliding_window_view(values, ahead + 1)
            known = windows[:samples].copy()
            # Errors add up sample by sample.
            draws = _forecast_draws(seed, number, (samples, ahead))
            known[:, 1:] += table.error * np.cumsum(draws, axis=1)
            known.flags.writeable = False
            self._forecasts[table.name] = known

    def _disturbance_index(self, table: SignalTable) -> int:
        """Place of the disturbance that a signal measures, in the plant's order."""
        return self._scenario.plant.disturbances.index(str(table.measures))

    def check_foreseen(self, disturbances: Array, first: int = 0) -> None:
        """Check that a run realised what was foreseen.

        Args:
            disturbances: of the run, (K, p).
            first: number of the first of these samples.

        Raises:
            PlantError: a measured disturbance depends on the actions.
        """
        for table in self.measured:
            realised = disturbances[:, self._disturbance_index(table)]
            end = first + len(disturbances)
            foreseen = self._forecasts[table.name][first:end, 0]
            # To the bit: it is the same FMU with the same seed.
            if not np.array_equal(foreseen, realised):
                raise PlantError(
                    f"signal '{table.name}': disturbance '{table.measures}' depends on the actions "
                    "and cannot be forecast: take the signal out"
                )

    def _lasts_to(self, i: int, k: int) -> bool:
        """Whether signal i has a value at sample k."""
        once = self.tables[i].once
        return once is None or k * self._h < once - ROUNDING * self._h

    def ahead(self, i: int) -> int:
        """Samples beyond the present one of which signal i is known."""
        return ahead_of(self.tables[i], self._scenario)

    def value(self, i: int, k: int) -> float:
        """Value of a signal at a sample.

        Args:
            i: number of the signal in `tables`.
            k: number of the sample.

        Raises:
            ScenarioError: the signal has ended before.
        """
        if k >= len(self._at_samples[i]):
            self._find_values(i, k + 1)
        return float(self._at_samples[i][k])

    def _value(self, i: int, k: int) -> float:
        """`value`, looked up in the table."""
        table = self.tables[i]
        if not self._lasts_to(i, k):
            raise ScenarioError(
                f"scenario '{self._scenario.name}': signal '{table.name}' has ended before sample "
                f"{k}: it lasts {table.once:g} s"
            )
        time = k * self._h
        if table.period is not None:
            # k·h may be just below a multiple of the period.
            periods = floor(time / table.period + ROUNDING * self._h / table.period)
            time -= periods * table.period
        # The last value that has begun by then.
        begun = bisect_right(self._times[i], time + ROUNDING * self._h)
        return self.tables[i].values[max(begun - 1, 0)]

    def at(self, k: int) -> Array:
        """Values of all signals at sample k, (n_signals,)."""
        return np.array([self.value(i, k) for i in range(len(self.tables))])

    def along(self, samples: NDArray[np.intp]) -> Array:
        """Values of all signals at K samples, (K, n_signals)."""
        table = np.empty((len(samples), len(self.tables)))
        for row, k in enumerate(samples.tolist()):
            table[row] = self.at(k)
        return table

    def known(self, k: int) -> Known:
        """Known values at sample k, by the signals' names.

        Args:
            k: number of the sample.

        Returns:
            The values at the samples k, k+1, … as far as they are known.
        """
        known = {}
        for i, table in enumerate(self.tables):
            if table.known == "none":
                continue
            known[table.name] = self._part(i, k, k + self.ahead(i) + 1)
        for name, forecasts in self._forecasts.items():
            known[name] = forecasts[k]
        return known

    def _part(self, i: int, first: int, end: int) -> Array:
        """Values of signal i at the samples `first` to `end`, without this one, read-only."""
        if len(self._at_samples[i]) < end:
            self._find_values(i, end)
        return self._at_samples[i][first:end]

    def _find_values(self, i: int, end: int) -> None:
        """Look the values of signal i up, to before sample `end` and as many again."""
        present = self._at_samples[i]
        # As many again, so that a run that asks sample by sample copies the array seldom.
        more = []
        for k in range(len(present), 2 * end):
            # What was not asked for may be beyond the signal's end.
            if k >= end and not self._lasts_to(i, k):
                break
            more.append(self._value(i, k))
        values = np.concatenate([present, more])
        # Controllers are given parts of it.
        values.flags.writeable = False
        self._at_samples[i] = values

    def penalty(self, k: int) -> Penalty:
        """Penalty of a state by the bounds at sample k."""
        if not self._bounds:
            return self._scenario.state_penalty
        values = tuple(self.value(i, k) for i in self._bounds)
        if values not in self._penalties:
            self._penalties[values] = self._penalty(values)
        return self._penalties[values]

    def _penalty(self, values: tuple[float, ...]) -> Penalty:
        """Penalty where the moving bounds have these values."""
        scenario = self._scenario
        lower = scenario.state_lower.copy()
        upper = scenario.state_upper.copy()
        for i, value in zip(self._bounds, values, strict=True):
            table = self.tables[i]
            state = scenario.plant.states.index(table.bounded_state)
            if table.is_lower_bound:
                lower[state] = value
            else:
                upper[state] = value
        return Penalty(
            lower,
            upper,
            scenario.penalty_linear,
            scenario.penalty_quadratic,
        )

    def penalties_along(self, states: Array, samples: NDArray[np.intp]) -> Array:
        """Penalty of each state at the bounds of its sample.

        Args:
            states: (K, n).
            samples: their numbers, (K,).

        Returns:
            (K,).
        """
        total = np.empty(len(states))
        for penalty, rows in self._by_penalty(samples):
            total[rows] = penalty.along(states[rows])
        return total

    def violations_along(self, states: Array, samples: NDArray[np.intp]) -> Array:
        """Violation of each state at the bounds of its sample.

        Args:
            states: (K, n).
            samples: their numbers, (K,).

        Returns:
            (K, n), in the states' units.
        """
        violations = np.empty(states.shape)
        for penalty, rows in self._by_penalty(samples):
            violations[rows] = penalty.violation(states[rows])
        return violations

    def _by_penalty(self, samples: NDArray[np.intp]) -> list[tuple[Penalty, NDArray[np.intp]]]:
        """The penalties of samples, each with the rows of its samples."""
        # A penalty is one object for all its samples (`_penalties`), so that it can be a key.
        rows_of: dict[Penalty, list[int]] = defaultdict(list)
        for row, k in enumerate(samples.tolist()):
            penalty = self.penalty(k)
            rows_of[penalty].append(row)
        groups = []
        for penalty, rows in rows_of.items():
            indices = np.array(rows, dtype=np.intp)
            groups.append((penalty, indices))
        return groups


def _realised(
    plant: Plant,
    seed: int,
    action: Array,
    samples: int,
) -> Array:
    """Disturbances (samples, p) that a plant realises under an action (m,)."""
    plant.reset(seed)
    disturbances = []
    for _ in range(samples):
        step = plant.step(action)
        disturbances.append(step.disturbance)
    return np.array(disturbances)


def _forecast_draws(seed: int, number: int, shape: tuple[int, int]) -> Array:
    """Standard normal draws of a measured signal: a function of seed and signal alone."""
    # As integers of 64 bits: in a list NumPy would round a large seed.
    key = np.array([seed, FORECAST_STREAM], dtype=np.uint64)
    # The low words of the counter are those that the draws count up.
    counter = np.array([0, 0, 0, number], dtype=np.uint64)
    philox = np.random.Philox(key=key, counter=counter)
    return np.random.Generator(philox).standard_normal(shape)


def ahead_of(table: SignalTable, scenario: Scenario) -> int:
    """Samples beyond the present one of which a signal is known.

    Args:
        table: of the signal.
        scenario: has the horizon, where the table says nothing.
    """
    if table.known != "preview":
        return 0
    return table.ahead or scenario.controller.horizon


def _times(table: SignalTable) -> list[float]:
    """Times in s at which a signal's values begin, increasing from 0."""
    if table.times is not None:
        return list(table.times)
    count = len(table.values)
    return [i * table.length / count for i in range(count)]


def period_of(scenario: Scenario) -> int | None:
    """Samples after which all valued signals begin again, 1 without any; None where none is."""
    period = 1
    for table in scenario.valued_signals:
        if table.period is None:
            return None
        samples = round(table.period / scenario.sampling_time)
        if not isclose(samples * scenario.sampling_time, table.period, rel_tol=1e-9):
            return None
        period = lcm(period, samples)
    return period


def sample_numbers(times: Array, scenario: Scenario) -> NDArray[np.intp]:
    """Numbers of the samples at some times.

    Args:
        times: in s, (K,).
        scenario: has the sampling time.

    Returns:
        (K,).
    """
    # k·h as it is recorded is off by rounding.
    numbers = np.rint(times / scenario.sampling_time)
    return numbers.astype(np.intp)
