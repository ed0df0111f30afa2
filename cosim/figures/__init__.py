"""Figures of runs and comparisons, drawn without a screen; the same data give the same bytes."""

from cosim.figures.density import plot_density
from cosim.figures.learning import plot_learning_curves, plot_parameters_and_td_error
from cosim.figures.overlay import overlay_figure, plot_overlay
from cosim.figures.pareto import plot_pareto
from cosim.figures.phase import Portrait, plot_phase_portraits, policy_on_grid
from cosim.figures.style import save
from cosim.figures.trajectory import plot_trajectory, trajectory_figure

__all__ = [
    "Portrait",
    "overlay_figure",
    "plot_density",
    "plot_learning_curves",
    "plot_overlay",
    "plot_parameters_and_td_error",
    "plot_pareto",
    "plot_phase_portraits",
    "plot_trajectory",
    "policy_on_grid",
    "save",
    "trajectory_figure",
]
