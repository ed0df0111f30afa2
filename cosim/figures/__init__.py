"""Figures of runs and comparisons, drawn without a screen; the same data give the same bytes."""
