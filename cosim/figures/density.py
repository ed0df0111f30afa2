"""Where a state lies with respect to its bound: the price of a back-off, in one picture."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cosim.figures.style import BOUND, figure, label, palette, plain, save
from cosim.penalty import VIOLATING

Array = NDArray[np.float64]


def plot_density(
    samples: Mapping[str, Array],
    bound: float,
    name: str,
    unit: str,
    path: str | Path,
    *,
    bins: int = 80,
) -> Path:
    """Draw each controller's density of one state, (K,) samples, against its lower bound.

    The bins are common and an edge lies on the bound, so that no bin mixes both sides; the axis
    leaves out the outermost 0.1 % of all samples. The legend gives the share that violates it.
    """
    everything = np.concatenate(list(samples.values()))
    low, high = np.quantile(everything, (0.001, 0.999))
    low, high = min(float(low), bound), max(float(high), bound)
    # Not narrower than the smallest sample can fill (Freedman and Diaconis' rule).
    width = max((high - low) / bins, *(_fitting_width(values) for values in samples.values()))
    width = width or 1e-3 * max(abs(bound), 1.0)
    edges = bound + width * np.arange(
        -np.ceil((bound - low) / width) - 1, np.ceil((high - bound) / width) + 2
    )
    with figure(2.9, 4.6) as drawn:
        axes = drawn.subplots()
        looks = palette(list(samples))
        for controller, values in samples.items():
            share = float(np.mean(bound - values > VIOLATING))
            counts, _ = np.histogram(values, edges)
            heights = counts / (len(values) * width)
            axes.stairs(heights, edges, fill=True, alpha=0.12, color=looks[controller].color)
            axes.stairs(
                heights,
                edges,
                color=looks[controller].color,
                linewidth=1.2,
                label=f"{plain(controller)}: {100 * share:.1f} % below",
            )
        axes.axvline(bound, color=BOUND, linewidth=1.1, linestyle=(0, (4, 2)), label="bound")
        axes.set_xlim(edges[0], edges[-1])
        axes.set_ylim(bottom=0.0)
        axes.set_xlabel(label(name, unit))
        inverse = f"1/({unit})" if "/" in unit else f"1/{unit}"
        axes.set_ylabel("density" if unit in ("", "1") else f"density [{inverse}]")
        axes.legend(
            loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2, borderaxespad=0.2,
            handlelength=1.4, alignment="left",
        )  # fmt: skip
    return save(drawn, path)


def _fitting_width(values: Array) -> float:
    lower, upper = np.quantile(values, (0.25, 0.75))
    return float(2.0 * (upper - lower) / np.cbrt(len(values)))
