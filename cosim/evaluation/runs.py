"""What is known of a controller's runs: a number for each seed and figure, and little more."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cosim.evaluation.unit import UnitResult

Array = NDArray[np.float64]


class Runs:
    """Indicators, timings and functions of a controller's runs on S seeds, in the seeds' order.

    Numbers in arrays, not objects for each run: a million runs take 150 MB.
    """

    def __init__(self, seeds: Sequence[int]) -> None:
        self.seeds = np.array(seeds, dtype=np.uint64)
        """The seeds, (S,)."""
        self.known = np.zeros(len(self.seeds), dtype=np.bool_)
        """Whether a seed's run is known, (S,)."""
        self.functions: set[str] = set()
        """How the controller's functions were computed at the ends of its runs."""
        self._order = np.argsort(self.seeds)
        self._sorted = self.seeds[self._order]
        self._indicators: dict[str, Array] = {}
        self._timing: dict[str, Array] = {}

    def add(self, result: UnitResult) -> int:
        """Take up what a unit gave, of seeds that are wanted; the number of runs new by it."""
        wanted = np.array(result.seeds, dtype=np.uint64)
        places = np.searchsorted(self._sorted, wanted)
        there = places < len(self._sorted)
        there[there] = self._sorted[places[there]] == wanted[there]
        rows = self._order[places[there]]
        for columns, figures in (
            (self._indicators, result.indicators),
            (self._timing, result.timing),
        ):
            for name, values in figures.items():
                if name not in columns:
                    columns[name] = np.full(len(self.seeds), np.nan)
                columns[name][rows] = np.array(values)[there]
        new = int(np.count_nonzero(~self.known[rows]))
        self.known[rows] = True
        if len(rows):
            self.functions |= set(result.functions)
        return new

    def missing(self) -> list[int]:
        """Seeds whose runs are not known."""
        found: list[int] = self.seeds[~self.known].tolist()
        return found

    def column(self, name: str) -> Array:
        """An indicator over the seeds, (S,)."""
        return self._indicators[name]

    @property
    def timing(self) -> dict[str, Array]:
        """What the clock said, by name, in s and µs, (S,) each."""
        return self._timing
