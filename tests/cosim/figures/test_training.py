"""The picture that a training leaves: what was measured is drawn, and named."""

import numpy as np
import pytest

from cosim.figures import save
from cosim.figures.training import training_figure

SAMPLES = np.array([1000.0, 2000.0, 3000.0, 4000.0])
UNKNOWN = np.full(4, np.nan)
LOG = {
    "samples": SAMPLES,
    "J": np.array([300.0, 200.0, 150.0, 120.0]),
    "greedy_J": np.array([np.nan, 150.0, np.nan, 110.0]),
    "greedy_violating_share": np.array([np.nan, 0.5, np.nan, 0.1]),
    "td_error": np.array([9.0, 5.0, np.nan, 2.0]),
}
THETA = {
    name: size * np.ones((4, 2)) for size, name in enumerate(("x_l", "c_f", "b_l", "B_l", "x_u"))
}
BASELINES = {"naive": 200.0, "optimal": 100.0}


def panels(figure):
    return {axes.get_title(loc="left"): axes for axes in figure.axes}


def test_costs_are_shown_as_regret_where_the_optimum_is_known():
    axes = panels(training_figure(LOG, THETA, BASELINES, title="t", start=400.0))["regret %"]
    training, greedy = axes.lines[:2]
    assert np.allclose(training.get_ydata(), [200.0, 100.0, 50.0, 20.0])
    assert np.allclose(greedy.get_xdata(), [0.0, 2000.0, 4000.0])
    assert np.allclose(greedy.get_ydata(), [300.0, 50.0, 10.0])
    assert [line.get_ydata()[0] for line in axes.lines[2:]] == pytest.approx([100.0, 0.0])
    assert {text.get_text() for text in axes.texts} == {"training", "greedy", "naive", "optimal"}


def test_what_was_not_measured_has_no_panel(tmp_path):
    log = LOG | {"td_error": UNKNOWN, "greedy_J": UNKNOWN, "greedy_violating_share": UNKNOWN}
    still = {"x_l": np.zeros((4, 2))}
    figure = training_figure(log, still, {}, title="$t")
    assert list(panels(figure)) == ["J per sample"]
    assert save(figure, tmp_path / "a.png").stat().st_size > 5000
