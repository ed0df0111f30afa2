"""Each figure draws what its data say; how it looks is for the eye."""

import numpy as np
import pytest

from cosim import FmuPlant, Scenario, simulate
from cosim.figures import (
    overlay_figure,
    save,
    trajectory_figure,
)
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


def test_runs_side_by_side_have_the_same_axes(trajectory, paper):
    with FmuPlant(paper) as plant:
        other = simulate(plant, Proportional(paper), 120, 1)
    both = [
        axes_by_label(trajectory_figure(run, paper, beside=[trajectory, other]))
        for run in (trajectory, other)
    ]
    for name, axes in both[0].items():
        assert axes.get_ylim() == pytest.approx(both[1][name].get_ylim(), rel=1e-9), name


def test_a_trajectory_of_one_sample_draws(tmp_path, paper):
    with FmuPlant(paper) as plant:
        run = simulate(plant, Proportional(paper), 1, 0)
    assert save(trajectory_figure(run, paper), tmp_path / "a.png").stat().st_size > 10_000
    assert save(overlay_figure({"one": run}), tmp_path / "b.png").stat().st_size > 10_000
