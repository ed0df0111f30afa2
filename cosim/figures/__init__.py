"""Figures of runs and comparisons, drawn without a screen; the same data give the same bytes."""

from cosim.figures.curves import LearningCurve, plot_curves
from cosim.figures.density import plot_density
from cosim.figures.evaluation import Costs, evaluation_figure
from cosim.figures.phase import Portrait, plot_phase_portraits, policy_on_grid
from cosim.figures.regret import Dots, Profile, plot_profiles, plot_regret
from cosim.figures.style import palette, save
from cosim.figures.training import parameters_figure, training_figure
from cosim.figures.trajectory import episode_image, overlay_figure, trajectory_figure

__all__ = [
    "Costs",
    "Dots",
    "LearningCurve",
    "Portrait",
    "Profile",
    "episode_image",
    "evaluation_figure",
    "overlay_figure",
    "palette",
    "parameters_figure",
    "plot_curves",
    "plot_density",
    "plot_phase_portraits",
    "plot_profiles",
    "plot_regret",
    "policy_on_grid",
    "save",
    "training_figure",
    "trajectory_figure",
]
