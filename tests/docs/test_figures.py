"""The figures that README and docs/ state are those of the stored tables."""

import csv
import re
import tomllib
from collections import defaultdict
from functools import cache
from statistics import fmean, median

import pytest

from cosim import Scenario
from tests.helpers.code_blocks import ROOT, pages
from tests.helpers.command import run_cosim

HOURS = {"8 h": 8, "1 day": 24, "1 week": 168, "4 weeks": 672, "25 days": 608}
WEEK = 10080
WRONG_MODEL = ("fouled", "mismatched")
MAIN = ("fouled", "mismatched", "paper")
README = " ".join((ROOT / "README.md").read_text().split())
MARKED = re.compile(r"<!-- (greedy|run|plants|summary|J) of (\S+) -->\n((?:\|.*\n)+)")


def rows(study, table):
    with (ROOT / "results" / study / f"{table}.csv").open(newline="") as stream:
        return list(csv.DictReader(stream))


@cache
def samples_of(scenario, time):
    """Samples of a scenario in a time, such as "1 week"."""
    return round(3600 * HOURS[time] / Scenario.load(scenario).sampling_time)


@cache
def regrets(study, kind="greedy"):
    """Regret in % of each run, by (scenario, case, samples): of its θ, or of all its samples."""
    costs = defaultdict(list)
    table = "greedy" if kind == "greedy" else "operation"
    for row in rows(study, table):
        key = row["scenario"], row["case"], int(row["samples"])
        costs[key, row["training_seed"]].append(float(row["J"]))
    result = defaultdict(list)
    known = {key for key, _ in costs}
    for (key, seed), values in costs.items():
        scenario, case, samples = key
        if case == "optimal" or (scenario, "optimal", samples) not in known:
            continue
        # Greedy runs share their noise; a run in operation has the noise of its training seed.
        optimum = costs[(scenario, "optimal", samples), "" if kind == "greedy" else seed]
        result[key].append(100 * (sum(values) / sum(optimum) - 1))
    return result


def after_a_week(study, case, scenarios):
    table = regrets(study)
    return [value for name in scenarios for value in table[name, case, WEEK]]


def test_the_headline_on_q_learning_is_stored():
    with_intercept = after_a_week("operation-intercept", "q-learning(start=naive)", WRONG_MODEL)
    without = after_a_week(
        "operation-intercept", "q-learning-without-intercept(start=naive)", WRONG_MODEL
    )
    assert len(with_intercept) == 20 and max(with_intercept) < 20
    assert "all 20 runs are below 20 % of regret" in README
    assert f"{sum(value < 1 for value in with_intercept)} below 1 %" in README
    assert f"{sum(value > 100 for value in without)} of 20 run away" in README
    month = regrets("operation-month")
    after_four_weeks = []
    for name in WRONG_MODEL:
        after_four_weeks += month[name, "q-learning-elsewhere(start=naive)", 4 * WEEK]
    high = [value for value in after_four_weeks if value > 10]
    assert len(high) == 3
    assert f"After four weeks three are at {min(high):.0f} to {max(high):.0f} %" in README
    week = regrets("operation-intercept", "run")["fouled", "q-learning(start=naive)", WEEK]
    assert f"{median(week):.0f} % of regret in the median" in README


def test_the_headline_on_the_model_based_rule_is_stored():
    values = [
        value
        for start in ("cautious", "naive")
        for value in after_a_week("operation-headline", f"model-based(start={start})", MAIN)
    ]
    assert len(values) == 60
    assert f"all 60 runs of `model-based` are within {max(values):.2f} % of the optimum" in README
    table = regrets("operation-headline", "run")
    cheaper = [
        learned < fixed
        for name in MAIN
        for learned, fixed in zip(
            table[name, "model-based(start=cautious)", WEEK],
            table[name, "fixed(start=cautious)", WEEK],
            strict=True,
        )
    ]
    assert all(cheaper) and f"in all {len(cheaper)} runs" in README
    others = after_a_week("operation-intercept", "q-learning(start=cautious)", MAIN)
    assert len(others) == 30
    assert f"those of Q-learning from `cautious` within {max(others):.2f} %" in README


def test_the_headline_on_cautious_control_is_stored():
    right = max(after_a_week("operation-headline", "fixed(start=cautious)", MAIN))
    assert f"`cautious` is already within {right:.2f} %" in README
    wrong = regrets("operation-gains")
    assert f"it has {median(wrong['holdup', 'fixed', WEEK]):.0f} %" in README
    assert f"comes to {median(wrong['holdup', 'model-based', WEEK]):.2f} %" in README


def test_the_counterexamples_to_cautious_control_are_stored():
    """Random plants by their tables; `dead-time` by the table of docs/reference/scenario.md."""
    random = regrets("operation-random")
    names = {name for name, *_ in random}
    regret = [fmean(random[n, "fixed-cautious", samples_of(n, "1 week")]) for n in names]
    assert len(regret) == 16 and sum(value > 10 for value in regret) == 4
    assert "more than 10 % on four of 16 random plants" in README
    results = (ROOT / "docs" / "results.md").read_text()
    assert "`fixed-cautious` has more than 10 % on four plants" in results
    page = (ROOT / "docs" / "reference" / "scenario.md").read_text()
    (row,) = re.findall(r"^\| `dead-time` \|.*$", page, re.MULTILINE)
    naive, *_, cautious = (float(cost) for cost in re.findall(r"\| ([\d.]+) \(", row))
    assert round(cautious / naive) == 5
    assert "On `dead-time` it costs five times as much as `naive`" in README


@pytest.mark.campaign
def test_the_demo_prints_the_table_of_readme(tmp_path):
    result = run_cosim("demo", "--out", "demo", folder=tmp_path)
    assert result.returncode == 0, result.stderr
    table = re.findall(r"^│.*│$", (ROOT / "README.md").read_text(), re.MULTILINE)
    assert len(table) == 6
    assert [line for line in table if line not in result.stdout] == []


def written(value):
    """The ways in which the pages write a figure."""
    return {f"{value:.{digits}f}" for digits in (0, 1, 2)}


def marked_tables():
    for page in pages():
        for kind, study, text in MARKED.findall(page.read_text()):
            head, _, *lines = [
                [cell.strip() for cell in line.strip("|\n ").split("|")]
                for line in text.splitlines()
            ]
            for line in lines:
                name = f"{page.name}-{study}-{line[0]}"
                yield pytest.param(kind, study, head, line, id=name)


def values_of(kind, study, case, column):
    """The values whose median and worst a cell states, in % but for J."""
    if kind == "summary":  # of the trained θ, on the study's own noise
        scenario = column.strip("`")
        return [
            100 * float(row["regret"])
            for row in rows(study, "runs")
            if (row["scenario"], row["case"]) == (scenario, case)
        ]
    if kind == "J":  # of the trained θ, where no optimum is known
        scenario = column.strip("`")
        return [
            float(row["J"])
            for row in rows(study, "runs")
            if (row["scenario"], row["case"]) == (scenario, case)
        ]
    if kind == "plants":  # a plant's value is the mean over its training seeds
        table = regrets(study)
        names = {name for name, *_ in table}
        return [fmean(table[name, case, samples_of(name, column)]) for name in names]
    scenario, time = re.fullmatch(r"`([^`]+)`, (.+)", column).groups()
    return regrets(study, kind)[scenario, case, samples_of(scenario, time)]


@pytest.mark.parametrize(("kind", "study", "head", "line"), list(marked_tables()))
def test_every_row_of_a_marked_table_is_stored(kind, study, head, line):
    """A column is headed "`scenario`, time"; a cell is "median" or "median (worst)"."""
    case = re.search(r"`([^`]+)`$", line[0])[1]
    for column, cell in zip(head[1:], line[1:], strict=True):
        values = values_of(kind, study, case, column)
        assert values, f"{study} has no {case}, {column}"
        middle, worst = re.fullmatch(r"([-\d.]+)(?: \(([-\d.]+)\))?", cell).groups()
        assert middle in written(median(values)), (column, cell, median(values))
        assert worst is None or worst in written(max(values)), (column, cell, max(values))


DIFFERENCES = re.compile(r"<!-- difference of (\S+) -->\n((?:\|.*\n)+)")


def test_the_differences_of_the_results_page_are_stored():
    page = (ROOT / "docs" / "results.md").read_text()
    compared = 0
    for study, table in DIFFERENCES.findall(page):
        stored = {(row["scenario"], row["case"]): row for row in rows(study, "summary")}
        header, _, *lines = (re.split(r" *\| *", line)[1:-1] for line in table.splitlines())
        for case, *cells in lines:
            for scenario, cell in zip(header[1:], cells, strict=True):
                row = stored[scenario.strip("`"), case.strip("`")]
                names = ("difference", "difference_low", "difference_high")
                value, low, high = (100 * float(row[name]) for name in names)
                assert row["against"] == "fixed"
                assert cell == f"{value:.3f} [{low:.3f}, {high:.3f}]", (scenario, case)
                compared += 1
    assert compared == 12


def tables_of(kind):
    """Study, header and lines of the tables of docs/results.md with a mark of this kind."""
    page = (ROOT / "docs" / "results.md").read_text()
    for study, table in re.findall(rf"<!-- {kind} of (\S+) -->\n((?:\|.*\n)+)", page):
        header, _, *lines = (re.split(r" *\| *", line)[1:-1] for line in table.splitlines())
        yield study, header, lines


def test_the_differences_from_the_rule_with_intercept_are_stored():
    ((study, header, lines),) = tables_of("counterpart")
    stored = {(row["scenario"], row["case"]): row for row in rows(study, "summary")}
    separated = set()
    for case, *cells in lines:
        for scenario, cell in zip(header[1:], cells, strict=True):
            row = stored[scenario.strip("`"), case.strip("`")]
            assert row["against"] == case.strip("`").replace("-without-intercept", "")
            names = ("difference", "difference_low", "difference_high")
            value, low, high = (100 * float(row[name]) for name in names)
            assert cell == f"{value:.2f} [{low:.2f}, {high:.2f}]", (scenario, case)
            if low > 0:
                separated.add((scenario, case))
    from_naive = {scenario for scenario, case in separated if "naive" in case}
    assert len(lines) == 2 and from_naive == {"`fouled`"}
    assert "is separated from zero on `fouled`, not on `mismatched`" in README


def test_the_numbers_of_weeks_that_cost_more_are_stored():
    ((study, header, lines),) = tables_of("higher")
    learned, fixed = regrets(study, "run"), regrets("operation-headline", "run")
    assert len(lines) == 2
    counts = [int(cell) for cell in lines[0][1:]]
    assert f"Q-learning's costs more in {sum(counts)} of {10 * len(counts)}" in README
    for case, *cells in lines:
        for scenario, cell in zip(header[1:], cells, strict=True):
            key = scenario.strip("`")
            costs = learned[key, case.strip("`"), WEEK]
            start = fixed[key, "fixed(start=cautious)", WEEK]
            assert int(cell) == sum(a > b for a, b in zip(costs, start, strict=True)), key


def test_the_runs_in_which_actor_critic_costs_less_are_stored():
    table = regrets("operation-policy-gradient", "run")
    counts = []
    for name in MAIN:
        learned = table[name, "actor-critic(start=cautious)", WEEK]
        fixed = table[name, "fixed(start=cautious)", WEEK]
        counts.append(sum(a < b for a, b in zip(learned, fixed, strict=True)))
    page = (ROOT / "docs" / "rules" / "actor-critic.md").read_text()
    first, second, third = counts
    assert f"It costs less in {first}, {second} and {third} of 10 runs" in page


def test_the_readings_of_the_printed_rule_are_stored():
    ((study, _, lines),) = tables_of("finished")
    stored = {row["case"]: row for row in rows(study, "summary") if row["scenario"] == "paper"}
    named = set()
    for name, finished, cost in lines:
        case = re.search(r"`([^`]+)`$", name)[1]
        named.add(case)
        assert (stored[case]["finished"], stored[case]["runs"]) == (finished, "10")
        assert f"{float(stored[case]['J_median']):.0f}" == cost
    assert named == {name for name in stored if name.startswith("printed")}
    page = (ROOT / "docs" / "results.md").read_text()
    best = stored[re.search(r"`([^`]+)`$", lines[0][0])[1]]
    for name, baseline in (("naive θ (a)", "naive"), ("tuned θ (b)", "tuned")):
        gain = 1 - float(best["J_median"]) / float(stored[baseline]["J_median"])
        assert re.search(rf"gain over the {re.escape(name)} \| {100 * gain:.1f} %", page)


def test_the_results_page_names_each_study_that_has_less_noise_than_its_file_says():
    page = (ROOT / "docs" / "results.md").read_text()
    _, _, rest = page.partition("Stored with one to six seeds, fewer than their files say now: ")
    named = set(re.findall(r"`(operation-[\w-]+)`", rest.partition(". ")[0]))
    found = set()
    for file in (ROOT / "results").glob("operation-*.toml"):
        if not (file.with_suffix("") / "greedy.csv").is_file():
            continue
        wanted = tomllib.loads(file.read_text())["evaluation"]["seeds"]
        if any(
            len({row["seed"] for row in rows(file.stem, table)}) < wanted
            for table in ("evaluation", "greedy")
        ):
            found.add(file.stem)
    assert named == found


def test_the_counts_of_random_plants_are_stored():
    page = (ROOT / "docs" / "results.md").read_text()
    ((study, table),) = re.findall(r"<!-- counts of (\S+) -->\n((?:\|.*\n)+)", page)
    stored = rows(study, "summary")
    start = {row["scenario"]: float(row["J_median"]) for row in stored if row["case"] == "fixed"}
    _, _, *lines = (re.split(r" *\| *", line)[1:-1] for line in table.splitlines())
    for case, *cells in lines:
        of_case = [row for row in stored if row["case"] == case.strip("`")]
        assert len(of_case) == len(start) == 16
        differences = [100 * float(row["difference"]) for row in of_case]
        worst = [100 * (float(row["J_worst"]) / start[row["scenario"]] - 1) for row in of_case]
        expected = [
            sum(float(row["difference_high"]) < 0 for row in of_case),
            sum(float(row["difference_low"]) > 0 for row in of_case),
            f"{median(differences):.2f}",
            f"{max(differences):.2f}",
            f"{max(worst):.2f}",
        ]
        assert cells == list(map(str, expected))
