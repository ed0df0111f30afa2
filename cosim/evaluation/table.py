"""The tidy table: one row per controller and seed, as CSV and Parquet with repeatable bytes."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from controllers.storage import write_atomically
from cosim.evaluation.statistics import gain, gap_closed, regret
from cosim.evaluation.summary import summarise
from cosim.evaluation.unit import Result

Array = NDArray[np.float64]

TEXT = ("controller", "scenario")
WHOLE = ("seed", "steps", "failures")
NUMBERS = (
    "economic_cost",
    "mean_violation",
    "violating_share",
    "J",
    "regret",
    "gap_closed",
    "gain_in_J",
    "input_effort",
    "settling_time",
)
PROVENANCE = (
    "version",
    "versions",
    "code_hash",
    "scenario_hash",
    "fmu_sha256",
    "parameters_hash",
    "command",
)
COLUMNS = (*TEXT, "seed", "steps", *NUMBERS, "failures", *PROVENANCE)


@dataclass(frozen=True)
class Evaluation:
    """Indicators of controllers × seeds on common random numbers.

    `results` maps (controller, seed) to a unit's result; `settling` a controller to its settling
    time in s; `facts` are the columns that do not vary, `parameters` each controller's hash.
    `reference` is the controller that gains are measured against, `naive` the one that the gap is
    measured from, `optimum` the one that gives J*, in `results` whether it is among the
    `controllers` or not; None where there is none.
    """

    controllers: Sequence[str]
    seeds: Sequence[int]
    results: Mapping[tuple[str, int], Result]
    settling: Mapping[str, float]
    parameters: Mapping[str, str]
    facts: Mapping[str, Any]
    reference: str
    optimum: str | None
    naive: str | None = None

    @property
    def optimal(self) -> Array:
        """J of the optimum over the seeds, (S,), NaN where it is not known."""
        if self.optimum is None:
            return np.full(len(self.seeds), np.nan)
        return self.column(self.optimum, "J")

    def column(self, controller: str, name: str) -> Array:
        """An indicator of a controller over the seeds, (S,)."""
        return np.array([self.results[controller, seed].indicators[name] for seed in self.seeds])

    @cached_property
    def rows(self) -> list[dict[str, Any]]:
        """The rows, by controller as given, then by seed; NaN where an indicator is undefined."""
        return [
            {
                "controller": controller,
                "seed": seed,
                "settling_time": self.settling[controller],
                "parameters_hash": self.parameters[controller],
                **self.facts,
                **self.results[controller, seed].indicators,
                **self._relative(controller, seed),
            }
            for controller in self.controllers
            for seed in self.seeds
        ]

    def _relative(self, controller: str, seed: int) -> dict[str, float]:
        def cost(name: str | None) -> Array:
            if name is None:
                return np.array([np.nan])
            return np.array([self.results[name, seed].indicators["J"]])

        own, optimum = cost(controller), cost(self.optimum)
        return {
            "regret": regret(own, optimum).value,
            "gap_closed": gap_closed(own, cost(self.naive), optimum).value,
            "gain_in_J": gain(own, cost(self.reference)).value,
        }

    def summary(self) -> dict[str, Any]:
        """Means, intervals, paired differences and ratios; see `summarise`."""
        return summarise(self)

    def to_csv(self) -> str:
        """The table as CSV; floats read back to the same bits, undefined ones are empty."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(COLUMNS)
        writer.writerows([_cell(name, row[name]) for name in COLUMNS] for row in self.rows)
        return text.getvalue()

    def to_parquet(self) -> bytes:
        """The table as Parquet, with the columns' types; the same rows give the same bytes."""
        table = pa.table(
            {name: pa.array([row[name] for row in self.rows], _type(name)) for name in COLUMNS}
        )
        sink = pa.BufferOutputStream()
        pq.write_table(table, sink, compression="zstd")
        return bytes(sink.getvalue())

    def timing_csv(self) -> str:
        """What the clock said, one row per controller and seed."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        names = list(next(iter(self.results.values())).timing)
        writer.writerow(["controller", "seed", *names])
        for (controller, seed), result in self.results.items():
            if controller not in self.controllers:
                continue
            cells = (f"{result.timing[name]:.6g}" for name in names)
            writer.writerow([controller, seed, *cells])
        return text.getvalue()

    def write(self, folder: Path) -> None:
        """Write evaluation.csv, evaluation.parquet and timing.csv, each whole or not at all."""
        write_atomically(folder / "evaluation.csv", self.to_csv())
        write_atomically(folder / "evaluation.parquet", self.to_parquet())
        write_atomically(folder / "timing.csv", self.timing_csv())


def _cell(name: str, value: Any) -> str:
    if name in WHOLE:
        return str(int(value))
    if isinstance(value, float):
        return "" if np.isnan(value) else repr(value)
    return str(value)


def _type(name: str) -> pa.DataType:
    if name in WHOLE:
        return pa.int64()
    return pa.float64() if name in NUMBERS else pa.string()
