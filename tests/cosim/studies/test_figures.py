"""Figures of a study from made-up numbers: what is drawn is what was given."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from cosim import FmuPlant, Scenario, simulate
from cosim.figures.states import density_figure
from cosim.figures.style import lighten, palette, shown_case
from cosim.studies.definition import Study
from cosim.studies.figures import LearningCurve, curves_figure, learning_curve
from cosim.studies.kept import increments
from cosim.studies.plan import plan
from cosim.studies.results import StudyResults
from cosim.studies.tables import document
from tests.helpers.loop import Proportional

RESULTS = Path(__file__).parents[3] / "results"


@pytest.fixture(scope="module")
def runs():
    paper = Scenario.load("paper")
    with FmuPlant(paper) as plant:
        one = simulate(plant, Proportional(paper), 300, 0)
        return {"naive": one, "$mine": simulate(plant, Proportional(paper), 300, 1)}


def test_a_densitys_bins_part_at_the_bound(runs, paper):
    (axes,) = density_figure(runs, paper).axes
    for stairs, run in zip(axes.patches[1::2], runs.values(), strict=True):
        values = run["X2"]
        heights, edges, _ = stairs.get_data()
        assert np.abs(edges - 25.0).min() < 1e-12
        below = float(np.sum(heights * np.diff(edges) * (edges[1:] <= 25.0 + 1e-9)))
        shown = (values >= edges[0]) & (values <= edges[-1])
        assert below == pytest.approx(np.mean((values < 25.0) & shown), abs=1e-12)
        assert float(np.sum(heights * np.diff(edges))) == pytest.approx(np.mean(shown), abs=1e-12)


def test_a_curve_averages_training_since_the_point_before_and_holds_diverged_runs():
    nan = float("nan")
    log = pd.DataFrame(
        [
            (0, 500, 4.0, nan), (0, 1000, 2.0, 9.0), (0, 1500, nan, nan), (0, 2000, 6.0, 8.0),
            (1, 500, 8.0, nan), (1, 1000, 6.0, 5.0), (1, 1500, 7.0, nan),
        ],
        columns=["training_seed", "samples", "J", "greedy_J"],
    )  # fmt: skip
    curve = learning_curve(log, None)
    assert curve.samples.tolist() == [1000, 2000]
    assert curve.training.tolist() == [[3.0, 6.0], [7.0, 7.0]]
    assert curve.greedy.tolist() == [[9.0, 8.0], [5.0, 5.0]]
    assert learning_curve(log, 4.0).greedy[0].tolist() == [125.0, 100.0]


def test_a_dark_ground_hides_no_controller():
    styles = palette(["naive", "q-learning", "optimal", "dyna"]).values()
    assert [lighten(look.color) for look in styles] == ["#7f7f7f", "#0072B2", "#c8c8c8", "#523ace"]


def test_one_controller_has_one_colour_on_all_scenarios():
    styles = palette(["two-fouled", "two-jump", "q"], ["fouled", "jump"])
    assert len({look.color for look in styles.values()}) == 2


def test_increments_are_of_each_block_since_its_first_row():
    log = pd.DataFrame({"samples": [0, 1], "theta b[0]": [1.0, 3.0], "theta b[1]": [2.0, 2.0]})
    assert increments(log)["b"].tolist() == [[0.0, 0.0], [2.0, 0.0]]


def test_a_cases_settings_are_set_after_its_name():
    assert shown_case("q(start=naive prior_width=0.3)") == "q, naive, prior width 0.3"
    assert shown_case("both(naive)") == "both(naive)"


def test_many_curves_have_a_panel_for_each_start():
    values = np.array([[3.0, 2.0]])
    one = LearningCurve(np.array([100.0, 200.0]), values, values)
    cases = [f"{rule}(start={start})" for start in ("naive", "tuned") for rule in "abcd"]
    axes = curves_figure(dict.fromkeys(cases, one), {}, palette(cases), relative=True).axes
    assert [panel.get_title() for panel in axes] == ["from naive", "from tuned", "", ""]
    assert all(len(panel.lines) == 4 for panel in axes)
    plain = {name.replace("start", "mine"): one for name in cases}
    first, _ = curves_figure(plain, {}, palette([*plain]), relative=True).axes
    assert len(first.texts) == len(cases)


def test_a_stored_study_says_when_its_plant_changes():
    """As its file does, from which the figure of operation marks it."""
    stored = StudyResults.load(RESULTS / "operation-plants")
    said = document(plan(Study.load(RESULTS / "operation-plants.toml")))["operation"]
    assert stored.about["operation"] == said
    layout = stored.operation_layout("jump")
    assert layout.changes == {11_700: {"UA2": 5.2}, 26_400: {"UA2": 6.84}}
    assert stored.operation_layout("drifting").changes == {}


def test_variants_of_a_rule_have_markers_and_a_lone_rule_has_none():
    styles = palette(["q(start=naive)", "q(start=tuned)", "dyna"])
    assert styles["q(start=naive)"].marker != styles["q(start=tuned)"].marker
    assert styles["dyna"].marker == ""
