"""Where the trainings of a study led θ: whether it has converged, and how far cases are apart."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from cosim.errors import StudyError
from cosim.statistics import Estimate, mean, shown
from cosim.studies.store import LOG
from cosim.studies.tables import read_table
from cosim.validation import suggestion

if TYPE_CHECKING:
    from cosim.studies.plan import Plan, Run, Training

Array = NDArray[np.float64]
Table = tuple[str, Sequence[str], list[list[str]]]
Where = tuple[str, str]
"""Scenario and case."""

PREFIX = "theta "
SHARES = (0.0, 0.5, 0.8, 1.0)
"""Shares of a training's samples at which θ is kept."""
CONVERGED = 0.05
"""Movement in the last fifth of a training, as a share of the way, below which it converged."""


def scales(plan: Plan) -> dict[str, float]:
    """Typical size of a change of each entry of θ, by name, over all trained cases."""
    found: dict[str, float] = {}
    for run in plan.runs:
        if run.training is not None:
            found |= _scales(run.training)
    return found


def _scales(training: Training) -> dict[str, float]:
    """Learning scale of each entry of a training's θ, by its column of the log."""
    run = training.prepare()
    blocks = run.starting_parameters().blocks
    names = (f"{PREFIX}{label}" for label in blocks.labels)
    return dict(zip(names, blocks.scale.tolist(), strict=True))


def collected(runs: Sequence[Run], out: Path) -> pd.DataFrame:
    """A row for each training and share of its samples: θ as the log has it there."""
    rows = []
    for run in runs:
        if run.training is None:
            continue
        log = read_table(out / run.key.folder / LOG)
        for share in SHARES:
            known = log[log.samples <= share * log.samples.iloc[-1] + 0.5].iloc[[-1]]
            entries = known[[name for name in log if name.startswith(PREFIX)]].astype(float)
            entries.insert(0, "samples", known.samples.astype(int))
            for name, value in (
                ("share", share), ("training_seed", run.key.seed), ("case", run.key.case),
                ("scenario", run.key.scenario),
            ):  # fmt: skip
                entries.insert(0, name, value)
            rows.append(entries)
    return pd.concat(rows, ignore_index=True) if rows else pd.DataFrame()


class Course(NamedTuple):
    """θ of the trainings of a case, in scaled entries: `theta` (runs, shares, entries)."""

    seeds: list[int]
    theta: Array

    def of(self, seeds: Sequence[int]) -> Course:
        """The course of these seeds alone."""
        return Course(list(seeds), self.theta[[self.seeds.index(seed) for seed in seeds]])

    @property
    def end(self) -> Array:
        """θ at the end, (runs, entries)."""
        return np.asarray(self.theta[:, -1])

    @property
    def way(self) -> Array:
        """‖θ_K − θ_0‖, (runs,)."""
        return np.asarray(np.linalg.norm(self.end - self.theta[:, 0], axis=1))

    def moved(self, share: float) -> Array:
        """‖θ_K − θ_share·K‖ as a share of the way, (runs,)."""
        late = np.linalg.norm(self.end - self.theta[:, SHARES.index(share)], axis=1)
        return np.asarray(late / np.maximum(self.way, np.finfo(np.float64).tiny))


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
    blocks = list(dict.fromkeys(map(_block, entries)))
    for name in (*settings["without"], *settings["blocks"]):
        if name not in blocks:
            raise StudyError(
                f"[theta]: no log has a block '{name}'{suggestion(name, blocks)}; there are "
                f"{', '.join(blocks)}"
            )
    counted = [name for name in entries if _block(name) not in settings["without"]]
    own = [name for name in entries if _block(name) in settings["blocks"]]
    courses = _courses(frame, counted, scales)
    costs = {
        where: dict(zip(rows.training_seed, rows.J, strict=True))
        for where, rows in runs.groupby(["scenario", "case"], sort=False)
    }
    several = frame.scenario.nunique() > 1
    names = {where: f"{where[1]} on {where[0]}" if several else where[1] for where in courses}
    title = "Where θ went, in scaled entries"
    title += f" without {', '.join(settings['without'])}" if settings["without"] else ""
    pairs = _pairs(trained, settings["pairs"], list(courses))
    unscaled = _courses(frame, own, {})
    return [
        (title, *_course_table(courses, names, settings["late"])),
        (
            "How far θ and J of two cases are apart, training seed by training seed",
            *_apart(pairs, courses, unscaled, costs, names, own),
        ),
    ]


def _block(entry: str) -> str:
    return entry.removeprefix(PREFIX).partition("[")[0]


def _courses(
    frame: pd.DataFrame, entries: Sequence[str], scales: Mapping[str, float]
) -> dict[Where, Course]:
    units = np.array([scales.get(name, 1.0) for name in entries])
    found = {}
    for where, rows in frame.groupby(["scenario", "case"], sort=False):
        theta = rows[list(entries)].to_numpy(dtype=np.float64) / units
        seeds = [int(seed) for seed in rows.training_seed.iloc[:: len(SHARES)]]
        found[where] = Course(seeds, theta.reshape(len(seeds), len(SHARES), len(entries)))
    return found


def _course_table(
    courses: Mapping[Where, Course], names: Mapping[Where, str], late: bool
) -> tuple[Sequence[str], list[list[str]]]:
    header: tuple[str, ...] = ("case", "runs", "way, median", "between seeds")
    if late:
        header += (
            "last half / way, median", "worst", "last fifth / way, median", "worst",
            f"converged (< {CONVERGED})",
        )  # fmt: skip
    rows = []
    for where, course in courses.items():
        apart = [float(np.linalg.norm(a - b)) for a, b in combinations(course.end, 2)]
        row = [
            names[where],
            str(len(course.seeds)),
            shown(float(np.median(course.way)), None, 1, 3),
        ]
        row.append(shown(float(np.median(apart)), None, 1, 3) if apart else "")
        if late:
            half, fifth = course.moved(0.5), course.moved(0.8)
            row += [shown(float(f(half)), None, 1, 2) for f in (np.median, np.max)]
            row += [shown(float(f(fifth)), None, 1, 2) for f in (np.median, np.max)]
            row.append(f"{int((fifth < CONVERGED).sum())}/{len(fifth)}")
        rows.append(row)
    return header, rows


def _pairs(
    trained: Sequence[str], wanted: Sequence[Sequence[str]], courses: Sequence[Where]
) -> list[tuple[Where, Where]]:
    """The wanted pairs, else all."""
    for name in (name for pair in wanted for name in pair):
        if name not in trained:
            raise StudyError(
                f"[theta], pairs: there is no trained case '{name}'{suggestion(name, trained)}; "
                f"there are {', '.join(trained)}"
            )
    if not wanted:
        return list(combinations(courses, 2))
    return [
        (a, b) for first, second in wanted for a in courses for b in courses
        if a[1] == first and b[1] == second
    ]  # fmt: skip


def _apart(
    pairs: Sequence[tuple[Where, Where]],
    courses: Mapping[Where, Course],
    unscaled: Mapping[Where, Course],
    costs: Mapping[Where, Mapping[int, float]],
    names: Mapping[Where, str],
    entries: Sequence[str],
) -> tuple[Sequence[str], list[list[str]]]:
    """Differences of two cases, second less first, over the seeds that both have."""
    header = (
        "cases", "seeds", "ΔJ, mean [95 %]", "‖Δθ‖, median", "of the way", "‖mean Δθ‖",
        "by chance", "entries that differ",
        *(f"Δ {name.removeprefix(PREFIX)}, mean [95 %]" for name in entries),
    )  # fmt: skip
    rows = []
    for first, second in pairs:
        common = [seed for seed in courses[first].seeds if seed in courses[second].seeds]
        if not common:
            continue
        before, after = courses[first].of(common), courses[second].of(common)
        change = after.end - before.end
        size = np.linalg.norm(change, axis=1)
        moved = unscaled[second].of(common).end - unscaled[first].of(common).end
        cost = np.array([costs[second][seed] - costs[first][seed] for seed in common])
        # Root of E‖mean‖² of as many differences whose expectation is zero.
        chance = np.sqrt(change.var(axis=0, ddof=1).sum() / len(change)) if len(change) > 1 else 0
        rows.append(
            [
                f"{names[second]} − {names[first]}",
                str(len(common)),
                _shown(mean(cost)),
                shown(float(np.median(size)), None, 1, 3),
                shown(float(np.median(2 * size / (before.way + after.way))), None, 1, 3),
                shown(float(np.linalg.norm(change.mean(axis=0))), None, 1, 3),
                shown(float(chance), None, 1, 3) if len(common) > 1 else "",
                f"{sum(_differs(mean(column)) for column in change.T)}/{change.shape[1]}",
                *(_shown(mean(column)) for column in moved.T),
            ]
        )
    return header, rows


def _differs(estimate: Estimate) -> bool:
    """Whether the 95 % interval leaves zero out, which one in twenty does by chance."""
    return estimate.t is not None and not estimate.t[0] <= 0 <= estimate.t[1]


def _shown(estimate: Estimate) -> str:
    return shown(estimate.value, estimate.t, 1, 3)
