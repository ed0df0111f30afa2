"""The values of every declared signal of a run, from samples to columns."""

from __future__ import annotations

from math import nan
from operator import attrgetter

import numpy as np
from numpy.typing import NDArray

from cosim import signals
from cosim.scenario import Scenario

Array = NDArray[np.float64]


class SignalColumns:
    """Every declared signal of a run, read sample by sample and stored by blocks, as `columns`.

    Without `residuals` their column is NaN.
    """

    def __init__(self, scenario: Scenario, steps: int, residuals: bool) -> None:
        unwanted = () if residuals else (signals.RESIDUAL,)
        read = {kind: kind.of for kind in signals.SIGNALS if isinstance(kind.of, str)}
        scalars = {k: of for k, of in read.items() if not k.vector and of not in unwanted}
        vectors = {kind: of for kind, of in read.items() if kind.vector}
        # Of all scalars, and of all vectors, one call a sample.
        self._scalars, self._vectors = attrgetter(*scalars.values()), attrgetter(*vectors.values())
        self._derived = {k.name: k.of for k in signals.SIGNALS if not isinstance(k.of, str)}
        self._rows: list[list[float]] = []
        self._scenario = scenario
        stored = [*scalars, *vectors]
        stored += [kind for kind in signals.SIGNALS if kind not in stored]
        widths = [len(kind.names(scenario)) for kind in stored]
        # Column-major, so that a signal is a column and not a copy of one.
        self._table = np.full((steps, sum(widths)), nan, order="F")
        parts = np.split(self._table, np.cumsum(widths)[:-1], axis=1)
        self.columns: dict[str, Array] = {
            kind.name: part if kind.vector else part[:, 0]
            for kind, part in zip(stored, parts, strict=True)
        }

    def read(self, sample: signals.Sample) -> None:
        """Take the values of a sample, since neither plant nor controller need keep theirs."""
        row = list(self._scalars(sample))
        for values in self._vectors(sample):
            row += values.tolist()
        self._rows.append(row)

    def store(self, first: int) -> dict[str, Array]:
        """Store what was read, from sample number `first` on, and return it by name."""
        where = slice(first, first + len(self._rows))
        self._table[where, : len(self._rows[0])] = self._rows
        self._rows.clear()
        stored = {name: column[where] for name, column in self.columns.items()}
        for name, derive in self._derived.items():
            stored[name][:] = derive(self._scenario, stored)
        return stored
