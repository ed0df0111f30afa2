"""The report of a study: whole in one page, and it says what the tables say."""

import re
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cosim.core.errors import StudyError
from cosim.studies.results import StudyResults
from cosim.studies.run import frame_csv
from cosim.studies.tables import RUN_KEYS
from tests.helpers.toy_study import GROW, run_toy

ROOT = Path(__file__).parents[3]
CASES = [
    {"name": "grow", "algorithm": GROW, "samples": 200, "settings": {"rate": [5.0, 45.0]}},
    {
        "name": "lost",
        "algorithm": GROW,
        "samples": 200,
        "settings": {"rate": -50.0},
        "group": "others",
    },
    {"controller": ["naive"]},
]


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    return run_toy(folder, case=CASES)


@pytest.fixture(scope="module")
def page(results):
    return results.report().read_text("utf-8")


def test_the_page_needs_nothing_else(page):
    sources = re.findall(r"(?:src|href)=['\"]([^'\"]+)", page)
    assert sources
    assert all(source.startswith(("data:image/svg+xml;base64,", "#")) for source in sources)
    assert "http" not in re.sub(r"data:[^'\"]+", "", page)


def test_the_page_holds_every_row_figure_and_definition(results, page):
    for scenario in results.scenarios:
        for line in results.lines(scenario)[1]:
            assert "".join(f"<td>{cell}</td>" for cell in line) in page
        for figure in ("curves", "regret"):
            assert f'alt="{figure}-{scenario}"' in page
    assert page.index("<dt>Regret</dt>") < page.index("<table>")
    assert "3 noise seeds × 30 samples" in page
    assert "2 other seeds × 20 samples" in page


def test_without_an_optimum_the_text_above_a_table_names_the_unit_of_differences(
    results, page, tmp_path
):
    note = "No J* is known: a difference is relative to |J'|"
    unknown = replace(results, folder=tmp_path, about={**results.about, "optimum": {}})
    unknown.report()
    assert note in (tmp_path / "report.md").read_text("utf-8")
    assert note not in (results.folder / "report.md").read_text("utf-8")


@pytest.mark.slow
def test_a_study_of_baselines_alone_draws_no_course_of_learning(tmp_path):
    baseline = {"name": "grow", "algorithm": GROW, "samples": 200, "group": "baselines"}
    found = run_toy(tmp_path, case=[baseline], training_seeds={"count": 1})
    assert found.figure("regret-paper").axes
    with pytest.raises(StudyError):
        found.figure("curves-paper")
    with pytest.raises(StudyError, match=r"no figure 'regret-papper'.*; there are regret-paper$"):
        found.figure("regret-papper")


@pytest.mark.slow
def test_the_report_repeats_its_bytes(results, page, tmp_path):
    again = StudyResults.load(results.folder)
    assert again.report().read_text("utf-8") == page


def test_tables_are_read_and_written_to_the_same_bytes(results):
    again = StudyResults.load(results.folder)
    for name in ("runs", "evaluation", "curves", "summary"):
        written = (results.folder / f"{name}.csv").read_text()
        assert frame_csv(getattr(again, name)) == written, name


def test_an_own_reader_finds_the_stored_summary():
    """Medians and worst runs of a stored study from its evaluation alone."""
    results = StudyResults.load(ROOT / "results" / "quick")
    cost = results.evaluation.groupby(RUN_KEYS, dropna=False).J.mean().reset_index()
    for row in results.summary.itertuples():
        own = cost[(cost.scenario == row.scenario) & (cost.case == row.case)].J
        best = cost[(cost.scenario == row.scenario) & (cost.case == "optimal")].J.item()
        assert row.J_median == pytest.approx(own.median(), rel=1e-12)
        assert row.regret_worst == pytest.approx(own.max() / best - 1, rel=1e-6, abs=1e-9)


def test_all_rules_are_in_one_panel_under_the_names_of_the_table(results):
    _, greedy = results.figure("curves-paper").axes
    named = {text.get_text() for text in greedy.texts}
    assert {"grow, rate 5.0", "grow, rate 45.0", "lost", "naive"} <= named
    curve = greedy.lines[0]
    own = results.curves[(results.curves.case == "grow(rate=5.0)")]
    own = own[own.scenario == "paper"].dropna(subset="greedy_J")
    levels = results.curves[results.curves.scenario == "paper"].set_index("case").greedy_J
    expected = 100 * (own.groupby("samples").greedy_J.median() / levels["optimal"] - 1)
    np.testing.assert_allclose(curve.get_xdata(), expected.index)
    np.testing.assert_allclose(curve.get_ydata(), expected, rtol=1e-9)


def test_diverged_runs_are_counted_in_the_table(results):
    row = results.summary.set_index(["scenario", "case"]).loc["paper", "lost"]
    assert (row.finished, row.runs) == (0, 2)
    _, lines = results.lines("paper", ["case", "finished"])
    assert ["lost", "0/2"] in lines


def test_the_worst_is_of_all_runs_and_the_interval_encloses_the_middle(results):
    for row in results.summary.itertuples():
        regrets = results.regrets(row.case, row.scenario)
        assert row.regret_worst == max(regrets)
        if len(regrets) > 1:
            assert row.regret_iqm_low <= row.regret_iqm <= row.regret_iqm_high
            assert row.regret_median == pytest.approx(sum(regrets) / 2, rel=1e-9)


def test_an_unfinished_study_is_reported_with_what_it_has(results, tmp_path, monkeypatch):
    monkeypatch.setattr(StudyResults, "draw", lambda self, folder: defaultdict(list))
    part = replace(
        results, folder=tmp_path, about=results.about | {"runs": 99}, state=results.state[:3]
    )
    assert "3 of 99 runs are finished; 96 are missing" in part.report().read_text("utf-8")
