"""Figures can be read: no text lies on another, and every line can be told from the others."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from controllers.factories import build_controller
from cosim import FmuPlant, Scenario, simulate
from cosim.figures.evaluation import evaluation_figure
from cosim.figures.style import SCREEN, WIDTH, DotRow, figure, palette, regret_axis
from cosim.figures.training import parameters_figure, training_figure
from cosim.figures.trajectory import overlay_figure, trajectory_figure
from cosim.studies.figures import draw_operation, regret_figure
from cosim.studies.results import StudyResults
from tests.helpers.figures import boxes, outside, overlaps

RESULTS = Path(__file__).parents[3] / "results"
WIDTHS = [SCREEN, WIDTH]


@pytest.fixture(scope="module")
def assay():
    return Scenario.load("assay")


@pytest.fixture(scope="module")
def run(assay):
    with FmuPlant(assay) as plant:
        return simulate(plant, build_controller("naive", assay), 200, 0)


@pytest.mark.parametrize("width", WIDTHS)
def test_the_texts_of_a_run_with_sensors_lie_apart(run, assay, width):
    drawn = trajectory_figure(run, assay, width=width)
    assert overlaps(drawn) == []
    assert outside(drawn) == []


@pytest.mark.parametrize("width", WIDTHS)
def test_no_label_of_a_run_lies_on_another_panel(run, assay, width):
    drawn = trajectory_figure(run, assay, width=width)
    boxes(drawn)
    for axes in drawn.axes:
        label = axes.yaxis.label.get_window_extent()
        assert not any(label.overlaps(panel.get_window_extent()) for panel in drawn.axes)


def test_every_line_of_a_run_with_sensors_is_named_once(run, assay):
    drawn = trajectory_figure(run, assay)
    legends = [axes.get_legend() for axes in drawn.axes if axes.get_legend()]
    names = [text.get_text() for legend in legends for text in legend.get_texts()]
    assert sorted(names) == ["estimated", "measured", "operating point"]


@pytest.mark.parametrize("width", WIDTHS)
def test_the_texts_of_an_overlay_lie_apart(run, width):
    assert overlaps(overlay_figure({"naive": run, "tuned": run}, width)) == []


SAMPLES = np.array([0.0, 1000.0, 1440.0])
LOG = {
    "samples": SAMPLES,
    "J": np.array([np.nan, 300.0, 200.0]),
    "greedy_J": np.array([400.0, np.nan, 110.0]),
    "greedy_violating_share": np.array([0.7, np.nan, 0.1]),
    "td_error": np.array([np.nan, 9.0, 5.0]),
}
THETA = {"x_l": np.outer(SAMPLES, [1.0, 2.0]), "c_f": np.outer(SAMPLES, [3.0, 1.0])}
BASELINES = {"naive": 500.0, "optimal": 100.0}


@pytest.mark.parametrize("columns", [2, 3, 4])
@pytest.mark.parametrize("width", WIDTHS)
def test_the_texts_of_a_training_lie_apart(columns, width):
    kept = ["samples", "J", "greedy_J", "greedy_violating_share", "td_error"][: columns + 1]
    log = {name: LOG[name] for name in kept}
    drawn = training_figure(log, THETA, BASELINES, title="a rule on a plant", width=width)
    assert overlaps(drawn) == []
    assert outside(drawn) == []


def test_a_training_of_one_row_is_a_line_over_its_samples():
    """Of one point there is no line, and its name would stand alone."""
    log = {"samples": np.array([0.0, 400.0]), "J": np.array([np.nan, 200.0])}
    axes = training_figure(log, {}, BASELINES, title="t").axes[0]
    (training,) = [line for line in axes.lines if line.get_drawstyle() == "steps-pre"]
    assert training.get_xdata().tolist() == [0.0, 400.0]
    assert training.get_ydata().tolist() == [100.0, 100.0]


def test_points_where_the_policy_was_judged_are_marked_and_joined_by_no_solid_line():
    for axes in training_figure(LOG, {}, BASELINES, title="t").axes[:2]:
        (judged,) = [line for line in axes.lines if line.get_marker() == "o"]
        assert judged.get_xdata().tolist() == [0.0, 1440.0]
        assert judged.get_linestyle() != "-"


@pytest.mark.parametrize("width", WIDTHS)
def test_the_texts_of_the_papers_figure_lie_apart(width):
    samples = np.linspace(0.0, 40_000.0, 50)
    blocks = {f"B_{name}": np.outer(samples, np.arange(1.0, 11.0)) for name in "abcdefghij"}
    drawn = parameters_figure(samples, blocks, samples, width=width)
    assert overlaps(drawn) == []
    assert outside(drawn) == []


# Axes of regrets

RANGES = [
    ([0.0, 0.28, 0.48], 0.1),
    ([0.0, 0.05], 0.1),
    ([0.03, 2000.0], 0.01),
    ([-0.013, 60.0], 0.01),
    ([-300.0, 5.0], 0.01),
    ([-0.05, 0.5], 0.1),
    ([2.0, 7.0], 0.01),
    ([3.0, 3.0], 0.01),
    ([110.0, 120.0], 0.01),
    ([0.0, 35.0], 1.0),
    ([0.0, 100.0], 0.1),
    ([-3.0, -2.0], 0.1),
]


@pytest.mark.parametrize(("values", "floor"), RANGES)
@pytest.mark.parametrize("which", ["x", "y"])
def test_ticks_of_regrets_bracket_them(values, floor, which):
    with figure(2.2, SCREEN) as drawn:
        axes = drawn.subplots()
        regret_axis(axes, which, np.array(values), floor)
    axis = axes.xaxis if which == "x" else axes.yaxis
    low, high = axis.get_view_interval()
    ticks = [tick for tick in axis.get_majorticklocs() if low <= tick <= high]
    assert ticks[0] <= min(values)
    assert max(values) <= ticks[-1]
    assert len(ticks) >= 2
    assert overlaps(drawn) == []


def test_regrets_that_differ_by_a_factor_of_five_have_ticks_between():
    costs = {}
    for name, level in {"before": 1.0048, "after": 1.0006}.items():
        values = level * np.array([6500.0, 6510.0, 6520.0])
        costs[name] = pd.DataFrame({"J": values, "violating_share": np.zeros(3)})
    drawn = evaluation_figure(costs, title="t", optimal=np.array([6500.0, 6510.0, 6520.0]))
    assert drawn.axes[0].get_xticks().tolist() == [0.0, 0.1, 0.2, 0.5]
    assert overlaps(drawn) == []


@pytest.mark.parametrize("width", WIDTHS)
def test_no_room_is_lost_between_the_axis_and_the_note(width):
    rows = []
    for case, value in {"mpcrl": 2.0, "naive": 300.0}.items():
        rows.append(DotRow(case, np.array([value]), np.array([True]), value, value, value))
    drawn = regret_figure(rows, palette(["mpcrl", "naive"]), width)
    places = {text: box for text, box in boxes(drawn) if len(text) > 20}
    (axis,) = [box for text, box in places.items() if text.startswith("regret %")]
    (note,) = [box for text, box in places.items() if text.startswith("Dots")]
    assert axis.y0 - note.y1 < axis.height


# Regret in operation


@pytest.fixture(scope="module", params=["operation-intercept", "operation-plants"])
def operation(request):
    return StudyResults.load(RESULTS / request.param)


@pytest.mark.slow
@pytest.mark.parametrize("width", WIDTHS)
def test_the_texts_of_a_figure_of_operation_lie_apart(operation, width):
    for scenario in operation.scenarios:
        drawn = draw_operation(operation, scenario, width)
        assert overlaps(drawn) == []
        assert outside(drawn) == []


@pytest.mark.slow
def test_every_line_of_operation_can_be_told_from_the_others():
    study = StudyResults.load(RESULTS / "operation-intercept")
    drawn = draw_operation(study, "fouled", SCREEN)
    for axes in drawn.axes:
        lines = [line for line in axes.lines if len(line.get_xdata()) == 3]
        assert len(lines) == 6
        assert len({(line.get_color(), line.get_marker()) for line in lines}) == 6


@pytest.mark.slow
def test_a_change_of_the_plant_is_marked_and_parts_the_lines():
    study = StudyResults.load(RESULTS / "operation-plants")
    greedy, whole = draw_operation(study, "jump", SCREEN).axes
    for axes in (greedy, whole):
        marked = {text.get_text(): text.xy[0] for text in axes.texts if "UA" in text.get_text()}
        assert marked == {"$UA_{2}$ = 5.2": 11_700, "$UA_{2}$ = 6.84": 26_400}
    (fixed,) = [line for line in greedy.lines if line.get_color() == "#999933"]
    before = np.searchsorted(fixed.get_xdata(), 11_700) - 1
    assert np.isnan(fixed.get_ydata()[before])
    for line in whole.lines:
        assert np.isfinite(np.asarray(line.get_ydata(), dtype=float)).all()


def test_an_evaluations_axis_reaches_the_upper_ends_of_its_intervals():
    """Of two seeds the interval is many times as wide as they lie apart."""
    J = np.array([6510.0, 6530.0])
    costs = {"a": pd.DataFrame({"J": J, "violating_share": np.array([0.0, 0.1])})}
    drawn = evaluation_figure(costs, title="t", optimal=np.array([6500.0, 6500.0]))
    for axes, middle, deviation in zip(drawn.axes, (0.3077, 5.0), (0.2176, 7.071), strict=True):
        upper = middle + 12.7062 * deviation / np.sqrt(2.0)
        assert axes.get_xticks()[-1] >= upper
