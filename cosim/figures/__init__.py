"""Figures of runs and comparisons, drawn without a screen; the same data give the same bytes."""

from cosim.figures.style import palette, save
from cosim.figures.training import parameters_figure
from cosim.figures.trajectory import overlay_figure, trajectory_figure

__all__ = [
    "overlay_figure",
    "palette",
    "parameters_figure",
    "save",
    "trajectory_figure",
]
