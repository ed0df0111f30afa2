"""The results tables that README and docs show are those of the stored studies, row by row."""

import csv
import math
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
RULES = ("q-learning", "batch-q-learning", "actor-critic")

PAGES = {
    "fouled": "README.md",
    "paper": "README.md",
    "fast-sampling": "docs/benchmark.md",
    "mismatched": "docs/benchmark.md",
}
LABELS = {
    "optimal": "optimal: dynamic programming",
    "naive": "naive: baseline (a)",
    "tuned": "tuned (economic): baseline (b)",
    "backoff(start=naive)": "naive + back-off",
    "backoff(start=tuned)": "tuned + back-off",
    "offset-free": "tuned + offset-free + back-off",
    "identified": "identified model + tuned + back-off",
    "backoff-equal": "naive + back-off, 40 000",
    "offset-free-equal": "tuned + offset-free + back-off, 40 000",
    "identified-equal": "identified model + tuned + back-off, 40 000",
    "policy-search": "policy search (CMA-ES) from tuned",
    "q-learning(start=naive)": "**Q-learning** from naive",
    "q-learning(start=tuned)": "**Q-learning** from tuned",
    "batch-q-learning(start=naive)": "**batch Q-learning** from naive",
    "batch-q-learning(start=tuned)": "**batch Q-learning** from tuned",
    "actor-critic(start=naive)": "**actor-critic** from naive",
    "actor-critic(start=tuned)": "**actor-critic** from tuned",
    "printed(value_offset=discounted exploration=additive)": "as printed, c_λ from ℓ_s/(1−γ)",
    "printed(value_offset=discounted exploration=literal)": (
        "as printed, c_λ from ℓ_s/(1−γ), a = sat(e)"
    ),
    "printed(value_offset=stage-cost exploration=additive)": "as printed, c_λ from ℓ_s",
    "printed(value_offset=stage-cost exploration=literal)": (
        "as printed, c_λ from ℓ_s, a = sat(e)"
    ),
}


def summary(study: str) -> list[dict[str, str]]:
    """The rows of a stored study's summary."""
    with (ROOT / "results" / study / "summary.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def table(scenario: str) -> str:
    """The table of a scenario, best median regret first."""
    rows = [row for row in summary("learning") if row["scenario"] == scenario]
    rows.sort(key=lambda row: float(row["regret_median"]))
    lines = [
        f"| `{scenario}` | plant samples | J, median | regret %, median [95 %] | "
        "regret %, worst | finished |",
        "|---|---:|---:|---:|---:|---:|",
        *(line(row) for row in rows),
    ]
    return "\n".join(lines)


def line(row: dict[str, str]) -> str:
    """A row of the table; controllers have no samples, no worst run and no share that finished."""
    label, median = LABELS[row["case"]], float(row["J_median"])
    cost = f"{median:.1f}" if median < 1e5 else f"{median:.0f}"
    if row["case"] == "optimal":
        return f"| {label} | – | {cost} | 0.00 |  |  |"
    values = [float(row[f"regret_median{end}"]) for end in ("", "_low", "_high")]
    regret = f"{percent(values[0])} [{percent(values[1])}, {percent(values[2])}]"
    if int(row["samples"]) == 0:
        return f"| {label} | – | {cost} | {regret} |  |  |"
    samples = f"{int(row['plant_samples']):,}".replace(",", " ")
    worst, finished = percent(float(row["regret_worst"])), f"{row['finished']}/{row['runs']}"
    return f"| {label} | {samples} | {cost} | {regret} | {worst} | {finished} |"


def percent(share: float) -> str:
    """Per cent with three significant digits, two decimals at most."""
    if not math.isfinite(share):
        return "–"
    value = 100 * share
    digits = 2 if abs(value) < 10 else 1 if abs(value) < 100 else 0
    return f"{value:.{digits}f}".replace("-0.00", "0.00")


@pytest.mark.parametrize("scenario", PAGES)
def test_the_table_is_the_stored_one(scenario):
    expected = table(scenario)
    page = ROOT / PAGES[scenario]
    assert expected in page.read_text(), f"{page.name}'s table of {scenario} shall be\n{expected}"


def bounds_line(scenario: str) -> str:
    """What a long policy search reaches on a scenario, beside the rules' medians."""
    found = {
        (row["scenario"], row["case"]): float(row["regret_median"])
        for study in ("bounds", "learning")
        for row in summary(study)
    }
    searches = [
        percent(found[scenario, f"policy-search(parametrisation={kind})"])
        for kind in ("paper", "extended")
    ]
    medians = [
        [found[scenario, f"{rule}(start={start})"] for rule in RULES]
        for start in ("naive", "tuned")
    ]
    rules = [f"{percent(min(each))}–{percent(max(each))}" for each in medians]
    return f"| `{scenario}` | {' | '.join((*searches, *rules))} |"


@pytest.mark.parametrize("scenario", PAGES)
def test_the_bounds_are_the_stored_ones(scenario):
    expected = bounds_line(scenario)
    assert expected in (ROOT / "docs" / "benchmark.md").read_text(), expected


OUTSIDERS = {
    "mpcrl": "mpcrl: LSTD Q-learning on IPOPT | 3 000",
    "sac": "Stable-Baselines3: SAC | 30 000",
    "ppo": "Stable-Baselines3: PPO | 200 000",
}


@pytest.mark.parametrize("case", OUTSIDERS)
def test_an_outsiders_row_is_the_stored_one(case):
    (row,) = (row for row in summary("outsiders") if row["case"] == case)
    values = [percent(float(row[f"regret_median{end}"])) for end in ("", "_low", "_high")]
    cost = f"{float(row['J_median']):.1f}"
    expected = f"| {OUTSIDERS[case]} | {cost} | {values[0]} [{values[1]}, {values[2]}] |"
    assert expected in (ROOT / "docs" / "benchmark.md").read_text(), expected
