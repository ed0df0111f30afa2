"""README.md of the sweep, from the stored tables and preface.md.

python results/learning/tables.py
"""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from cases import CASES, NOISE_SEEDS, STEPS, TUNING_NOISE_SEEDS, TUNING_SEEDS
from stored import SCENARIOS, Run, Stored, load

from cosim.evaluation.statistics import Estimate, ratio, shown
from cosim.files import write_atomically

HERE = Path(__file__).parent
TARGETS = {  # median and worst share of the gap closed that the benchmark asks for
    "actor-critic": (0.995, 0.98),
    "batch-q-learning": (0.98, 0.95),
    "q-learning": (0.95, None),
}


def percent(estimate: Estimate) -> str:
    """Value and 95 % interval in percent."""
    return shown(estimate.value, estimate.t, 100.0)


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Markdown table."""
    rule = ["---", *["---:"] * (len(header) - 1)]
    return "\n".join("| " + " | ".join(row) + " |" for row in (header, rule, *rows)) + "\n"


def ranked(runs: list[Run]) -> list[Run]:
    """Runs from the best J to the worst."""
    return sorted(runs, key=lambda run: run.cost)


def middle(runs: list[Run]) -> Run:
    """The median run; the better of the two middle ones where their number is even."""
    return ranked(runs)[(len(runs) - 1) // 2]


def baselines(stored: Stored) -> str:
    """Table of the baselines of a scenario."""
    header = ("controller", "economic cost", "J", "mean violation", "violating %", "gap closed %")
    rows = []
    for name, found in stored.baselines.items():
        row = [name, *(f"{found[f].mean():.1f}" for f in ("economic_cost", "J"))]
        row.append(f"{found['mean_violation'].mean():.5f}")
        row.append(f"{100 * found['violating_share'].mean():.2f}")
        rows.append([*row, percent(stored.gap(found["J"]))])
    return table(header, rows)


def cases(stored: Stored) -> str:
    """Table of the learned controllers of a scenario."""
    rows = []
    for name, runs in stored.cases.items():
        gaps = [stored.gap(run.figures["J"]) for run in ranked(runs)]
        median = float(np.median([gap.value for gap in gaps]))
        wanted, least = TARGETS[CASES[name].algorithm]
        met = median >= wanted and (least is None or gaps[-1].value >= least)
        finished = sum(run.record["status"] == "finished" for run in runs)
        rows.append(
            [
                name,
                str(CASES[name].samples),
                f"{finished}/{len(runs)}",
                f"{np.median([run.cost for run in runs]):.1f}",
                f"{max(run.cost for run in runs):.1f}",
                f"{100 * median:.2f}",
                percent(gaps[(len(gaps) - 1) // 2]),
                percent(gaps[-1]),
                "yes" if met else "no",
                f"{100 * max(float(run.record['late_rise']) for run in runs):.2f}",
                ", ".join(dict.fromkeys(run.record["commit"] for run in runs)),
            ]
        )
    header = (
        "case", "samples", "finished", "J, median", "J, worst", "gap closed %, median",
        "median run [95 %]", "worst run [95 %]", "target met", "late rise of J %", "commit",
    )  # fmt: skip
    return table(header, rows)


def untouched(found: dict[str, Stored]) -> str:
    """Gap closed on the training and noise seeds that no hyperparameter was chosen on."""
    rows = []
    for scenario, stored in found.items():
        for name, runs in stored.cases.items():
            fresh = [run for run in runs if run.seed >= TUNING_SEEDS]
            if not fresh:
                continue
            naive, optimum = (
                stored.baselines[n]["J"][TUNING_NOISE_SEEDS:] for n in ("naive", "optimal")
            )
            gaps = [
                ratio(naive - run.figures["J"][TUNING_NOISE_SEEDS:], naive - optimum).value
                for run in fresh
            ]
            cells = (f"{100 * value:.2f}" for value in (np.median(gaps), min(gaps)))
            rows.append([name, scenario, str(len(fresh)), *cells])
    text = (
        f"## On untouched seeds\n\nTraining seeds from {TUNING_SEEDS} on, noise seeds from the "
        f"{TUNING_NOISE_SEEDS + 1}th on: nothing was chosen on these.\n\n"
    )
    header = ("case", "scenario", "runs", "gap closed %, median", "gap closed %, worst")
    return text + table(header, rows)


def papers_figures(found: dict[str, Stored]) -> str:
    """The paper's 21 % over naive and 15 % over tuned, beside ours."""
    rows = [["paper.tex, RTI Q-learning", "", "21", "15", "", ""]]
    for scenario, stored in found.items():
        for name, runs in stored.cases.items():
            run = middle(runs)
            gains = []
            for figure in ("J", "economic_cost"):
                for base in ("naive", "tuned"):
                    reference = stored.baselines[base][figure]
                    gains.append(percent(ratio(reference - run.figures[figure], reference)))
            rows.append([name, scenario, *gains])
    header = (
        "case (median run)", "scenario", "J over naive %", "J over tuned %",
        "economic cost over naive %", "economic cost over tuned %",
    )  # fmt: skip
    return "## The paper's own figures beside ours\n\n" + table(header, rows)


def converged(path: Path) -> str:
    """The entries of θ in which RTI and converged NMPC differ most (`converged.py`)."""
    with path.open(newline="", encoding="utf-8") as stream:
        rows = [
            (row["entry"], float(row["rti"]), float(row["converged"]))
            for row in csv.DictReader(stream)
        ]
    one, other = np.array([row[1] for row in rows]), np.array([row[2] for row in rows])
    apart = np.linalg.norm(one - other) / np.linalg.norm(one)
    text = (
        "## RTI and converged NMPC: the first two fits differ\n\n"
        "Two early fits on 150 transitions, not what learning converges to.\n\n"
        "From the very same transitions and start, by the same fits (`converged.py`): changes "
        f"of θ in units of its scale. ‖difference‖ / ‖change under RTI‖ = {apart:.3f}; the ten "
        "entries that differ most:\n\n"
    )
    rows.sort(key=lambda row: -abs(row[1] - row[2]))
    return text + table(
        ("entry", "RTI", "converged"), [(e, f"{x:.4f}", f"{y:.4f}") for e, x, y in rows[:10]]
    )


def main() -> None:
    """Write README.md."""
    found = {scenario: load(HERE, scenario) for scenario in SCENARIOS}
    preface = (HERE / "preface.md").read_text(encoding="utf-8")
    text = [preface.format(seeds=NOISE_SEEDS, steps=STEPS)]
    for scenario, stored in found.items():
        text += [f"## Scenario `{scenario}`\n", baselines(stored), cases(stored)]
        text.append(f"![learning](learning-{scenario}.png)\n")
    text += [untouched(found), papers_figures(found), converged(HERE / "converged.csv")]
    write_atomically(HERE / "README.md", "\n".join(text))


if __name__ == "__main__":
    main()
