"""Tables of learning in operation: regrets of the θ at given times, and what it has cost."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from cosim.protocols import Array
from cosim.result import TextTable
from cosim.statistics import paired_difference, shown
from cosim.studies.operation import LIFE, SHIFT
from cosim.studies.store import KEYS, LOG, ONLINE, RunStore, greedy_file, read_table

COLUMNS = [*KEYS, "samples", *LIFE]
GREEDY_COLUMNS = [*KEYS, "samples", "seed", "J"]


def collected(stores: Sequence[RunStore]) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Rows of the lives, by run and mark, and of the greedy evaluations, by noise seed, too.

    The optimum has a life on the noise of every training seed, of which J is known.
    """
    lives, greedy = [], []
    for store in (store for store in stores if store.run.marks):
        run, key = store.run, store.run.key
        names = {"scenario": key.scenario, "case": key.case}
        for mark in run.marks:
            rows = store.measured(greedy_file(mark)).rename_axis("seed").reset_index()
            greedy.append(rows.assign(**names, training_seed=key.seed, samples=mark))
        if run.training is not None:
            rows = read_table(store.folder / LOG, types={"samples": int})
            lives.append(rows.assign(**names, training_seed=key.seed))
        elif ONLINE in run.noise:
            for seed, blocks in sorted(store.indicators(ONLINE).items()):
                ends = run.noise[ONLINE].block * np.arange(1, len(blocks["J"]) + 1)
                so_far = pd.Series(blocks["J"]).expanding().mean()
                rows = pd.DataFrame({"samples": ends, "J": so_far})
                rows = rows[rows.samples.isin(run.marks)]
                lives.append(rows.assign(**names, training_seed=seed))
    tables = []
    for found, columns in ((lives, COLUMNS), (greedy, GREEDY_COLUMNS)):
        table = pd.concat(found, ignore_index=True) if found else pd.DataFrame(columns=columns)
        tables.append(table.reindex(columns=columns).astype({"training_seed": "Int64"}))
    return tables[0], tables[1]


class Judged(NamedTuple):
    """Operation on one scenario: by case and samples the greedy costs, and each run's life.

    `greedy[case][samples]` (R, S), `optimum[samples]` (S,); `lives` has a row for each run and
    mark with `regret` (greedy), `life_regret`, `dearest` as a regret, and `excess` as a share of
    the optimum's cost.
    """

    greedy: dict[str, dict[int, Array]]
    optimum: dict[int, Array]
    lives: pd.DataFrame


def judged(lives: pd.DataFrame, greedy: pd.DataFrame, optimum: str) -> Judged:
    """Regrets of the rows of a scenario; without an optimum against the best case at the time."""
    costs: dict[str, dict[int, Array]] = {}
    for (case, samples), rows in greedy.groupby(["case", "samples"], sort=False):
        table = rows.assign(run=rows.training_seed.fillna(-1)).pivot(
            index="run", columns="seed", values="J"
        )
        costs.setdefault(case, {})[int(samples)] = table.to_numpy(dtype=np.float64)
    best = {samples: cost[0] for samples, cost in costs.pop(optimum, {}).items()}
    where = ["training_seed", "samples"]
    own = lives[lives.case == optimum].set_index(where).J
    if not best:
        for mark in lives.samples.unique().tolist():
            each = (cost[mark].mean(axis=0) for cost in costs.values() if mark in cost)
            best[mark] = min(each, key=np.mean)
        own = lives.groupby(where).J.min()
    found = lives[lives.case != optimum].merge(own.rename("optimal_J"), on=where, how="left")
    mean = greedy.groupby([*KEYS[1:], "samples"]).J.mean().rename("greedy_J").reset_index()
    found = found.merge(mean, on=[*KEYS[1:], "samples"], how="left")
    level = found.samples.map({samples: float(cost.mean()) for samples, cost in best.items()})
    found["regret"] = (found.greedy_J - level) / level.abs()
    found["life_regret"] = (found.J - found.optimal_J) / found.optimal_J.abs()
    found["dearest"] = (found.dearest - found.optimal_J) / found.optimal_J.abs()
    found["excess"] = found.excess / found.optimal_J.abs()
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
) -> list[TextTable]:
    """Title, header and rows of a scenario's tables.

    `about` holds its `sampling_time` and the samples of the `columns`; `against` the counterpart
    of each case; `seconds` the processor time by case at the last of the samples.
    """
    marks, lives = about["columns"], found.lives
    times = [duration(mark * about["sampling_time"]) for mark in marks]
    result: list[TextTable] = []
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
        result.append((f"{title}: `{scenario}`", ("case", *times), rows))
    last = lives[lives.samples == marks[-1]].groupby("case", sort=False)
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
    result.append((f"What {times[-1]} of operation took on `{scenario}`, medians", header, rows))
    shifts = lives[(lives.samples == marks[-1]) & lives.dearer.notna()].groupby("case", sort=False)
    rows = [
        [str(case), f"{_whole(own.dearer.median())} ({_whole(own.dearer.max())})",
         f"{100 * own.excess.median():.2f} ({100 * own.excess.max():.2f})"]
        for case, own in shifts
    ]  # fmt: skip
    if rows:
        title = (
            f"Shifts of {SHIFT} samples dearer than θ as it starts, median (worst): `{scenario}`"
        )
        result.append((title, ("case", "shifts", "largest excess %"), rows))
    rows = []
    for case, other in against.items():
        pairs = [found.greedy.get(str(name), {}) for name in (case, other)]
        if other and all(pairs) and found.optimum:
            line = [f"{case} − {other}"]
            for mark in marks:
                one, two = np.broadcast_arrays(*(costs[mark] for costs in pairs))
                value, ends, p = paired_difference(one, two, found.optimum[mark])
                line.append(shown(value, ends, 100, 3) + ("" if np.isnan(p) else f", p {p:.2f}"))
            rows.append(line)
    if rows:
        title = f"Greedy regret less the counterpart's, percentage points [95 %]: `{scenario}`"
        result.append((title, ("case", *times), rows))
    return result


def _percent(share: float) -> str:
    return shown(float(share), None, 100.0, 3)


def _whole(value: float) -> str:
    return "" if np.isnan(value) else f"{value:.0f}"
