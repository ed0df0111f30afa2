"""Figures of runs and comparisons, drawn without a screen; the same data give the same bytes."""

from cosim.figures.curves import LearningCurve, plot_curves
from cosim.figures.density import plot_density
from cosim.figures.learning import plot_parameters_and_td_error
from cosim.figures.overlay import overlay_figure, plot_overlay
from cosim.figures.pareto import plot_pareto
from cosim.figures.phase import Portrait, plot_phase_portraits, policy_on_grid
from cosim.figures.regret import Dots, Profile, plot_profiles, plot_regret
from cosim.figures.style import save
from cosim.figures.trajectory import plot_trajectory, trajectory_figure

__all__ = [
    "Dots",
    "LearningCurve",
    "Portrait",
    "Profile",
    "overlay_figure",
    "plot_curves",
    "plot_density",
    "plot_overlay",
    "plot_parameters_and_td_error",
    "plot_pareto",
    "plot_phase_portraits",
    "plot_profiles",
    "plot_regret",
    "plot_trajectory",
    "policy_on_grid",
    "save",
    "trajectory_figure",
]
