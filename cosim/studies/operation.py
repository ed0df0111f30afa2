"""Learning in operation: θ at given times, and the cost of a run's samples until then."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from time import process_time
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from scipy.stats import ttest_1samp

from controllers import compile_functions
from controllers.factories import nmpc
from controllers.optimum import QuasiStaticPolicy, fouling, frozen
from cosim.core.plugins import build_controller
from cosim.core.protocols import Array, Controller
from cosim.core.result import TextTable
from cosim.core.scenario import VIOLATING, Scenario
from cosim.core.simulation import simulate
from cosim.core.statistics import paired_difference, regrets, relative, shown
from cosim.plant import FmuPlant
from learning.algorithm import load_algorithm
from learning.errors import DivergenceError
from learning.log import LogRow
from learning.training_run import TrainingRun, begin

WINDOW = 100
"""Samples in a row of which the dearest are reported."""
SHIFT, PARTS, LEVEL = 480, 8, 0.05
"""Samples in a row that are compared with those of the start, in how many parts, at which level."""
LIFE = [
    "J", "violating", "dearest", "first_change", "updates", "model_samples", "dearer", "excess",
]  # fmt: skip


def plant_at(scenario: Scenario, time: float) -> Scenario:
    """The scenario with its plant frozen at a time in s."""
    if fouled := fouling(scenario):
        name, value = fouled
        return frozen(scenario, name, float(value(time)))
    return scenario.at(time)


def optimum_at(scenario: Scenario, sample: int) -> Controller:
    """The optimal policy of the plant frozen at a sample."""
    time = sample * scenario.sampling_time
    if fouling(scenario) is None:
        return build_controller("optimal", plant_at(scenario, time))
    moving = QuasiStaticPolicy.from_scenario(scenario)
    where = moving.law.position(time)
    law = replace(moving.law, position=lambda _: where)
    return QuasiStaticPolicy(law, moving.policies, scenario.sampling_time)


def live(run: TrainingRun, marks: Sequence[int]) -> tuple[list[LogRow], str, dict[int, float], int]:
    """Take the samples of a run on its plant; rows of `LIFE` and θ after each of the `marks`.

    Also the status, the processor time in s by mark, and the plant samples taken. `metrics` has the
    rows' costs; `updates` and `model_samples` are numbers so far. The cost of a diverged run is
    infinite.
    """
    cost, violating = np.full(run.samples, np.inf), np.ones(run.samples, dtype=bool)
    rows: list[LogRow] = []
    clock: dict[int, float] = {}
    status, first, updates = "finished", 0, 0
    with FmuPlant(run.scenario) as plant:
        held = nmpc(run.scenario, run.starting_parameters(), run.controller)
        compile_functions(held, run.samples)
        signals = simulate(plant, held, run.samples, run.seed, residuals=False).signals
        before = signals["stage_cost"].values + signals["penalty"].values
        loop, start = begin(run, load_algorithm(run.algorithm), plant), process_time()
        compile_functions(loop.controller, run.samples)
        theta, penalty = loop.controller.theta.copy(), run.scenario.state_penalty
        for k in range(run.samples):
            if status == "finished":
                violating[k] = float(penalty.violation(loop.s).sum()) > VIOLATING
                try:
                    cost[k], update = loop.advance()
                    updates += update is not None
                    if not first and not np.array_equal(theta, loop.controller.theta):
                        first = k + 1
                except DivergenceError as error:
                    status = f"diverged: {error} at sample {k + 1}"
            if k + 1 not in marks:
                continue
            clock[k + 1] = process_time() - start
            figures = metrics(k + 1, before, cost, violating, first) | {
                "updates": float(updates),
                "model_samples": float(getattr(loop.algorithm, "model_samples", 0)),
            }
            rows.append(LogRow(figures, loop.parameters))
        return rows, status, clock, loop.counts.number


def metrics(
    samples: int, before: Array, cost: Array, violating: Array, first_change: int
) -> dict[str, float]:
    """What the first samples of a run in operation cost.

    Args:
        samples: Number of the run's samples so far.
        before: Cost (K,) that the start's θ has in each sample of the run, on the same noise.
        cost: Cost (K,) of each sample.
        violating: Whether each sample violates a bound, (K,).
        first_change: Number of samples before the first one with another θ; 0 while θ rests.

    Returns:
        `samples`; `J`, the mean cost of all of them; `first_change`, NaN while θ rests; of the
        samples since then (of all, while θ rests) the share of `violating` ones and `dearest`, the
        largest mean cost of `WINDOW` samples in a row; `dearer` and `excess` of `dearer_than`, NaN
        while θ rests. A figure of no sample is NaN.
    """
    changed = first_change > 0
    since = slice(first_change, samples)
    dearer, excess = dearer_than(before[since], cost[since]) if changed else (np.nan, np.nan)
    return {
        "samples": float(samples),
        "J": float(cost[:samples].mean()),
        "violating": float(violating[since].mean()) if first_change < samples else np.nan,
        "dearest": dearest(cost[since]),
        "first_change": float(first_change) if changed else np.nan,
        "dearer": dearer,
        "excess": excess,
    }


def dearest(cost: Array) -> float:
    """Largest mean of `WINDOW` samples in a row of K, (K,); of all where there are fewer."""
    if not np.isfinite(cost).all() or not len(cost):
        return float("inf") if len(cost) else float("nan")
    width = min(WINDOW, len(cost))
    total = np.concatenate([[0.0], np.cumsum(cost)])
    return float((total[width:] - total[:-width]).max() / width)


def dearer_than(before: Array, cost: Array) -> tuple[float, float]:
    """Number of shifts that are dearer than `before`, and the largest excess of a shift's mean.

    Costs (K,) of the same noise, in shifts of `SHIFT` samples; NaN without a shift. A shift is
    dearer where the excess of its `PARTS` is above zero by a one-sided t test at `LEVEL`
    (Bonferroni over the shifts).
    """
    shifts = len(cost) // SHIFT
    if not shifts:
        return np.nan, np.nan
    with np.errstate(invalid="ignore", divide="ignore"):
        parts = (cost - before)[: shifts * SHIFT].reshape(shifts, PARTS, -1).mean(axis=2)
        p = ttest_1samp(parts, 0.0, axis=1, alternative="greater").pvalue
    mean = parts.mean(axis=1)
    return float(((p < LEVEL / shifts) | (mean == np.inf)).sum()), float(mean.max())


def theta_at(log: str, mark: int) -> tuple[float, ...]:
    """θ that a run would have handed over after `mark` samples, from the text of its log."""
    rows = csv.DictReader(log.splitlines())
    row = next(row for row in rows if int(row["samples"]) == mark)
    return tuple(float(value) for name, value in row.items() if name.startswith("theta "))


class Judged(NamedTuple):
    """Operation on one scenario: by case and samples the greedy costs, and each run's life.

    `greedy[case][samples]` has a row for each training seed and a column for each seed of the
    noise, `optimum[samples]` (S,); `lives` has a row for each run and
    mark with `regret` (greedy), `life_regret`, `dearest` as a regret, and `excess` as a share of
    the optimum's cost.
    """

    greedy: dict[str, dict[int, pd.DataFrame]]
    optimum: dict[int, Array]
    lives: pd.DataFrame


def judged(lives: pd.DataFrame, greedy: pd.DataFrame, optimum: str) -> Judged:
    """Regrets of the rows of a scenario; without an optimum against the best case at the time."""
    costs: dict[str, dict[int, pd.DataFrame]] = {}
    for (case, samples), rows in greedy.groupby(["case", "samples"], sort=False):
        table = rows.assign(run=rows.training_seed.fillna(-1)).pivot(
            index="run", columns="seed", values="J"
        )
        costs.setdefault(case, {})[int(samples)] = table
    best = {samples: cost.to_numpy()[0] for samples, cost in costs.pop(optimum, {}).items()}
    where = ["training_seed", "samples"]
    key = ["case", *where]
    own = lives[lives.case == optimum].set_index(where).J
    if not best:
        for mark in lives.samples.unique().tolist():
            each = (cost[mark].to_numpy().mean(axis=0) for cost in costs.values() if mark in cost)
            best[mark] = min(each, key=np.mean)
        own = lives.groupby(where).J.min()
    found = lives[lives.case != optimum].merge(own.rename("optimal_J"), on=where, how="left")
    mean = greedy.groupby(key).J.mean().rename("greedy_J").reset_index()
    found = found.merge(mean, on=key, how="left")
    level = found.samples.map({samples: float(cost.mean()) for samples, cost in best.items()})
    found["regret"] = regrets(found.greedy_J.to_numpy(), level.to_numpy())
    optimal = found.optimal_J.to_numpy()
    found["life_regret"] = regrets(found.J.to_numpy(), optimal)
    found["dearest"] = regrets(found.dearest.to_numpy(), optimal)
    found["excess"] = relative(found.excess.to_numpy(), optimal)
    return Judged(costs, best, found)


def duration(seconds: float) -> str:
    """A time of operation in words of a calendar: `8 h`, `7 d`."""
    day = seconds / 86400.0
    return f"{day:.3g} d" if day >= 1.0 else f"{seconds / 3600.0:.3g} h"


def tables(
    found: Judged,
    scenario: str,
    about: Mapping[str, Any],
    against: Mapping[str, str | None],
    seconds: Mapping[str, float],
) -> Iterator[TextTable]:
    """Title, header and rows of a scenario's tables.

    `about` holds its `sampling_time` and the samples of the `columns`; `against` the counterpart
    of each case; `seconds` the processor time by case at the last of the samples.
    """
    marks, lives = about["columns"], found.lives
    times = [duration(mark * about["sampling_time"]) for mark in marks]
    for name, title in (
        ("regret", "Greedy regret in % of the θ that a run would hand over, median (worst)"),
        ("life_regret", "Regret in % of the run so far, exploration included, median (worst)"),
    ):
        grid = lives.pivot_table(
            index="case", columns="samples", values=name, aggfunc=["median", "max"], sort=False
        )
        rows = [
            [case, *(f"{_percent(row['median'][m])} ({_percent(row['max'][m])})" for m in marks)]
            for case, row in grid.iterrows()
        ]
        yield f"{title}: `{scenario}`", ("case", *times), rows
    end = lives[lives.samples == marks[-1]]
    last = end.groupby("case", sort=False)
    header = (
        "case", "runs", "first change, samples", "violating % since", "dearest 100 samples %",
        "updates", "model samples", "processor s",
    )  # fmt: skip
    middle = last.median(numeric_only=True)
    rows = [
        [
            case, str(last.size()[case]), _whole(row.first_change),
            f"{100 * row.violating:.2f}", f"{100 * row.dearest:.1f}",
            _whole(row.updates), _whole(row.model_samples),
            _whole(seconds.get(str(case), np.nan)),
        ]
        for case, row in middle.iterrows()
    ]  # fmt: skip
    yield f"What {times[-1]} of operation took on `{scenario}`, medians", header, rows
    rows = [
        [str(case), str(len(own)), f"{_whole(own.dearer.median())} ({_whole(own.dearer.max())})",
         f"{100 * own.excess.median():.2f} ({100 * own.excess.max():.2f})"]
        for case, own in end[end.dearer.notna()].groupby("case", sort=False)
    ]  # fmt: skip
    if rows:
        title = (
            f"Shifts of {SHIFT} samples dearer than θ as it starts, median (worst): `{scenario}`"
        )
        yield title, ("case", "runs", "shifts", "largest excess %"), rows
    rows = []
    for case, other in against.items():
        pairs = [found.greedy.get(str(name), {}) for name in (case, other)]
        if other and all(pairs) and found.optimum:
            line = [f"{case} − {other}"]
            for mark in marks:
                one, two = (costs[mark] for costs in pairs)
                if len(common := one.index.intersection(two.index)):
                    one, two = one.loc[common], two.loc[common]
                one, two = np.broadcast_arrays(one, two)  # a controller has one row, for any seed
                value, ends, p = paired_difference(one, two, found.optimum[mark])
                line.append(shown(value, ends, 100, 3) + ("" if np.isnan(p) else f", p {p:.2f}"))
            rows.append(line)
    if rows:
        title = f"Greedy regret less the counterpart's, percentage points [95 %]: `{scenario}`"
        yield title, ("case", *times), rows


def _percent(share: float) -> str:
    return shown(float(share), None, 100.0, 3)


def _whole(value: float) -> str:
    return "" if np.isnan(value) else f"{value:.0f}"
