"""Where the trainings of a study led θ: how far it went, and how far cases are apart."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from cosim.errors import StudyError
from cosim.statistics import Estimate, mean, shown
from cosim.studies.plan import Plan, Run
from cosim.studies.store import LOG, read_table
from cosim.text_tables import Table
from cosim.validation import instead

Where = tuple[str, str]
"""Scenario and case."""

PREFIX = "theta "
SHARES = (0.0, 0.5, 0.8, 1.0)
"""Shares of a training's samples at which θ is kept."""


def scales(plan: Plan) -> dict[str, float]:
    """Learning scale of each entry of θ, by its column of the log, over all trained cases."""
    found: dict[str, float] = {}
    for run in plan.runs:
        if run.training is not None:
            blocks = run.training.prepare().starting_parameters().blocks
            names = (f"{PREFIX}{label}" for label in blocks.labels)
            found |= dict(zip(names, blocks.scale.tolist(), strict=True))
    return found


def collected(runs: Sequence[Run], out: Path) -> pd.DataFrame:
    """A row for each training and share of its samples: θ as the log has it there."""
    rows = []
    for run in runs:
        if run.training is None:
            continue
        log = read_table(out / run.key.folder / LOG)
        for share in SHARES:
            known = log[log.samples <= share * log.samples.iloc[-1] + 0.5].iloc[-1]
            own: dict[str, Any] = {"scenario": run.key.scenario, "case": run.key.case}
            own |= {"training_seed": run.key.seed, "share": share, "samples": int(known.samples)}
            rows.append(own | {name: known[name] for name in log if name.startswith(PREFIX)})
    return pd.DataFrame(rows)


def tables(
    frame: pd.DataFrame,
    runs: pd.DataFrame,
    trained: Sequence[str],
    settings: Mapping[str, Any],
    scales: Mapping[str, float],
) -> list[Table]:
    """Title, header and rows: the course of θ in each case, and every two cases beside each other.

    Distances are Euclidean norms of entries in units of `scales`, those of the blocks `without`
    left out. `runs` gives J of each training; `settings` are the study's table `[theta]`. Raises
    StudyError for a block or a case that is not there.
    """
    entries = [name for name in frame if name.startswith(PREFIX)]
    blocks = {name: name.removeprefix(PREFIX).partition("[")[0] for name in entries}
    for name in (*settings["without"], *settings["blocks"]):
        if name not in (known := dict.fromkeys(blocks.values())):
            raise StudyError(f"[theta]: no log has a block '{name}'{instead(name, known)}")
    counted = [name for name in entries if blocks[name] not in settings["without"]]
    own = [name for name in entries if blocks[name] in settings["blocks"]]
    theta = frame.set_index(["scenario", "case", "share", "training_seed"])[entries].sort_index()
    scaled = theta[counted] / [scales.get(name, 1.0) for name in counted]
    names = {
        (scenario, case): f"{case} on {scenario}" if frame.scenario.nunique() > 1 else case
        for scenario, case in zip(frame.scenario, frame.case, strict=True)
    }
    costs = runs.set_index(["scenario", "case", "training_seed"]).J.sort_index()
    title = "Where θ went, in scaled entries"
    title += f" without {', '.join(settings['without'])}" if settings["without"] else ""
    for name in (name for pair in settings["pairs"] for name in pair):
        if name not in trained:
            raise StudyError(
                f"[theta], pairs: there is no trained case '{name}'{instead(name, trained)}"
            )
    pairs = [
        (a, b) for first, second in settings["pairs"] for a in names for b in names
        if a[1] == first and b[1] == second
    ] if settings["pairs"] else list(combinations(names, 2))  # fmt: skip
    return [
        (title, *_course_table(scaled, names)),
        (
            "How far θ and J of two cases are apart, training seed by training seed",
            *_apart(pairs, scaled, theta[own], costs, names),
        ),
    ]


def _way(theta: pd.DataFrame, where: Where) -> pd.Series[float]:
    """‖θ_K − θ_0‖ by training seed."""
    moved = theta.loc[(*where, 1.0)] - theta.loc[(*where, 0.0)]
    return pd.Series(np.linalg.norm(moved, axis=1), moved.index)


def _course_table(
    theta: pd.DataFrame, names: Mapping[Where, str]
) -> tuple[Sequence[str], list[list[str]]]:
    rows = []
    for where, name in names.items():
        way, end = _way(theta, where), theta.loc[(*where, 1.0)].to_numpy()
        apart = [float(np.linalg.norm(a - b)) for a, b in combinations(end, 2)]
        between = shown(float(np.median(apart)), None, 1, 3) if apart else ""
        rows.append([name, str(len(way)), shown(way.median(), None, 1, 3), between])
    return ("case", "runs", "way, median", "between seeds"), rows


def _apart(
    pairs: Sequence[tuple[Where, Where]],
    scaled: pd.DataFrame,
    own: pd.DataFrame,
    costs: pd.Series[float],
    names: Mapping[Where, str],
) -> tuple[Sequence[str], list[list[str]]]:
    """Differences of two cases, second less first, over the seeds that both have."""
    header = (
        "cases", "seeds", "ΔJ, mean [95 %]", "‖Δθ‖, median", "of the way", "‖mean Δθ‖",
        "by chance", "entries that differ",
        *(f"Δ {name.removeprefix(PREFIX)}, mean [95 %]" for name in own),
    )  # fmt: skip
    rows = []
    for first, second in pairs:
        change, moved = (
            (theta.loc[(*second, 1.0)] - theta.loc[(*first, 1.0)]).dropna()
            for theta in (scaled, own)
        )
        if not (seeds := len(change)):
            continue
        size = np.linalg.norm(change, axis=1)
        ways = (_way(scaled, first) + _way(scaled, second)).loc[change.index]
        cost = (costs.loc[second] - costs.loc[first]).loc[change.index].to_numpy(dtype=np.float64)
        # Root of E‖mean‖² of as many differences whose expectation is zero.
        chance = np.sqrt(change.var().sum() / seeds) if seeds > 1 else 0.0
        # Entries whose 95 % interval leaves zero out, as one in twenty does by chance.
        ends = [mean(column).t for column in change.to_numpy().T]
        differing = sum(each is not None and not each[0] <= 0 <= each[1] for each in ends)
        rows.append(
            [
                f"{names[second]} − {names[first]}",
                str(seeds),
                _shown(mean(cost)),
                shown(float(np.median(size)), None, 1, 3),
                shown(float(np.median(2 * size / ways)), None, 1, 3),
                shown(float(np.linalg.norm(change.mean())), None, 1, 3),
                shown(float(chance), None, 1, 3) if seeds > 1 else "",
                f"{differing}/{len(ends)}",
                *(_shown(mean(column)) for column in moved.to_numpy().T),
            ]
        )
    return header, rows


def _shown(estimate: Estimate) -> str:
    return shown(estimate.value, estimate.t, 1, 3)
