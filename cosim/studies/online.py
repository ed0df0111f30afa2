"""Cost of a study's runs themselves, exploration included."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from cosim.protocols import Array
from cosim.statistics import regret, regrets, shown
from cosim.studies.plan import ONLINE, Run
from cosim.studies.store import measured
from cosim.studies.tables import Table

Course = tuple[Array, Array, Array]
"""Samples (K,) at the blocks' ends, mean costs (R, K) of the runs, and the optimum's (R, K)."""
HEADER = ("case", "runs", "regret %, mean [95 %]", "median", "worst")
COLUMNS = ["scenario", "case", "training_seed", "samples", "J"]


def collected(runs: Sequence[Run], curves: pd.DataFrame, out: Path) -> pd.DataFrame:
    """A row for each block of each run: the samples at its end, and its mean cost.

    A training's blocks are the rows of its log, in `curves`; the first, θ at the start, has no
    cost.
    """
    found = []
    for run in runs:
        key = {"scenario": run.key.scenario, "case": run.key.case}
        if run.training is not None:
            own = (curves[list(key)] == key).all(axis=1) & (curves.training_seed == run.key.seed)
            found.append(curves[own].dropna(subset="J")[COLUMNS])
        elif (beside := run.noise.get(ONLINE)) is not None:
            rows = measured(out / run.key.folder, run, ONLINE).reset_index()
            ends = beside.block * (rows.groupby("seed").cumcount() + 1)
            values = {
                "training_seed": rows.seed.astype("Int64"),
                "samples": np.minimum(ends, beside.steps).astype("Int64"),
                "J": rows.J,
            }
            found.append(pd.DataFrame(values).assign(**key)[COLUMNS])
    return pd.concat(found, ignore_index=True) if found else pd.DataFrame(columns=COLUMNS)


def courses(online: pd.DataFrame, optimum: str) -> dict[str, Course]:
    """The course of each case on a scenario, over the training seeds that the optimum ran, too."""
    costs: dict[str, dict[int, Array]] = {}
    samples: dict[str, Array] = {}
    for (case, seed), rows in online.groupby(["case", "training_seed"], sort=False):
        costs.setdefault(case, {})[seed] = rows.J.to_numpy()
        samples.setdefault(case, rows.samples.to_numpy(dtype=np.float64))
    best = costs.get(optimum, {})
    found = {}
    for case, runs in costs.items():
        seeds = sorted(s for s in runs if s in best and len(runs[s]) == len(best[s]))
        if seeds:
            own, other = (np.array([which[s] for s in seeds]) for which in (runs, best))
            found[case] = (samples[case], own, other)
    return found


def table(online: pd.DataFrame, scenario: str, optimum: str, settings: Mapping[str, Any]) -> Table:
    """Title, header and rows: regret of each case's runs, and of each period; least first.

    Against the optimum's own run on the same noise, paired over the training seeds. `settings` are
    the study's table `[online]`.
    """
    each = settings["period"] // settings["block"]
    found = courses(online, optimum)
    periods = max((best.shape[1] // each for _, _, best in found.values()), default=0)
    rows = []
    for case, (_, own, best) in found.items():
        mean = regret(own.mean(axis=1), best.mean(axis=1))
        single = regrets(own.mean(axis=1), best.mean(axis=1))
        cut = [slice(i * each, (i + 1) * each) for i in range(periods)]
        parts = [regret(own[:, c].mean(axis=1), best[:, c].mean(axis=1)).value for c in cut]
        line = [case, str(len(own)), shown(mean.value, mean.t, 100, 3)]
        line += [shown(float(f(single)), None, 100, 3) for f in (np.median, np.max)]
        rows.append((mean.value, [*line, *(shown(part, None, 100, 3) for part in parts)]))
    header = (*HEADER, *(f"period {i + 1}" for i in range(periods)))
    title = f"The runs' own samples on `{scenario}`: regret in %, exploration's cost included"
    return title, header, [line for _, line in sorted(rows, key=lambda row: row[0])]
