"""Cost of a study's runs themselves, exploration included: its table and its figure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cosim.errors import StudyError
from cosim.figures.style import (
    REFERENCE,
    EndLabel,
    Look,
    figure,
    label,
    label_ends,
    plain,
    regret_axis,
    samples_axis,
)
from cosim.protocols import Array
from cosim.statistics import regret, regret_terms, regrets, shown
from cosim.studies.store import accompanied
from cosim.validation import suggestion

if TYPE_CHECKING:
    from cosim.studies.plan import Run

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
        elif run.online is not None:
            rows = accompanied(out / run.key.folder, run.online)
            ends = run.online.block * (rows.groupby("seed").cumcount() + 1)
            values = {
                "training_seed": rows.seed.astype("Int64"),
                "samples": np.minimum(ends, run.online.steps).astype("Int64"),
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


def table(
    online: pd.DataFrame, scenario: str, optimum: str, settings: Mapping[str, Any]
) -> tuple[str, Sequence[str], list[list[str]]]:
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


def online_figure(
    courses: Mapping[str, Course],
    logs: Mapping[str, pd.DataFrame],
    looks: Mapping[str, Look],
    settings: Mapping[str, Any],
    optimum: str,
) -> Figure:
    """A panel for each signal of the logs; below the mean regret of each block and since the start.

    `logs` are those of the first training seed by case. Vertical lines stand at multiples of the
    period. Raises StudyError for a signal that no log has.
    """
    names = list(settings["signals"]) if logs else []
    known = list(dict.fromkeys(column for log in logs.values() for column in log))
    for name in names:
        if name not in known:
            raise StudyError(
                f"online.signals: no log has a column '{name}'{suggestion(name, known)}"
            )
    shown_cases = {case: course for case, course in courses.items() if case != optimum}
    blocks = {
        case: np.mean([100 * regret_terms(a, b) for a, b in zip(own, best, strict=True)], axis=0)
        for case, (_, own, best) in shown_cases.items()
    }
    so_far = {c: np.cumsum(v) / np.arange(1, len(v) + 1) for c, v in blocks.items()}
    with figure(1.25 * (len(names) + 2) + 1.2) as drawn:
        ratios = [1.0] * len(names) + [1.7, 1.7]
        grid = drawn.subplots(len(ratios), 1, sharex=True, squeeze=False, height_ratios=ratios)
        panels = [axes for (axes,) in grid]
        end = max(float(samples[-1]) for samples, *_ in shown_cases.values())
        for axes in panels:
            for edge in np.arange(settings["period"], end, settings["period"]):
                axes.axvline(edge, color=REFERENCE, linewidth=0.6, linestyle=(0, (1, 2)))
        for axes, name in zip(panels, names, strict=False):
            _signal(axes, name, {c: log for c, log in logs.items() if name in log}, looks)
        titles = ("regret % of the block", "regret % since the start")
        for axes, means, title in zip(panels[-2:], (blocks, so_far), titles, strict=True):
            for case, values in means.items():
                color, line = looks[case]
                axes.plot(shown_cases[case][0], values, color=color, linestyle=line, linewidth=1.2)
            regret_axis(axes, "y", np.concatenate([[0.0], *means.values()]), 0.1)
            axes.set_ylabel(title)
        samples_axis(panels[-1], end, "samples of the run")
        ends = [EndLabel(plain(c), float(so_far[c][-1]), looks[c].color) for c in so_far]
        label_ends(drawn, [(panels[-1], ends)])
    return drawn


def _signal(
    axes: Axes, name: str, logs: Mapping[str, pd.DataFrame], looks: Mapping[str, Look]
) -> None:
    """A line for each case, or one where the signal is the same in all."""
    lines = {case: log[["samples", name]].dropna().to_numpy().T for case, log in logs.items()}
    first = next(iter(lines.values()))
    if all(np.array_equal(line, first) for line in lines.values()):
        axes.plot(*first, color=REFERENCE, linewidth=1.2)
    else:
        for case, line in lines.items():
            color, style = looks[case]
            axes.plot(*line, color=color, linestyle=style, linewidth=1.2)
    axes.set_ylabel(label(name.removeprefix("theta "), ""))
