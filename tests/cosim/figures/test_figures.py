"""Each figure draws what its data say; how it looks is for the eye."""

import matplotlib as mpl
import numpy as np
import pytest

from cosim import FmuPlant, Scenario, simulate
from cosim.figures.style import figure, save
from cosim.figures.training import training_figure
from cosim.figures.trajectory import overlay_figure, trajectory_figure
from tests.helpers.loop import Failing, Proportional


@pytest.fixture(scope="module")
def trajectory():
    paper = Scenario.load("paper")
    with FmuPlant(paper) as plant:
        return simulate(plant, Failing(paper, [5, 6]), 120, 0)


def axes_by_label(figure):
    return {axes.get_ylabel(): axes for axes in figure.axes}


def test_a_trajectory_shows_every_signal_with_its_unit(trajectory, paper):
    axes = axes_by_label(trajectory_figure(trajectory, paper))
    expected = {"$X_{2}$ [%]", "$P_{2}$ [kPa]", "$P_{100}$ [kPa]", "$F_{200}$ [kg/min]"}
    assert expected | {"$T_{1}$ [°C]", "stage cost", "penalty"} <= set(axes)
    state = axes["$X_{2}$ [%]"].lines[0]
    assert np.array_equal(state.get_ydata(), trajectory["X2"])
    assert np.allclose(state.get_xdata(), np.arange(120.0))


def test_a_trajectory_shows_the_bound_and_the_fallbacks(trajectory, paper):
    axes = axes_by_label(trajectory_figure(trajectory, paper))
    levels = [set(np.asarray(line.get_ydata())) for line in axes["$X_{2}$ [%]"].lines[1:]]
    assert {25.0} in levels
    marks = [line for line in axes["$P_{100}$ [kPa]"].lines if line.get_marker() == "x"]
    assert [list(line.get_xdata()) for line in marks] == [[5.0, 6.0]]


def test_an_overlay_shows_each_run_and_its_cost(trajectory):
    figure = overlay_figure({"naive": trajectory, "$mine": trajectory})
    axes = axes_by_label(figure)
    assert list(axes) == ["$X_{2}$ [%]", "$P_{2}$ [kPa]", "$P_{100}$ [kPa]", "$F_{200}$ [kg/min]"]
    for name, axis in zip(("X2", "P2", "P100", "F200"), axes.values(), strict=True):
        assert all(np.array_equal(line.get_ydata(), trajectory[name]) for line in axis.lines[:2])
    legend = [text.get_text() for text in figure.axes[0].get_legend().get_texts()]
    J = f"J = {trajectory.summary()['J']:.0f}"
    assert [J in text for text in legend] == [True, True, False]


@pytest.mark.slow
def test_a_trajectory_of_one_sample_draws(tmp_path, paper):
    with FmuPlant(paper) as plant:
        run = simulate(plant, Proportional(paper), 1, 0)
    assert save(trajectory_figure(run, paper), tmp_path / "a.png").stat().st_size > 10_000
    assert save(overlay_figure({"one": run}), tmp_path / "b.png").stat().st_size > 10_000


def drawing():
    with figure(2.0) as drawn:
        axes = drawn.subplots()
        axes.plot([0.0, 1.0], [1.0, 0.0], label="$x_1$")
        axes.legend()
    return drawn


@pytest.mark.parametrize("kind", ["png", "svg"])
def test_the_same_figure_gives_the_same_bytes(tmp_path, kind):
    one, two = (save(drawing(), tmp_path / f"{i}.{kind}").read_bytes() for i in range(2))
    assert one == two
    assert b"Date" not in one
    assert b"date" not in one


def test_the_users_settings_neither_matter_nor_change(tmp_path):
    plain = save(drawing(), tmp_path / "a.svg").read_bytes()
    with mpl.rc_context({"lines.linewidth": 9.0, "font.size": 20.0, "svg.hashsalt": "other"}):
        before = dict(mpl.rcParams)
        styled = save(drawing(), tmp_path / "b.svg").read_bytes()
        assert dict(mpl.rcParams) == before
    assert styled == plain


SAMPLES = np.array([0.0, 1000.0, 2000.0, 3000.0, 4000.0])
LOG = {
    "samples": SAMPLES,
    "J": np.array([np.nan, 300.0, 200.0, 150.0, 120.0]),
    "greedy_J": np.array([400.0, np.nan, 150.0, np.nan, 110.0]),
    "greedy_violating_share": np.array([0.7, np.nan, 0.5, np.nan, 0.1]),
    "td_error": np.array([np.nan, 9.0, 5.0, np.nan, 2.0]),
}
THETA = {
    name: size * np.ones((5, 2)) for size, name in enumerate(("x_l", "c_f", "b_l", "B_l", "x_u"))
}
BASELINES = {"naive": 200.0, "optimal": 100.0}


def panels(figure):
    # A title of several lines is one all the same.
    return {" ".join(axes.get_title(loc="left").split()): axes for axes in figure.axes}


def test_costs_are_shown_as_regret_where_the_optimum_is_known():
    axes = panels(training_figure(LOG, THETA, BASELINES, title="t"))[
        "regret %: cost above the least possible"
    ]
    training, greedy = axes.lines[:2]
    # Each is a mean since the row before, and drawn as long.
    assert training.get_drawstyle() == "steps-pre"
    assert np.allclose(training.get_xdata(), SAMPLES)
    assert np.allclose(training.get_ydata(), [200.0, 200.0, 100.0, 50.0, 20.0])
    assert np.allclose(greedy.get_xdata(), [0.0, 2000.0, 4000.0])
    assert np.allclose(greedy.get_ydata(), [300.0, 50.0, 10.0])
    assert [line.get_ydata()[0] for line in axes.lines[2:]] == pytest.approx([100.0, 0.0])
    assert {text.get_text() for text in axes.texts} == {"training", "greedy", "naive", "optimal"}
