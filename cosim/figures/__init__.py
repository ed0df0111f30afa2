"""Figures of runs and comparisons, drawn without a screen; the same data give the same bytes."""

from cosim.figures.evaluation import evaluation_figure
from cosim.figures.style import palette, save
from cosim.figures.training import parameters_figure, training_figure
from cosim.figures.trajectory import episode_image, overlay_figure, trajectory_figure

__all__ = [
    "episode_image",
    "evaluation_figure",
    "overlay_figure",
    "palette",
    "parameters_figure",
    "save",
    "training_figure",
    "trajectory_figure",
]
