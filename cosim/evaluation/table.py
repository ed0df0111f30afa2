"""The tidy table of an evaluation, one row per controller and seed, and its summary."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cosim.evaluation.runs import Runs
from cosim.files import write_atomically
from cosim.statistics import gain, gains, gap_closed, gaps_closed, mean, regret, regrets
from cosim.text_tables import cell, csv_pieces

if TYPE_CHECKING:
    from matplotlib.figure import Figure

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
INDICATORS = (
    "economic_cost",
    "mean_violation",
    "violating_share",
    "J",
    "input_effort",
    "failures",
)
DRAWN = ("J", "economic_cost", "mean_violation")
FIGURE = "evaluation.png"
MEANS = ("economic_cost", "mean_violation", "violating_share", "J", "input_effort")
COMPARED = ("J", "economic_cost", "mean_violation", "violating_share")
COLUMNS = (*TEXT, "seed", "steps", *NUMBERS, "failures", *PROVENANCE)


@dataclass(frozen=True)
class Evaluation:
    """Indicators of controllers × seeds on common random numbers.

    `results` holds each controller's runs; `settling` a controller to its settling
    time in s, NaN where permanent disturbances let nothing settle; `facts` are the columns that do
    not vary, `parameters` each controller's hash. `reference` is the controller that gains are
    measured against, `naive` the one that the gap is measured from, `optimum` the one that gives
    J*, in `results` whether it is among the `controllers` or not; None where there is none.
    """

    controllers: Sequence[str]
    seeds: Sequence[int]
    results: Mapping[str, Runs]
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
        return self.results[controller].column(name)

    @cached_property
    def rows(self) -> list[dict[str, Any]]:
        """The rows, by controller as given, then by seed; NaN where an indicator is undefined."""
        return list(self._rows())

    def _rows(self) -> Iterator[dict[str, Any]]:
        for controller in self.controllers:
            constant = {
                "controller": controller,
                "settling_time": self.settling[controller],
                "parameters_hash": self.parameters[controller],
                **self.facts,
            }
            columns = {name: self.column(controller, name) for name in INDICATORS}
            columns |= self._relative(controller)
            for row, seed in enumerate(self.seeds):
                figures = {name: float(values[row]) for name, values in columns.items()}
                yield {**constant, "seed": seed, **figures}

    def _relative(self, controller: str) -> dict[str, Array]:
        """Each seed's own regret, gap closed and gain in J, (S,) each."""

        def cost(name: str | None) -> Array:
            return np.full(len(self.seeds), np.nan) if name is None else self.column(name, "J")

        own, optimum = cost(controller), cost(self.optimum)
        return {
            "regret": regrets(own, optimum),
            "gap_closed": gaps_closed(own, cost(self.naive), optimum),
            "gain_in_J": gains(own, cost(self.reference)),
        }

    def summary(self) -> dict[str, Any]:
        """Means, intervals, paired differences and ratios; see `summarise`."""
        return summarise(self)

    def to_csv(self) -> str:
        """The table as CSV; floats read back to the same bits, undefined ones are empty."""
        return "".join(self._csv())

    def _csv(self) -> Iterator[str]:
        return csv_pieces(
            COLUMNS, ([_cell(name, row[name]) for name in COLUMNS] for row in self._rows())
        )

    def timing_csv(self) -> str:
        """What the clock said, one row per controller and seed."""
        return "".join(self._timing_csv())

    def _timing_csv(self) -> Iterator[str]:
        names = list(next(iter(self.results.values())).timing)
        rows = (
            [controller, str(seed), *(f"{value:.6g}" for value in values)]
            for controller in self.controllers
            for seed, *values in zip(
                self.seeds,
                *(self.results[controller].timing[name] for name in names),
                strict=True,
            )
        )
        return csv_pieces(["controller", "seed", *names], rows)

    def figure(self) -> Figure:
        """Regret (J where J* is not known) with its intervals; economic cost against violation."""
        from cosim.figures.evaluation import Costs, evaluation_figure  # noqa: PLC0415 - matplotlib

        return evaluation_figure(
            {name: Costs(*(self.column(name, key) for key in DRAWN)) for name in self.controllers},
            title=f"{self.facts['scenario']}, {self.facts['steps']} samples × {len(self.seeds)} "
            "seeds, the same disturbances for all",
            optimal=None if self.optimum is None else self.optimal,
        )

    def plot(self, path: str | Path) -> Path:
        """Draw `figure` to a PNG or SVG file; raises FigureError where it cannot be written."""
        from cosim.figures.style import save  # noqa: PLC0415 - matplotlib

        return save(self.figure(), path)

    def write(self, folder: Path) -> None:
        """Write evaluation.csv, evaluation.png and timing.csv, each whole or not at all."""
        write_atomically(folder / "evaluation.csv", self._csv())
        self.plot(folder / FIGURE)
        write_atomically(folder / "timing.csv", self._timing_csv())


def _cell(name: str, value: Any) -> str:
    return str(int(value)) if name in WHOLE else cell(value)


def summarise(evaluation: Evaluation) -> dict[str, Any]:
    """An evaluation as a JSON document: controllers, comparisons, provenance, timing.

    `controllers`: per controller the means over all seeds and samples, `failures` in total,
    `settling_time` [s], null under permanent disturbances, `intervals` of each mean, where J* is
    known the `regret` (J − J*)/|J*|, and where the naive controller is there too `gap_closed` =
    (J_naive − J)/(J_naive − J*).
    `comparisons`: for each pair, the paired difference controller − reference of each mean, and
    `gain_in_J`, (J_ref − J)/|J_ref|. Every interval is of 95 %, paired over seeds, once by
    Student's t and once by BCa bootstrap. `optimal_J` is J* on the same seeds.
    """
    names = list(evaluation.controllers)
    return {
        **evaluation.facts,
        "seeds": list(evaluation.seeds),
        "reference": evaluation.reference,
        "optimum": evaluation.optimum,
        "optimal_J": None if evaluation.optimum is None else float(np.mean(evaluation.optimal)),
        "controllers": {name: _controller(evaluation, name) for name in names},
        "comparisons": [
            _comparison(evaluation, name, reference)
            for i, name in enumerate(names)
            for reference in names[:i]
        ],
        "timing": {name: _timing(evaluation, name) for name in names},
    }


def _controller(evaluation: Evaluation, name: str) -> dict[str, Any]:
    estimates = {key: mean(evaluation.column(name, key)) for key in MEANS}
    document: dict[str, Any] = {key: estimate.value for key, estimate in estimates.items()}
    document |= {
        "failures": int(np.sum(evaluation.column(name, "failures"))),
        "settling_time": evaluation.settling[name],
        "parameters_hash": evaluation.parameters[name],
        "intervals": {
            key: {"t": estimate.t, "bootstrap": estimate.bootstrap}
            for key, estimate in estimates.items()
        },
    }
    if evaluation.optimum is None:
        return document
    cost = evaluation.column(name, "J")
    document["regret"] = regret(cost, evaluation.optimal).to_dict()
    if evaluation.naive is not None:
        naive = evaluation.column(evaluation.naive, "J")
        document["gap_closed"] = gap_closed(cost, naive, evaluation.optimal).to_dict()
    return document


def _comparison(evaluation: Evaluation, name: str, reference: str) -> dict[str, Any]:
    cost, base = evaluation.column(name, "J"), evaluation.column(reference, "J")
    return {
        "controller": name,
        "reference": reference,
        "differences": {
            key: mean(evaluation.column(name, key) - evaluation.column(reference, key)).to_dict()
            for key in COMPARED
        },
        "gain_in_J": gain(cost, base).to_dict(),
    }


def _timing(evaluation: Evaluation, name: str) -> dict[str, Any]:
    """Median over seeds of each of the clock's figures; how the functions were computed, if any."""
    runs = evaluation.results[name]
    return {
        **{key: float(np.median(values)) for key, values in runs.timing.items()},
        "functions": " and ".join(sorted(runs.functions)) or None,
    }
