"""Tables of the sweep, and the baselines that they need.

    python results/learning/tables.py --runs results/learning/runs

Evaluates naive, tuned and optimal on the sweep's held-out seeds (once; kept in OUT), then writes to
OUT: evaluation.csv (controller and noise seed), runs.csv (training run), curves.csv and README.md.
Baselines that cannot be built yet are named in the README. The figures are drawn by figures.py.
"""

from __future__ import annotations

import argparse
import csv
import io
import json
import tomllib
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from cases import CASES
from numpy.typing import NDArray
from sweep import FIGURES, STEPS, evaluate

from controllers.storage import write_atomically
from cosim import FmuPlant, Scenario
from cosim.cli.compose import build_controller
from cosim.errors import CosimError
from cosim.evaluation.statistics import Estimate, ratio

Array = NDArray[np.float64]
SEEDS = 50
BASELINES = ("naive", "tuned", "optimal")
TARGETS = {  # median and worst share of the gap closed that the benchmark asks for
    "actor-critic": (0.995, 0.98),
    "batch-q-learning": (0.98, 0.95),
    "q-learning": (0.95, None),
}


def read(path: Path) -> dict[str, Array]:
    """Columns of a CSV of numbers; an empty cell is NaN."""
    with path.open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    return {k: np.array([float(row[k]) if row[k] else np.nan for row in rows]) for k in rows[0]}


def to_csv(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """CSV text; floats with eight digits."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(header)
    for row in rows:
        writer.writerow([f"{v:.8g}" if isinstance(v, float) else v for v in row])
    return stream.getvalue()


def baselines(out: Path, scenario: Scenario) -> dict[str, dict[str, Array]]:
    """Figures of each baseline by held-out seed; those that exist already are read."""
    found = {}
    for name in BASELINES:
        path = out / "baselines" / f"{scenario.name}-{name}.csv"
        path.parent.mkdir(parents=True, exist_ok=True)
        if not path.exists():
            try:
                controller = build_controller(name, scenario)
            except CosimError as error:
                print(f"{scenario.name}: {name} is left out: {error}")
                continue
            with FmuPlant(scenario) as plant:
                write_atomically(path, evaluate(plant, controller, SEEDS))
        found[name] = read(path)
    return found


class Runs:
    """The training runs of one case on one scenario, in the order of their seeds."""

    def __init__(self, folder: Path) -> None:
        folders = sorted(path.parent for path in folder.glob("*/evaluation.csv"))
        self.seeds = [int(path.name) for path in folders]
        self.evaluations = [read(path / "evaluation.csv") for path in folders]
        self.logs = [read(path / "learning.csv") for path in folders]
        self.summaries = [json.loads((path / "summary.json").read_text()) for path in folders]
        self.theta = [
            tomllib.loads((path / "parameters.toml").read_text())["theta"] for path in folders
        ]

    def __len__(self) -> int:
        """Number of runs."""
        return len(self.seeds)

    def figure(self, name: str) -> Array:
        """Mean of a figure over the held-out seeds, for each run."""
        return np.array([evaluation[name].mean() for evaluation in self.evaluations])

    def steadiness(self) -> Array:
        """Worst greedy J in the last 20 % of training relative to the last one, less 1."""
        worst = []
        for log in self.logs:
            known = ~np.isnan(log["greedy_J"])
            late = known & (log["samples"] > 0.8 * log["samples"][-1])
            worst.append(log["greedy_J"][late].max() / log["greedy_J"][known][-1] - 1)
        return np.array(worst)


def percent(estimate: Estimate) -> str:
    """Value and 95 % interval in percent."""
    if estimate.t is None:
        return f"{100 * estimate.value:.2f}"
    low, high = estimate.t
    return f"{100 * estimate.value:.2f} [{100 * low:.2f}, {100 * high:.2f}]"


def gap(reference: dict[str, dict[str, Array]], cost: Array) -> Estimate:
    """Gap closed with its paired interval over the held-out seeds."""
    naive, optimum = (reference[name]["J"][: len(cost)] for name in ("naive", "optimal"))
    return ratio(naive - cost, naive - optimum)


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Markdown table."""
    rule = ["---", *["---:"] * (len(header) - 1)]
    return "\n".join("| " + " | ".join(row) + " |" for row in (header, rule, *rows)) + "\n"


def scenario_page(
    scenario: Scenario, reference: dict[str, dict[str, Array]], cases: dict[str, Runs]
) -> str:
    """The README's section of one scenario."""
    known = "optimal" in reference
    text = [f"## Scenario `{scenario.name}`\n"]
    rows = [
        [
            name,
            *(f"{reference[name][f].mean():.{d}f}" for f, d in (("economic_cost", 1), ("J", 1))),
            f"{reference[name]['mean_violation'].mean():.5f}",
            f"{100 * reference[name]['violating_share'].mean():.2f}",
            percent(gap(reference, reference[name]["J"])) if known else "",
        ]
        for name in reference
    ]
    header = ("controller", "economic cost", "J", "mean violation", "violating %", "gap closed %")
    text.append(table(header, rows))
    rows = []
    for name, runs in cases.items():
        order = np.argsort(runs.figure("J"))
        middle, worst = order[(len(order) - 1) // 2], order[-1]
        algorithm = CASES[name].algorithm
        finished = sum(s["status"] == "finished" for s in runs.summaries)
        row = [name, str(CASES[name].samples), f"{finished}/{len(runs)}"]
        row += [f"{np.median(runs.figure('J')):.1f}", f"{runs.figure('J').max():.1f}"]
        if known:
            gaps = [gap(reference, e["J"]) for e in runs.evaluations]
            median = float(np.median([g.value for g in gaps]))
            row += [f"{100 * median:.2f}", percent(gaps[middle]), percent(gaps[worst])]
            wanted, least = TARGETS[algorithm]
            met = median >= wanted and (least is None or gaps[worst].value >= least)
            row.append("yes" if met else "no")
        else:
            row += [""] * 4
        row.append(f"{100 * runs.steadiness().max():.2f}")
        rows.append(row)
    header = (
        "case",
        "samples",
        "finished",
        "J, median",
        "J, worst",
        "gap closed %, median",
        "median run [95 %]",
        "worst run [95 %]",
        "target met",
        "late rise of J %",
    )
    text.append(table(header, rows))
    text.append(f"![learning](learning-{scenario.name}.png)\n")
    return "\n".join(text)


def papers_figures(
    found: dict[str, tuple[dict[str, dict[str, Array]], dict[str, Runs]]],
) -> str:
    """The paper's 21 % over naive and 15 % over tuned, beside ours."""
    rows = [["paper.tex, RTI Q-learning", "", "21", "15", "", ""]]
    for scenario, (reference, cases) in found.items():
        for name, runs in cases.items():
            order = np.argsort(runs.figure("J"))
            run = runs.evaluations[order[(len(order) - 1) // 2]]
            gains = [
                percent(
                    ratio(
                        reference[base][f][: len(run[f])] - run[f],
                        reference[base][f][: len(run[f])],
                    )
                )
                if base in reference
                else ""
                for f in ("J", "economic_cost")
                for base in ("naive", "tuned")
            ]
            rows.append([name, scenario, *gains])
    header = (
        "case (median run)",
        "scenario",
        "J over naive %",
        "J over tuned %",
        "economic cost over naive %",
        "economic cost over tuned %",
    )
    return "## The paper's own figures beside ours\n\n" + table(header, rows)


def converged_page(path: Path) -> str:
    """The entries of θ in which RTI and converged NMPC differ most (`converged.py`)."""
    with path.open(newline="") as stream:
        rows = [
            (row["entry"], float(row["rti"]), float(row["converged"]))
            for row in csv.DictReader(stream)
        ]
    one, other = np.array([row[1] for row in rows]), np.array([row[2] for row in rows])
    apart = np.linalg.norm(one - other) / np.linalg.norm(one)
    text = (
        "## RTI and converged NMPC learn different θ\n\n"
        "From the very same transitions and start, by the same fits (`converged.py`): changes "
        f"of θ in units of its scale. ‖difference‖ / ‖change under RTI‖ = {apart:.3f}; the ten "
        "entries that differ most:\n\n"
    )
    rows.sort(key=lambda row: -abs(row[1] - row[2]))
    return text + table(
        ("entry", "RTI", "converged"), [(e, f"{x:.4f}", f"{y:.4f}") for e, x, y in rows[:10]]
    )


def collect(
    arguments: argparse.Namespace,
) -> dict[str, tuple[dict[str, dict[str, Array]], dict[str, Runs]]]:
    """Baselines and runs of every scenario that has runs."""
    found = {}
    for name in ("paper", "fast-sampling"):
        cases = {case: Runs(arguments.runs / name / case) for case in CASES}
        cases = {case: runs for case, runs in cases.items() if len(runs)}
        if cases:
            found[name] = (baselines(arguments.out, Scenario.load(name)), cases)
    return found


def evaluation_rows(found: Any) -> Iterable[Sequence[Any]]:
    """Rows of evaluation.csv."""
    for scenario, (reference, cases) in found.items():
        sources: list[tuple[str, int | str, dict[str, Array]]] = [
            (name, "", figures) for name, figures in reference.items()
        ]
        for case, runs in cases.items():
            sources += [(case, s, e) for s, e in zip(runs.seeds, runs.evaluations, strict=True)]
        for name, seed, figures in sources:
            for row, noise in enumerate(figures["seed"]):
                yield (scenario, name, seed, int(noise), *(float(figures[f][row]) for f in FIGURES))


def run_rows(found: Any) -> Iterable[Sequence[Any]]:
    """Rows of runs.csv: one a training run."""
    for scenario, (reference, cases) in found.items():
        for case, runs in cases.items():
            for k, seed in enumerate(runs.seeds):
                cost, summary = runs.evaluations[k]["J"], runs.summaries[k]
                closed = gap(reference, cost).value if "optimal" in reference else ""
                yield (
                    scenario, case, seed, summary["samples"], summary["status"].split(":")[0],
                    float(cost.mean()), closed, float(runs.steadiness()[k]),
                    float(summary["smallest_eigenvalue"]), int(summary["training_failures"]),
                )  # fmt: skip


def curve_rows(found: Any) -> Iterable[Sequence[Any]]:
    """Rows of curves.csv: the greedy evaluations of each run."""
    for scenario, (_, cases) in found.items():
        for case, runs in cases.items():
            for seed, log in zip(runs.seeds, runs.logs, strict=True):
                for row in np.flatnonzero(~np.isnan(log["greedy_J"])):
                    figures = (float(log[name][row]) for name in ("greedy_J", "td_error"))
                    yield (scenario, case, seed, int(log["samples"][row]), *figures)


def main() -> None:
    """Write everything."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=Path, default=Path("results/learning/runs"))
    parser.add_argument("--out", type=Path, default=Path("results/learning"))
    arguments = parser.parse_args()
    found = collect(arguments)
    files: dict[str, tuple[Sequence[str], Callable[[Any], Iterable[Sequence[Any]]]]] = {
        "evaluation.csv": (
            ("scenario", "controller", "training_seed", "seed", *FIGURES),
            evaluation_rows,
        ),
        "runs.csv": (
            (
                "scenario", "case", "training_seed", "samples", "status", "J", "gap_closed",
                "late_rise", "smallest_eigenvalue", "failures",
            ),
            run_rows,
        ),
        "curves.csv": (
            ("scenario", "case", "training_seed", "samples", "greedy_J", "td_error"),
            curve_rows,
        ),
    }  # fmt: skip
    for name, (header, rows) in files.items():
        write_atomically(arguments.out / name, to_csv(header, rows(found)))
    text = [(Path(__file__).parent / "preface.md").read_text().format(seeds=SEEDS, steps=STEPS)]
    for name, (reference, cases) in found.items():
        text.append(scenario_page(Scenario.load(name), reference, cases))
    text.append(papers_figures(found))
    if (arguments.out / "converged.csv").exists():
        text.append(converged_page(arguments.out / "converged.csv"))
    write_atomically(arguments.out / "README.md", "\n".join(text))


if __name__ == "__main__":
    main()
