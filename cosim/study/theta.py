"""Where the trainings of a study led θ: whether it has converged, and how far cases are apart."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cosim.errors import StudyError
from cosim.statistics import Estimate, mean, shown
from cosim.study.document import ThetaTable
from cosim.study.plan import Plan
from cosim.study.records import RunResult
from cosim.study.results import StudyResults
from cosim.study.store import RunKey, RunStore
from cosim.study.tables import KEYS, to_csv
from cosim.study.traces import THETA
from cosim.text_tables import parse_records, read_records
from cosim.validation import suggestion

Array = NDArray[np.float64]
Lines = list[list[str]]
Where = tuple[str, str]
"""Scenario and case."""

FILE = "theta.csv"
SHARES = (0.0, 0.5, 0.8, 1.0)
"""Shares of a training's samples at which θ is kept."""
COURSE = "Where θ went"
APART = "How far θ and J of two cases are apart, training seed by training seed"
CONVERGED = 0.05
"""Movement in the last fifth of a training, as a share of the way, below which it converged."""


def scales(plan: Plan) -> dict[str, float]:
    """Typical size of a change of each entry of θ, by name, over all trained cases."""
    found: dict[str, float] = {}
    for run in plan.runs:
        if run.training is not None:
            found |= plan.definition.trainer.scales(run.training)
    return found


def theta_csv(runs: Iterable[RunResult], stores: Mapping[str, RunStore]) -> str:
    """A row for each training and share of its samples: θ as the log has it there."""
    rows: list[dict[str, Any]] = []
    for run in runs:
        if run.seed is None:
            continue
        log = parse_records(stores[str(RunKey(*run.key))].progress().log)
        samples = np.array([float(row["samples"]) for row in log])
        for share in SHARES:
            row = log[int(np.flatnonzero(samples <= share * samples[-1] + 0.5)[-1])]
            entries = {k: float(v) for k, v in row.items() if k.startswith(THETA)}
            key = dict(zip(KEYS, run.key, strict=True))
            rows.append(key | {"share": share, "samples": int(float(row["samples"]))} | entries)
    names = list(dict.fromkeys(name for row in rows for name in row if name.startswith(THETA)))
    return to_csv((*KEYS, "share", "samples", *names), rows)


@dataclass(frozen=True)
class Course:
    """θ of the trainings of a case, in scaled entries: `theta` (runs, shares, entries)."""

    seeds: tuple[int, ...]
    theta: Array

    def of(self, seeds: Sequence[int]) -> Course:
        """That of these seeds alone."""
        return Course(tuple(seeds), self.theta[[self.seeds.index(seed) for seed in seeds]])

    @property
    def end(self) -> Array:
        """Where they ended, (runs, entries)."""
        last: Array = self.theta[:, -1]
        return last

    def moved(self, share: float) -> Array:
        """‖θ_K − θ_share·K‖ as a share of the way ‖θ_K − θ_0‖, (runs,)."""
        late = np.linalg.norm(self.end - self.theta[:, SHARES.index(share)], axis=1)
        moved: Array = late / np.maximum(self.way, np.finfo(np.float64).tiny)
        return moved

    @property
    def way(self) -> Array:
        """‖θ_K − θ_0‖, (runs,)."""
        way: Array = np.linalg.norm(self.end - self.theta[:, 0], axis=1)
        return way

    @property
    def between_seeds(self) -> float:
        """Median distance of two trainings' ends; there must be two."""
        distances = [float(np.linalg.norm(a - b)) for a, b in combinations(self.end, 2)]
        return float(np.median(distances))


def tables(results: StudyResults) -> list[tuple[str, tuple[str, ...], Lines]]:
    """Title, header and rows: the course of θ in each case, and every two cases beside each other.

    Distances are Euclidean norms of scaled entries, those of the blocks `without` left out.
    """
    if results.about.get("theta") is None:
        return []
    settings = ThetaTable.model_validate(results.about["theta"]["settings"])
    scale: Mapping[str, float] = results.about["theta"]["scales"]
    records = read_records(results.folder / FILE, StudyError)
    entries = [name for name in records[0] if name.startswith(THETA)] if records else []
    blocks = list(dict.fromkeys(map(_block, entries)))
    for name in (*settings.without, *settings.blocks):
        if name not in blocks:
            raise StudyError(
                f"[theta]: no log has a block '{name}'{suggestion(name, blocks)}; there are "
                f"{', '.join(blocks)}"
            )
    counted = [name for name in entries if _block(name) not in settings.without]
    courses = _courses(records, counted, scale)
    several = len({scenario for scenario, _ in courses}) > 1
    shown_entries = [name for name in entries if _block(name) in settings.blocks]
    title = f"{COURSE}, in scaled entries" + (
        f" without {', '.join(settings.without)}" if settings.without else ""
    )
    return [
        (title, *_course_lines(courses, several, settings.late)),
        (
            APART,
            *_apart(
                results,
                _pairs(results, settings.pairs, courses),
                courses,
                _courses(records, shown_entries),
                shown_entries,
                several,
            ),
        ),
    ]


def _block(entry: str) -> str:
    return entry.removeprefix(THETA).partition("[")[0]


def _courses(
    records: Sequence[Mapping[str, str]],
    entries: Sequence[str],
    scale: Mapping[str, float] | None = None,
) -> dict[Where, Course]:
    units = np.array([1.0 if scale is None else scale[name] for name in entries])
    grouped: dict[Where, dict[int, list[Array]]] = {}
    for row in records:
        runs = grouped.setdefault((row["scenario"], row["case"]), {})
        values = np.array([float(row[name] or "nan") for name in entries]) / units
        runs.setdefault(int(row["training_seed"]), []).append(values)
    return {
        where: Course(tuple(runs), np.array(list(runs.values()))) for where, runs in grouped.items()
    }


def _course_lines(
    courses: Mapping[Where, Course], several: bool, late: bool
) -> tuple[tuple[str, ...], Lines]:
    header: tuple[str, ...] = ("case", "runs", "way, median", "between seeds")
    if late:
        header += (
            "last half / way, median", "worst", "last fifth / way, median", "worst",
            f"converged (< {CONVERGED})",
        )  # fmt: skip
    lines = []
    for where, course in courses.items():
        line = [
            _name(where, several),
            str(len(course.seeds)),
            shown(float(np.median(course.way)), None, 1, 3),
            shown(course.between_seeds, None, 1, 3) if len(course.seeds) > 1 else "",
        ]
        if late:
            half, fifth = course.moved(0.5), course.moved(0.8)
            line += [shown(float(f(half)), None, 1, 2) for f in (np.median, np.max)]
            line += [shown(float(f(fifth)), None, 1, 2) for f in (np.median, np.max)]
            line.append(f"{int((fifth < CONVERGED).sum())}/{len(fifth)}")
        lines.append(line)
    return header, lines


def _pairs(
    results: StudyResults, wanted: Sequence[Sequence[str]], courses: Mapping[Where, Course]
) -> list[tuple[Where, Where]]:
    """The wanted pairs, else all; raises StudyError on a name of no trained case."""
    trained = [name for name, case in results.cases.items() if case.trained]
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
    results: StudyResults,
    pairs: Sequence[tuple[Where, Where]],
    courses: Mapping[Where, Course],
    shown_courses: Mapping[Where, Course],
    entries: Sequence[str],
    several: bool,
) -> tuple[tuple[str, ...], Lines]:
    """Of two cases the differences, second less first, over the seeds that both have."""
    header = (
        "cases", "seeds", "ΔJ, mean [95 %]", "‖Δθ‖, median", "of the way", "‖mean Δθ‖",
        "by chance", "entries that differ",
        *(f"Δ {name.removeprefix(THETA)}, mean [95 %]" for name in entries),
    )  # fmt: skip
    lines = []
    for first, second in pairs:
        common = [seed for seed in courses[first].seeds if seed in courses[second].seeds]
        if not common:
            continue
        before, after = courses[first].of(common), courses[second].of(common)
        change = after.end - before.end
        size = np.linalg.norm(change, axis=1)
        moved = shown_courses[second].of(common).end - shown_courses[first].of(common).end
        lines.append(
            [
                f"{_name(second, several)} − {_name(first, several)}",
                str(len(common)),
                _shown(mean(_costs(results, second, common) - _costs(results, first, common))),
                shown(float(np.median(size)), None, 1, 3),
                shown(float(np.median(2 * size / (before.way + after.way))), None, 1, 3),
                shown(float(np.linalg.norm(change.mean(axis=0))), None, 1, 3),
                shown(_by_chance(change), None, 1, 3) if len(common) > 1 else "",
                f"{sum(_differs(mean(column)) for column in change.T)}/{change.shape[1]}",
                *(_shown(mean(column)) for column in moved.T),
            ]
        )
    return header, lines


def _costs(results: StudyResults, where: Where, seeds: Sequence[int]) -> Array:
    """J of a case's trainings, (runs,)."""
    runs = {run.seed: run.J for run in results.of(where[1], where[0])}
    return np.array([runs[seed] for seed in seeds])


def _by_chance(change: Array) -> float:
    """Root of E‖mean‖² of as many differences whose expectation is zero, from their variance."""
    return float(np.sqrt(change.var(axis=0, ddof=1).sum() / len(change)))


def _differs(estimate: Estimate) -> bool:
    """Whether the 95 % interval leaves zero out, which one in twenty does by chance."""
    return estimate.t is not None and not estimate.t[0] <= 0 <= estimate.t[1]


def _shown(estimate: Estimate) -> str:
    return shown(estimate.value, estimate.t, 1, 3)


def _name(where: Where, several: bool) -> str:
    scenario, case = where
    return f"{case} on {scenario}" if several else case
