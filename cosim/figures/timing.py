"""How long a step takes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.ticker import NullFormatter, ScalarFormatter
from numpy.typing import NDArray

from cosim.figures.style import colors, figure, legend_above, plain, save

Array = NDArray[np.float64]


def plot_step_times(times: Mapping[str, Array], path: str | Path, *, bins: int = 120) -> Path:
    """Draw histograms of wall-clock times (K,) in µs on a logarithmic axis.

    The legend gives median and 99 % quantile; the axis ends at the 99.9 % quantile of all, and
    the last bin holds what lies beyond.
    """
    everything = np.concatenate(list(times.values()))
    low, high = np.quantile(everything, (0.0, 0.999))
    edges = np.geomspace(0.95 * low, 1.05 * high, bins)
    with figure(2.7, 4.6) as drawn:
        axes = drawn.subplots()
        color = colors(list(times))
        for name, values in times.items():
            median, tail = np.quantile(values, (0.5, 0.99))
            counts, _ = np.histogram(np.minimum(values, edges[-1]), edges)
            share = 100 * counts / len(values)
            text = f"{plain(name)}: median {median:.0f} µs, 99 % {tail:.0f} µs"
            axes.stairs(share, edges, fill=True, alpha=0.12, color=color[name])
            axes.stairs(share, edges, color=color[name], linewidth=1.1, label=text)
            axes.axvline(median, color=color[name], linewidth=0.7, linestyle=(0, (1, 1)))
        axes.set_xscale("log")
        axes.xaxis.set_major_formatter(ScalarFormatter())
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.set_ylim(bottom=0.0)
        axes.set_xlabel("time per step [µs]")
        axes.set_ylabel("share of steps [%]")
        legend_above(axes, columns=1)
    return save(drawn, path)
