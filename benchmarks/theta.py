r"""Where the trainings of a study led θ: how far it went, and how far two cases are apart.

    cosim study run results/converged.toml --out converged
    python -m benchmarks.theta results/converged.toml converged "q(nmpc=rti)" "q(nmpc=converged)" \
        --entries "x_l[0]"

Distances are norms of entries in units of their learning scale, without the initial cost, on which
no action depends, medians over runs with the same training seed. The norm of the mean difference
stands beside its size by chance: were the expectation of each entry's difference zero. Differences
of `--entries` are means in the entry's own unit.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import pandas as pd

from cosim.core.result import markdown_table
from cosim.core.statistics import mean, shown
from cosim.studies.definition import Study
from cosim.studies.plan import StudyPlan, plan
from cosim.studies.results import StudyResults

LEFT_OUT = ("B_lambda", "b_lambda", "c_lambda")


def moves(
    planned: StudyPlan, out: Path, case: str
) -> tuple[dict[tuple[str, int], pd.DataFrame], dict]:
    """First and last θ of each run by scenario and training seed, and the scale of each entry."""
    found, scale = {}, {}
    for run in planned.runs:
        if run.case == case and run.training is not None:
            blocks = run.prepared().starting_parameters().blocks
            log = pd.read_csv(out / run.folder / "learning.csv").iloc[[0, -1]]
            theta = log[[f"theta {label}" for label in blocks.labels]]
            found[run.scenario.name, run.seed] = theta.set_axis(blocks.labels, axis=1)
            scale = dict(zip(blocks.labels, blocks.scale.tolist(), strict=True))
    return found, scale


def main() -> None:
    """Print a line for the two cases on each scenario."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("study", type=Path)
    parser.add_argument("folder", type=Path, help="its --out")
    parser.add_argument("cases", nargs=2)
    parser.add_argument("--entries", nargs="*", default=[])
    chosen = parser.parse_args()
    planned, results = plan(Study.load(chosen.study)), StudyResults.load(chosen.folder)
    (one, scale), (two, _) = (moves(planned, chosen.folder, case) for case in chosen.cases)
    counted = [label for label in scale if label.partition("[")[0] not in LEFT_OUT]
    units, rows = np.array([scale[label] for label in counted]), []
    for scenario in results.scenarios:
        keys = sorted(key for key in one.keys() & two.keys() if key[0] == scenario)
        if not keys:
            continue
        first, second = (
            np.array([each[key][counted] / units for key in keys]) for each in (one, two)
        )
        ways = [np.linalg.norm(case[:, 1] - case[:, 0], axis=1) for case in (first, second)]
        apart = second[:, 1] - first[:, 1]
        size = np.linalg.norm(apart, axis=1)
        cost = [results.of(case, scenario).set_index("training_seed").J for case in chosen.cases]
        chance = np.sqrt(apart.var(axis=0, ddof=1).sum() / len(keys)) if keys[1:] else np.nan
        numbers = (
            *(np.median(ways), np.median(size), np.median(2 * size / sum(ways))),
            *(np.linalg.norm(apart.mean(axis=0)), chance),
        )
        differences = [(cost[1] - cost[0]).dropna().to_numpy(float)]
        for name in chosen.entries:
            ends = [[each[key][name].iloc[-1] for key in keys] for each in (two, one)]
            differences.append(np.subtract(*ends))
        moved, *entries = (shown(*mean(each), 1, 3) for each in differences)
        texts = [f"{number:.3g}" for number in numbers]
        rows.append([scenario, str(len(keys)), moved, *texts, *entries])
    header = ("scenario", "seeds", "ΔJ [95 %]", "way", "‖Δθ‖", "of the way", "‖mean Δθ‖")
    entries = (f"Δ {name} [95 %]" for name in chosen.entries)
    print(markdown_table((*header, "by chance", *entries), rows))


if __name__ == "__main__":
    main()
