"""The figures of a study's report, from its results."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cosim.figures.curves import LearningCurve, chunks, plot_curves
from cosim.figures.regret import FINE, Dots, Profile, plot_profiles, plot_regret
from cosim.statistics import LEVEL, regrets
from cosim.study import online
from cosim.study.cases import BASELINES
from cosim.study.records import RunResult
from cosim.study.results import StudyResults
from cosim.study.summary import summary_rows

Array = NDArray[np.float64]

SUFFIXES = ("svg", "png")
COLUMNS = 2
"""Panels of a figure of learning curves side by side."""
LEVELS = 4
"""Baselines that are drawn as lines, at most."""
FOLDER = "figures"


def draw(results: StudyResults, folder: Path) -> dict[str, list[str]]:
    """Draw every figure into `folder`/figures; returns their names by scenario, "" for all."""
    target = folder / FOLDER
    target.mkdir(parents=True, exist_ok=True)
    drawn: dict[str, list[str]] = {}
    for scenario in results.scenarios:
        names = _regret(results, scenario, target)
        if results.about.get("online") is not None:
            names += online.draw(results, scenario, target, SUFFIXES)
        names += _curves(results, scenario, target)
        names += _profiles(results, [scenario], f"profile-{_safe(scenario)}", target)
        drawn[scenario] = names
    known = [s for s in results.scenarios if results.optimum(s) is not None]
    drawn[""] = _profiles(results, known, "profile", target) if len(known) > 1 else []
    return drawn


def _safe(name: str) -> str:
    return re.sub(r"[^\w.-]", "_", name)


def _regret(results: StudyResults, scenario: str, target: Path) -> list[str]:
    if results.optimum(scenario) is None:
        return []
    optimum = results.about["optimum"][scenario]
    found: dict[str, Dots] = {}
    for row in summary_rows(results, scenario):
        if row["case"] == optimum:
            continue
        runs = results.of(row["case"], scenario)
        name = "regret_iqm" if len(runs) > 1 else "regret_median"
        low, high = 100 * row[f"{name}_low"], 100 * row[f"{name}_high"]
        found[row["case"]] = Dots(
            results.cases[row["case"]].group,
            np.array([100 * results.regrets[run.key] for run in runs]),
            np.array([run.finished for run in runs]),
            100 * row[name],
            (low, high) if np.isfinite([low, high]).all() else None,
        )
    if not found:
        return []
    for suffix in SUFFIXES:
        plot_regret(found, target / f"regret-{_safe(scenario)}.{suffix}")
    return [f"regret-{_safe(scenario)}"]


def panels(results: StudyResults, scenario: str, baselines: bool = False) -> dict[str, list[str]]:
    """Trained cases in panels of a few, by group; `baselines` counts theirs too."""
    groups: dict[str, list[str]] = {}
    for name, case in results.cases.items():
        if case.trained and results.of(name, scenario) and (baselines or case.group != BASELINES):
            groups.setdefault(case.group, []).append(name)
    found = {}
    for group, names in groups.items():
        parts = chunks(names)
        for number, part in enumerate(parts, start=1):
            found[f"{group} ({number}/{len(parts)})" if len(parts) > 1 else group] = part
    return found


def _curves(results: StudyResults, scenario: str, target: Path) -> list[str]:
    """Figures of the learning curves: relative to J* in %, where it is known.

    None where no training was looked at more than once: a point is no curve.
    """
    trained = (run for name in results.cases for run in results.of(name, scenario) if run.curve)
    if not any(np.isfinite(run.curve["greedy_J"]).sum() > 1 for run in trained):
        return []
    optimum = results.optimum(scenario)
    known = optimum is not None and np.isfinite(optimum.greedy_J)
    best = optimum.greedy_J if optimum is not None and known else float("nan")

    def relative(cost: Array) -> Array:
        return 100 * regrets(cost, best) if known else cost

    everything = list(panels(results, scenario).items())
    levels = {
        name: float(relative(np.array(cost)))
        for name, cost in _baselines(results, scenario).items()
    }
    names = []
    for number, first in enumerate(range(0, len(everything), COLUMNS), start=1):
        shown = {
            title: {
                short: _curve(results.of(case, scenario), relative)
                for case, short in shortened(cases).items()
            }
            for title, cases in everything[first : first + COLUMNS]
        }
        name = f"curves-{_safe(scenario)}-{number}"
        for suffix in SUFFIXES:
            plot_curves(
                shown,
                levels,
                target / f"{name}.{suffix}",
                ylabel="regret %" if known else "J",
                relative=known,
            )
        names.append(name)
    return names


def shortened(cases: Sequence[str]) -> dict[str, str]:
    """Names of cases within one panel: without what they have in common, settings as values."""
    heads = {case.partition("(")[0] for case in cases}
    if len(heads) > 1 or len(cases) == 1:
        return {case: case for case in cases}
    return {case: _values(case.partition("(")[2].removesuffix(")")) or "defaults" for case in cases}


def _values(settings: str) -> str:
    """`a=1 b=word` as `a=1 word`: a word says what it is of, a number does not.

    A start is `from naive`, since `naive` alone is the baseline's name.
    """
    parts = []
    for part in settings.split():
        key, _, value = part.partition("=")
        said = value if re.match(r"[A-Za-z]", value) else part
        parts.append(f"from {value}" if key == "start" else said)
    return " ".join(parts)


def _baselines(results: StudyResults, scenario: str) -> dict[str, float]:
    """J of the baselines on the noise of the curves; a trained one with the end of its curve."""
    found: dict[str, float] = {}
    optimum = results.about["optimum"].get(scenario)
    for name, case in results.cases.items():
        runs = results.of(name, scenario)
        if case.group != BASELINES or not runs or name == optimum:
            continue
        ends = [run.greedy_J if run.seed is None else _last(run.curve["greedy_J"]) for run in runs]
        if np.isfinite(cost := float(np.median(ends))):
            found[name] = cost
    kept = sorted(found, key=lambda name: found[name])
    # Naive stays: it is where the curves begin.
    first = [n for n in kept if n == results.about["naive"].get(scenario)]
    chosen = [*first, *(name for name in kept if name not in first)][:LEVELS]
    return {name: found[name] for name in chosen}


def _last(values: Array) -> float:
    known = values[~np.isnan(values)]
    return float(known[-1]) if known.size else float("nan")


def _curve(runs: Sequence[RunResult], relative: Callable[[Array], Array]) -> LearningCurve:
    """Runs at their greedy evaluations; one that diverged is held where it ended.

    What training cost is the mean since the evaluation before.
    """
    points = [_points(run) for run in runs]
    samples = max((own for own, *_ in points), key=len)
    training, greedy = (
        np.array([_held(own[which], len(samples)) for own in points]) for which in (1, 2)
    )
    return LearningCurve(samples, relative(training), relative(greedy))


def _held(values: Array, count: int) -> Array:
    return np.append(values, np.full(count - len(values), _last(values)))


def _points(run: RunResult) -> tuple[Array, Array, Array]:
    """Samples, mean cost of training since the point before, and greedy cost, (K,) each."""
    curve = run.curve
    ends = np.flatnonzero(~np.isnan(curve["greedy_J"]))
    begins = np.concatenate([[0], ends[:-1] + 1]) if ends.size else ends
    training = [_mean(curve["J"][i : j + 1]) for i, j in zip(begins, ends, strict=True)]
    return curve["samples"][ends], np.array(training), curve["greedy_J"][ends]


def _mean(values: Array) -> float:
    known = values[~np.isnan(values)]
    return float(known.mean()) if known.size else float("nan")


def _profiles(
    results: StudyResults, scenarios: Sequence[str], name: str, target: Path
) -> list[str]:
    scenarios = [s for s in scenarios if results.optimum(s) is not None]
    if not scenarios:
        return []
    regrets = _regrets(results, scenarios)
    several = {case for case, strata in regrets.items() if sum(map(len, strata)) > 1}
    shown = {
        title: {short: regrets[case] for case, short in shortened(cases).items() if case in several}
        for title, cases in panels(results, scenarios[0], baselines=True).items()
    }
    shown = {title: cases for title, cases in shown.items() if cases}
    if not shown:
        return []
    finite = np.concatenate([r for cases in shown.values() for s in cases.values() for r in s])
    finite = finite[np.isfinite(finite)]
    top = max(float(finite.max(initial=1.0)), 10 * FINE)
    axis = np.geomspace(FINE, 1.3 * top, 200)
    drawn = {
        title: {case: _profile(strata, axis) for case, strata in cases.items()}
        for title, cases in shown.items()
    }
    for suffix in SUFFIXES:
        plot_profiles(drawn, target / f"{name}.{suffix}")
    return [name]


def _regrets(results: StudyResults, scenarios: Sequence[str]) -> Mapping[str, list[Array]]:
    """Regrets in % of each trained case that ran on all of the scenarios, an array for each."""
    found = {}
    for name, case in results.cases.items():
        strata = [
            np.array([100 * results.regrets[run.key] for run in results.of(name, scenario)])
            for scenario in scenarios
        ]
        if case.trained and all(len(stratum) for stratum in strata):
            found[name] = strata
    return found


def _profile(strata: Sequence[Array], axis: Array) -> Profile:
    """Share of runs whose regret is at most τ, with a stratified bootstrap band, pointwise."""
    below = [(stratum[:, None] <= axis).astype(float) for stratum in strata]
    count = sum(map(len, strata))
    share = sum(part.sum(axis=0) for part in below) / count
    rng = np.random.default_rng(0)
    draws = np.zeros((2000, len(axis)))
    for part in below:
        weights = rng.multinomial(len(part), np.full(len(part), 1 / len(part)), size=2000)
        draws += weights @ part
    low, high = np.quantile(draws / count, (0.5 - LEVEL / 2, 0.5 + LEVEL / 2), axis=0)
    return Profile(axis, np.asarray(share), low, high)
