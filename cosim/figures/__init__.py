"""Figures of runs and comparisons, drawn without a screen; the same data give the same bytes."""

from cosim.figures.style import save
from cosim.figures.trajectory import plot_trajectory, trajectory_figure

__all__ = ["plot_trajectory", "save", "trajectory_figure"]
