"""The report of a study: whole in one page, and it says what the tables say."""

import re
from dataclasses import replace

import pytest

from cosim.study.charts import draw, shortened
from cosim.study.formatting import HEADER, lines
from cosim.study.outcome import StudyOutcome
from cosim.study.report import write_report
from cosim.study.results import StudyResults
from cosim.study.summary import aggregate_rows, summary_rows
from tests.helpers.toy_trainer import study

CASES = [
    {"name": "grow", "algorithm": "grow", "samples": 2000, "settings": {"rate": [1.0, 9.0]}},
    {"name": "lost", "algorithm": "diverge", "samples": 2000, "group": "others"},
    {"controller": ["naive"]},
]


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    return study(case=CASES, scenarios=["paper", "fast-sampling"]).run(folder)


@pytest.fixture(scope="module")
def page(results):
    return write_report(results).read_text("utf-8")


def test_the_page_needs_nothing_else(page):
    sources = re.findall(r"(?:src|href)=['\"]([^'\"]+)", page)
    assert sources
    assert all(source.startswith(("data:image/svg+xml;base64,", "#")) for source in sources)
    assert "http" not in re.sub(r"data:[^'\"]+", "", page)


def test_the_page_holds_every_row_and_figure(results, page):
    for scenario in results.scenarios:
        assert f"Scenario {scenario}" in page
        for line in lines(results, scenario):
            assert "".join(f"<td>{cell}</td>" for cell in line) in page
        for figure in ("regret", "curves", "profile"):
            assert f"alt='{figure}-{scenario}" in page
    assert "10 of 10 runs" not in page
    assert f"{len(results.runs)} of {len(results.runs)} runs are finished" in page


@pytest.mark.slow
def test_the_report_repeats_its_bytes(results, page, tmp_path):
    again = write_report(StudyResults.load(results.folder), tmp_path).read_text("utf-8")
    assert again == page


def test_one_point_is_no_curve(results, tmp_path):
    runs = [
        replace(run, curve={name: values[-1:] for name, values in run.curve.items()})
        for run in results.runs
    ]
    drawn = draw(StudyResults(results.folder, results.about, runs), tmp_path)
    assert not any(name.startswith("curves") for name in drawn["paper"])
    assert not list((tmp_path / "figures").glob("curves*"))


def test_diverged_runs_are_counted_in_the_table(results):
    row = next(row for row in summary_rows(results, "paper") if row["case"] == "lost")
    assert (row["finished"], row["runs"]) == (0, 2)
    line = next(line for line in lines(results, "paper") if line[0] == "lost")
    assert line[HEADER.index("finished")] == "0/2"


def test_the_worst_is_of_all_runs_and_the_interval_encloses_the_middle(results):
    for row in summary_rows(results):
        regrets = [results.regrets[run.key] for run in results.of(row["case"], row["scenario"])]
        assert row["regret_worst"] == max(regrets)
        if len(regrets) > 1:
            assert row["regret_iqm_low"] <= row["regret_iqm"] <= row["regret_iqm_high"]
            assert row["regret_median"] == pytest.approx(sum(regrets) / 2, rel=1e-9)


def test_cases_are_compared_over_all_scenarios(results):
    found = {row["case"]: row for row in aggregate_rows(results)}
    assert found["grow(rate=9.0)"]["runs"] == 4
    assert found["best"]["regret_iqm"] == 0.0


def test_an_unfinished_study_is_reported_with_what_it_has(results, tmp_path):
    part = StudyOutcome(tmp_path, results.about | {"runs": 99}, results.runs[:3])
    assert part.report() == tmp_path / "report.html"
    text = (tmp_path / "report.html").read_text("utf-8")
    assert "3 of 99 runs are finished; 96 are missing here" in text


def test_a_start_is_told_from_the_baseline_of_its_name():
    cases = ["q(start=naive gain=0.1)", "q(start=tuned gain=0.1)"]
    assert list(shortened(cases).values()) == ["from naive gain=0.1", "from tuned gain=0.1"]


def test_an_outcome_has_its_tables(results):
    outcome = StudyOutcome(results.folder, results.about, results.runs)
    assert outcome.table("paper").splitlines()[0].startswith("| case |")
    assert len(outcome.table("paper").splitlines()) == 2 + len(lines(results, "paper"))
